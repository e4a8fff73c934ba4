"""The ops that read a field at points, silhouettes at points, and faces at pixels. See :mod:`torch_surfcap.ops`."""

from __future__ import annotations

from typing import cast

import torch
from torch import Tensor

from torch_surfcap.ops.records import GROUPS

_ops = torch.ops.torch_surfcap


def sample_forward(voxels: Tensor, table: Tensor, frame: list[float], points: Tensor) -> Tensor:
    """Trilinear read at ``points [N, 3]``: records [N, P]; a missing corner is black with the boundary's opacity."""
    return cast(Tensor, _ops.sample_forward(voxels, table, frame, points))


def sample_backward(
    grad_values: Tensor,
    voxels: Tensor,
    table: Tensor,
    frame: list[float],
    points: Tensor,
    groups: int = GROUPS,
) -> Tensor:
    """Adjoint of :func:`sample_forward` by the voxels: [T, 4, 4, 4, P]."""
    return cast(Tensor, _ops.sample_backward(grad_values, voxels, table, frame, points, groups))


def shade_forward(
    voxels: Tensor, table: Tensor, frame: list[float], points: Tensor, directions: Tensor
) -> Tensor:
    """What ``points [N, 3]`` look like along unit ``directions [N, 3]``: [N, 4] opacity value, r, g, b, as the samples of
    a ray read them."""
    return cast(Tensor, _ops.shade_forward(voxels, table, frame, points, directions))


def shade_backward(
    grad_values: Tensor,
    voxels: Tensor,
    table: Tensor,
    frame: list[float],
    points: Tensor,
    directions: Tensor,
    groups: int = GROUPS,
) -> Tensor:
    """Adjoint of :func:`shade_forward` by the voxels: [T, 4, 4, 4, P]."""
    field, seen = (voxels, table, frame), (points, directions)
    return cast(Tensor, _ops.shade_backward(grad_values, *field, *seen, groups))


def upscale(
    voxels: Tensor, table: Tensor, frame: list[float], fine_coordinates: Tensor, fine_frame: list[float]
) -> Tensor:
    """Trilinear read of a field at the voxel centres of finer tiles ``[F, 3]`` (table coordinates): [F, 4, 4, 4, P]."""
    return cast(Tensor, _ops.upscale(voxels, table, frame, fine_coordinates, fine_frame))


def soft_hull(points: Tensor, projections: Tensor, masks: Tensor, sizes: Tensor) -> tuple[Tensor, Tensor]:
    """The soft visual hull at ``points [N, 3]``: (value [N], number of cameras that see the point [N] int32).

    The value is the least of the bilinearly read masks of the cameras that see the point, 0 where none does.

    Args:
        projections: [V, 3, 4] world to pixels. masks: all masks end to end. sizes: [V, 2] int64 width, height.
    """
    return cast("tuple[Tensor, Tensor]", _ops.soft_hull(points, projections, masks, sizes))


def rasterize(corners: Tensor, faces: Tensor, height: int, width: int) -> Tensor:
    """The nearest face at each pixel's centre, by a z-buffer: [height, width] int32, -1 where there is none.

    Args:
        corners: [V, 3] pixel position (pixel (0, 0) is centred at (1/2, 1/2)) and depth. faces: [F, 3] int32; those with a
            corner that is not in front of the camera are left out.
    """
    return cast(Tensor, _ops.rasterize(corners, faces, height, width))
