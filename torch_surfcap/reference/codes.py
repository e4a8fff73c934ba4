"""Fields in codes of 8 or 16 bits: what they stand for, and Adam on them with moments in 8 or 16 bits."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

HALF_SCALE = 1024.0  # of narrow moments


def decoded(voxels: Tensor, frame: Sequence[float]) -> Tensor:
    """Records [T,4,4,4,P] in double where they are codes: the opacity from the inside value (0) to the outside value
    (254 or 65534), constant colour from 0 to 1, the rest from -1 to 1; padding is 0. Floats as they are."""
    if voxels.is_floating_point():
        return voxels
    part = voxels.double() / (torch.iinfo(voxels.dtype).max - 1)
    opacity = frame[5] + part[..., :1] * (frame[4] - frame[5])
    count = {4: 4, 16: 13, 32: 28}[voxels.shape[-1]]
    padding = torch.zeros_like(part[..., count:])
    return torch.cat([opacity, part[..., 1:4], 2 * part[..., 4:count] - 1, padding], -1)


def e5m2() -> Tensor:
    """The finite numbers [124] of 1-5-2 that are not negative, by their code."""
    return torch.arange(124, dtype=torch.uint8).view(torch.float8_e5m2).double()


def u53() -> Tensor:
    """The numbers [248] of an unsigned float of 5 and 3 bits with the exponents of 1-5-2, by their code."""
    code = torch.arange(248)
    exponent, mantissa = (code >> 3).double(), (code & 7).double() / 8
    return torch.where(exponent > 0, (1 + mantissa) * 2 ** (exponent - 15), mantissa * 2.0**-14)


def noise(count: int, t: int, seed: int) -> Tensor:
    """32 random bits for each of `count` places, as int64."""
    mask = 0xFFFFFFFF
    key = (seed * 0x85EBCA6B + t * 0xC2B2AE35) & mask
    x = (torch.arange(count) * 0x9E3779B9 + key) & mask
    x = ((x ^ (x >> 16)) * 0x21F0AAAD) & mask
    x = ((x ^ (x >> 15)) * 0x735A2D97) & mask
    return x ^ (x >> 15)


def rounded(x: Tensor, numbers: Tensor, up: Tensor) -> Tensor:
    """The codes of x >= 0 among rising `numbers`, rounded up where the part of the way to the next, plus up in [0, 1),
    reaches 1; x is taken in half precision."""
    x = x.half().double().clamp(max=float(numbers[-1]))
    code = torch.searchsorted(numbers, x, right=True) - 1
    following = numbers[(code + 1).clamp(max=len(numbers) - 1)]
    part = torch.where(following > numbers[code], (x - numbers[code]) / (following - numbers[code]), 0.0)
    return code + (part + up >= 1)


def adam_codes(
    voxels: Tensor,
    gradient: Tensor,
    first: Tensor,
    second: Tensor,
    rate: Tensor,
    low: Tensor,
    high: Tensor,
    t: int,
    beta1: float,
    beta2: float,
    epsilon: float,
    seed: int,
    stochastic: bool,
) -> None:
    """The t-th step of Adam in place on codes that span [low, high], see `torch_surfcap.ops.adam_step`; the gradient is
    not in the scale of narrow sums."""
    bits = noise(voxels.numel(), t, seed).view(voxels.shape)
    if first.dtype == torch.uint8:
        sign = torch.where(first >= 128, -1.0, 1.0)
        m, root = sign * e5m2()[(first & 127).long()], u53()[second.long()]
    else:
        m, root = first.double(), second.double()
    g = HALF_SCALE * gradient
    m = beta1 * m + (1 - beta1) * g
    root = (beta2 * root**2 + (1 - beta2) * g**2).sqrt()
    step = (m / (1 - beta1**t)) / (root / (1 - beta2**t) ** 0.5 + HALF_SCALE * epsilon)
    top = torch.iinfo(voxels.dtype).max - 1
    per_unit = torch.where(high > low, top / (high - low), 0.0)
    up = (bits >> 16) / 2**16 if stochastic else 0.5
    codes = voxels.double() + (up - rate * per_unit * step).floor()
    voxels.copy_(codes.clamp(0, top))
    if first.dtype == torch.uint8:
        first.copy_(rounded(m.abs(), e5m2(), (bits & 255) / 256) + 128 * (m < 0))
        second.copy_(rounded(root, u53(), (bits >> 8 & 127) / 128))
    else:
        first.copy_(m)
        second.copy_(root)
