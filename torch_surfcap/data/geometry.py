"""Reading meshes and point clouds."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray

from torch_surfcap.errors import InputError

Points = NDArray[np.float64]


def read_mesh(path: Path) -> trimesh.Trimesh:
    """A triangle mesh. Raises InputError naming the file where it is missing, damaged, without triangles or not finite."""
    try:
        mesh = trimesh.load(path, force="mesh", process=False)
    except Exception as error:  # trimesh's readers raise whatever their parsing trips over
        raise InputError(f"{path}: {error}, expected a triangle mesh") from error
    if not isinstance(mesh, trimesh.Trimesh) or len(mesh.faces) == 0:
        raise InputError(f"{path}: no triangles, expected a triangle mesh")
    if not np.isfinite(mesh.vertices).all():
        raise InputError(f"{path}: vertices with NaN or infinite values, expected finite numbers")
    return mesh


def read_points(path: Path) -> Points:
    """Points [P, 3]: "points", or the only table of numbers, of an .npz; the vertices of anything else trimesh reads."""
    try:
        if path.suffix == ".npz":
            with np.load(path, allow_pickle=False) as file:
                names = [name for name in file.files if file[name].ndim == 2 and file[name].dtype.kind == "f"]
                points = file["points" if "points" in names or len(names) != 1 else names[0]]
        else:
            points = np.asarray(getattr(trimesh.load(path, process=False), "vertices", ()))
    except Exception as error:  # as in read_mesh
        raise InputError(f"{path}: {error}, expected points") from error
    if points.ndim != 2 or points.shape[1] != 3 or len(points) == 0 or not np.isfinite(points).all():
        raise InputError(f"{path}: an array of shape {list(points.shape)}, expected finite points [P, 3]")
    return np.asarray(points, dtype=np.float64)
