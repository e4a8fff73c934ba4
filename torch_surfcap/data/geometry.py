"""Reading and writing meshes, reading point clouds."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray

from torch_surfcap.errors import InputError

Points = NDArray[np.float64]

ROUNDING = 1e-3  # of a mesh's mean edge: what single precision may move a vertex by in a file
SAMPLE = 10_000  # triangles, at least, that the mean is taken of
CHANNELS = ("red", "green", "blue", "alpha")


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


def export_mesh(path: Path, mesh: trimesh.Trimesh) -> None:
    """Write a mesh in the format that the suffix names.

    Far from the world's origin, where single precision has no place for the vertices, a PLY gets double precision. A GLB
    cannot: it has the vertices about their middle, and in their node's matrix where that is.
    """
    vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    start, end = vertices[faces[:: 1 + len(faces) // SAMPLE, :2]].swapaxes(0, 1)
    edge = np.linalg.norm(end - start, axis=1).mean() if len(faces) else np.inf
    moved = np.abs(vertices - vertices.astype(np.float32)).max(initial=0.0)
    if moved <= ROUNDING * edge or path.suffix not in (".ply", ".glb"):
        mesh.export(str(path))
    elif path.suffix == ".ply":
        path.write_bytes(_double_ply(mesh))
    else:
        middle, scene = mesh.bounds.mean(axis=0), trimesh.Scene()
        near = mesh.copy().apply_translation(-middle)
        scene.add_geometry(near, transform=trimesh.transformations.translation_matrix(middle))
        scene.export(str(path))


def _double_ply(mesh: trimesh.Trimesh) -> bytes:
    """Binary PLY of the vertices in double precision, their colours, where they have some, and the faces."""
    count, visual = (len(mesh.vertices), len(mesh.faces)), mesh.visual
    colors = np.empty((count[0], 0), np.uint8)
    if isinstance(visual, trimesh.visual.ColorVisuals) and visual.kind == "vertex":
        colors = visual.vertex_colors
    at = np.ascontiguousarray(mesh.vertices, "<f8").view(np.uint8)
    corners = np.ascontiguousarray(mesh.faces, "<i4").view(np.uint8)
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"element vertex {count[0]}",
        *(f"property double {axis}" for axis in "xyz"),
        *(f"property uchar {channel}" for channel in CHANNELS[: colors.shape[1]]),
        f"element face {count[1]}",
        "property list uchar int vertex_indices",
        "end_header\n",
    ]
    rows = np.hstack([at, colors]), np.hstack([np.full((count[1], 1), 3, np.uint8), corners])
    return "\n".join(header).encode() + b"".join(row.tobytes() for row in rows)


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
