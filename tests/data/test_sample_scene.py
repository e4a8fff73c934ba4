"""The sample scene: a closed known surface, seen where its cameras say, written once."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from torch_surfcap.data.capture import load_capture
from torch_surfcap.data.plates import separate
from torch_surfcap.data.sample_scene import Coat, main, make_sample_scene
from torch_surfcap.errors import InputError


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_sample_scene(tmp_path_factory.mktemp("sample"), views=3, test_views=1, size=192)


def test_the_capture_is_complete(folder: Path) -> None:
    capture = load_capture(folder)
    assert len(capture) == 3
    assert capture.test is not None
    assert len(capture.test) == 1
    assert capture.mask_source == "file"
    assert capture.plates is not None
    assert not capture.warnings


def test_the_surface_is_closed_and_of_human_size(folder: Path) -> None:
    mesh = trimesh.load_mesh(folder / "gt.ply")
    assert mesh.is_watertight
    assert mesh.body_count == 1
    assert mesh.volume > 0.05
    low, high = mesh.bounds
    assert low[2] == pytest.approx(0, abs=0.01)
    assert high[2] == pytest.approx(1.78, abs=0.05)


def test_the_surface_projects_into_the_masks(folder: Path) -> None:
    capture = load_capture(folder)
    points = torch.from_numpy(np.array(trimesh.load_mesh(folder / "gt.ply").vertices))
    assert capture.masks is not None
    for i, mask in enumerate(capture.masks):
        uv, depth = capture.cameras.project(i, points)
        assert (depth > 0).all()
        column, row = uv.floor().long().unbind(dim=1)
        drawn = torch.zeros_like(mask)
        drawn[row, column] = 1
        assert (mask[row, column] > 0).float().mean() > 0.97  # slivers fall between the rays
        inside = mask > 0.99
        assert drawn[inside].mean() > 0.99


def test_a_coat_adds_highlights_and_nothing_else(tmp_path: Path) -> None:
    matte = load_capture(make_sample_scene(tmp_path / "matte", 3, 0, 64))
    assert matte.masks is not None
    lit = {}
    for roughness in (0.3, 0.6):
        glossy = load_capture(make_sample_scene(tmp_path / "gloss", 3, 0, 64, coat=Coat(1.5, roughness)))
        assert glossy.masks is not None
        more = glossy.photograph(0) - matte.photograph(0)
        assert torch.equal(glossy.masks[0], matte.masks[0])
        assert (more[matte.masks[0] == 0] == 0).all()
        assert more.min() > -0.01
        assert more.max() > 0.1
        lit[roughness] = float((more > 0.02).float().mean())
    assert 0 < lit[0.3] < 0.7 * lit[0.6]  # the rougher, the wider
    with pytest.raises(InputError, match="roughness 0"):
        Coat(0.5, 0.0)


def test_plates_show_the_room_without_the_figure(folder: Path) -> None:
    capture = load_capture(folder)
    assert capture.masks is not None
    assert capture.plates is not None
    for photograph, plate, mask in zip(capture.images, capture.plates, capture.masks, strict=True):
        outside = mask == 0
        assert torch.equal(photograph[outside], plate[outside])
        found = torch.from_numpy(separate(photograph.numpy(), plate.numpy())[0]) > 0.5
        true = mask > 0.5
        sure = mask > 0.8
        assert (found & sure).sum() / sure.sum() > 0.98
        assert (found & true).sum() / (found | true).sum() > 0.9


def test_a_complete_scene_is_left_alone(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = (folder / "train/000.png").stat().st_mtime_ns
    assert main([str(folder), "--views", "3", "--test-views", "1", "--size", "192"]) == 0
    assert "3 + 1 views of 192 x 192" in capsys.readouterr().out
    assert (folder / "train/000.png").stat().st_mtime_ns == before


def test_unwritable_folder(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="cannot be written to"):
        make_sample_scene(tmp_path / "file")
    assert main([str(tmp_path / "file")]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1
