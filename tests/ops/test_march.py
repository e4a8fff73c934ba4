"""march_forward and march_backward: the ray integral and its adjoint."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from torch import Tensor

from tests.ops.calls import MODES, has_depth, normal
from tests.ops.fields import GRADCHECK, Scene, assert_close, doubled, make_scene, one_tile
from torch_surfcap import ops, reference
from torch_surfcap.autograd import March, MarchRays
from torch_surfcap.reference import DISTANCE, OUTSIDE, TRANSPARENCY


def ray_along_x(device: str, background: float) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """One ray whose samples, with a step of 1, are the voxel centres x = -3.5, -2.5, ... at y = z = 0.5."""
    numbers = ([[-4.0, 0.5, 0.5]], [[1.0, 0.0, 0.0]], [0.0], [[background] * 3])
    origins, directions, shift, color = (torch.tensor(n, dtype=torch.float64, device=device) for n in numbers)
    return origins, directions, shift, color


def test_transparency_by_hand(device: str) -> None:
    # Samples at t = 0.5, 1.5, ...; the tile's four are at t = 4.5 ... 7.5 with a = 1/2, 4/5, 1, 0 and red = 1, 1/2, 0,
    # 1/4; what lies before has a = 1. T = 1, 1/2, 2/5, 2/5, then 0; w = 1/2, 1/10, 0, 2/5.
    # Red = 1/2 + 1/20 + 0 + 1/10 = 0.65. Depth = (4.5/2 + 5.5/10 + 7.5 * 2/5) / 1 = 5.8.
    voxels, table, frame = one_tile(device=device)
    voxels[0, :, 0, 0, 0] = voxels.new_tensor([0.5, 0.8, 1.0, 0.0])
    voxels[0, :, 0, 0, 1] = voxels.new_tensor([1.0, 0.5, 0.0, 0.25])
    march = (TRANSPARENCY, 0.0, 1.0, 0.0)
    rays = ray_along_x(device, background=0.3)
    color, transmittance, depth = ops.march_forward(voxels, table, frame, *rays, *march)
    assert_close(color, torch.tensor([[0.65, 0.0, 0.0]], dtype=torch.float64))
    assert_close(transmittance, torch.zeros(1, dtype=torch.float64))
    assert_close(depth, torch.tensor([5.8], dtype=torch.float64))

    # Behind each sample: B_3 = 0.3, the background, B_2 = 1/4, B_1 = 0 * 0 + 1 * 1/4, B_0 = 1/5 * 1/2 + 4/5 * 1/4.
    # dRed/da = T (B - red) = 1 (0.3 - 1), 1/2 (1/4 - 1/2), 2/5 (1/4 - 0), 2/5 (0.3 - 1/4); dRed/dred = w.
    red, none = voxels.new_tensor([[1.0, 0, 0]]), voxels.new_zeros(1)
    gradient = ops.march_backward(red, none, none, voxels, table, frame, *rays, *march)
    expected = torch.zeros_like(voxels).cpu()
    expected[0, :, 0, 0, 0] = expected.new_tensor([-0.7, -0.125, 0.1, 0.02])
    expected[0, :, 0, 0, 1] = expected.new_tensor([0.5, 0.1, 0.0, 0.4])
    assert_close(gradient, expected)


def test_distance_by_hand(device: str) -> None:
    # Slope ln 2, so E = 2^-s. The run begins in the cell before the tile: four samples outside with s = 4, E = 1/16, of
    # which the first has a = 1/(1 + 1/16) = 16/17 and the next three 1. Then s = 1, 0, -1, -1: E = 1/2, 1, 2, 2 and
    # a = (17/16)/(3/2) = 17/24, (3/2)/2 = 3/4, 2/3, 1. T = 1, 16/17, 2/3, 1/2, 1/3. Red is 1 at the sample with s = 0
    # only, so the interval before it and the one behind it have red = 1/2: w = 2/3 - 1/2 and 1/2 - 1/3; red = 1/6.
    voxels, table, frame = one_tile(outside=4.0, device=device)
    voxels[0, :, 0, 0, 0] = voxels.new_tensor([1.0, 0.0, -1.0, -1.0])
    voxels[0, 1, 0, 0, 1] = 1.0
    march = (DISTANCE, math.log(2.0), 1.0, 0.0)
    color, transmittance, depth = ops.march_forward(
        voxels, table, frame, *ray_along_x(device, background=0.0), *march
    )
    assert_close(color, torch.tensor([[1 / 6, 0.0, 0.0]], dtype=torch.float64))
    assert_close(transmittance, torch.tensor([1 / 3], dtype=torch.float64))
    # w = 1/17 at t = 0.5, 16/17 - 2/3 at 4.5, 1/6 at 5.5 and 1/6 at 6.5.
    expected = (0.5 / 17 + 4.5 * (16 / 17 - 2 / 3) + 5.5 / 6 + 6.5 / 6) / (2 / 3)
    assert_close(depth, torch.tensor([expected], dtype=torch.float64))


def test_stop(device: str) -> None:
    """A ray ends behind the sample that brings its transmittance below stop, and keeps that transmittance."""
    # As by hand above: T = 1, 1/2, 2/5, 2/5, 0. With stop = 0.45 the second sample is the last: T = 2/5.
    voxels, table, frame = one_tile(device=device)
    voxels[0, :, 0, 0, 0] = voxels.new_tensor([0.5, 0.8, 1.0, 0.0])
    voxels[0, :, 0, 0, 1] = 1.0
    rays = ray_along_x(device, background=0.5)
    color, transmittance, _ = ops.march_forward(voxels, table, frame, *rays, TRANSPARENCY, 0.0, 1.0, 0.45)
    assert_close(transmittance, torch.tensor([0.4], dtype=torch.float64))
    assert_close(color, torch.tensor([[0.6 + 0.4 * 0.5, 0.2, 0.2]], dtype=torch.float64))


def test_ray_that_misses_sees_the_background(device: str) -> None:
    voxels, table, frame = one_tile(device=device)
    origins, directions, shift, background = ray_along_x(device, background=0.7)
    color, transmittance, depth = ops.march_forward(
        voxels, table, frame, origins, -directions, shift, background, TRANSPARENCY, 0.0, 1.0, 0.0
    )
    assert torch.equal(color, background)
    assert torch.equal(transmittance, torch.ones_like(transmittance))
    assert depth.isnan().all()


@pytest.mark.parametrize("opacity", MODES)
def test_promises_in_the_table_change_nothing(opacity: int, device: str) -> None:
    """An entry OUTSIDE - d only says how far a ray may jump."""
    scene = make_scene(opacity=opacity, device=device, rays=100, side=4)
    color, transmittance, _ = ops.march_forward(*scene.marched())
    scene.table = torch.where(scene.table < OUTSIDE, OUTSIDE - 1, scene.table)
    shorter = ops.march_forward(*scene.marched())
    assert_close(shorter[0], color.cpu())
    assert_close(shorter[1], transmittance.cpu())


def test_rays_along_the_axes(device: str) -> None:
    """Directions with zeros, where slopes are infinite, through the table and beside it."""
    scene = make_scene(device=device, rays=60)
    axes = torch.eye(3, dtype=torch.float64, device=device)
    scene.directions = torch.cat([axes, -axes]).repeat(10, 1)
    scene.origins = scene.origins - 0.5 * scene.directions
    given: list[Any] = scene.marched()
    actual, expected = ops.march_forward(*given), reference.march_forward(*doubled(given))
    for a, e in zip(actual[:2], expected[:2], strict=True):
        assert_close(a, e)


@pytest.mark.parametrize("opacity", MODES)
@pytest.mark.parametrize("degree", [0, 1, 2])
def test_gradcheck(degree: int, opacity: int, device: str) -> None:
    scene = make_scene(degree, opacity, device=device, rays=12, side=2)
    scene = scene.select(has_depth(ops.march_forward(*scene.marched())[1]))
    assert len(scene.origins) >= 4

    def render(voxels: Tensor, background: Tensor) -> Any:
        rays = (scene.origins, scene.directions, scene.shift)
        march = March(scene.opacity, scene.slope, scene.step, 0.0)
        return MarchRays.apply(voxels, background, scene.table, scene.frame, *rays, march)

    inputs = (scene.voxels.requires_grad_(), scene.background.requires_grad_())
    assert torch.autograd.gradcheck(render, inputs, **GRADCHECK)


def test_unused_results_pass_no_gradient(device: str) -> None:
    """Depth is NaN where a ray meets nothing; a loss of colours alone must not be touched by it."""
    scene = make_scene(device=device)
    march = March(scene.opacity, scene.slope, scene.step, 0.0)
    voxels = scene.voxels.requires_grad_()
    rays = (scene.origins, scene.directions, scene.shift)
    color, _, depth = MarchRays.apply(voxels, scene.background, scene.table, scene.frame, *rays, march)
    (gradient,) = torch.autograd.grad(color.sum(), voxels, retain_graph=True)
    assert gradient.isfinite().all()
    assert gradient.abs().sum() > 0
    (of_all,) = torch.autograd.grad(depth.nansum(), voxels)
    assert of_all.isfinite().all()


def adjoint_of_colors(scene: Scene) -> tuple[Tensor, Tensor]:
    """<J c, y> and <c, J^T y> for the map from colour coefficients to a ray's colour, which is linear."""
    scene.background = torch.zeros_like(scene.background)
    y, none = normal(scene.voxels, len(scene.origins), 3), torch.zeros_like(scene.shift)
    color = ops.march_forward(*scene.marched())[0]
    gradient = ops.march_backward(y, none, none, *scene.marched())
    return (color * y).sum(), (scene.voxels * gradient)[..., 1:].sum()


@pytest.mark.parametrize("opacity", MODES)
@pytest.mark.parametrize("degree", [0, 1, 2])
def test_adjoint(degree: int, opacity: int, device: str) -> None:
    torch.testing.assert_close(*adjoint_of_colors(make_scene(degree, opacity, device=device, rays=100)))
