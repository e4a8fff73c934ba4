"""Fields with a known surface for the tests of this folder."""

from __future__ import annotations

import numpy as np
import torch
import trimesh

from torch_surfcap.field.field import SurfaceField

CENTER, RADIUS, VOXEL = np.array([0.13, -0.2, 0.31]), 0.25, 0.02


def ball_distance(shape: tuple[int, int, int] = (40, 40, 40)) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Origin [3], voxel centres [X, Y, Z, 3] and their signed distances [X, Y, Z] to the ball, world units."""
    origin = CENTER - 0.5 * VOXEL * np.array(shape) + 0.003
    index = np.stack(np.meshgrid(*[np.arange(n) for n in shape], indexing="ij"), axis=-1)
    centers = origin + (index + 0.5) * VOXEL
    return origin, centers, np.linalg.norm(centers - CENTER, axis=-1) - RADIUS


def soft(distance: np.ndarray) -> np.ndarray:
    """Transparency that rises linearly over four voxels and is 0.81 at distance 0, clamped to [0.01, 1]."""
    return np.clip(0.81 + 0.25 * distance / VOXEL, 0.01, 1.0)


def signed(distance: np.ndarray) -> np.ndarray:
    """Signed distance in voxels, constant beyond four voxels, as a field of distances keeps it."""
    return np.clip(distance / VOXEL, -4.0, 4.0)


def field_of(
    values: np.ndarray, origin: np.ndarray, color: np.ndarray | None = None, **more: str
) -> SurfaceField:
    """Field of degree 0 with these values [X, Y, Z] and colours [X, Y, Z, 3] (grey if None)."""
    sh = np.full((*values.shape, 3), 0.5) if color is None else color
    values_tensor, sh_tensor = torch.from_numpy(values).float(), torch.from_numpy(sh[..., None, :]).float()
    return SurfaceField.from_dense(values_tensor, sh_tensor, torch.from_numpy(origin), VOXEL, **more)


def ball(color: np.ndarray | None = None) -> SurfaceField:
    """A ball of RADIUS about CENTER."""
    origin, _, distance = ball_distance()
    return field_of(soft(distance), origin, color)


def colors_of(mesh: trimesh.Trimesh) -> np.ndarray:
    """[V, 3] vertex colours in [0, 1]."""
    assert isinstance(mesh.visual, trimesh.visual.ColorVisuals)
    return np.asarray(mesh.visual.vertex_colors)[:, :3] / 255.0


def half_of(mesh: trimesh.Trimesh, axis: int) -> trimesh.Trimesh:
    """The faces of a mesh on the side of CENTER on which x, y or z (0, 1, 2) is greater."""
    faces = mesh.faces[mesh.triangles_center[:, axis] > CENTER[axis]]
    return trimesh.Trimesh(mesh.vertices, faces, process=False)


def tiled(dense: np.ndarray) -> tuple[torch.Tensor, torch.Tensor]:
    """Voxels [T, 4, 4, 4] and table of a dense grid of whole tiles, every tile stored, with the outside rim."""
    x, y, z = (n // 4 for n in dense.shape)
    voxels = dense.reshape(x, 4, y, 4, z, 4).transpose(0, 2, 4, 1, 3, 5).reshape(-1, 4, 4, 4)
    table = torch.full((x + 2, y + 2, z + 2), -2, dtype=torch.int32)
    table[1:-1, 1:-1, 1:-1] = torch.arange(x * y * z).view(x, y, z)
    return torch.from_numpy(voxels.astype(np.float32)), table


def assert_closed(faces: torch.Tensor) -> None:
    """Every edge has exactly two faces, which go along it in opposite directions."""
    start, end = faces.cpu()[:, [0, 1, 1, 2, 2, 0]].view(-1, 2).unbind(1)
    count = int(faces.max()) + 1
    there, times = (start * count + end).unique(return_counts=True)
    assert (times == 1).all()
    assert torch.equal(there, (end * count + start).unique())
