"""train/fit.py from the command line to the files, on a tiny sample scene."""

from __future__ import annotations

import csv
import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
import trimesh

import torch_surfcap as sc
from torch_surfcap import config as settings
from torch_surfcap import devices
from torch_surfcap.data.sample_scene import make_sample_scene
from torch_surfcap.field.field import SurfaceField
from torch_surfcap.fitting.course import Progress
from train import fit

SIZE, VIEWS, TEST_VIEWS = 64, 12, 2
QUICK = ["levels=2", "sh_degree=0"]  # what every run here is given


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_sample_scene(tmp_path_factory.mktemp("fit") / "scene", VIEWS, TEST_VIEWS, SIZE)


@pytest.fixture(scope="module")
def finished(scene: Path) -> Path:
    """The folder of a run of the command, in a process of its own."""
    out = scene.with_name("finished")
    root = Path(__file__).parents[1]
    environment = os.environ | {"PYTHONPATH": str(root)}
    command = [sys.executable, str(root / "train" / "fit.py"), f"data.path={scene}", f"out={out}", *QUICK]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    out.with_suffix(".txt").write_text(done.stdout + done.stderr)
    return out


@pytest.fixture
def copied(scene: Path, tmp_path: Path) -> Path:
    """A copy of the scene to be spoilt."""
    return Path(shutil.copytree(scene, tmp_path / "scene"))


def run(scene: Path, out: Path, *more: str) -> int:
    return fit.main([f"data.path={scene}", f"out={out}", *QUICK, *more])


def refused(scene: Path, out: Path, capsys: pytest.CaptureFixture[str], *more: str) -> str:
    """The one line that a run ends with; it has left nothing behind."""
    before = sorted(out.iterdir()) if out.is_dir() else None
    capsys.readouterr()
    assert run(scene, out, *more) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1, error
    assert (sorted(out.iterdir()) if out.is_dir() else None) == before
    return error


def test_prints_what_it_does(finished: Path) -> None:
    printed = finished.with_suffix(".txt").read_text()
    assert f"{VIEWS} views of {SIZE} x {SIZE}, {TEST_VIEWS} held out, masks by file, with plates" in printed
    assert re.search(r"2 levels, about \d+ s on \d threads?, \d+\.\d GiB\n", printed)
    assert "level 2 of 2" in printed
    assert "voxels" in printed
    assert "PSNR volume" in printed
    assert "triangles" in printed
    assert str(finished) in printed


def test_files_are_complete(finished: Path) -> None:
    assert sorted(p.name for p in finished.iterdir()) == sorted(fit.RESULTS)
    mesh = trimesh.load(finished / "mesh.ply", force="mesh", process=False)
    assert isinstance(mesh, trimesh.Trimesh)
    assert mesh.is_watertight
    assert mesh.volume > 0
    assert isinstance(mesh.visual, trimesh.visual.ColorVisuals)
    assert np.asarray(mesh.visual.vertex_colors)[:, :3].std() > 10
    glb = trimesh.load(finished / "mesh.glb", force="mesh", process=False)
    assert isinstance(glb, trimesh.Trimesh)
    assert len(glb.faces) == len(mesh.faces)
    field = SurfaceField.load(finished / "field.npz")
    assert field.sh_degree == 0
    picture = cv2.imread(str(finished / "preview.png"))
    assert picture is not None
    assert picture.shape[1] == 4 * SIZE


