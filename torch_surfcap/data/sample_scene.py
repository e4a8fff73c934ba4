"""A scene to try everything on: a textured figure of known surface in a textured room.

    python -m torch_surfcap.data.sample_scene OUT [--views 24] [--test-views 4] [--size 256] [--seed 0]
                                              [--gloss 0.5] [--roughness 0.5]

Writes a nerfstudio-style capture: transforms_train.json, transforms_test.json, the photographs in train/ and test/,
masks in mask/, pictures of the empty room in background/, and the true surface gt.ply (metres). A folder that already
holds the same scene is left as it is.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
import trimesh
from kornia.geometry.conversions import camtoworld_vision_to_graphics_4x4
from numpy.typing import NDArray

from torch_surfcap.data.cameras import Cameras
from torch_surfcap.data.files import atomic_write
from torch_surfcap.data.load import in_threads
from torch_surfcap.data.sample_figure import PAINTS, figure_mesh, room_colors
from torch_surfcap.errors import InputError

Array = NDArray[np.float64]

VERSION = 1  # raised whenever the pictures change
TARGET = (0.0, 0.0, 0.92)  # what all cameras look at
DISTANCE = 2.9  # of the cameras from it, metres
HEIGHTS = (0.45, 1.35, 2.30)  # of the cameras above the floor
FIELD_OF_VIEW = 0.70  # radians
LIGHTS = (
    ((0.4, -0.7, 0.6), 0.45),
    ((-0.8, 0.1, 0.6), 0.25),
    ((0.3, 0.9, 0.3), 0.20),
)  # directions and strengths
AMBIENT = 0.35
SUPERSAMPLES = 2  # per pixel and axis


@dataclass(frozen=True)
class Coat:
    """What lies over the figure's matte colours: white highlights of the lamps, of this strength (0: none), by Blinn and
    Phong with the exponent 2/roughness^4 - 2. paint: the matte colours, "cloth", "plain" (one grey) or "repeated" (the same
    few centimetres everywhere). mirror: heights (from, to) in metres between which it reflects the room instead."""

    gloss: float = 0.0
    roughness: float = 0.5
    paint: str = "cloth"
    mirror: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        if self.paint not in PAINTS:
            raise InputError(f"coat: found paint {self.paint}, expected one of {', '.join(PAINTS)}")
        if not (0 <= self.gloss <= 10 and 0.05 <= self.roughness <= 1):
            raise InputError(
                f"coat: found gloss {self.gloss} and roughness {self.roughness}, expected 0 to 10 and 0.05 to 1"
            )


def make_sample_scene(
    folder: str | Path,
    views: int = 24,
    test_views: int = 4,
    size: int = 256,
    seed: int = 0,
    coat: Coat | None = None,
) -> Path:
    """Write the sample scene into `folder` and return it.

    views, test_views: cameras around the figure for training and held out; size: of the square pictures, pixels;
    seed: of textures and camera positions; coat: by default none. Raises InputError where the folder cannot be written to.
    """
    folder = Path(folder)
    coat = coat or Coat()
    parameters: dict[str, Any] = {
        "version": VERSION,
        "views": views,
        "test_views": test_views,
        "size": size,
        "seed": seed,
        **asdict(coat),
    }
    last = folder / "transforms_train.json"  # written last: its presence says that all is there
    if _parameters(last) == json.loads(json.dumps(parameters)):
        return folder
    try:
        last.unlink(missing_ok=True)
        for name in ("train", "test", "mask", "background"):
            (folder / name).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{folder}: cannot be written to ({error.strerror}), expected a folder") from error
    mesh = figure_mesh()
    with atomic_write(folder / "gt.ply") as target:
        mesh.export(target)
    rng = np.random.default_rng(seed)
    _ = mesh.vertex_normals, mesh.ray  # made once, before the threads share the mesh
    for split, count in (("test", test_views), ("train", views)):
        cameras = sample_cameras(count, size, turn=float(rng.uniform(0, 2 * np.pi)))
        transforms = folder / f"transforms_{split}.json"
        transforms.unlink(missing_ok=True)
        if count:
            in_threads(partial(_write_view, folder, split, mesh, cameras, seed, coat), range(count))
            _write_transforms(transforms, cameras, split, parameters)
    return folder


def sample_cameras(count: int, size: int, turn: float = 0.0) -> Cameras:
    """`count` cameras around the figure on three heights, evenly by the golden angle, starting at `turn` radians."""
    focal = 0.5 * size / np.tan(0.5 * FIELD_OF_VIEW)
    K = torch.tensor(
        [[focal, 0.0, 0.5 * size], [0.0, focal, 0.5 * size], [0.0, 0.0, 1.0]], dtype=torch.float64
    )
    target = np.array(TARGET)
    poses = []
    for i in range(count):
        angle, height = turn + i * np.pi * (3 - np.sqrt(5)), HEIGHTS[i % len(HEIGHTS)]
        level = np.sqrt(DISTANCE**2 - (height - target[2]) ** 2)
        center = np.array([level * np.cos(angle), level * np.sin(angle), height])
        forward = (target - center) / DISTANCE
        right = np.cross(forward, (0.0, 0.0, 1.0))
        right /= np.linalg.norm(right)
        pose = np.eye(4)
        pose[:3, :3] = [right, np.cross(forward, right), forward]
        pose[:3, 3] = -pose[:3, :3] @ center
        poses.append(pose)
    return Cameras(
        K.repeat(count, 1, 1),
        torch.from_numpy(np.array(poses).reshape(count, 4, 4)),
        torch.full((count, 2), size),
    )


def render_view(
    mesh: trimesh.Trimesh, cameras: Cameras, i: int, seed: int, coat: Coat
) -> tuple[Array, Array, Array]:
    """Photograph [H,W,3], mask [H,W] and plate [H,W,3] of camera i, all in [0, 1]; edges are as soft as pixels are."""
    width, height = (int(s) for s in cameras.size[i])
    fine = SUPERSAMPLES
    v, u = np.mgrid[0 : height * fine, 0 : width * fine]
    pixels = torch.from_numpy((np.stack([u, v], axis=-1).reshape(-1, 2) + 0.5) / fine)
    origins, directions = (rays.numpy() for rays in cameras.rays(i, pixels))
    plate = room_colors(origins, directions, seed).astype(np.float64)
    uv, _ = cameras.project(i, torch.from_numpy(np.array(mesh.vertices)))
    low, high = uv.amin(dim=0) - 1, uv.amax(dim=0) + 1  # only rays that can meet the figure are cast
    near = np.flatnonzero(((pixels > low) & (pixels < high)).all(dim=1).numpy())
    face = np.asarray(mesh.ray.intersects_first(origins[near], directions[near]))
    hit, face = near[face >= 0], face[face >= 0]
    photograph, mask = plate.copy(), np.zeros(len(plate))
    photograph[hit], mask[hit] = _shaded(mesh, face, origins[hit], directions[hit], seed, coat), 1.0

    def pooled(values: Array) -> Array:
        channels = values.reshape(height, fine, width, fine, -1).mean(axis=(1, 3))
        return channels[:, :, 0] if channels.shape[2] == 1 else channels

    return pooled(photograph), pooled(mask), pooled(plate)


def _shaded(
    mesh: trimesh.Trimesh, face: NDArray[np.int64], origins: Array, directions: Array, seed: int, coat: Coat
) -> Array:
    """[M,3] colours where rays meet these faces, with normals interpolated between the vertices."""
    corners = np.asarray(mesh.vertices)[np.asarray(mesh.faces)[face]]
    flat = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    slope = (flat * directions).sum(axis=1)
    distance = (flat * (corners[:, 0] - origins)).sum(axis=1) / np.where(np.abs(slope) > 1e-15, slope, 1e-15)
    points = origins + distance[:, None] * directions
    weights = np.clip(trimesh.triangles.points_to_barycentric(corners, points), 0, 1)
    normals = np.einsum("ij,ijk->ik", weights, np.asarray(mesh.vertex_normals)[np.asarray(mesh.faces)[face]])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    light, highlight = np.full(len(points), AMBIENT), np.zeros(len(points))
    for towards, strength in LIGHTS:
        lamp = np.array(towards) / np.linalg.norm(towards)
        # half-Lambert: as soft as a lamp of the size of a wall
        light += strength * (0.5 + 0.5 * normals @ lamp) ** 2
        halfway = lamp - directions
        halfway /= np.linalg.norm(halfway, axis=1, keepdims=True)
        highlight += strength * np.clip((normals * halfway).sum(axis=1), 0, 1) ** (2 / coat.roughness**4 - 2)
    colors = PAINTS[coat.paint](points, seed) * light[:, None] + coat.gloss * highlight[:, None]
    if coat.mirror is not None:
        low, high = coat.mirror
        patch = (points[:, 2] > low) & (points[:, 2] < high)
        slope = (normals * directions).sum(axis=1, keepdims=True)
        reflected = (directions - 2 * slope * normals)[patch]
        colors[patch] = room_colors(points[patch], reflected, seed)
    return np.clip(colors, 0, 1)


def _write_view(
    folder: Path, split: str, mesh: trimesh.Trimesh, cameras: Cameras, seed: int, coat: Coat, i: int
) -> None:
    photograph, mask, plate = render_view(mesh, cameras, i, seed, coat)
    names = _names(split, i)
    for name, picture in zip(names, (photograph, mask, plate), strict=True):
        pixels = np.round(255 * picture).astype(np.uint8)
        with atomic_write(folder / name) as target:
            cv2.imwrite(str(target), pixels[:, :, ::-1] if pixels.ndim == 3 else pixels)


def _names(split: str, i: int) -> tuple[str, str, str]:
    return f"{split}/{i:03d}.png", f"mask/{split}_{i:03d}.png", f"background/{split}_{i:03d}.png"


def _write_transforms(path: Path, cameras: Cameras, split: str, parameters: dict[str, Any]) -> None:
    to_world = camtoworld_vision_to_graphics_4x4(torch.linalg.inv(cameras.world_to_camera))
    K, size = cameras.K[0], cameras.size[0]
    frames = []
    for i, pose in enumerate(to_world.tolist()):
        photograph, mask, plate = _names(split, i)
        frames.append(
            {"file_path": photograph, "mask_path": mask, "background_path": plate, "transform_matrix": pose}
        )
    content: dict[str, Any] = {
        "sample_scene": parameters,
        "fl_x": float(K[0, 0]),
        "fl_y": float(K[1, 1]),
        "cx": float(K[0, 2]),
        "cy": float(K[1, 2]),
        "w": int(size[0]),
        "h": int(size[1]),
        "frames": frames,
    }
    with atomic_write(path) as target:
        target.write_text(json.dumps(content, indent=1), encoding="utf-8")


def _parameters(path: Path) -> Any:
    try:
        return json.loads(path.read_text(encoding="utf-8")).get("sample_scene")
    except (OSError, ValueError):
        return None


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit status."""
    parser = argparse.ArgumentParser(description="Make the sample scene.")
    parser.add_argument("folder", metavar="OUT")
    parser.add_argument("--views", type=int, default=24)
    parser.add_argument("--test-views", type=int, default=4)
    parser.add_argument("--size", type=int, default=256, help="of the square pictures, pixels")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--gloss", type=float, default=Coat.gloss, help="strength of highlights, 0: matte")
    parser.add_argument("--roughness", type=float, default=Coat.roughness, help="of the gloss, above 0 to 1")
    options = parser.parse_args(arguments)
    try:
        coat = Coat(options.gloss, options.roughness)
        make_sample_scene(options.folder, options.views, options.test_views, options.size, options.seed, coat)
    except InputError as error:
        print(error, file=sys.stderr)
        return 2
    print(
        f"{options.folder}: {options.views} + {options.test_views} views of {options.size} x {options.size} pixels"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
