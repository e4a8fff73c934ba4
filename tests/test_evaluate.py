"""train/evaluate.py on a finished run made by hand: a ball, its pictures and its true surface."""

import json
from pathlib import Path

import numpy as np
import pytest
import trimesh

from tests.runs import write_run
from tests.surface.shapes import CENTER, RADIUS, ball
from torch_surfcap import config as settings
from torch_surfcap import report
from train import evaluate


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A capture of the ball with 8 + 3 views, a run that fits it perfectly, and the truth."""
    base = tmp_path_factory.mktemp("evaluate")
    write_run(base, ball())
    truth = trimesh.creation.icosphere(5, RADIUS)
    truth.apply_translation(CENTER)
    report.write_mesh(base / "truth" / "gt.ply", truth)
    np.savez(base / "truth" / "points.npz", points=truth.vertices.astype(np.float32), seen=0.5)
    np.savez(base / "truth" / "concave.npz", points=truth.vertices[:50].astype(np.float32))
    return base


def run(folder: Path, *more: str) -> int:
    return evaluate.main(["--run", str(folder / "run"), *more])


def test_scores_views_and_surface(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    truth, points = str(folder / "truth" / "gt.ply"), str(folder / "truth" / "points.npz")
    assert run(folder, "--mesh-truth", truth, "--points-truth", points) == 0
    found = json.loads((folder / "run" / "evaluation.json").read_text())
    assert found["test"]["views"] == 3
    assert len(found["test"]["each"]) == 3
    assert found["test"]["psnr_volume"] > 25
    assert found["test"]["silhouette_iou"] == pytest.approx(1.0)
    surface = found["surface"]
    assert surface["chamfer"] < 3e-4
    assert surface["concave"] < 4e-4
    assert surface["pieces"] == 1
    assert "train" not in found
    for name in ("error.ply", "error.png"):
        assert (folder / "run" / name).is_file()
    printed = capsys.readouterr().out
    assert "psnr_volume" in printed
    assert "chamfer" in printed


def test_views_of_the_fit_and_no_truth(folder: Path) -> None:
    assert run(folder, "--train") == 0
    found = json.loads((folder / "run" / "evaluation.json").read_text())
    assert found["train"]["views"] == 8
    assert "surface" not in found


def test_protocol_nerf_is_full_size_over_white(folder: Path, tmp_path: Path) -> None:
    small = settings.load(folder / "run" / "config.yaml", ["data.scale=0.5"])
    for name in ("field.npz", "mesh.ply"):
        (tmp_path / name).write_bytes((folder / "run" / name).read_bytes())
    settings.save(small, tmp_path / "config.yaml")
    assert run(folder) == 0
    assert evaluate.main(["--run", str(tmp_path), "--protocol", "nerf"]) == 0
    full, nerf = (json.loads((p / "evaluation.json").read_text()) for p in (folder / "run", tmp_path))
    assert nerf["test"] == full["test"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--mesh-truth", "nowhere.ply"], "nowhere.ply"),
        (["--points-truth", "nowhere.npz"], "nowhere.npz"),
        (["--concave", "{run}/config.yaml"], "config.yaml"),
        (["--points-truth", "{run}/field.npz"], "field.npz"),
    ],
)
def test_bad_truth_is_named(
    folder: Path, arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(folder, *[a.format(run=folder / "run") for a in arguments]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1


@pytest.mark.parametrize("missing", ["config.yaml", "field.npz", "mesh.ply"])
def test_unfinished_run_is_named(
    folder: Path, missing: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("config.yaml", "field.npz", "mesh.ply"):
        if name != missing:
            (tmp_path / name).write_bytes((folder / "run" / name).read_bytes())
    assert evaluate.main(["--run", str(tmp_path)]) == 2
    assert capsys.readouterr().err.startswith(f"{tmp_path / missing}: not there")


@pytest.mark.parametrize("damaged", ["field.npz", "mesh.ply"])
def test_damaged_run_is_named(
    folder: Path, damaged: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("config.yaml", "field.npz", "mesh.ply"):
        data = (folder / "run" / name).read_bytes()
        (tmp_path / name).write_bytes(data[:100] if name == damaged else data)
    assert evaluate.main(["--run", str(tmp_path)]) == 2
    error = capsys.readouterr().err
    assert error.startswith(str(tmp_path / damaged))
    assert not (tmp_path / "evaluation.json").exists()
