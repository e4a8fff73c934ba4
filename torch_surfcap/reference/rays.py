"""The ray march, the fused photometric step and the visibility of voxels, on a dense [R, K] lattice.

Equation numbers are of Toussaint, Genisson, Franco, "Fast Gradient Descent for Surface Capture Via
Differentiable Rendering", 3DV 2022.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from .codes import decoded
from .store import TILE, corners, dense, dense_index, nonempty_cells, sample_forward
from .voxels import huber_norm

TRANSPARENCY, DISTANCE = 0, 1  # what the first coefficient of a voxel means
BASIS_OF_PITCH = {4: 1, 16: 4, 32: 9}  # padded record length -> spherical harmonics per channel
NOTHING = {torch.float32: 1e-6, torch.float64: 1e-12}  # sum of weights that can be all rounding: no depth


def harmonics(directions: Tensor, count: int) -> Tensor:
    """Real spherical harmonics without their constants, [..., 3] unit directions -> [..., count], count 1, 4
    or 9.
    """
    x, y, z = directions.unbind(-1)
    functions = [
        torch.ones_like(x),
        y,
        z,
        x,
        x * y,
        y * z,
        0.5 * (3 * z * z - 1),
        x * z,
        0.5 * (x * x - y * y),
    ]
    return torch.stack(functions[:count], -1)


def shaded(records: Tensor, directions: Tensor) -> Tensor:
    """Records [...,P] seen along unit directions [...,3]: [...,4] opacity value, r, g, b."""
    basis = BASIS_OF_PITCH[records.shape[-1]]
    coefficients = records[..., 1 : 1 + 3 * basis].unflatten(-1, (basis, 3))
    color = (harmonics(directions, basis)[..., None] * coefficients).sum(-2)
    return torch.cat([records[..., :1], color], -1)


class March(NamedTuple):
    """Samples of R rays on a lattice of K distances; after a ray's end and in empty cells a = 1."""

    t: Tensor  # [R,K] distance from the origin
    read: Tensor  # [R,K,4] opacity value and colour as read from the voxels
    a: Tensor  # [R,K] transparency
    color: Tensor  # [R,K,3]
    transmittance: Tensor  # [R,K+1] exclusive: what is left before sample k, and at the end
    visited: Tensor  # [R,K] bool: in a non-empty cell and before the ray's end
    corners: Tensor  # [R,K,8,3] dense grid index of the voxels read
    corner_weights: Tensor  # [R,K,8]

    @property
    def weight(self) -> Tensor:
        return (1 - self.a) * self.transmittance[:, :-1]

    @property
    def value(self) -> Tensor:
        """[R,K] opacity value."""
        return self.read[..., 0]

    @property
    def depth(self) -> Tensor:
        """[R], NaN where a ray meets nothing."""
        total = self.weight.sum(1)
        solid = total > NOTHING[total.dtype]
        return torch.where(solid, (self.weight * self.t).sum(1) / torch.where(solid, total, 1), math.nan)


