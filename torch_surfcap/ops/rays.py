"""The ops that march rays through a field. See :mod:`torch_surfcap.ops`."""

from __future__ import annotations

from typing import cast

import torch
from torch import Tensor

from torch_surfcap.ops.records import GROUPS

_ops = torch.ops.torch_surfcap


def march_forward(
    voxels: Tensor,
    table: Tensor,
    frame: list[float],
    origins: Tensor,
    directions: Tensor,
    shift: Tensor,
    background: Tensor,
    opacity: int,
    slope: float,
    step: float,
    stop: float,
) -> tuple[Tensor, Tensor, Tensor]:
    """The ray integral (paper eq. 4 to 6 with the exclusive transmittance): colour [R, 3], transmittance [R] and depth
    [R] = sum w t / sum w, NaN where a ray meets nothing."""
    field, rays = (voxels, table, frame), (origins, directions, shift, background)
    return cast(
        "tuple[Tensor, Tensor, Tensor]", _ops.march_forward(*field, *rays, opacity, slope, step, stop)
    )


def march_backward(
    grad_color: Tensor,
    grad_transmittance: Tensor,
    grad_depth: Tensor,
    voxels: Tensor,
    table: Tensor,
    frame: list[float],
    origins: Tensor,
    directions: Tensor,
    shift: Tensor,
    background: Tensor,
    opacity: int,
    slope: float,
    step: float,
    stop: float,
    groups: int = GROUPS,
) -> Tensor:
    """Adjoint of :func:`march_forward` by the voxels (eq. 17 without its division): [T, 4, 4, 4, P]."""
    grads, field = (grad_color, grad_transmittance, grad_depth), (voxels, table, frame)
    rays, march = (origins, directions, shift, background), (opacity, slope, step, stop)
    return cast(Tensor, _ops.march_backward(*grads, *field, *rays, *march, groups))


def integration_ranges(
    voxels: Tensor,
    table: Tensor,
    frame: list[float],
    origins: Tensor,
    directions: Tensor,
    shift: Tensor,
    opacity: int,
    slope: float,
    step: float,
    stop: float,
    quiet: float,
) -> tuple[Tensor, Tensor]:
    """The stretches of rays that are worth sampling (paper, section 4.1), front to back.

    They reach a step beyond the samples whose opacity value is under ``quiet``, and two steps beyond where a ray ends.

    Returns:
        offsets [R + 1] int64, where each ray's ranges begin, and ranges [M, 2]: begin and end, world units from the origin.
    """
    field, rays, march = (voxels, table, frame), (origins, directions, shift), (opacity, slope, step, stop)
    return cast("tuple[Tensor, Tensor]", _ops.integration_ranges(*field, *rays, *march, quiet))


def visibility(
    voxels: Tensor,
    table: Tensor,
    frame: list[float],
    origins: Tensor,
    directions: Tensor,
    shift: Tensor,
    opacity: int,
    slope: float,
    step: float,
    stop: float,
    groups: int = GROUPS,
) -> Tensor:
    """Per voxel the largest T_k and the largest w_k of the samples that read it: [T, 4, 4, 4, 2]."""
    field, rays = (voxels, table, frame), (origins, directions, shift)
    return cast(Tensor, _ops.visibility(*field, *rays, opacity, slope, step, stop, groups))
