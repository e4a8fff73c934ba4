"""train/render.py on a finished run made by hand: a ball with two colours and some view dependence."""

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
import trimesh

from tests.runs import FOCAL, SIZE, write_run
from tests.surface.shapes import CENTER, RADIUS, VOXEL, ball_distance, half_of, soft
from torch_surfcap.field.field import SurfaceField
from torch_surfcap.movie import frames_in
from train import render

USUAL = {*render.USUAL, "depth16"}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A capture with 8 + 3 views, a run of degree 1 that fits it, and the truth: the half of the ball with x over its
    centre's."""
    base = tmp_path_factory.mktemp("render")
    origin, centers, distance = ball_distance()
    sh = torch.zeros(*distance.shape, 4, 3)
    sh[..., 0, :] = torch.from_numpy(np.where(centers[..., :1] < CENTER[0], [0.8, 0.1, 0.1], [0.1, 0.1, 0.8]))
    sh[..., 3, 1] = 0.2
    values = torch.from_numpy(soft(distance)).float()
    write_run(base, SurfaceField.from_dense(values, sh, torch.from_numpy(origin), VOXEL))
    truth = trimesh.creation.icosphere(4, RADIUS)
    truth.apply_translation(CENTER)
    half_of(truth, 0).export(base / "half.ply")
    return base


def rendered(folder: Path, *more: str) -> dict[str, np.ndarray]:
    """The PNG files of a successful command, by name, RGB; they and all others are removed."""
    assert render.main(["--run", str(folder / "run"), *more]) == 0
    out = folder / "run" / "pictures"
    found = {path.stem: cv2.imread(str(path), cv2.IMREAD_UNCHANGED) for path in out.glob("*.png")}
    shutil.rmtree(out)
    return {
        name: np.asarray(p)[..., 2::-1] if p is not None and p.ndim == 3 else np.asarray(p)
        for name, p in found.items()
    }


