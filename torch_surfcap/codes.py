"""Fields in 8 or 16 bits: each coefficient as a code, a step on a scale between fixed bounds.

A code q of b bits stands for low + q (high - low) / (2^b - 2). An opacity value lies between the two boundary values, a
constant colour in [0, 1], any other coefficient in [-1, 1]; the last code is unused, so that the number of steps is even
and zero has a code wherever the range is symmetric. The ops of a fit's iteration read and step codes as they are
(``csrc/core/code.h``); everything else works on what :func:`decode` gives.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torch_surfcap import ops

TYPES = {64: torch.float64, 32: torch.float32, 16: torch.uint16, 8: torch.uint8}  # of the values, by bits
MOMENTS = {torch.uint16: torch.float16, torch.uint8: torch.uint8}  # of Adam, beside codes


def real(dtype: torch.dtype) -> torch.dtype:
    """What is computed with beside values of this type: themselves, or float32 beside codes."""
    return dtype if dtype.is_floating_point else torch.float32


def steps(dtype: torch.dtype) -> int:
    """Steps between the bounds: 254 or 65534."""
    return int(torch.iinfo(dtype).max) - 1


def bounds(
    pitch: int, outside: float, inside: float, *, device: torch.device | str = "cpu"
) -> tuple[Tensor, Tensor]:
    """(low [P], high [P]) of a padded record's coefficients, float32; the padding has only zero."""
    count = ops.coefficients(ops.degree_of(pitch))
    low, high = (torch.zeros(pitch, device=device) for _ in range(2))
    low[0], high[0] = inside, outside
    high[1:count] = 1.0
    low[4:count] = -1.0
    return low, high


def encode(voxels: Tensor, outside: float, inside: float, bits: int) -> Tensor:
    """Padded records [..., P] float32 as codes of so many bits, rounded to the nearest; with 32 or 64, floats.

    >>> encode(torch.tensor([-4.0, 0.5, 2.0, 0.0]), 4.0, -4.0, 8).tolist()
    [0, 127, 254, 0]
    """
    if TYPES[bits].is_floating_point:
        return voxels.to(TYPES[bits])
    low, high = bounds(voxels.shape[-1], outside, inside, device=voxels.device)
    top = steps(TYPES[bits])
    per_unit = torch.where(high != low, top / (high - low), 0.0)
    return ((voxels - low) * per_unit).round().clamp(0, top).to(TYPES[bits])


def decode(voxels: Tensor, outside: float, inside: float) -> Tensor:
    """The values of records [..., P] in codes, float32; records of floats as they are.

    >>> decode(torch.tensor([127, 254, 0, 0], dtype=torch.uint8), 4.0, -4.0).tolist()
    [0.0, 1.0, 0.0, 0.0]
    """
    if voxels.is_floating_point():
        return voxels
    low, high = bounds(voxels.shape[-1], outside, inside, device=voxels.device)
    return low + voxels.float() * ((high - low) / steps(voxels.dtype))