def march(
    voxels: Tensor,
    table: Tensor,
    frame: Sequence[float],
    origins: Tensor,
    directions: Tensor,
    shift: Tensor,
    opacity: int,
    slope: float,
    step: float,
    stop: float,
) -> March:
    """All samples of all rays; see `march_forward` for the arguments."""
    low = origins.new_tensor(frame[:3])
    extent = frame[3] * TILE * origins.new_tensor(table.shape)
    farthest = torch.maximum((origins - low).abs(), (origins - low - extent).abs()).norm(dim=-1)
    count = math.ceil(float(farthest.max()) / step) + 2 if len(origins) else 0
    t = (torch.arange(count, device=origins.device) + 0.5 + shift[:, None]) * step
    index, corner, base = corners(origins[:, None] + t[..., None] * directions[:, None], table, frame)

    tile = base.div(TILE, rounding_mode="floor")
    within = ((tile >= 0) & (tile < torch.tensor(table.shape, device=tile.device))).all(-1)
    active = (
        within & nonempty_cells(table)[tile.clamp(min=0).minimum(base.new_tensor(table.shape) - 1).unbind(-1)]
    )

    record = (dense(decoded(voxels, frame), table, frame)[index.unbind(-1)] * corner[..., None]).sum(-2)
    read = shaded(record, directions[:, None])
    value, color = read[..., 0], read[..., 1:]
    if opacity == TRANSPARENCY:
        a = value
    else:
        # a_k = min(1, (1 + E_{k-1}) / (1 + E_k)), log(1 + E) = softplus(-slope s); before a run's first
        # sample E = 0.
        follows = torch.nn.functional.pad(active[:, :-1], (1, 0))
        log_e = torch.nn.functional.softplus(-slope * value)
        log_before = torch.where(follows, torch.nn.functional.pad(log_e[:, :-1], (1, 0)), 0)
        a = (log_before - log_e).clamp(max=0).exp()
        color_before = torch.nn.functional.pad(color[:, :-1], (0, 0, 1, 0))
        color = torch.where(follows[..., None], 0.5 * (color_before + color), color)

    a = torch.where(active, a, 1)
    left = torch.cumprod(a.detach(), 1) >= stop  # after sample k
    alive = torch.cumprod(torch.nn.functional.pad(left[:, :-1], (1, 0), value=True), 1).bool()
    a = torch.where(alive, a, 1)
    transmittance = torch.cat([a.new_ones(len(a), 1), torch.cumprod(a, 1)], 1)
    return March(t, read, a, color, transmittance, active & alive, index, corner)


def shade_forward(
    voxels: Tensor, table: Tensor, frame: Sequence[float], points: Tensor, directions: Tensor
) -> Tensor:
    """Opacity value and colour [N,4] at points [N,3] (world) seen along unit directions [N,3]."""
    return shaded(sample_forward(voxels, table, frame, points), directions)


def shade_backward(
    grad_values: Tensor,
    voxels: Tensor,
    table: Tensor,
    frame: Sequence[float],
    points: Tensor,
    directions: Tensor,
    groups: int = 1,
) -> Tensor:
    """The adjoint of `shade_forward`: [N,4] -> [T,4,4,4,P]."""
    leaf = voxels.detach().requires_grad_()
    return torch.autograd.grad(shade_forward(leaf, table, frame, points, directions), leaf, grad_values)[0]


def march_forward(
    voxels: Tensor,
    table: Tensor,
    frame: Sequence[float],
    origins: Tensor,
    directions: Tensor,
    shift: Tensor,
    background: Tensor,
    opacity: int,
    slope: float,
    step: float,
    stop: float,
) -> tuple[Tensor, Tensor, Tensor]:
    """Colour [R,3], transmittance [R] and depth [R] of rays; depth is NaN where a ray meets nothing.

    origins [R,3] world, directions [R,3] unit, shift [R] in steps, background [R,3]; opacity 0 =
    transparency, 1 = signed distance with slope slope; step in world units; a ray ends once its transmittance
    is below stop.
    """
    m = march(voxels, table, frame, origins, directions, shift, opacity, slope, step, stop)
    left = m.transmittance[:, -1]
    return (m.weight[..., None] * m.color).sum(1) + left[:, None] * background, left, m.depth


def march_backward(
    grad_color: Tensor,
    grad_transmittance: Tensor,
    grad_depth: Tensor,
    voxels: Tensor,
    table: Tensor,
    frame: Sequence[float],
    origins: Tensor,
    directions: Tensor,
    shift: Tensor,
    background: Tensor,
    opacity: int,
    slope: float,
    step: float,
    stop: float,
    groups: int = 1,
) -> Tensor:
    """Gradient by the voxels [T,4,4,4,P]; rays without a depth pass nothing on from grad_depth."""
    leaf = voxels.detach().requires_grad_()
    color, transmittance, depth = march_forward(
        leaf, table, frame, origins, directions, shift, background, opacity, slope, step, stop
    )
    solid = ~depth.isnan()
    outputs, grads = (color, transmittance, depth[solid]), (grad_color, grad_transmittance, grad_depth[solid])
    return torch.autograd.grad(outputs, leaf, grads)[0]


