"""The torch.autograd.Function subclasses over the raw ops, one per differentiable op.

All gradients are analytic and exact, computed in ``csrc``; none can be differentiated a second time.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from . import ops


class March(NamedTuple):
    """How a ray is sampled: see :mod:`torch_surfcap.ops`."""

    opacity: int
    slope: float
    step: float
    stop: float


class SampleTiles(torch.autograd.Function):
    """``apply(voxels, table, frame, points) -> records [N, P]``. Differentiability: voxels."""

    @staticmethod
    def forward(ctx: Any, voxels: Tensor, table: Tensor, frame: list[float], points: Tensor) -> Tensor:
        ctx.save_for_backward(voxels, table, points)
        ctx.frame = frame
        return ops.sample_forward(voxels, table, frame, points)

    @staticmethod
    @once_differentiable  # type: ignore[untyped-decorator]
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        voxels, table, points = ctx.saved_tensors
        by_voxels = None
        if ctx.needs_input_grad[0]:
            by_voxels = ops.sample_backward(grad, voxels, table, ctx.frame, points)
        return by_voxels, None, None, None


class ShadePoints(torch.autograd.Function):
    """``apply(voxels, table, frame, points, directions) -> opacity value, r, g, b [N, 4]``. Differentiability: voxels."""

    @staticmethod
    def forward(
        ctx: Any, voxels: Tensor, table: Tensor, frame: list[float], points: Tensor, directions: Tensor
    ) -> Tensor:
        ctx.save_for_backward(voxels, table, points, directions)
        ctx.frame = frame
        return ops.shade_forward(voxels, table, frame, points, directions)

    @staticmethod
    @once_differentiable  # type: ignore[untyped-decorator]
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        voxels, table, points, directions = ctx.saved_tensors
        by_voxels = None
        if ctx.needs_input_grad[0]:
            by_voxels = ops.shade_backward(grad, voxels, table, ctx.frame, points, directions)
        return by_voxels, None, None, None, None


class MarchRays(torch.autograd.Function):
    """``apply(voxels, background, table, frame, origins, directions, shift, march) -> colour, transmittance, depth``.

    Differentiability: voxels and background; not rays. Rays that meet nothing have depth NaN and pass no gradient to it.
    """

    @staticmethod
    def forward(
        ctx: Any,
        voxels: Tensor,
        background: Tensor,
        table: Tensor,
        frame: list[float],
        origins: Tensor,
        directions: Tensor,
        shift: Tensor,
        march: March,
    ) -> tuple[Tensor, Tensor, Tensor]:
        out = ops.march_forward(voxels, table, frame, origins, directions, shift, background, *march)
        ctx.save_for_backward(voxels, background, table, origins, directions, shift, out[1])
        ctx.frame, ctx.march = frame, march
        ctx.set_materialize_grads(False)
        return out

    @staticmethod
    @once_differentiable  # type: ignore[untyped-decorator]
    def backward(
        ctx: Any, by_color: Tensor | None, by_transmittance: Tensor | None, by_depth: Tensor | None
    ) -> tuple[Tensor | None, ...]:
        voxels, background, table, origins, directions, shift, transmittance = ctx.saved_tensors
        by_voxels = by_background = None
        if by_color is not None and ctx.needs_input_grad[1]:
            by_background = by_color * transmittance[:, None]
        if ctx.needs_input_grad[0] and (by_color, by_transmittance, by_depth) != (None, None, None):
            by_voxels = ops.march_backward(
                torch.zeros_like(background) if by_color is None else by_color,
                torch.zeros_like(transmittance) if by_transmittance is None else by_transmittance,
                torch.zeros_like(transmittance) if by_depth is None else by_depth.nan_to_num(0.0),
                voxels,
                table,
                ctx.frame,
                origins,
                directions,
                shift,
                background,
                *ctx.march,
            )
        return by_voxels, by_background, None, None, None, None, None, None


class PhotometricStep(torch.autograd.Function):
    """``apply(voxels, table, frame, origins, directions, shift, background, target, mask, weight, march, huber, weights,
    detach_sample) -> total, losses [3], colour [R, 3], transmittance [R], depth [R]``.

    The gradient is computed together with the value. Differentiability: ``total = weights . losses`` by the voxels.
    """

    @staticmethod
    def forward(
        ctx: Any,
        voxels: Tensor,
        table: Tensor,
        frame: list[float],
        origins: Tensor,
        directions: Tensor,
        shift: Tensor,
        background: Tensor,
        target: Tensor,
        mask: Tensor,
        weight: Tensor,
        march: March,
        huber: float,
        weights: list[float],
        detach_sample: bool = False,
    ) -> tuple[Tensor, ...]:
        rays, seen = (origins, directions, shift, background), (target, mask, weight)
        losses, gradient, *rendering = ops.photometric_step(
            voxels,
            table,
            frame,
            *rays,
            *seen,
            **march._asdict(),
            huber=huber,
            weights=weights,
            detach_sample=detach_sample,
        )
        ctx.save_for_backward(gradient)
        ctx.mark_non_differentiable(losses, *rendering)
        total = losses @ losses.new_tensor(weights)
        return total.to(voxels.dtype), losses, *rendering

    @staticmethod
    @once_differentiable  # type: ignore[untyped-decorator]
    def backward(ctx: Any, by_total: Tensor, *unused: Tensor) -> tuple[Tensor | None, ...]:
        (gradient,) = ctx.saved_tensors
        return (by_total * gradient if ctx.needs_input_grad[0] else None, *[None] * 13)


class VoxelTerms(torch.autograd.Function):
    """``apply(voxels, table, frame, coordinates, weights, huber, bend) -> total, losses [5]``: see ``ops.voxel_terms``.

    Differentiability: ``total = weights . losses`` by the voxels.
    """

    @staticmethod
    def forward(
        ctx: Any,
        voxels: Tensor,
        table: Tensor,
        frame: list[float],
        coordinates: Tensor,
        weights: list[float],
        huber: float,
        bend: float,
    ) -> tuple[Tensor, Tensor]:
        gradient = torch.zeros_like(voxels, memory_format=torch.contiguous_format)
        losses = ops.voxel_terms(voxels, table, frame, coordinates, weights, huber, bend, gradient)
        ctx.save_for_backward(gradient)
        ctx.mark_non_differentiable(losses)
        return (losses @ losses.new_tensor(weights)).to(voxels.dtype), losses

    @staticmethod
    @once_differentiable  # type: ignore[untyped-decorator]
    def backward(ctx: Any, by_total: Tensor, *unused: Tensor) -> tuple[Tensor | None, ...]:
        (gradient,) = ctx.saved_tensors
        return (by_total * gradient if ctx.needs_input_grad[0] else None, *[None] * 6)
