"""Reading the sparse store: the dense grid it stands for, trilinear sampling, its adjoint, and upscaling."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

TILE = 4  # voxels along a tile's edge
INSIDE, OUTSIDE = (
    -1,
    -2,
)  # table entries without a tile; OUTSIDE - d promises that cells nearer than d are empty


def dense(voxels: Tensor, table: Tensor, frame: Sequence[float]) -> Tensor:
    """The whole table as one grid of voxels [4X, 4Y, 4Z, P]; missing tiles have their boundary value and are
    black.
    """
    missing = voxels.new_zeros(2, TILE, TILE, TILE, voxels.shape[-1])
    missing[0, ..., 0], missing[1, ..., 0] = frame[4], frame[5]
    count = voxels.shape[0]
    index = torch.where(table >= 0, table, torch.where(table == INSIDE, count + 1, count)).long()
    blocks = torch.cat([voxels, missing])[index]  # [X, Y, Z, 4, 4, 4, P]
    x, y, z = table.shape
    return blocks.permute(0, 3, 1, 4, 2, 5, 6).reshape(TILE * x, TILE * y, TILE * z, -1)


def dense_index(table: Tensor) -> Tensor:
    """Row of every voxel of the table in `voxels.view(-1, P)`, [4X, 4Y, 4Z] long; -1 where the tile is
    missing.
    """
    local = torch.arange(TILE**3, device=table.device).view(TILE, TILE, TILE)
    rows = torch.where(table < 0, -1, table * TILE**3).long()[..., None, None, None] + local
    rows = torch.where(table[..., None, None, None] < 0, -1, rows)
    x, y, z = table.shape
    return rows.permute(0, 3, 1, 4, 2, 5).reshape(TILE * x, TILE * y, TILE * z)


def corners(points: Tensor, table: Tensor, frame: Sequence[float]) -> tuple[Tensor, Tensor, Tensor]:
    """The 8 voxels around each point [..., 3]: dense grid index [..., 8, 3], weight [..., 8], base voxel
    [..., 3].

    Beyond the table everything is outside, as its border is: indices are held to the border.
    """
    u = (points - points.new_tensor(frame[:3])) / frame[3] - 0.5
    base = u.floor()
    offset = torch.cartesian_prod(*[torch.arange(2, device=points.device)] * 3)  # [8, 3]
    fraction = (u - base)[..., None, :]
    weight = torch.where(offset.bool(), fraction, 1 - fraction).prod(-1)
    high = TILE * torch.tensor(table.shape, device=points.device) - 1
    index = torch.minimum((base.long()[..., None, :] + offset).clamp(min=0), high)
    return index, weight, base.long()


def sample_forward(voxels: Tensor, table: Tensor, frame: Sequence[float], points: Tensor) -> Tensor:
    """Trilinear read of the field at points [N,3] (world) -> [N,P]."""
    index, weight, _ = corners(points, table, frame)
    return (dense(voxels, table, frame)[index.unbind(-1)] * weight[..., None]).sum(-2)


def sample_backward(
    grad_values: Tensor,
    voxels: Tensor,
    table: Tensor,
    frame: Sequence[float],
    points: Tensor,
    groups: int = 1,
) -> Tensor:
    """The adjoint of `sample_forward`: [N,P] -> [T,4,4,4,P]."""
    leaf = voxels.detach().requires_grad_()
    return torch.autograd.grad(sample_forward(leaf, table, frame, points), leaf, grad_values)[0]


def nonempty_cells(table: Tensor) -> Tensor:
    """[X,Y,Z] bool: whether any of the tiles t..t+1 is stored or inside; beyond the table all are outside."""
    solid = torch.nn.functional.pad((table > OUTSIDE)[None, None].double(), (0, 1) * 3)
    return torch.nn.functional.max_pool3d(solid, 2, stride=1)[0, 0] > 0


def upscale(
    voxels: Tensor,
    table: Tensor,
    frame: Sequence[float],
    fine_coordinates: Tensor,
    fine_frame: Sequence[float],
) -> Tensor:
    """The coarse field read at the centres of the fine tiles' voxels: [F,4,4,4,P].

    fine_coordinates [F,3] are places in the fine table whose low corner is fine_frame[:3].
    """
    local = torch.cartesian_prod(*[torch.arange(TILE, device=voxels.device)] * 3)  # [64, 3]
    place = (TILE * fine_coordinates[:, None] + local).to(voxels.dtype)  # [F, 64, 3]
    centers = voxels.new_tensor(fine_frame[:3]) + (place + 0.5) * fine_frame[3]
    fine = sample_forward(voxels, table, frame, centers.view(-1, 3))
    return fine.view(-1, TILE, TILE, TILE, voxels.shape[-1])
