"""View-dependent colour on voxels coarser than the field's, read once per ray.

A highlight is wider than a voxel and lies on the surface. So the field may keep one constant colour per voxel, while a
coarse field v holds the coefficients of degree 1 and 2, and a ray o + t d adds v(o + t d, d) at its mean depth t to the
colour of all its samples (shading after compositing, as in Hedman et al., "Baking neural radiance fields", ICCV 2021). With
v_r constant along ray r,

    sum_k w_k (c_k + v_r) + T B - P  =  sum_k w_k c_k + T (B - v_r) - (P - v_r),

so the ray losses and their gradients by the fine field are those of a photograph P - v_r before a background B - v_r.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torch_surfcap import ops
from torch_surfcap.autograd import March
from torch_surfcap.field.field import MISSING, SurfaceField
from torch_surfcap.field.tiles import TileGrid
from torch_surfcap.fitting.adam import TileAdam
from torch_surfcap.fitting.budget import gradient_groups
from torch_surfcap.fitting.rays import RayBatch
from torch_surfcap.fitting.settings import PARSIMONY_HUBER, FitSettings, Losses

KIND = "distance"  # opacity of the coarse field, which stays 0, as its constant colour does


@dataclass
class ViewColor:
    """The coarse field of one level: padded records [T, 4, 4, 4, P], and depth [R], how far along its ray each reads it."""

    grid: TileGrid
    store: Tensor
    adam: TileAdam
    depth: Tensor

    def points(self, rays: RayBatch) -> Tensor:
        """Where the rays read it: [R, 3]."""
        return torch.addcmul(rays.origins, self.depth[:, None], rays.directions)

    def seen_by(self, rays: RayBatch) -> Tensor:
        """v_r: [R, 3]."""
        read = (self.store, self.grid.table, frame_of(self.grid), self.points(rays), rays.directions)
        return ops.shade_forward(*read)[:, 1:]

    def step(
        self,
        rays: RayBatch,
        residual: Tensor,
        transmittance: Tensor,
        depth: Tensor,
        losses: Losses,
        scale: float,
    ) -> None:
        """One step of Adam down the losses; the next reading is at this ``depth`` [R]. The others: see ``gradient``."""
        self.adam.step(self.gradient(rays, residual, transmittance, losses), scale)
        self.depth = depth.nan_to_num(0.0)

    def gradient(self, rays: RayBatch, residual: Tensor, transmittance: Tensor, losses: Losses) -> Tensor:
        """Of the photometric loss, of the sample loss (as if all samples of a ray had the ray's colour), of total variation
        and of parsimony by the records.

        Args:
            residual: [R, 3] rendered colour minus photograph. transmittance: [R].
        """
        # Samples that are held against the rendering move with it.
        share = losses.photo + (losses.sample if losses.sample_target == "observed" else 0.0)
        pull = share * rays.weight * (1 - transmittance)
        by_value = residual.new_zeros(len(rays), 4)
        torch.mul(residual.clamp(-losses.huber, losses.huber), pull[:, None], out=by_value[:, 1:])
        table, frame = self.grid.table, frame_of(self.grid)
        read = (self.store, table, frame, self.points(rays), rays.directions)
        gradient = ops.shade_backward(
            by_value, *read, groups=gradient_groups(self.store.numel(), self.store.device)
        )
        terms = [0.0, losses.tv_color, losses.parsimony, 0.0, 0.0]
        ops.voxel_terms(self.store, table, frame, self.grid.places, terms, PARSIMONY_HUBER, 1.0, gradient)
        return gradient

    def field(self) -> SurfaceField:
        """The coarse field as what a ``SurfaceField`` adds to its rays."""
        return SurfaceField(self.store, self.grid, KIND)


def frame_of(grid: TileGrid) -> list[float]:
    """The ``frame`` argument of the ops: all is 0 beyond the tiles."""
    return grid.frame(0.0, 0.0)


def begin_view_color(
    settings: FitSettings,
    grid: TileGrid,
    store: Tensor,
    rays: RayBatch,
    march: March,
    before: ViewColor | None,
) -> ViewColor | None:
    """That of a level whose field, in floats, is given; refined from that of the level before. None where the view-dependent
    coefficients are in the voxels' own records."""
    if settings.degree == settings.voxel_degree:
        return None
    coarse = covering(grid, settings.view_spacing)
    if before is None:
        records = store.new_zeros(
            len(coarse.coords), ops.TILE, ops.TILE, ops.TILE, ops.pitch(settings.degree)
        )
    else:
        whole = (before.store, before.grid.table, frame_of(before.grid))
        records = ops.upscale(*whole, coarse.places, frame_of(coarse))
    frame = grid.frame(*MISSING[settings.opacity])
    shift, black = torch.zeros_like(rays.mask), torch.zeros_like(rays.origins)
    origins, directions = rays.origins, rays.directions
    _, _, depth = ops.march_forward(store, grid.table, frame, origins, directions, shift, black, *march)
    return ViewColor(coarse, records, begin_adam(records, settings), depth.nan_to_num(0.0))


def begin_adam(records: Tensor, settings: FitSettings) -> TileAdam:
    """Adam at rest, for the view-dependent coefficients alone."""
    return TileAdam(records, KIND, replace(settings.descent, rate_opacity=0.0, rate_color=0.0))


def covering(grid: TileGrid, spacing: int) -> TileGrid:
    """The grid of voxels ``spacing`` (even) times as large whose trilinear reads, anywhere within the stored tiles of
    ``grid``, find stored voxels."""
    edge = ops.TILE * spacing  # of a coarse tile, in fine voxels
    low = grid.coords.long() * ops.TILE - spacing // 2
    high = low + ops.TILE + spacing - 1
    ends = torch.stack([low, high]).div(edge, rounding_mode="floor") + 1  # one tile more before the box
    size = [-(-ops.TILE * n // edge) + 2 for n in grid.size]
    stored = torch.zeros(size, dtype=torch.bool, device=grid.coords.device)
    for corner in range(8):
        x, y, z = (ends[corner >> axis & 1, :, axis] for axis in range(3))
        stored[x, y, z] = True
    low_x, low_y, low_z = (o - edge * grid.voxel_size for o in grid.origin)
    origin = (low_x, low_y, low_z)
    return TileGrid.build(stored, torch.zeros_like(stored), origin, spacing * grid.voxel_size)