def test_history_has_a_row_per_iteration(finished: Path) -> None:
    metrics = json.loads((finished / "metrics.json").read_text())
    with (finished / "history.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == metrics["iterations_run"]
    assert {row["level"] for row in rows} == {"0.0", "1.0"}
    for level in ("0.0", "1.0"):
        losses = [float(row["loss"]) for row in rows if row["level"] == level]
        assert all(float(row["samples"]) > VIEWS * SIZE for row in rows if row["level"] == level)
        assert losses[-1] < losses[0]


def test_metrics(finished: Path) -> None:
    metrics = json.loads((finished / "metrics.json").read_text())
    assert list(metrics) == [
        *(
            "train",
            "test",
            "seconds",
            "peak_memory_bytes",
            "device",
            "views",
            "pixels",
            "voxels",
            "tiles",
            "triangles",
        ),
        *("chosen", "warnings", "resumed_from", "iterations_run"),
    ]
    for split, views in (("train", 8), ("test", TEST_VIEWS)):
        assert metrics[split]["views"] == views
        assert metrics[split]["psnr_volume"] > 25
        assert metrics[split]["psnr_raster"] > 20
        assert metrics[split]["psnr_masked"] > 15
        assert 0.8 < metrics[split]["ssim"] <= 1
    seconds = metrics["seconds"]
    assert len(seconds["levels"]) == 2
    assert all(level["march"] > 0 for level in seconds["levels"])
    stages = [value for name, value in seconds.items() if name not in ("total", "levels")]
    assert sum(stages) == pytest.approx(seconds["total"], rel=0.05)
    assert 50e6 < metrics["peak_memory_bytes"] < 8e9
    device = devices.resolve("auto")
    assert metrics["device"]["word"] == str(device)
    assert metrics["device"]["name"] == devices.name(device)
    assert metrics["device"]["torch"] == torch.__version__
    assert (metrics["device"]["peak_memory_bytes"] is None) == (device.type == "cpu")
    assert metrics["voxels"] == 64 * metrics["tiles"]
    mesh = trimesh.load(finished / "mesh.ply", force="mesh", process=False)
    assert isinstance(mesh, trimesh.Trimesh)
    assert metrics["triangles"] == len(mesh.faces)
    assert metrics["chosen"]["sh_degree"]["value"] == 0
    assert metrics["warnings"] == []
    assert metrics["resumed_from"] is None


def test_saved_config_runs_again(finished: Path, scene: Path) -> None:
    saved = settings.load(finished / "config.yaml")
    assert saved == settings.resolved(settings.load(None, [f"data.path={scene}", f"out={finished}", *QUICK]))
    assert saved.losses.photo is not None
    assert saved.opacity is not None


def test_same_mesh_whatever_the_threads(finished: Path, scene: Path, tmp_path: Path) -> None:
    before = torch.get_num_threads()
    try:
        for threads in (1, 2):
            torch.set_num_threads(threads)
            assert run(scene, tmp_path / str(threads)) == 0
    finally:
        torch.set_num_threads(before)
    expected = (finished / "mesh.ply").read_bytes()
    assert (tmp_path / "1" / "mesh.ply").read_bytes() == expected
    assert (tmp_path / "2" / "mesh.ply").read_bytes() == expected
    for name in ("field.npz", "mesh.glb", "preview.png", "history.csv"):
        assert (tmp_path / "1" / name).read_bytes() == (tmp_path / "2" / name).read_bytes()


def test_held_out_views_are_never_looked_at(finished: Path, copied: Path, tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    for i in range(TEST_VIEWS):
        noise = rng.integers(0, 255, (SIZE, SIZE, 3), dtype=np.uint8)
        cv2.imwrite(str(copied / "test" / f"{i:03d}.png"), noise)
        cv2.imwrite(str(copied / "mask" / f"test_{i:03d}.png"), noise)
    assert run(copied, tmp_path / "noise") == 0
    (copied / "transforms_test.json").unlink()
    assert run(copied, tmp_path / "none") == 0
    for name in ("noise", "none"):
        for file in ("mesh.ply", "field.npz"):
            assert (tmp_path / name / file).read_bytes() == (finished / file).read_bytes()
    assert json.loads((tmp_path / "none" / "metrics.json").read_text())["test"] is None
    scores = [json.loads((p / "metrics.json").read_text())["test"] for p in (finished, tmp_path / "noise")]
    assert scores[1]["psnr_volume"] < scores[0]["psnr_volume"] - 5


def test_earlier_results_are_kept(
    finished: Path, scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = Path(shutil.copytree(finished, tmp_path / "out"))
    error = refused(scene, out, capsys)
    assert error.startswith(f"out: {out} holds the results of an earlier run (mesh.ply)")
    assert "overwrite=true or resume=true" in error
    error = refused(scene, out, capsys, "resume=true", "losses.mask=0.7")
    assert f"{out / 'config.yaml'}: losses.mask is None there and 0.7 now" in error
    (out / "evaluation.json").write_text("{}")
    (out / "notes.txt").write_text("mine")
    (out / "pictures").mkdir()
    (out / "pictures" / "turntable_raster.mp4").write_bytes(b"of the earlier mesh")
    old = (out / "metrics.json").read_bytes()
    assert run(scene, out, "overwrite=true", "seed=1") == 0
    assert (out / "metrics.json").read_bytes() != old
    assert sorted(p.name for p in out.iterdir()) == sorted([*fit.RESULTS, "notes.txt"])


def test_resume_without_a_checkpoint_starts_afresh(
    finished: Path, scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = Path(shutil.copytree(finished, tmp_path / "out"))
    assert run(scene, out, "resume=true") == 0
    assert f"{out}: no checkpoint there, the fit starts afresh" in capsys.readouterr().out
    assert (out / "mesh.ply").read_bytes() == (finished / "mesh.ply").read_bytes()


@pytest.mark.parametrize(
    ("argument", "message"),
    [
        ("losses.maks=1", "unknown key losses.maks, nearest known key: losses.mask"),
        ("sh_degree=4", "sh_degree is 4, expected one of 0, 1, 2"),
        ("mesh.threshold=9", "mesh.threshold is 9, expected more than -4 and less than 4"),
        ("device=cuda:99", "device: found cuda:99, expected c"),
        ("cameras.skip=[nobody]", "no camera nobody among"),
        ("data.format=idr", "no calibration found"),
        ("data.box=[5,5,5,6,6,6]", "the visual hull is empty inside the box"),
    ],
)
def test_bad_settings(
    scene: Path, tmp_path: Path, argument: str, message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert message in refused(scene, tmp_path / "out", capsys, argument)


def test_paths_that_are_not_there(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    error = refused(tmp_path / "nowhere", tmp_path / "out", capsys)
    assert error.startswith(f"{tmp_path / 'nowhere'}: no such file or folder")
    assert fit.main([f"out={tmp_path / 'out'}"]) == 2
    assert capsys.readouterr().err.startswith("data.path is not given")
    assert fit.main(["--config", str(tmp_path / "no.yaml")]) == 2
    assert capsys.readouterr().err.startswith(f"{tmp_path / 'no.yaml'}: cannot read this config file")


def test_unwritable_out(
    scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is noticed before any work."""
    monkeypatch.setattr(fit, "load_capture", lambda *_: pytest.fail("was loaded"))
    (tmp_path / "file").write_text("")
    for out in (tmp_path / "file", tmp_path / "file" / "deeper", Path("/proc/nowhere")):
        assert f"out: {out} cannot be written to" in refused(scene, out, capsys)
    if os.geteuid():  # nothing is closed to root
        (tmp_path / "closed").mkdir(mode=0o500)
        assert "cannot be written to" in refused(scene, tmp_path / "closed" / "out", capsys)


def test_missing_photograph(copied: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (copied / "train" / "003.png").unlink()
    assert str(copied / "train" / "003.png") in refused(copied, tmp_path / "out", capsys)


def test_no_common_volume(copied: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Silhouettes of a subject that is somewhere else for each half of the cameras."""
    mask = np.zeros((SIZE, SIZE), np.uint8)
    mask[4:10, 4:10] = 255
    for i in range(VIEWS):
        cv2.imwrite(str(copied / "mask" / f"train_{i:03d}.png"), np.rot90(mask, i))
    error = refused(copied, tmp_path / "out", capsys)
    assert "no common volume" in error or "hull is empty" in error


def test_blind_camera_is_named_and_left_out(
    copied: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cv2.imwrite(str(copied / "mask" / "train_002.png"), np.zeros((SIZE, SIZE), np.uint8))
    assert run(copied, tmp_path / "out", "levels=1") == 0
    assert "warning: camera train/002 is left out: empty" in capsys.readouterr().out
    metrics = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert len(metrics["warnings"]) == 1
    assert "train/002" in metrics["warnings"][0]


@pytest.mark.parametrize("moment", ["descent", "writing"])
def test_interrupted(
    scene: Path,
    tmp_path: Path,
    moment: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    if moment == "descent":
        show = fit.Bars.__call__
        monkeypatch.setattr(
            fit.Bars,
            "__call__",
            lambda bars, at: interrupt() if at.row.get("iteration") == 2 else show(bars, at),
        )
    else:
        monkeypatch.setattr("torch_surfcap.report.write_history", interrupt)
    assert run(scene, tmp_path / "deep" / "out", "levels=1") == 130
    assert "interrupted" in capsys.readouterr().err
    assert not (tmp_path / "deep" / "out").exists()


def test_a_full_disk_is_one_line(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("torch_surfcap.report.write_json", full)
    assert run(scene, tmp_path / "out", "levels=1") == 2
    assert "cannot be written to (No space left on device)" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_library_fits_arrays(scene: Path) -> None:
    """A capture of tensors, without any file or command."""
    read = sc.load_capture(scene)
    assert read.masks is not None
    images, masks = torch.stack(read.images), torch.stack(read.masks)
    capture = sc.Capture(images, read.cameras.K, read.cameras.world_to_camera, masks)
    seen: list[Progress] = []
    result = sc.fit(capture, seen.append, levels=1, sh_degree=1, losses={"mask": 0.2})
    assert seen[0].budget is not None
    assert seen[0].row == {}
    assert len(seen) == 1 + len(result.history)
    assert result.field.sh_degree == 1
    assert result.mesh.is_watertight
    assert tuple(result.gain.shape) == (VIEWS, 3)
    with pytest.raises(TypeError, match="unknown setting 'degree'"):
        sc.fit(capture, degree=1)


def test_library_needs_silhouettes(scene: Path) -> None:
    read = sc.load_capture(scene)
    bare = sc.Capture(torch.stack(read.images), read.cameras.K, read.cameras.world_to_camera)
    with pytest.raises(sc.InputError, match="no masks"):
        sc.fit(bare)
