"""Pictures from calibrated cameras: of the field along rays, of the field at the mesh, and of the bare geometry.

All pictures are float32 on the CPU, row-major like the photographs. A background is a number, a colour [3] or a
picture [H, W, 3]; it fills what nothing covers.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
import trimesh
from numpy.typing import NDArray
from torch import Tensor

from torch_surfcap.data.cameras import Cameras
from torch_surfcap.distance import Array, face_normals, row_dot

if TYPE_CHECKING:
    from torch_surfcap.field.field import SurfaceField

Background = float | Sequence[float] | Tensor

CHUNK = 1 << 16  # rays or points handed to the field at a time
GREY = 0.85  # albedo of the shaded geometry


@dataclass
class Hits:
    """Where a camera's pixel rays first meet a mesh.

    size: (height, width); pixel [M]: row-major number of the pixels that hit; face [M]; point, direction [M, 3]:
    world units and unit vectors; distance [M]: along the ray from the camera's centre.
    """

    size: tuple[int, int]
    pixel: NDArray[np.int64]
    face: NDArray[np.int64]
    point: Array
    direction: Array
    distance: Array

    def picture(self, values: Tensor, background: Tensor) -> Tensor:
        """[H, W, C] float32 with values [M, C] at the pixels that hit and background [H*W, C] elsewhere."""
        out = background.clone()
        out[torch.from_numpy(self.pixel)] = values.detach().cpu().float()
        return out.reshape(*self.size, -1)


def cast(mesh: trimesh.Trimesh, cameras: Cameras, i: int) -> Hits:
    """First hits of the rays through camera i's pixel centres.

    The ray caster finds the triangle in single precision; the point is then taken on its plane in double.
    """
    width, height = (int(s) for s in cameras.size[i])
    origins, directions = (x.numpy() for x in cameras.rays(i))
    if len(mesh.faces) == 0:
        face = np.full(len(origins), -1)
    else:
        face = np.asarray(mesh.ray.intersects_first(origins, directions), dtype=np.int64)
    pixel = np.flatnonzero(face >= 0)
    face, origins, directions = face[pixel], origins[pixel], directions[pixel]
    offset = np.asarray(mesh.vertices, dtype=np.float64)[np.asarray(mesh.faces)[face]] - origins[:, None]
    normal = np.cross(offset[:, 1] - offset[:, 0], offset[:, 2] - offset[:, 0])
    slope = row_dot(normal, directions)
    distance = row_dot(normal, offset[:, 0]) / np.where(slope != 0, slope, 1.0)
    # Grazing rays: no farther out than the triangle itself.
    along = np.einsum("ijk,ik->ij", offset, directions)
    distance = np.clip(distance, along.min(axis=1, initial=np.inf), along.max(axis=1, initial=-np.inf))
    return Hits((height, width), pixel, face, origins + distance[:, None] * directions, directions, distance)


def raster(
    field: SurfaceField, mesh: trimesh.Trimesh, cameras: Cameras, i: int, background: Background
) -> Tensor:
    """[H, W, 3]: the field's colour, in the direction of the ray, at the first point of the mesh in each pixel."""
    hits = cast(mesh, cameras, i)
    colors = torch.zeros(len(hits.pixel), 3)
    with torch.no_grad():
        for s in range(0, len(colors), CHUNK):
            at, towards = (
                torch.from_numpy(x[s : s + CHUNK]).to(field.voxels) for x in (hits.point, hits.direction)
            )
            colors[s : s + CHUNK] = field.sample(at, towards)[1].cpu().float()
    return hits.picture(colors, backdrop(background, hits.size))


def volume(field: SurfaceField, cameras: Cameras, i: int, background: Background) -> Tensor:
    """[H, W, 3]: the integral of the field along each pixel's ray. Only rays that meet the field's box are marched."""
    width, height = (int(s) for s in cameras.size[i])
    origins, directions = cameras.rays(i)
    out = backdrop(background, (height, width))
    inside = torch.nonzero(meets_box(origins, directions, *field_box(field)))[:, 0]
    with torch.no_grad():
        for rows in inside.split(CHUNK):
            o, d, behind = (x[rows].to(field.voxels) for x in (origins, directions, out))
            out[rows] = field(o, d, background=behind).color.cpu().float()
    return out.reshape(height, width, 3)


