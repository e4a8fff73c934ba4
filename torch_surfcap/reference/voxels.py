"""The voxel terms of the loss, Adam, and the soft hull."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from .codes import adam_codes, decoded
from .store import dense, dense_index


def huber_norm(x: Tensor, eps: float) -> Tensor:
    """x²/2 for |x| < eps, eps (|x| - eps/2) above."""
    return torch.where(x.abs() < eps, 0.5 * x * x, eps * (x.abs() - 0.5 * eps))


def voxel_terms(
    voxels: Tensor,
    table: Tensor,
    frame: Sequence[float],
    coordinates: Tensor,
    weights: Sequence[float],
    huber: float,
    bend: float,
    gradient: Tensor,
) -> Tensor:
    """Losses [5] in double, unweighted: TV of the opacity value, TV of colour, parsimony (eq. 11), ballooning
    (eq. 12), curvature (0 where its weight is); adds the gradient of weights · losses to `gradient` [T,4,4,4,P].

    TV sums (x_i - x_j)² over unordered pairs of 6-neighbours of which at least one is stored. A missing
    neighbour has its boundary value for the opacity value and does not count for colour. The curvature sums
    Huber's norm of the 7-point Laplacian of the opacity value where all 7 lie strictly between the boundary values.
    coordinates [T,3] place the tiles in the table.
    """
    if not bool(
        (table[coordinates.long().unbind(-1)] == torch.arange(len(coordinates), device=table.device)).all()
    ):
        raise ValueError("coordinates: expected the place of every tile in the table")
    leaf = decoded(voxels, frame).detach().requires_grad_()
    grid, stored = dense(leaf, table, frame), dense_index(table) >= 0
    tv_opacity, tv_color = leaf.new_zeros(()), leaf.new_zeros(())
    for axis in range(3):
        last = grid.shape[axis] - 1
        squares = (grid.narrow(axis, 0, last) - grid.narrow(axis, 1, last)) ** 2
        first, second = stored.narrow(axis, 0, last), stored.narrow(axis, 1, last)
        tv_opacity = tv_opacity + squares[..., 0][first | second].sum()
        tv_color = tv_color + squares[..., 1:][first & second].sum()
    parsimony = huber_norm(leaf[..., 4:], huber).sum()
    ballooning = (leaf[..., 0] ** 2).sum()
    value, inner = grid[..., 0], slice(1, -1)
    star = [value[inner, inner, inner]]
    for axis in range(3):
        cut = value[tuple(slice(None) if a == axis else inner for a in range(3))]
        star += [cut.narrow(axis, side, value.shape[axis] - 2) for side in (0, 2)]
    low, high = sorted(frame[4:6])
    known = torch.stack([(low < v) & (v < high) for v in star]).all(0) & (weights[4] != 0)
    laplacian = torch.stack(star[1:]).sum(0) - 6 * star[0]
    curvature = huber_norm(laplacian[known], bend).sum()
    losses = torch.stack([tv_opacity, tv_color, parsimony, ballooning, curvature])
    gradient += torch.autograd.grad((losses * losses.new_tensor(weights)).sum(), leaf)[0]
    return losses.detach().double()


def adam_step(
    voxels: Tensor,
    gradient: Tensor,
    first: Tensor,
    second: Tensor,
    rate: Tensor,
    low: Tensor,
    high: Tensor,
    t: int,
    beta1: float = 0.9,
    beta2: float = 0.99,
    epsilon: float = 1e-8,
    seed: int = 0,
    stochastic: bool = True,
) -> None:
    """One bias-corrected step of Adam (Kingma and Ba 2015), the t-th from 1, in place; then the clamp to
    [low, high].

    rate, low, high [P] are per coefficient.
    """
    if not voxels.is_floating_point():
        moments, bounds = (first, second), (rate, low, high)
        return adam_codes(voxels, gradient, *moments, *bounds, t, beta1, beta2, epsilon, seed, stochastic)
    first.mul_(beta1).add_(gradient, alpha=1 - beta1)
    second.mul_(beta2).addcmul_(gradient, gradient, value=1 - beta2)
    step = (first / (1 - beta1**t)) / ((second / (1 - beta2**t)).sqrt() + epsilon)
    voxels.copy_(torch.minimum(torch.maximum(voxels - rate * step, low), high))


def soft_hull(points: Tensor, projections: Tensor, masks: Tensor, sizes: Tensor) -> tuple[Tensor, Tensor]:
    """Least mask [N] over the cameras that see each point [N,3] (0 where none does), and their number [N]
    int32.

    projections [V,3,4] to pixels with pixel (0,0) centred at (0.5, 0.5); masks: all [H,W] end to end; sizes
    [V,2] = width, height. A camera sees what lies in front of it inside its picture, the edge included.
    """
    value = points.new_full((len(points),), torch.inf)
    votes = torch.zeros(len(points), dtype=torch.int32, device=points.device)
    start = 0
    for projection, (width, height) in zip(projections, sizes.tolist(), strict=True):
        mask = masks[start : start + width * height].view(height, width)
        start += width * height
        h = points @ projection[:, :3].T + projection[:, 3]
        u, v = h[:, 0] / h[:, 2], h[:, 1] / h[:, 2]
        seen = (h[:, 2] > 0) & (u >= 0) & (u <= width) & (v >= 0) & (v <= height)
        x = torch.where(seen, u - 0.5, 0).clamp(0, width - 1)
        y = torch.where(seen, v - 0.5, 0).clamp(0, height - 1)
        x0, y0 = x.floor().long(), y.floor().long()
        x1, y1 = (x0 + 1).clamp(max=width - 1), (y0 + 1).clamp(max=height - 1)
        fx, fy = x - x0, y - y0
        read = (1 - fy) * ((1 - fx) * mask[y0, x0] + fx * mask[y0, x1])
        read = read + fy * ((1 - fx) * mask[y1, x0] + fx * mask[y1, x1])
        value = torch.where(seen, torch.minimum(value, read), value)
        votes += seen
    return torch.where(votes > 0, value, 0), votes
