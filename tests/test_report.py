"""torch_surfcap.report: what is compared, and files that are complete or absent."""

import csv
import json
import math
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
import trimesh

from tests.surface.shapes import CENTER, ball, half_of
from torch_surfcap import report
from torch_surfcap.data.capture import Capture
from torch_surfcap.field.field import SurfaceField
from torch_surfcap.metrics import psnr
from torch_surfcap.surface.extract import extract_mesh
from torch_surfcap.surface.render import mesh_mask, raster, volume

WIDTH, HEIGHT = 40, 32


@pytest.fixture(scope="module")
def field() -> SurfaceField:
    return ball()


@pytest.fixture(scope="module")
def mesh(field: SurfaceField) -> trimesh.Trimesh:
    return extract_mesh(field)


def capture_of(field: SurfaceField, mesh: trimesh.Trimesh, plates: bool) -> Capture:
    """Two views of the field as it renders itself: over plates, or black around the mask."""
    K = torch.tensor([[60.0, 0, WIDTH / 2], [0, 60, HEIGHT / 2], [0, 0, 1]], dtype=torch.float64)
    poses = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
    poses[:, :3, 3] = torch.tensor([[0.0, 0, 2], [0.1, 0, 2]]) - torch.from_numpy(CENTER)
    blank = Capture(torch.zeros(2, HEIGHT, WIDTH, 3), K, poses)
    rooms = torch.rand(2, HEIGHT, WIDTH, 3, generator=torch.Generator().manual_seed(0))
    masks = torch.stack([mesh_mask(mesh, blank.cameras, i) for i in range(2)])
    images = torch.stack([volume(field, blank.cameras, i, rooms[i]) for i in range(2)])
    if plates:
        return Capture(images, K, poses, masks=masks, plates=rooms)
    return Capture(images * masks[..., None], K, poses, masks=masks)


def test_views_are_spread() -> None:
    assert report.some_views(10, 4) == [0, 3, 6, 9]
    assert report.some_views(2, 8) == [0, 1]
    assert report.some_views(0, 8) == []


def test_masked_photograph_is_composited(field: SurfaceField, mesh: trimesh.Trimesh) -> None:
    capture = capture_of(field, mesh, plates=False)
    assert capture.masks is not None
    capture.masks[0] = 0.5 * capture.masks[0]
    half = 0.5 * capture.photograph(0) + 0.5
    shown = report.scene_photograph(capture, 0)
    inside = capture.masks[0] > 0
    torch.testing.assert_close(shown[inside], half[inside])
    assert (shown[~inside] == 1).all()
    grey = report.scene_photograph(capture, 0, [0.2, 0.3, 0.4])
    torch.testing.assert_close(grey[0, 0], torch.tensor([0.2, 0.3, 0.4]))


def test_scores_over_plates(field: SurfaceField, mesh: trimesh.Trimesh) -> None:
    capture = capture_of(field, mesh, plates=True)
    scores = report.score_views(field, mesh, capture)
    # The pictures are the field's own, up to the 32-bit float they are kept in.
    assert scores["psnr_volume"] > 100
    assert scores["psnr_masked"] > 100
    assert scores["ssim"] == pytest.approx(1.0, abs=1e-4)
    assert scores["silhouette_iou"] == 1.0
    assert scores["views"] == 2
    onto = [raster(field, mesh, capture.cameras, i, capture.plate(i)) for i in range(2)]
    expected = np.mean([psnr(onto[i], capture.photograph(i)) for i in range(2)])
    assert scores["psnr_raster"] == pytest.approx(expected)


def test_scores_are_means_over_the_views_asked_for(field: SurfaceField, mesh: trimesh.Trimesh) -> None:
    capture = capture_of(field, mesh, plates=False)
    each = [report.score_view(field, mesh, capture, i) for i in range(2)]
    both = report.score_views(field, mesh, capture)
    for name, value in each[0].items():
        assert both[name] == pytest.approx((value + each[1][name]) / 2)
    assert report.score_views(field, mesh, capture, [1]) == {**each[1], "views": 1}
    assert report.score_views(field, mesh, capture, []) == {"views": 0}


def test_means_leave_out_what_is_no_number() -> None:
    assert report.mean_scores([{"psnr": 20.0}, {"psnr": math.nan}]) == {"psnr": 20.0, "views": 2}


