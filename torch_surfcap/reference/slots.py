"""The gathered gradient (paper, eq. 19): gradients left at the samples, and voxels that read the 8 nearest."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import torch
from torch import Tensor

from .rays import BASIS_OF_PITCH, harmonics, march, ray_losses
from .store import TILE


def photometric_lattice(
    voxels: Tensor,
    table: Tensor,
    frame: Sequence[float],
    origins: Tensor,
    directions: Tensor,
    shift: Tensor,
    background: Tensor,
    target: Tensor,
    mask: Tensor,
    weight: Tensor,
    opacity: int,
    slope: float,
    step: float,
    stop: float,
    huber: float,
    weights: Sequence[float],
    detach_sample: bool,
    starts: Tensor,
    first: Tensor,
    exponent: int,
    slots: Tensor,
    ranges: tuple[Tensor, Tensor] | None = None,
    rendered_sample: bool = False,
    bundle: int = 1,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Losses [3], colour [R,3], transmittance [R], depth [R] as `photometric_step` gives them; writes `slots` [S,4].

    Slot starts[r] + i gets 2^exponent times the gradient of weights · losses by what sample first[r] + i of ray r
    read, (opacity value, r, g, b); uint8 stands for torch.float8_e5m2.
    """
    leaf = voxels.detach().requires_grad_()
    m = march(leaf, table, frame, origins, directions, shift, opacity, slope, step, stop)
    losses, color, left = ray_losses(
        m, background, target, mask, weight, huber, detach_sample, rendered_sample
    )
    (by_read,) = torch.autograd.grad((losses * losses.new_tensor(weights)).sum(), m.read)
    slots.zero_()
    rows = zip(starts[:-1].tolist(), starts[1:].tolist(), first.tolist(), strict=True)
    for ray, (begin, end, low) in enumerate(rows):
        k = torch.arange(low, low + end - begin)
        exists = (k >= 0) & (k < by_read.shape[1])
        slots[begin:end][exists] = coded(by_read[ray, k[exists]] * 2.0**exponent, slots.dtype)
    return losses.detach().double(), color.detach(), left.detach(), m.depth.detach()


def coded(values: Tensor, dtype: torch.dtype) -> Tensor:
    """Numbers as slots of this dtype hold them; in 8 bits what is too large becomes the largest."""
    if dtype != torch.uint8:
        return values
    largest = torch.finfo(torch.float8_e5m2).max
    return values.float().clamp(-largest, largest).to(torch.float8_e5m2).view(torch.uint8)


def decoded(slots: Tensor) -> Tensor:
    """The numbers that slots hold, in double."""
    return (slots.view(torch.float8_e5m2) if slots.dtype == torch.uint8 else slots).double()


def gather_gradient(
    voxels: Tensor,
    table: Tensor,
    frame: Sequence[float],
    coordinates: Tensor,
    matrices: Tensor,
    centers: Tensor,
    windows: Tensor,
    window_rays: Tensor,
    shift: Tensor,
    step: float,
    starts: Tensor,
    first: Tensor,
    exponent: int,
    slots: Tensor,
    gradient: Tensor,
) -> None:
    """Eq. 19 with the density of samples; overwrites `gradient` [T,4,4,4,P]. See `torch_surfcap.ops` for the rest."""
    values = decoded(slots) / 2.0**exponent
    local = torch.cartesian_prod(*[torch.arange(TILE)] * 3)
    places = (TILE * coordinates[:, None] + local).reshape(-1, 3).to(voxels.dtype)
    points = voxels.new_tensor(frame[:3]) + (places + 0.5) * frame[3]  # the voxels' centres
    basis, pixels = BASIS_OF_PITCH[voxels.shape[-1]], 0
    total = voxels.new_zeros(len(points), voxels.shape[-1])
    for matrix, center, (left, top, width, height), moved in zip(
        matrices, centers, windows.tolist(), shift, strict=True
    ):
        window = window_rays[pixels : pixels + width * height].view(height, width)
        pixels += width * height
        away = points - center
        h = away @ matrix.T
        distance, depth = away.norm(dim=-1), h[:, 2]
        row, column = h[:, 1] / depth - 0.5 - top, h[:, 0] / depth - 0.5 - left
        k = (distance / step - 0.5 - moved).clamp(min=0)
        at = torch.stack([row, column, k], -1)
        read = values.new_zeros(len(points), 4)
        for offset in itertools.product((0, 1), repeat=3):
            corner = at.floor() + at.new_tensor(offset)
            weight = (1 - (at - corner).abs()).prod(-1)
            read += weight[:, None] * lattice_values(corner.long(), window, starts, first, values)
        density = torch.linalg.det(matrix) * frame[3] ** 3 * distance / (depth**3 * step)
        read = torch.where((depth > 0)[:, None], density[:, None] * read, 0)
        y = harmonics(away / distance[:, None], basis)
        total[:, 0] += read[:, 0]
        total[:, 1 : 1 + 3 * basis] += (y[:, :, None] * read[:, None, 1:]).flatten(1)
    gradient.copy_(total.view(gradient.shape))


def lattice_values(corner: Tensor, window: Tensor, starts: Tensor, first: Tensor, values: Tensor) -> Tensor:
    """[P,4]: what stands at the places [P,3] = (row, column, k) of a camera's lattice; 0 where nothing does."""
    row, column, k = corner.unbind(-1)
    height, width = window.shape
    inside = (row >= 0) & (row < height) & (column >= 0) & (column < width)
    ray = torch.full_like(k, -1)
    ray[inside] = window[row[inside], column[inside]].long()
    hit = ray >= 0
    slot = k[hit] - first[ray[hit]]
    exists = (slot >= 0) & (slot < starts.diff()[ray[hit]])
    found = values.new_zeros(len(k), 4)
    found[hit.nonzero()[exists, 0]] = values[(starts[ray[hit]] + slot)[exists]]
    return found
