"""Copies of the layouts of DTU and NeRF-synthetic in small: one ball, its pictures, a finished run, the scanner's truth."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh
from numpy.typing import NDArray
from scipy.io import savemat

from tests.data.rigs import write_json, write_picture
from tests.fitting.sphere import look_at
from tests.surface import shapes
from torch_surfcap import Cameras, SurfaceField
from torch_surfcap import config as settings
from torch_surfcap.report import write_mesh
from torch_surfcap.surface.extract import extract_mesh
from torch_surfcap.surface.render import volume

MM = 40.0  # of the unit of tests/surface/shapes.py
CENTER, RADIUS = MM * shapes.CENTER, MM * shapes.RADIUS  # of the ball, mm: a radius of 10
SIZE, FOCAL, AWAY = 48, 70.0, 2.0 * MM

Array = NDArray[Any]


def ball() -> tuple[SurfaceField, trimesh.Trimesh]:
    """The ball in millimetres, grey, and its mesh."""
    origin, _, distance = shapes.ball_distance()
    values = torch.from_numpy(shapes.soft(distance)).float()
    sh = torch.full((*values.shape, 1, 3), 0.5)
    field = SurfaceField.from_dense(values, sh, torch.from_numpy(MM * origin), MM * shapes.VOXEL)
    return field, extract_mesh(field)


def cameras(views: int, turn: float = 0.0) -> Cameras:
    """On a circle about the ball."""
    center = torch.from_numpy(CENTER)
    angles = turn + 2 * torch.pi * torch.arange(views, dtype=torch.float64) / views
    ways = torch.stack([angles.cos(), angles.sin(), torch.full_like(angles, 0.2)], dim=1)
    poses = torch.stack([look_at(center + AWAY * way, center) for way in ways])
    K = torch.tensor([[FOCAL, 0, SIZE / 2], [0, FOCAL, SIZE / 2], [0, 0, 1]], dtype=torch.float64)
    return Cameras(K.expand(views, 3, 3), poses, torch.full((views, 2), SIZE))


def photographs(field: SurfaceField, seen_by: Cameras) -> list[tuple[Array, Array]]:
    """Straight colours [H, W, 3] and alpha [H, W] of every view, 8 bit: composited they are the field's rendering."""
    pairs = []
    for i in range(len(seen_by)):
        black, white = volume(field, seen_by, i, 0.0), volume(field, seen_by, i, 1.0)
        alpha = (1 - (white - black).mean(dim=2)).clamp(0, 1)
        color = (black / alpha.clamp(min=1e-3)[:, :, None]).clamp(0, 1)
        pairs.append(((255 * color).round().byte().numpy(), (255 * alpha).round().byte().numpy()))
    return pairs


def write_run(
    folder: Path, field: SurfaceField, mesh: trimesh.Trimesh, *changes: str, **metrics: Any
) -> Path:
    """What a fit leaves behind that evaluate.py reads."""
    settings.save(settings.load(None, changes), folder / "config.yaml")
    field.save(folder / "field.npz")
    write_mesh(folder / "mesh.ply", mesh)
    write_json(folder / "metrics.json", metrics)
    return folder


def write_nerf_scene(folder: Path, field: SurfaceField) -> Path:
    """transforms_{train,test}.json with pictures RGBA, named without their suffix; beside those of the test split
    lie, as in the data set, depths and normals."""
    for split, views, turn in (("train", 6, 0.0), ("test", 3, 0.3)):
        seen_by, frames = cameras(views, turn), []
        for i, (color, mask) in enumerate(photographs(field, seen_by)):
            write_picture(folder / split / f"r_{i}.png", np.dstack([color, mask]))
            if split == "test":
                for kind in ("depth", "normal"):
                    write_picture(
                        folder / split / f"r_{i}_{kind}_0001.png", np.dstack([255 - color, 255 - mask])
                    )
            to_world = np.linalg.inv(seen_by.world_to_camera[i].numpy()) @ np.diag([1.0, -1.0, -1.0, 1.0])
            frames.append(
                {"file_path": f"./{split}/r_{i}", "rotation": 0.0126, "transform_matrix": to_world.tolist()}
            )
        angle = 2 * np.arctan(SIZE / 2 / FOCAL)
        write_json(folder / f"transforms_{split}.json", {"camera_angle_x": angle, "frames": frames})
    return folder


def write_dtu_scene(folder: Path, field: SurfaceField, views: int = 6) -> Path:
    """image/, mask/ and cameras_sphere.npz as IDR gives DTU's objects."""
    seen_by, matrices = cameras(views), {}
    for i, (color, mask) in enumerate(photographs(field, seen_by)):
        write_picture(folder / "image" / f"{i:06d}.png", color)
        write_picture(folder / "mask" / f"{i:03d}.png", mask)
        K = seen_by.K[i].numpy().copy()
        K[:2, 2] -= 0.5  # to integer pixel centres
        matrices[f"world_mat_{i}"] = np.vstack([K @ seen_by.world_to_camera[i, :3].numpy(), [0, 0, 0, 1]])
        matrices[f"scale_mat_{i}"] = np.diag([2 * RADIUS, 2 * RADIUS, 2 * RADIUS, 1.0])
    np.savez(folder / "cameras_sphere.npz", **matrices)  # type: ignore[arg-type]
    return folder


def write_dtu_truth(
    folder: Path, number: int, points: Array, observed: Array, box: Array, resolution: float, plane: Array
) -> Path:
    """Points/stl and ObsMask as DTU gives them, shapes and types included."""
    (folder / "ObsMask").mkdir(parents=True, exist_ok=True)
    mask = {"ObsMask": observed.astype(np.uint8), "BB": box, "Res": resolution, "Margin": 10}
    savemat(folder / "ObsMask" / f"ObsMask{number}_10.mat", mask, do_compression=True)
    savemat(folder / "ObsMask" / f"Plane{number}.mat", {"P": np.reshape(plane, (4, 1))})
    (folder / "Points" / "stl").mkdir(parents=True, exist_ok=True)
    trimesh.PointCloud(points).export(folder / "Points" / "stl" / f"stl{number:03d}_total.ply")
    return folder


def sphere_points(radius: float, count: int = 60_000) -> Array:
    """[count, 3] points spread over a sphere about the ball's centre."""
    way = np.random.default_rng(0).normal(size=(count, 3))
    return CENTER + radius * way / np.linalg.norm(way, axis=1, keepdims=True)
