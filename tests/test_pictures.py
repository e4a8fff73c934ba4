"""The kinds of pictures: what each is made of, and colours that can be told by hand."""

import pytest
import torch
from torch import Tensor

from tests.surface.shapes import ball
from torch_surfcap.data.cameras import Cameras
from torch_surfcap.pictures import KINDS, Subject, depth_colors, pooled
from torch_surfcap.report import error_mesh
from torch_surfcap.surface.render import mesh_normals, raster, shaded, volume
from torch_surfcap.surface.turntable import turntable

UP = torch.tensor([0.0, 0, 1])


@pytest.fixture(scope="module")
def subject() -> Subject:
    field = ball()
    mesh = field.extract_mesh()
    return Subject(field, mesh, error_mesh(mesh, mesh.vertices[:, 2] * 0 + 1.0, 1.0))


@pytest.fixture(scope="module")
def cameras(subject: Subject) -> Cameras:
    return turntable(subject.mesh, UP, 3, 20.0, size=40)


def test_every_kind(subject: Subject, cameras: Cameras) -> None:
    shown = subject.pictures(list(KINDS), cameras, 1, subject.depth_range(cameras))
    assert list(shown) == list(KINDS)
    width, height = cameras.size[1].tolist()
    for kind, picture in shown.items():
        assert picture.shape == (height, width, 3), kind
        assert picture[0, 0].tolist() == [1, 1, 1], kind
        assert picture[height // 2, width // 2].tolist() != [1, 1, 1], kind
    field, mesh = subject.field, subject.mesh
    expected: dict[str, Tensor] = {
        "volume": volume(field, cameras, 1, 1.0),
        "raster": raster(field, mesh, cameras, 1, 1.0),
        "shaded": shaded(mesh, cameras, 1),
        "normals": mesh_normals(mesh, cameras, 1),
        "constant": shown["raster"],  # a field of degree 0 is its constant part
    }
    for kind, picture in expected.items():
        torch.testing.assert_close(shown[kind], picture)
    # Dark red where the distance reaches the end of the colours.
    red, green, blue = shown["error"][height // 2, width // 2]
    assert red > 0.35 > 0.1 > max(green, blue)


def test_samples_are_averaged(subject: Subject, cameras: Cameras) -> None:
    coarse, fine = (subject.pictures(["shaded", "volume"], cameras, 0, (0, 1), samples) for samples in (1, 3))
    assert coarse["shaded"].shape == fine["shaded"].shape
    assert torch.equal(coarse["volume"], fine["volume"])
    # Outlines turn from white or not to something between; the whole stays as bright.
    steps = ((coarse["shaded"] > 0.86) & (coarse["shaded"] < 0.999)).sum()
    soft = ((fine["shaded"] > 0.86) & (fine["shaded"] < 0.999)).sum()
    assert steps == 0
    assert soft > 20
    torch.testing.assert_close(coarse["shaded"].mean(), fine["shaded"].mean(), atol=5e-3, rtol=0)


def test_pooled_by_hand() -> None:
    picture = torch.arange(16.0).reshape(4, 4, 1).expand(-1, -1, 3)
    assert pooled(picture, 2)[:, :, 0].tolist() == [[2.5, 4.5], [10.5, 12.5]]


def test_depth_colors() -> None:
    near, middle, far, nothing = depth_colors(torch.tensor([[1.0, 2.0, 3.0, torch.nan]]), 1.0, 3.0)[0]
    assert near.argmax() == 0
    assert middle.argmax() == 1
    assert far.argmax() == 2
    assert nothing.tolist() == [1, 1, 1]
    assert torch.equal(depth_colors(torch.tensor([[0.5, 9.0]]), 1.0, 3.0)[0], torch.stack([near, far]))


def test_what_cannot_be_shown_is_refused(subject: Subject, cameras: Cameras) -> None:
    for kind in ("photograph", "error"):
        with pytest.raises(ValueError, match=f"picture of kind '{kind}'"):
            Subject(subject.field, subject.mesh).pictures([kind], cameras, 0, (0, 1))
