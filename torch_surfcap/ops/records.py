"""The records of voxels and the entries of tables, as the ops know them; see :mod:`torch_surfcap.ops`."""

from __future__ import annotations

import torch
from torch import Tensor

INSIDE = -1
OUTSIDE = -2
TILE = 4
OPACITY = {"transparency": 0, "distance": 1}
GROUPS = 4
HALF_SCALE = 1024  # what gradients and moments in 16 and 8 bits are multiplied with, core/code.h


def coefficients(sh_degree: int) -> int:
    """Numbers that a voxel holds: the opacity value and three colour channels per harmonic."""
    return 1 + 3 * (sh_degree + 1) ** 2


def pitch(sh_degree: int) -> int:
    """Numbers that a voxel's record occupies, padding included."""
    return (4, 16, 32)[sh_degree]


def degree_of(count: int) -> int:
    """SH degree of a voxel of ``count`` numbers, padded or not."""
    for sh_degree in range(3):
        if count in (coefficients(sh_degree), pitch(sh_degree)):
            return sh_degree
    raise ValueError(
        f"voxels: expected 4, 13, 16, 28 or 32 numbers per voxel (SH degree 0, 1, 2), got {count}"
    )


def padded(voxels: Tensor) -> Tensor:
    """Records filled up to their pitch; the tensor itself where it is padded already. Differentiable."""
    missing = pitch(degree_of(voxels.shape[-1])) - voxels.shape[-1]
    return torch.nn.functional.pad(voxels, (0, missing)) if missing else voxels
