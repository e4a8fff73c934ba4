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

from torch_surfcap import ops
from torch_surfcap.data.cameras import Cameras
from torch_surfcap.devices import CPU
from torch_surfcap.distance import Array, face_normals, row_dot

if TYPE_CHECKING:
    from torch_surfcap.field.field import SurfaceField

Background = float | Sequence[float] | Tensor

CHUNK = 1 << 16  # rays or points handed to the field at a time
GREY = 0.85  # albedo of the shaded geometry
MID_GREY = 0.5  # colour on which the view-dependent part is shown


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


def window(cameras: Cameras, i: int, low: Tensor, high: Tensor) -> Tensor:
    """Row-major numbers [M] of the pixels of camera i in which a box (corners [3], world units) can be seen: a
    rectangle, or all pixels where a part of the box is not in front of the camera."""
    width, height = (int(s) for s in cameras.size[i])
    corners = torch.cartesian_prod(*torch.stack([low, high], dim=1).double())
    uv, depth = cameras.project(i, corners)
    left, top, right, bottom = 0, 0, width, height
    if (depth > 0).all():
        left, top = (max(0, int(x)) for x in uv.amin(dim=0).clamp(-1, 1e6).floor())
        right, bottom = (int(x) for x in torch.minimum(uv.amax(dim=0).clamp(min=0).ceil(), cameras.size[i]))
    rows, columns = torch.arange(top, max(top, bottom)), torch.arange(left, max(left, right))
    return (rows[:, None] * width + columns).reshape(-1)