def test_preview(field: SurfaceField, mesh: trimesh.Trimesh, tmp_path: Path) -> None:
    capture = capture_of(field, mesh, plates=True)
    report.write_preview(tmp_path / "preview.png", field, mesh, capture)
    picture = cv2.imread(str(tmp_path / "preview.png"))
    assert picture is not None
    assert picture.shape == (24 + 2 * HEIGHT, 4 * WIDTH, 3)
    photograph = np.rint(255 * capture.photograph(0).numpy())[:, :, ::-1]
    assert np.abs(picture[24 : 24 + HEIGHT, :WIDTH] - photograph).max() <= 1
    assert [p.name for p in tmp_path.iterdir()] == ["preview.png"]


def test_history(tmp_path: Path) -> None:
    report.write_history(
        tmp_path / "history.csv", [{"level": 0, "loss": 0.5}, {"level": 1, "loss": 0.25, "tv": 3}]
    )
    with (tmp_path / "history.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert rows == [{"level": "0", "loss": "0.5", "tv": ""}, {"level": "1", "loss": "0.25", "tv": "3"}]


def test_json_without_nan(tmp_path: Path) -> None:
    values = {
        "a": np.float32(0.5),
        "b": math.nan,
        "c": [torch.tensor(3), math.inf],
        "d": {"e": None, "f": True},
    }
    report.write_json(tmp_path / "metrics.json", values)
    found = json.loads((tmp_path / "metrics.json").read_text())
    assert found == {"a": 0.5, "b": None, "c": [3, None], "d": {"e": None, "f": True}}


def test_a_failed_write_leaves_the_old_file(tmp_path: Path) -> None:
    report.write_json(tmp_path / "metrics.json", {"a": 1})
    with pytest.raises(TypeError):
        report.write_json(tmp_path / "metrics.json", {"a": object()})
    assert json.loads((tmp_path / "metrics.json").read_text()) == {"a": 1}
    assert len(list(tmp_path.iterdir())) == 1


def test_error_mesh_and_picture(field: SurfaceField, mesh: trimesh.Trimesh, tmp_path: Path) -> None:
    distance = np.linspace(0, 0.02, len(mesh.vertices))
    distance[-1] = np.inf
    painted = report.error_mesh(mesh, distance, 0.01)
    assert isinstance(painted.visual, trimesh.visual.ColorVisuals)
    colors = np.asarray(painted.visual.vertex_colors)
    assert (colors[0, :3] >= 240).all()
    assert (colors[-2] == colors[-10]).all()  # both beyond the scale's end
    assert (colors[-1] == report.BEYOND).all()
    report.write_mesh(tmp_path / "error.ply", painted)
    report.write_errors(tmp_path / "error.png", painted, capture_of(field, mesh, False).cameras, [0, 1], 0.01)
    again = trimesh.load(tmp_path / "error.ply", force="mesh", process=False)
    assert isinstance(again, trimesh.Trimesh)
    assert isinstance(again.visual, trimesh.visual.ColorVisuals)
    assert (np.asarray(again.visual.vertex_colors) == colors).all()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["error.ply", "error.png"]


def test_depth_in_16_bits(field: SurfaceField, mesh: trimesh.Trimesh, tmp_path: Path) -> None:
    cameras = capture_of(field, mesh, False).cameras
    # 7 / 65535 = 1.07e-4: the next power of ten is 1e-3.
    depth = torch.tensor([[7.0, 1.2344], [torch.nan, 0.0012]])
    report.write_depth(tmp_path / "depth.png", depth, cameras, 1)
    found = cv2.imread(str(tmp_path / "depth.png"), cv2.IMREAD_UNCHANGED)
    assert found is not None
    assert found.dtype == np.uint16
    assert found.tolist() == [[7000, 1234], [0, 1]]
    beside = json.loads((tmp_path / "depth.json").read_text())
    assert beside["depth_unit"] == 1e-3
    assert beside["K"] == cameras.K[1].tolist()
    assert beside["world_to_camera"] == cameras.world_to_camera[1].tolist()
    assert beside["size"] == [WIDTH, HEIGHT]
    report.write_depth(tmp_path / "depth.png", torch.full((2, 2), torch.nan), cameras, 1)
    assert np.count_nonzero(np.asarray(cv2.imread(str(tmp_path / "depth.png"), cv2.IMREAD_UNCHANGED))) == 0


def test_errors_against_the_truth(mesh: trimesh.Trimesh) -> None:
    # The truth is the upper half alone: green below, nearly white above.
    painted, top = report.errors_of(mesh, half_of(mesh, 2), 0.05)
    assert top == pytest.approx(0.05 * report.ERROR_SCALE)
    assert isinstance(painted.visual, trimesh.visual.ColorVisuals)
    colors, height = np.asarray(painted.visual.vertex_colors), mesh.vertices[:, 2] - CENTER[2]
    assert (colors[height > 0.02, :3] >= 240).all()
    assert (colors[height < -0.08] == report.BEYOND).all()