def field_box(field: SurfaceField) -> tuple[Tensor, Tensor]:
    """Low and high corner [3] (float64, world units) of what the field can hold, with a voxel of margin for the
    interpolation."""
    low = torch.tensor(field.frame[:3], dtype=torch.float64)
    tiles = torch.tensor(field.table.shape, dtype=torch.float64)
    return low + 3 * field.voxel_size, low + (4 * tiles - 3) * field.voxel_size


def meets_box(origins: Tensor, directions: Tensor, low: Tensor, high: Tensor) -> Tensor:
    """[R] bool: whether each ray (origins, directions [R, 3], forwards only) meets the box between two corners."""
    # Where a direction has no component along an axis, 1 / 0 = inf gives the slab's interval all or nothing.
    to_low, to_high = (low - origins) / directions, (high - origins) / directions
    near = torch.minimum(to_low, to_high).nan_to_num(nan=-torch.inf).amax(dim=1)
    far = torch.maximum(to_low, to_high).nan_to_num(nan=torch.inf).amin(dim=1)
    return far >= near.clamp(min=0)


def shaded(mesh: trimesh.Trimesh, cameras: Cameras, i: int, background: Background = 1.0) -> Tensor:
    """[H, W, 3]: grey matt geometry under a lamp at the camera, shaded flat per face, so that steps show."""
    hits = cast(mesh, cameras, i)
    light = GREY * np.abs(row_dot(_normals(mesh, hits), hits.direction))
    values = torch.from_numpy(light)[:, None].expand(-1, 3)
    return hits.picture(values, backdrop(background, hits.size))


def mesh_mask(mesh: trimesh.Trimesh, cameras: Cameras, i: int) -> Tensor:
    """[H, W]: 1 where the pixel's centre sees the mesh, else 0."""
    hits = cast(mesh, cameras, i)
    return hits.picture(torch.ones(len(hits.pixel), 1), torch.zeros(hits.size[0] * hits.size[1], 1))[:, :, 0]


def mesh_depth(mesh: trimesh.Trimesh, cameras: Cameras, i: int) -> Tensor:
    """[H, W]: distance from the camera's centre along the ray, world units; NaN where nothing is hit."""
    hits = cast(mesh, cameras, i)
    empty = torch.full((hits.size[0] * hits.size[1], 1), torch.nan)
    return hits.picture(torch.from_numpy(hits.distance)[:, None], empty)[:, :, 0]


def mesh_normals(mesh: trimesh.Trimesh, cameras: Cameras, i: int, background: Background = 1.0) -> Tensor:
    """[H, W, 3]: face normals in the camera's axes (x right, y down, z forward) as colours, -1..1 to 0..1."""
    hits = cast(mesh, cameras, i)
    turn = cameras.world_to_camera[i, :3, :3]
    normals = torch.from_numpy(_normals(mesh, hits)) @ turn.T
    return hits.picture(0.5 + 0.5 * normals, backdrop(background, hits.size))


def colored(mesh: trimesh.Trimesh, cameras: Cameras, i: int, background: Background = 1.0) -> Tensor:
    """[H, W, 3]: the mesh's own vertex colours, interpolated within the faces, under a lamp at the camera."""
    if not isinstance(mesh.visual, trimesh.visual.ColorVisuals):
        raise ValueError("a mesh with vertex colours is needed")
    hits = cast(mesh, cameras, i)
    faces = np.asarray(mesh.faces)[hits.face]
    weights = trimesh.triangles.points_to_barycentric(np.asarray(mesh.vertices)[faces], hits.point)
    colors = np.asarray(mesh.visual.vertex_colors)[faces, :3] / 255.0
    light = np.abs(row_dot(_normals(mesh, hits), hits.direction))
    values = (0.4 + 0.6 * light)[:, None] * np.einsum("ij,ijk->ik", weights, colors)
    return hits.picture(torch.from_numpy(values), backdrop(background, hits.size))


def _normals(mesh: trimesh.Trimesh, hits: Hits) -> Array:
    return face_normals(np.asarray(mesh.vertices, dtype=np.float64)[np.asarray(mesh.faces)[hits.face]])


def backdrop(background: Background, size: tuple[int, int]) -> Tensor:
    """A background as a fresh [H*W, 3] float32 for a picture of (height, width)."""
    color = torch.as_tensor(background, dtype=torch.float32).cpu()
    if color.ndim == 3 and color.shape != (*size, 3):
        raise ValueError(f"background: expected [{size[0]}, {size[1]}, 3], got {list(color.shape)}")
    return color.expand(*size, 3).reshape(-1, 3).clone()