def pixel_rays(cameras: Cameras, i: int, pixels: Tensor) -> tuple[Tensor, Tensor]:
    """Origins and unit directions [M, 3] of the rays through the centres of the pixels numbered [M]."""
    width = int(cameras.size[i, 0])
    return cameras.rays(i, torch.stack([pixels % width, pixels // width], dim=1) + 0.5)


def cast(mesh: trimesh.Trimesh, cameras: Cameras, i: int, device: torch.device = CPU) -> Hits:
    """First hits of the rays through camera i's pixel centres.

    The triangle is found in single precision, on the CPU by a ray caster and elsewhere by a z-buffer, which leaves out
    triangles that reach behind the camera; the point is then taken on its plane in double.
    """
    width, height = (int(s) for s in cameras.size[i])
    box = np.zeros((2, 3)) if len(mesh.faces) == 0 else np.array(mesh.bounds)
    pixels = window(cameras, i, *torch.from_numpy(box))
    face = first_faces(mesh, cameras, i, pixels, device)
    hit = np.flatnonzero(face >= 0)
    face, pixels = face[hit], pixels[torch.from_numpy(hit)]
    origins, directions = (x.numpy() for x in pixel_rays(cameras, i, pixels))
    offset = np.asarray(mesh.vertices, dtype=np.float64)[np.asarray(mesh.faces)[face]] - origins[:, None]
    normal = np.cross(offset[:, 1] - offset[:, 0], offset[:, 2] - offset[:, 0])
    slope = row_dot(normal, directions)
    distance = row_dot(normal, offset[:, 0]) / np.where(slope != 0, slope, 1.0)
    # Grazing rays: no farther out than the triangle itself.
    along = np.einsum("ijk,ik->ij", offset, directions)
    distance = np.clip(distance, along.min(axis=1, initial=np.inf), along.max(axis=1, initial=-np.inf))
    point = origins + distance[:, None] * directions
    return Hits((height, width), pixels.numpy(), face, point, directions, distance)


def first_faces(
    mesh: trimesh.Trimesh, cameras: Cameras, i: int, pixels: Tensor, device: torch.device
) -> NDArray[np.int64]:
    """[M] the face that the ray through each of the pixels numbered [M] meets first, -1 where there is none."""
    if len(mesh.faces) == 0 or len(pixels) == 0:
        return np.full(len(pixels), -1)
    if device.type != "cpu":
        return z_buffer(mesh, cameras, i, device).flatten()[pixels].numpy().astype(np.int64)
    origins, directions = (x.numpy() for x in pixel_rays(cameras, i, pixels))
    first = np.full(len(pixels), -1)
    # Not `intersects_first`, which rounds the origins to single precision, however far from them the mesh is.
    face, ray = mesh.ray.intersects_id(origins, directions, multiple_hits=False)
    first[ray] = face
    return first


def z_buffer(mesh: trimesh.Trimesh, cameras: Cameras, i: int, device: torch.device) -> Tensor:
    """[H, W] int32 on the CPU: the face that each pixel of camera i sees, found on a device; -1 where there is none."""
    width, height = (int(s) for s in cameras.size[i])
    vertices, faces = torch.tensor(mesh.vertices, device=device), torch.tensor(mesh.faces, device=device)
    projection = cameras.projection_matrices()[i].to(device)
    seen = vertices @ projection[:, :3].T + projection[:, 3]
    corners = torch.cat([seen[:, :2] / seen[:, 2:], seen[:, 2:]], 1).float()
    return ops.rasterize(corners, faces.int(), height, width).cpu()


def raster(
    field: SurfaceField,
    mesh: trimesh.Trimesh,
    cameras: Cameras,
    i: int,
    background: Background,
    hits: Hits | None = None,
) -> Tensor:
    """[H, W, 3]: the field's colour, in the direction of the ray, at the first point of the mesh in each pixel.

    hits: what `cast` found for this mesh and camera, where it is known already.
    """
    hits = cast(mesh, cameras, i, field.voxels.device) if hits is None else hits
    colors = torch.zeros(len(hits.pixel), 3)
    with torch.no_grad():
        for s in range(0, len(colors), CHUNK):
            at, towards = (torch.from_numpy(x[s : s + CHUNK]) for x in (hits.point, hits.direction))
            colors[s : s + CHUNK] = field.sample(at, towards)[1].cpu().float()
    return hits.picture(colors, backdrop(background, hits.size))


def light(field: SurfaceField, cameras: Cameras, i: int) -> tuple[Tensor, Tensor]:
    """The field's own part of each pixel's ray, colour [H, W, 3], and the transmittance [H, W] that is left for what lies
    behind; marched where the field's box can be seen."""
    width, height = (int(s) for s in cameras.size[i])
    color, through = torch.zeros(height * width, 3), torch.ones(height * width)
    with torch.no_grad():
        for pixels in window(cameras, i, *field_box(field)).split(CHUNK):
            seen = field(*pixel_rays(cameras, i, pixels))
            color[pixels], through[pixels] = seen.color.cpu().float(), seen.transmittance.cpu().float()
    return color.reshape(height, width, 3), through.reshape(height, width)


def volume(field: SurfaceField, cameras: Cameras, i: int, background: Background) -> Tensor:
    """[H, W, 3]: the integral of the field along each pixel's ray."""
    color, through = light(field, cameras, i)
    return color + through[:, :, None] * backdrop(background, through.shape).reshape(color.shape)


def constant_part(field: SurfaceField) -> SurfaceField:
    """The field with its constant colour β_00 alone: what does not depend on the direction of view."""
    return type(field)(field.voxels.detach()[..., :4], field.grid, field.opacity, field.step)


def view_dependent_part(field: SurfaceField) -> SurfaceField:
    """The field with mid grey in place of β_00: what depends on the direction of view, brighter or darker than that."""
    voxels = field.voxels.detach().clone()
    voxels[..., 1:4] = MID_GREY
    return type(field)(voxels, field.grid, field.opacity, field.step, field.view)


def field_box(field: SurfaceField) -> tuple[Tensor, Tensor]:
    """Low and high corner [3] (float64, world units) of what the field can hold, with a voxel of margin for the
    interpolation."""
    low = torch.tensor(field.frame[:3], dtype=torch.float64)
    tiles = torch.tensor(field.table.shape, dtype=torch.float64)
    return low + 3 * field.voxel_size, low + (4 * tiles - 3) * field.voxel_size


def shaded(
    mesh: trimesh.Trimesh, cameras: Cameras, i: int, background: Background = 1.0, hits: Hits | None = None
) -> Tensor:
    """[H, W, 3]: grey matt geometry under a lamp at the camera, shaded flat per face, so that steps show."""
    hits = cast(mesh, cameras, i) if hits is None else hits
    light = GREY * np.abs(row_dot(_normals(mesh, hits), hits.direction))
    values = torch.from_numpy(light)[:, None].expand(-1, 3)
    return hits.picture(values, backdrop(background, hits.size))


def mesh_mask(mesh: trimesh.Trimesh, cameras: Cameras, i: int, hits: Hits | None = None) -> Tensor:
    """[H, W]: 1 where the pixel's centre sees the mesh, else 0."""
    hits = cast(mesh, cameras, i) if hits is None else hits
    return hits.picture(torch.ones(len(hits.pixel), 1), torch.zeros(hits.size[0] * hits.size[1], 1))[:, :, 0]


def mesh_depth(mesh: trimesh.Trimesh, cameras: Cameras, i: int, hits: Hits | None = None) -> Tensor:
    """[H, W]: depth along the optical axis, world units; NaN where nothing is hit."""
    hits = cast(mesh, cameras, i) if hits is None else hits
    forward, offset = cameras.world_to_camera[i, 2, :3], cameras.world_to_camera[i, 2, 3]
    depth = torch.from_numpy(hits.point) @ forward + offset
    empty = torch.full((hits.size[0] * hits.size[1], 1), torch.nan)
    return hits.picture(depth[:, None], empty)[:, :, 0]


def mesh_normals(
    mesh: trimesh.Trimesh, cameras: Cameras, i: int, background: Background = 1.0, hits: Hits | None = None
) -> Tensor:
    """[H, W, 3]: face normals as normal maps show them, -1..1 to 0..1: red right, green up, blue towards the camera."""
    hits = cast(mesh, cameras, i) if hits is None else hits
    right, down, forward = cameras.world_to_camera[i, :3, :3]
    normals = torch.from_numpy(_normals(mesh, hits)) @ torch.stack([right, -down, -forward], dim=1)
    return hits.picture(0.5 + 0.5 * normals, backdrop(background, hits.size))


def colored(
    mesh: trimesh.Trimesh, cameras: Cameras, i: int, background: Background = 1.0, hits: Hits | None = None
) -> Tensor:
    """[H, W, 3]: the mesh's own vertex colours, interpolated within the faces, under a lamp at the camera."""
    if not isinstance(mesh.visual, trimesh.visual.ColorVisuals):
        raise ValueError("a mesh with vertex colours is needed")
    hits = cast(mesh, cameras, i) if hits is None else hits
    faces = np.asarray(mesh.faces)[hits.face]
    weights = trimesh.triangles.points_to_barycentric(np.asarray(mesh.vertices)[faces], hits.point)
    colors = np.asarray(mesh.visual.vertex_colors)[faces, :3] / 255.0
    light = np.abs(row_dot(_normals(mesh, hits), hits.direction))
    values = (0.4 + 0.6 * light)[:, None] * np.einsum("ij,ijk->ik", weights, colors)
    return hits.picture(torch.from_numpy(values), backdrop(background, hits.size))


def _normals(mesh: trimesh.Trimesh, hits: Hits) -> Array:
    return face_normals(np.asarray(mesh.vertices, dtype=np.float64)[np.asarray(mesh.faces)[hits.face]])


def backdrop(background: Background, size: Sequence[int]) -> Tensor:
    """A background as a fresh [H*W, 3] float32 for a picture of (height, width)."""
    color = torch.as_tensor(background, dtype=torch.float32).cpu()
    if color.ndim == 3 and color.shape != (*size, 3):
        raise ValueError(f"background: expected [{size[0]}, {size[1]}, 3], got {list(color.shape)}")
    return color.expand(*size, 3).reshape(-1, 3).clone()
