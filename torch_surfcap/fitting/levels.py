"""The levels of a fit: their plan, the first field out of the hull, and the change to the next level."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from scipy.ndimage import binary_dilation, distance_transform_edt
from torch import Tensor

from torch_surfcap import ops
from torch_surfcap.autograd import March
from torch_surfcap.data.capture import Capture
from torch_surfcap.data.floor import Floor
from torch_surfcap.errors import InputError
from torch_surfcap.field.field import CLAMP, MISSING
from torch_surfcap.field.hull import Silhouettes, find_box, pixel_footprint
from torch_surfcap.field.tiles import TileGrid, voxel_centers
from torch_surfcap.fitting.budget import shortage
from torch_surfcap.fitting.rays import QUIET, RayBatch
from torch_surfcap.fitting.settings import FitSettings

ITERATIONS = (60, 40, 30, 20)  # from the fourth-finest level to the finest: a scale, not a limit
SMALLEST_IMAGE = 32  # pixels along the shorter side of the coarsest pictures
MARGIN = 2  # coarse voxels around the subject's box
DENSE_BYTES = 100  # per voxel of the box, while the first field is made: points, hull and distances
FOG = 0.98  # transparency that the hull is filled with
DEEP = 12.0  # voxels below the hull's surface where a start that falls off ends
BAND = (
    0.5  # voxels on either side of a signed distance's zero that the next level follows, with a margin of one
)
SEEN = 0.02  # largest weight above which a voxel belongs to the surface; largest transmittance under which it is solid


@dataclass(frozen=True)
class Level:
    """voxel_size in world units; halvings of the pictures; iterations that recipe-like scenes take; last: the finest one."""

    voxel_size: float
    halvings: int
    iterations: int
    last: bool


def plan_levels(
    capture: Capture,
    box: tuple[Tensor, Tensor],
    voxel: float | None,
    levels: int | None,
    voxel_pixels: float = 1.0,
) -> list[Level]:
    """From coarse to fine: voxels halve and pictures double until they have their full size.

    The finest voxel is by default ``voxel_pixels`` footprints of a pixel at the box's middle (the median over the cameras).
    """
    footprint = pixel_footprint(capture.cameras, (box[0] + box[1]) / 2)
    finest = voxel if voxel is not None else voxel_pixels * footprint
    side = int(capture.cameras.size.min())
    if levels is None:
        levels = 1
        while levels < len(ITERATIONS) and side >> levels >= SMALLEST_IMAGE:
            levels += 1
    plan = []
    for index in range(levels):
        behind = levels - 1 - index
        halvings = min(behind, max(0, side.bit_length() - 3))
        iterations = ITERATIONS[max(0, len(ITERATIONS) - 1 - behind)]
        plan.append(Level(finest * 2**behind, halvings, iterations, behind == 0))
    return plan


def subject_box(capture: Capture, box: tuple[float, ...] | None) -> tuple[Tensor, Tensor]:
    """(low [3], high [3]) float64: as given, else found from silhouettes and cameras."""
    if box is None:
        return find_box(capture)
    if len(box) != 6 or not all(a < b for a, b in zip(box[:3], box[3:], strict=True)):
        raise InputError(f"box: found {list(box)}, expected x0, y0, z0, x1, y1, z1 with low < high")
    return torch.tensor(box[:3], dtype=torch.float64), torch.tensor(box[3:], dtype=torch.float64)


def first_field(
    capture: Capture,
    box: tuple[Tensor, Tensor],
    voxel_size: float,
    settings: FitSettings,
    floor: Floor | None = None,
) -> tuple[TileGrid, Tensor]:
    """Grid and padded records [T, 4, 4, 4, P] of the coarsest level, out of the soft hull.

    The hull of masks grown by a pixel is widened by a voxel, so that no thin part is lost on the coarse grid. A signed
    distance starts as the distance to it, a transparency as thin fog inside it, or, where ``settings.start`` is "hull",
    falling off from its surface; all grey. Nothing of it lies below a floor.
    """
    opacity = settings.opacity
    low, high = box
    edge = ops.TILE * voxel_size
    corner = low - MARGIN * voxel_size
    size = [int(n) for n in torch.ceil((high - low + 2 * MARGIN * voxel_size) / edge)]
    remedy = "voxels 1.3 times as large or one level more halve it"
    device = torch.device(settings.device)
    missing = shortage(DENSE_BYTES * ops.TILE**3 * math.prod(size), remedy, device)
    if missing:
        raise InputError(f"memory: the first level (voxels of {voxel_size:.4g}) {missing}")
    x, y, z = corner.tolist()
    counts = (torch.arange(n * ops.TILE, dtype=torch.float64, device=device) for n in size)
    steps = [(count + 0.5) * voxel_size for count in counts]
    points = torch.stack(torch.meshgrid(*steps, indexing="ij"), -1) + corner.to(device)
    # What follows is small, and scipy's: it is done on the host.
    hull = binary_dilation(Silhouettes.of(capture, grow=1).occupied(points).cpu().numpy())
    if floor is not None:
        hull &= (floor.height(points) > 0).cpu().numpy()
    if not hull.any():
        raise InputError("silhouettes: the visual hull is empty inside the box, expected a subject there")
    distance = torch.from_numpy(distance_transform_edt(~hull) - distance_transform_edt(hull)).float()
    distance = distance - torch.sign(distance) * 0.5  # of voxel centres to the border between voxels
    if opacity == "distance":
        value = (distance - 0.5).clamp(-CLAMP, CLAMP)
        stored, deep = _tilewise(distance < 2.0), ~_tilewise(distance > -CLAMP)
    else:
        value = torch.where(distance < 0, FOG, MISSING[opacity][0])
        if settings.start == "hull":
            value = 1 - (1 - FOG) * (1 - distance).clamp(0, DEEP)
        stored, deep = _tilewise(distance < 1.0), torch.zeros(size, dtype=torch.bool)
    grid = TileGrid.build(stored & ~deep, deep, (x, y, z), voxel_size)
    tiles = value.reshape(size[0], 4, size[1], 4, size[2], 4).permute(0, 2, 4, 1, 3, 5)
    i, j, k = grid.coords.long().unbind(1)
    store = torch.zeros(len(grid.coords), 4, 4, 4, ops.pitch(settings.voxel_degree))
    store[..., 0] = tiles[i, j, k]
    store[..., 1:4] = 0.5
    return grid.to(device), store.to(device)


def _tilewise(voxels: Tensor) -> Tensor:
    """Whether any voxel of a tile is marked: [4X, 4Y, 4Z] -> [X, Y, Z]."""
    pooled = torch.nn.functional.max_pool3d(voxels.float()[None, None], ops.TILE)
    return pooled[0, 0] > 0


def next_level(
    grid: TileGrid, store: Tensor, settings: FitSettings, rays: RayBatch, march: March
) -> tuple[TileGrid, Tensor]:
    """Grid and records at half the voxel size; ``rays`` and ``march`` are those of the level that is done.

    A signed distance knows where its surface is. A transparency does not: its surface is where samples have weight,
    and what no camera's light reaches is solid (paper, section 4.2), unless it is as good as empty: no ray came by.
    """
    opacity = settings.opacity
    outside, inside = MISSING[opacity]
    frame = grid.frame(outside, inside)
    if opacity == "distance":
        solid = store[..., 0] < 0
        # Where the distance is steep, it may jump over the band.
        surface = (store[..., 0].abs() < BAND) | grid.borders(solid)
    else:
        shift = torch.zeros_like(rays.mask)
        seen = ops.visibility(store, grid.table, frame, rays.origins, rays.directions, shift, *march)
        surface = seen[..., 1] > SEEN
        solid = (seen[..., 0] < SEEN) & (store[..., 0] < QUIET[opacity])
    fine = grid.refined(surface, solid)
    values = ops.upscale(store, grid.table, frame, fine.places, fine.frame(outside, inside))
    if opacity == "distance":
        values[..., 0].mul_(2.0).clamp_(-CLAMP, CLAMP)
    elif settings.upscale == "sqrt":
        values[..., 0].sqrt_()
    return fine, values


def cut_at_floor(grid: TileGrid, store: Tensor, opacity: str, floor: Floor | None) -> None:
    """Takes what lies below the floor out of a field, in place: the intersection with the space above it."""
    if floor is None:
        return
    reach = ops.TILE * grid.voxel_size * math.sqrt(3)
    origin = torch.tensor(grid.origin, dtype=torch.float64, device=store.device)
    low = origin + grid.coords.double() * ops.TILE * grid.voxel_size
    near = (floor.height(low) < reach).nonzero()[:, 0]
    height = (floor.height(voxel_centers(grid, near)) / grid.voxel_size).to(store.dtype)
    value = store[near, ..., 0]
    if opacity == "distance":
        store[near, ..., 0] = torch.maximum(value, -height).clamp(max=CLAMP)
    else:  # as much of a voxel as is above
        store[near, ..., 0] = torch.lerp(torch.ones_like(value), value, (height + 0.5).clamp(0, 1))
