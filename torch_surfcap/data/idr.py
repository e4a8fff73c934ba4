"""cameras_sphere.npz or cameras.npz of IDR and NeuS, with the folders image/ and mask/.

world_mat_i is the projection matrix of the i-th picture (in the order of file names), of any scale and sign, OpenCV
axes, integer pixel centres. scale_mat_i only says where the subject is in a unit sphere; it is not used, and results
stay in world units.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import torch
from kornia.geometry import KRt_from_projection

from torch_surfcap.data.images import SUFFIXES
from torch_surfcap.data.parse import matrix, pose
from torch_surfcap.data.view import Matrix, View
from torch_surfcap.errors import InputError

FILES = ("cameras_sphere.npz", "cameras.npz")


def find(path: Path) -> Path | None:
    """The calibration file of a folder, or the file itself where it is one of this format."""
    if path.is_dir():
        return next((path / name for name in FILES if (path / name).is_file()), None)
    return path if path.suffix == ".npz" else None


def read(path: Path) -> list[View]:
    """One view per world_mat_i."""
    try:
        with np.load(path, allow_pickle=False) as content:
            matrices = {int(k[10:]): content[k] for k in content.files if re.fullmatch(r"world_mat_\d+", k)}
    except (OSError, ValueError) as error:
        raise InputError(
            f"{path}: cannot be read ({error}), expected a .npz with world_mat_0, ..."
        ) from error
    images, masks = _pictures(path.parent / "image"), _pictures(path.parent / "mask")
    if sorted(matrices) != list(range(len(images))):
        found = f"{len(matrices)} cameras (world_mat_i) for {len(images)} pictures in image/"
        raise InputError(f"{path}: {found}, expected one each")
    if masks and len(masks) != len(images):
        found = f"{len(masks)} masks for {len(images)} pictures in image/"
        raise InputError(f"{path.parent / 'mask'}: {found}, expected one each")
    views = []
    for i, image in enumerate(images):
        source = f"{path}, world_mat_{i}"
        K, world_to_camera = decompose(_top(matrices[i], source), source)
        K[:2, 2] += 0.5  # the first pixel's centre moves from (0, 0) to (0.5, 0.5)
        views.append(View(image.stem, image, source, K, world_to_camera, mask=masks[i] if masks else None))
    return views


def decompose(P: Matrix, source: str) -> tuple[Matrix, Matrix]:
    """K [3,3] with K[2,2] = 1 and world-to-camera [4,4] of a projection matrix [3,4] of any scale and sign."""
    if not np.isfinite(P).all():
        raise InputError(f"{source}: NaN or infinite values, expected a projection matrix")
    if np.linalg.matrix_rank(P[:, :3]) < 3:
        raise InputError(f"{source}: singular, expected a projection matrix of rank 3")
    K, R, t = (part[0].numpy() for part in KRt_from_projection(torch.from_numpy(P)[None]))
    # R^T R = I only up to the rounding of float32 files; K is upper triangular up to the same
    return np.triu(K / K[2, 2]), pose(R, t)


def _top(values: Matrix, source: str) -> Matrix:
    return matrix(values[:3] if values.ndim == 2 else values, (3, 4), "the matrix's upper part", source)


def _pictures(folder: Path) -> list[Path]:
    if not folder.is_dir():
        return []
    return sorted(p for p in folder.iterdir() if p.suffix.lower() in SUFFIXES and not p.name.startswith("."))