def refused(folder: Path, capsys: pytest.CaptureFixture[str], *more: str) -> str:
    """The one line of a command that ends with status 2."""
    capsys.readouterr()
    assert render.main(["--run", str(folder / "run"), *more]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert not (folder / "run" / "pictures").exists()
    return error


def test_usual_pictures_of_the_held_out_views(folder: Path) -> None:
    found = rendered(folder)
    section = f"section_0_{CENTER[0]:.4g}"
    views = {f"test_{i}_{kind}" for i in range(3) for kind in USUAL}
    assert {name for name in found if not name.startswith("section")} == views
    assert len(found) == len(views) + 1, section
    assert all(found[name].shape[:2] == (SIZE, SIZE) for name in views)


def test_one_view_by_hand(folder: Path) -> None:
    # View 0 of the fit stands on the ball's blue side and looks along -x: green is 0.1 - 0.2, clipped.
    what = "raster,constant,view_dependent,view_dependent_volume,depth,normals"
    found = rendered(folder, "--view", "train/0", "--what", what, "--samples", "1")
    middle = {
        name.removeprefix("train_0_"): picture[SIZE // 2, SIZE // 2].astype(float)
        for name, picture in found.items()
    }
    assert middle["raster"] == pytest.approx([26, 0, 204], abs=2)
    assert middle["constant"] == pytest.approx([26, 26, 204], abs=2)
    assert middle["view_dependent"] == pytest.approx([128, 77, 128], abs=2)
    assert middle["view_dependent_volume"] == pytest.approx([128, 77, 128], abs=8)
    assert middle["normals"] == pytest.approx([128, 128, 255], abs=20)
    assert middle["depth16"] == pytest.approx((2.0 - RADIUS) / 1e-4, abs=30)  # 2 from the centre, unit 1e-4
    assert found["train_0_depth16"][0, 0] == 0


def test_views_by_number_and_split_and_size(folder: Path) -> None:
    found = rendered(folder, "--what", "shaded", "--view", "9", "train", "--size", "24", "--samples", "1")
    assert set(found) == {"test_1_shaded", *(f"train_{i}_shaded" for i in range(8))}
    assert {picture.shape for picture in found.values()} == {(24, 24, 3)}
    covered = (found["train_3_shaded"].min(2) < 250).sum() / 24**2
    assert covered == pytest.approx(np.pi * (FOCAL / SIZE * RADIUS / 2) ** 2, rel=0.12)


def test_a_window_of_a_view(folder: Path) -> None:
    """The same pixels as in the whole picture, at its size and enlarged."""
    view = ["--what", "shaded", "--view", "9", "--samples", "1"]
    whole = rendered(folder, *view)["test_1_shaded"]
    part = rendered(folder, *view, "--crop", "0.25,0.5,0.5,0.25")["test_1_shaded"]
    left, top = SIZE // 4, SIZE // 2
    assert np.array_equal(part, whole[top : top + SIZE // 4, left : left + SIZE // 2])
    large = rendered(folder, *view, "--crop", "0.25,0.5,0.5,0.25", "--size", str(SIZE))["test_1_shaded"]
    assert large.shape == (SIZE // 2, SIZE, 3)


def test_error_is_green_where_there_is_no_truth(folder: Path) -> None:
    found = rendered(
        folder, "--what", "error", "--mesh-truth", str(folder / "half.ply"), "--view", "train/0", "train/4"
    )
    green = {
        name: ((p[..., 1] > p[..., 0] + 40.0) & (p[..., 1] > p[..., 2] + 40.0)).mean()
        for name, p in found.items()
    }
    assert green["train_0_error"] < 0.01
    assert green["train_4_error"] > 0.03


@pytest.mark.parametrize("gone", [False, True])
def test_turntable(folder: Path, gone: bool, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """With and without the capture."""
    shutil.copytree(folder, tmp_path / "base")
    if gone:
        text = (tmp_path / "base" / "run" / "config.yaml").read_text()
        (tmp_path / "base" / "run" / "config.yaml").write_text(
            text.replace(str(folder), str(tmp_path / "gone"))
        )
    run = tmp_path / "base" / "run"
    assert render.main(["--run", str(run), "--turntable", "6", "--size", "64", "--what", "raster"]) == 0
    assert ("z is taken to be up" in capsys.readouterr().out) == gone
    (film,) = (run / "pictures").iterdir()
    assert film.stem == "turntable_raster"
    if film.suffix == ".mp4":
        assert frames_in(film) == 6
        frames, reader = [], cv2.VideoCapture(str(film))
        for _ in range(6):
            frames.append(np.asarray(reader.read()[1], dtype=float)[32, 32, ::-1])
        red, blue = (max(frames, key=lambda f: f[c]) for c in (0, 2))
        assert red[0] > 150 > 80 > red[2]
        assert blue[2] > 150 > 80 > blue[0]
    if gone:
        assert render.main(["--run", str(run), "--view", "0"]) == 2
        assert str(tmp_path / "gone") in capsys.readouterr().err


def test_section(folder: Path) -> None:
    (name,) = rendered(folder, "--section", f"z={CENTER[2]}", "--size", "300")
    assert name == f"section_z_{CENTER[2]:.4g}"
    (name,) = rendered(folder, "--what", "section", "--section", "y", "--size", "300")
    assert float(name.removeprefix("section_y_")) == pytest.approx(CENTER[1], abs=VOXEL / 2)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--what", "raster,normal"], "--what: no kind 'normal', expected of volume, raster"),
        (["--what", "error"], "--what: error without a true surface, expected --mesh-truth"),
        (["--what", "error", "--mesh-truth", "nowhere.ply"], "nowhere.ply"),
        (["--view", "train/9"], "--view: no view train/9 among 11, did you mean train/"),
        (["--view", "11"], "--view: no view 11 among 11"),
        (["--section", "w=1"], "--section is 'w=1', expected x, y or z"),
        (["--section", "x=nan"], "--section is 'x=nan'"),
        (["--section", "z=99"], "section: no tile of the field at z=99, expected "),
        (["--turntable", "0"], "--turntable is 0, expected 1 or more"),
        (["--size", "3"], "--size is 3, expected 16 or more"),
        (["--turntable", "4", "--up", "0,0,0"], "--up is '0,0,0', expected x, y, z"),
        (["--turntable", "4", "--up", "north"], "--up is 'north'"),
        (["--cut", "0"], "--cut is 0"),
        (["--crop", "0.5,0,0.6,1"], "--crop is '0.5,0,0.6,1', expected left,top,width,height"),
        (["--crop", "0.5"], "--crop is '0.5'"),
    ],
)
def test_bad_input_is_one_line(
    folder: Path, arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert message in refused(folder, capsys, *arguments)


def test_no_view_dependence_in_degree_0(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copytree(folder / "run", tmp_path / "run")
    field = SurfaceField.load(tmp_path / "run" / "field.npz")
    SurfaceField(field.voxels[..., :4], field.grid).save(tmp_path / "run" / "field.npz")
    message = "--what: view_dependent of a run of sh_degree=0"
    assert message in refused(tmp_path, capsys, "--what", "view_dependent")
    found = rendered(tmp_path, "--view", "0")
    assert {name.removeprefix("train_0_") for name in found if "section" not in name} == USUAL - {
        "view_dependent"
    }
