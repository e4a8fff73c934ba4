"""train/evaluate.py on a finished run made by hand: a ball, its pictures and its true surface."""

import json
import math
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
import trimesh

from tests.surface.shapes import CENTER, RADIUS, ball
from torch_surfcap import config as settings
from torch_surfcap import report
from torch_surfcap.data.cameras import Cameras
from torch_surfcap.surface.extract import extract_mesh
from torch_surfcap.surface.render import mesh_mask, volume
from train import evaluate

SIZE, FOCAL, AWAY = 48, 70.0, 2.0


def camera_to_world(angle: float) -> np.ndarray:
    """OpenGL axes: on a circle about the ball, looking at its centre."""
    back = np.array([math.cos(angle), math.sin(angle), 0.0])
    up = np.array([0.0, 0.0, 1.0])
    pose = np.eye(4)
    pose[:3, :3] = np.stack([np.cross(up, back), up, back], axis=1)
    pose[:3, 3] = CENTER + AWAY * back
    return pose


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A capture of the ball with 8 + 3 views, a run that fits it perfectly, and the truth."""
    base = tmp_path_factory.mktemp("evaluate")
    field = ball()
    mesh = extract_mesh(field)
    K = torch.tensor([[FOCAL, 0, SIZE / 2], [0, FOCAL, SIZE / 2], [0, 0, 1]], dtype=torch.float64)
    for split, count, turn in (("train", 8, 0.0), ("test", 3, 0.3)):
        frames = []
        (base / "scene" / split).mkdir(parents=True)
        for i in range(count):
            pose = camera_to_world(turn + 2 * math.pi * i / count)
            to_camera = torch.from_numpy(np.linalg.inv(pose @ np.diag([1.0, -1, -1, 1])))
            cameras = Cameras(K[None], to_camera[None], torch.tensor([[SIZE, SIZE]]))
            alpha = mesh_mask(mesh, cameras, 0)
            color = volume(field, cameras, 0, 1.0).clamp(0, 1)
            rgba = (255 * torch.cat([color.flip(-1), alpha[..., None]], -1)).round().byte().numpy()
            cv2.imwrite(str(base / "scene" / split / f"{i}.png"), rgba)
            frames.append({"file_path": f"{split}/{i}", "transform_matrix": pose.tolist()})
        angle = 2 * math.atan(SIZE / 2 / FOCAL)
        text = json.dumps({"camera_angle_x": angle, "frames": frames})
        (base / "scene" / f"transforms_{split}.json").write_text(text)
    settings.save(settings.load(None, [f"data.path={base / 'scene'}"]), base / "run" / "config.yaml")
    field.save(base / "run" / "field.npz")
    report.write_mesh(base / "run" / "mesh.ply", mesh)
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
