"""photometric_step: the ray losses and their gradient in one call."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor

from tests.ops.calls import GROUPS, MODES, arguments, ops, settled
from tests.ops.fields import GRADCHECK, assert_close, doubled, make_scene, one_tile
from torch_surfcap import reference
from torch_surfcap.autograd import March, PhotometricStep
from torch_surfcap.reference import TRANSPARENCY

HUBER = 0.1


def test_by_hand(device: str) -> None:
    # One ray through the voxel centres of a tile with a = 1/2, 4/5, 1, 0 and red = 1, 1/2, 0, 1/4, green = blue = 0,
    # as in test_march: w = 1/2, 1/10, 0, 2/5, red C = 0.65, T = 0. Target red 0.6, the others 0; weight 2; mask 3/4.
    # photo = (0.65 - 0.6)^2 / 2 = 0.00125. Samples: |red - 0.6| = 0.4, 0.1, 0.6, 0.35, all at or above eps = 0.1, Huber
    # eps (|x| - eps/2) = 0.035, 0.005, 0.055, 0.03; sample = 0.035/2 + 0.005/10 + 0 + 0.03 * 2/5 = 0.03.
    # mask = (0 - 1/4)^2 = 0.0625. All times the ray's weight 2.
    voxels, table, frame = one_tile(device=device)
    voxels[0, :, 0, 0, 0] = voxels.new_tensor([0.5, 0.8, 1.0, 0.0])
    voxels[0, :, 0, 0, 1] = voxels.new_tensor([1.0, 0.5, 0.0, 0.25])
    numbers = ([[-4.0, 0.5, 0.5]], [[1.0, 0, 0]], [0.0], [[0.3, 0, 0]], [[0.6, 0, 0]], [0.75], [2.0])
    rays = [voxels.new_tensor(n) for n in numbers]
    march = (TRANSPARENCY, 0.0, 1.0, 0.0)
    losses, gradient, color, transmittance, depth = ops.photometric_step(
        voxels, table, frame, *rays[:4], *rays[4:], *march, HUBER, [1.0, 0.0, 0.0], False, GROUPS
    )
    assert_close(losses, torch.tensor([0.0025, 0.06, 0.125], dtype=torch.float64))
    assert_close(color, torch.tensor([[0.65, 0, 0]], dtype=torch.float64))
    assert_close(transmittance, torch.zeros(1, dtype=torch.float64))
    # Weights 1/2, 1/10, 0, 4/10 at distances 4.5, 5.5, 6.5, 7.5.
    assert_close(depth, torch.tensor([0.5 * 4.5 + 0.1 * 5.5 + 0.4 * 7.5], dtype=torch.float64))
    # The photo loss pulls with 2 * 0.05 on red; dRed/da and dRed/dred as in test_march.
    expected = torch.zeros_like(voxels).cpu()
    expected[0, :, 0, 0, 0] = 0.1 * expected.new_tensor([-0.7, -0.125, 0.1, 0.02])
    expected[0, :, 0, 0, 1] = 0.1 * expected.new_tensor([0.5, 0.1, 0.0, 0.4])
    assert_close(gradient, expected)


@pytest.mark.parametrize("opacity", MODES)
@pytest.mark.parametrize("weights", [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
@pytest.mark.parametrize("detach", [False, True])
def test_each_loss_alone(detach: bool, weights: list[float], opacity: int, device: str) -> None:
    given = arguments("photometric_step", make_scene(opacity=opacity, device=device))
    given[-3:-1] = [weights, detach]
    for actual, expected in zip(
        settled("photometric_step", ops.photometric_step(*given)),
        settled("photometric_step", reference.photometric_step(*doubled(given))),
        strict=True,
    ):
        assert_close(actual, expected)


@pytest.mark.parametrize("opacity", MODES)
@pytest.mark.parametrize("rendered", [False, True])
def test_a_colour_that_all_samples_share(rendered: bool, opacity: int, device: str) -> None:
    """Adding it to every sample is taking it from photograph and background: what view_color.py rests on."""
    voxels, table, frame = one_tile(device=device)
    g = torch.Generator().manual_seed(0)
    voxels += torch.rand(voxels.shape, generator=g, dtype=torch.float64).to(voxels) - (
        0.5 if opacity else 0.0
    )
    color = voxels.new_tensor([0.3, -0.2, 0.1])
    brighter = voxels.clone()
    brighter[..., 1:] += color
    place = 0.5 + 3 * torch.rand(9, 2, generator=g, dtype=torch.float64)
    origins = torch.cat([torch.full((9, 1), -4.0, dtype=torch.float64), place], 1).to(device)
    directions = voxels.new_tensor([[1.0, 0, 0]]).expand(9, 3)
    target, background = torch.rand(2, 9, 3, generator=g, dtype=torch.float64).to(device)
    mask, weight = torch.rand(2, 9, generator=g, dtype=torch.float64).to(device)
    # Within the tile: what is beyond is black.
    ranges = torch.arange(10, device=device), voxels.new_tensor([[4.5, 7.5]]).expand(9, 2)

    def step(field: Tensor, less: Tensor) -> tuple[Tensor, ...]:
        rays = (origins, directions, torch.zeros_like(mask), background - less)
        seen, march = (target - less, mask, weight), (opacity, 4.0, 0.7, 0.0)
        loss = (HUBER, [1.0, 0.7, 0.3], False, GROUPS, ranges, None, rendered)
        return ops.photometric_step(field, table, frame, *rays, *seen, *march, *loss)

    whole, shifted = step(brighter, torch.zeros_like(color)), step(voxels, color)
    assert_close(whole[2], (shifted[2] + color).cpu())
    for at in (0, 1, 3, 4):
        assert_close(whole[at], shifted[at].cpu())


def test_detached_sample_loss_moves_colors_only(device: str) -> None:
    given = arguments("photometric_step", make_scene(device=device))
    given[-3:-1] = [[0.0, 1.0, 0.0], True]
    gradient = ops.photometric_step(*given)[1]
    assert not gradient[..., 0].any()
    assert gradient[..., 1:].any()


@pytest.mark.parametrize("opacity", MODES)
@pytest.mark.parametrize("detach", [False, True])
def test_samples_against_the_rendered_colour(detach: bool, opacity: int, device: str) -> None:
    """The rendered colour is a constant: the loss does not pull at it, and the target has no say."""
    given = arguments("photometric_step", make_scene(opacity=opacity, device=device))
    given[-3:-1] = [[0.0, 1.0, 0.0], detach]
    actual = ops.photometric_step(*given, rendered_sample=True)
    for one, other in zip(
        actual, reference.photometric_step(*[*doubled(given), None, None, True]), strict=True
    ):
        assert_close(one, other)
    given[7] = torch.rand_like(given[7])
    assert_close(ops.photometric_step(*given, rendered_sample=True)[1], actual[1].cpu(), 1e-13)
    assert not torch.equal(ops.photometric_step(*given)[1], actual[1])


@pytest.mark.parametrize("opacity", MODES)
@pytest.mark.parametrize("degree", [0, 1, 2])
def test_gradcheck(degree: int, opacity: int, device: str) -> None:
    scene = make_scene(degree, opacity, device=device, rays=12, side=2)

    def total(voxels: Tensor) -> Any:
        march = March(scene.opacity, scene.slope, scene.step, 0.0)
        seen = (scene.target, scene.mask, scene.weight)
        return PhotometricStep.apply(
            voxels, scene.table, scene.frame, *scene.rays, *seen, march, HUBER, [1.0, 0.7, 0.3]
        )[0]

    assert torch.autograd.gradcheck(total, scene.voxels.requires_grad_(), **GRADCHECK)


def test_groups_change_the_last_bits_only(device: str) -> None:
    given = arguments("photometric_step", make_scene(device=device, rays=200))
    one, many = (ops.photometric_step(*given[:-1], groups)[1] for groups in (1, 7))
    torch.testing.assert_close(one, many, rtol=1e-12, atol=1e-12)


def test_wrong_observations_are_named(device: str) -> None:
    scene = make_scene(device=device)
    good = arguments("photometric_step", scene)
    for name, wrong in (("target", scene.mask), ("mask", scene.target), ("weight", scene.weight[1:])):
        at = next(i for i, a in enumerate(good) if a is getattr(scene, name))
        with pytest.raises(RuntimeError, match=f"{name}: expected shape"):
            ops.photometric_step(*good[:at], wrong, *good[at + 1 :])
    with pytest.raises(RuntimeError, match="weights: expected"):
        ops.photometric_step(*good[:-3], [1.0], *good[-2:])
