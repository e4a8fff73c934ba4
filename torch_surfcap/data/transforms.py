"""transforms.json of NeRF-synthetic, nerfstudio and instant-ngp.

Poses are camera-to-world with OpenGL axes (x right, y up, z backward), pixel centres at one half. Intrinsics stand in
the file or, per frame, in the frame: fl_x fl_y cx cy w h, or camera_angle_x [camera_angle_y]; k1 k2 p1 p2 k3 are undone.
A frame's file_path may come without its suffix. mask_path is nerfstudio's; background_path, the picture of the empty
room from the same camera, is ours. transforms_test.json beside transforms_train.json, or nerfstudio's test_filenames,
name the held-out views.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from kornia.geometry.conversions import camtoworld_graphics_to_vision_4x4

from torch_surfcap.data.images import SUFFIXES
from torch_surfcap.data.load import picture_beside
from torch_surfcap.data.parse import matrix, read_json
from torch_surfcap.data.view import Matrix, View
from torch_surfcap.errors import InputError

MODELS = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL")
FISHEYE = (
    "k4",
)  # of the pinhole models with lens distortion none has a fourth radial term without k5 and k6


def find(path: Path) -> Path | None:
    """The calibration file of a folder, or the file itself where it is one of this format."""
    if path.is_dir():
        names = ("transforms_train.json", "transforms.json")
        return next((path / name for name in names if (path / name).is_file()), None)
    return path if path.suffix == ".json" and "frames" in read_json(path) else None


def read(path: Path) -> list[View]:
    """The views of a transforms file; those of transforms_test.json follow, held out."""
    views = _read_file(path, held_out=False)
    test = path.with_name("transforms_test.json")
    if path.name == "transforms_train.json" and test.is_file():
        views += _read_file(test, held_out=True)
    return views


def _read_file(path: Path, held_out: bool) -> list[View]:
    content = read_json(path)
    frames = content.get("frames")
    if not isinstance(frames, list) or not all(isinstance(frame, dict) for frame in frames):
        raise InputError(
            f"{path}: no list of frames, expected the key 'frames' with one object per photograph"
        )
    test_names = set(content.get("test_filenames") or ())
    views = []
    for number, frame in enumerate(frames):
        source = f"{path}, frame {number}"
        if "file_path" not in frame or "transform_matrix" not in frame:
            raise InputError(f"{source}: keys {sorted(frame)}, expected file_path and transform_matrix")
        to_world = torch.from_numpy(matrix(frame["transform_matrix"], (4, 4), "transform_matrix", source))
        settings = {**content, **frame}
        name = str(frame["file_path"])
        views.append(
            View(
                name=_short(name),
                image=picture_beside(path.parent / name, SUFFIXES),
                source=source,
                K=_intrinsics(settings, source),
                world_to_camera=_inverse(
                    camtoworld_graphics_to_vision_4x4(to_world[None])[0].numpy(), source
                ),
                mask=_beside(path, frame.get("mask_path")),
                plate=_beside(path, frame.get("background_path")),
                distortion=_distortion(settings, source),
                size=_stated_size(settings, source),
                held_out=held_out or name in test_names,
            )
        )
    return views


def _short(file_path: str) -> str:
    name = file_path[2:] if file_path.startswith("./") else file_path
    suffix = Path(name).suffix
    return name[: -len(suffix)] if suffix.lower() in SUFFIXES else name


def _beside(path: Path, name: Any) -> Path | None:
    return picture_beside(path.parent / str(name), SUFFIXES) if name else None


def _number(settings: dict[str, Any], key: str, source: str) -> float:
    return float(matrix(settings[key], (), key, source))


def _inverse(to_world: Matrix, source: str) -> Matrix:
    if not np.isfinite(to_world).all():
        raise InputError(f"{source}: the pose holds NaN or infinite values, expected finite numbers")
    if abs(np.linalg.det(to_world[:3, :3])) < 1e-12:
        raise InputError(f"{source}: transform_matrix is singular, expected a rotation and a translation")
    return np.linalg.inv(to_world).astype(np.float64)


def _stated_size(settings: dict[str, Any], source: str) -> tuple[int, int] | None:
    if "w" not in settings or "h" not in settings:
        return None
    return int(_number(settings, "w", source)), int(_number(settings, "h", source))


def _distortion(settings: dict[str, Any], source: str) -> tuple[float, ...]:
    model = str(settings.get("camera_model", "OPENCV"))
    if model not in MODELS or settings.get("k4") or settings.get("is_fisheye"):
        found = model if model not in MODELS else "with fisheye terms (k4, is_fisheye)"
        raise InputError(
            f"{source}: camera model {found}, expected one of {', '.join(MODELS)} (k1 k2 p1 p2 k3)"
        )
    keys = ("k1", "k2", "p1", "p2", "k3")
    values = tuple(_number(settings, key, source) if settings.get(key) is not None else 0.0 for key in keys)
    return values if any(values) else ()


def _intrinsics(settings: dict[str, Any], source: str) -> Matrix | Callable[[int, int], Matrix]:
    """K from focal lengths, or from angles once the picture's size is known."""
    if "fl_x" not in settings and "camera_angle_x" not in settings:
        raise InputError(
            f"{source}: no focal length, expected fl_x or camera_angle_x in the file or the frame"
        )
    known = {
        key: _number(settings, key, source)
        for key in ("fl_x", "fl_y", "cx", "cy", "camera_angle_x", "camera_angle_y")
        if settings.get(key) is not None
    }

    def K(width: int, height: int) -> Matrix:
        fx = known["fl_x"] if "fl_x" in known else 0.5 * width / math.tan(0.5 * known["camera_angle_x"])
        fy = fx
        if "fl_y" in known:
            fy = known["fl_y"]
        elif "camera_angle_y" in known and "fl_x" not in known:
            fy = 0.5 * height / math.tan(0.5 * known["camera_angle_y"])
        cx, cy = known.get("cx", 0.5 * width), known.get("cy", 0.5 * height)
        return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])

    size = _stated_size(settings, source)
    return K(*size) if size else K