def photometric_step(
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
    detach_sample: bool = False,
    groups: int = 1,
    ranges: tuple[Tensor, Tensor] | None = None,
    gradients: Tensor | None = None,
    rendered_sample: bool = False,
    bundle: int = 1,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Losses [3] (photo, sample: eq. 10, mask), gradient of weights · losses, colour [R,3], transmittance
    [R] and depth [R].

    target [R,3] observed colour, mask [R] 1 = subject, weight [R] of the ray in every loss. `ranges` and
    `gradients`, which save the compiled op a search and memory, are not looked at.
    """
    leaf = decoded(voxels, frame).detach().requires_grad_()
    m = march(leaf, table, frame, origins, directions, shift, opacity, slope, step, stop)
    losses, color, left = ray_losses(
        m, background, target, mask, weight, huber, detach_sample, rendered_sample
    )
    (gradient,) = torch.autograd.grad((losses * losses.new_tensor(weights)).sum(), leaf)
    return losses.detach().double(), gradient, color.detach(), left.detach(), m.depth.detach()


def ray_losses(
    m: March,
    background: Tensor,
    target: Tensor,
    mask: Tensor,
    weight: Tensor,
    huber: float,
    detach: bool,
    rendered: bool = False,
) -> tuple[Tensor, Tensor, Tensor]:
    """Losses [3], colour [R,3] and transmittance [R] of marched rays; see `photometric_step`."""
    left = m.transmittance[:, -1]
    color = (m.weight[..., None] * m.color).sum(1) + left[:, None] * background
    w = m.weight.detach() if detach else m.weight
    photo = huber_norm(color - target, huber).sum(-1)
    own_target = color.detach() if rendered else target
    sample = (w * huber_norm(m.color - own_target[:, None], huber).sum(-1)).sum(1)
    terms = (photo, sample, (left - (1 - mask)) ** 2)
    return torch.stack([(weight * term).sum() for term in terms]), color, left


def visibility(
    voxels: Tensor,
    table: Tensor,
    frame: Sequence[float],
    origins: Tensor,
    directions: Tensor,
    shift: Tensor,
    opacity: int,
    slope: float,
    step: float,
    stop: float,
    groups: int = 1,
) -> Tensor:
    """[T,4,4,4,2]: per voxel the largest T_k and the largest w_k of the samples that read it."""
    m = march(voxels, table, frame, origins, directions, shift, opacity, slope, step, stop)
    row = dense_index(table)[m.corners.unbind(-1)]  # [R,K,8]
    reads = (row >= 0) & (m.corner_weights > 0) & m.visited[..., None]
    seen = origins.new_zeros(voxels.shape[0] * TILE**3, 2)
    for channel, quantity in enumerate((m.transmittance[:, :-1], m.weight)):
        values = quantity[..., None].expand_as(row)[reads].detach()
        seen[:, channel].scatter_reduce_(0, row[reads], values, "amax")
    return seen.view(-1, TILE, TILE, TILE, 2)


def integration_ranges(
    voxels: Tensor,
    table: Tensor,
    frame: Sequence[float],
    origins: Tensor,
    directions: Tensor,
    shift: Tensor,
    opacity: int,
    slope: float,
    step: float,
    stop: float,
    quiet: float,
) -> tuple[Tensor, Tensor]:
    """The stretches of rays worth sampling (section 4.1): where each ray's begin [R+1] long, and [M,2] distances.

    They reach a step to either side of every sample with a value under `quiet`, and two more behind the last sample.
    """
    m = march(voxels, table, frame, origins, directions, shift, opacity, slope, step, stop)
    offsets, ranges = [0], list[list[float]]()
    for t, value, visited in zip(m.t, m.value, m.visited, strict=True):
        t, value = t[visited], value[visited]
        reach = torch.full_like(t, step)
        reach[-1:] = 3 * step
        for begin, end in torch.stack([t - step, t + reach], 1)[value < quiet].tolist():
            if len(ranges) > offsets[-1] and begin <= ranges[-1][1] + 1e-9 * step:
                ranges[-1][1] = end
            else:
                ranges.append([begin, end])
        offsets.append(len(ranges))
    return torch.tensor(offsets), origins.new_tensor(ranges).view(-1, 2)
