"""adam_step: Adam on records, in place, with bounds."""

from __future__ import annotations

import pytest
import torch

from tests.ops.calls import arguments, normal, ops
from tests.ops.fields import assert_close, make_scene


def test_by_hand(device: str) -> None:
    # t = 1, from zero moments: m = 0.1 g, v = 0.01 g^2, corrected to g and g^2, so each coefficient moves by its rate
    # against the sign of its gradient: 0.5 - 0.06, 0.5 + 0.02, 0.99 + 0.06 clamped to 1, and no step without gradient.
    voxels = torch.zeros(1, 4, 4, 4, 4, dtype=torch.float64, device=device)
    voxels[0, 1, 2, 3] = voxels.new_tensor([0.5, 0.5, 0.99, 0.3])
    gradient, first, second = (torch.zeros_like(voxels) for _ in range(3))
    gradient[0, 1, 2, 3] = voxels.new_tensor([2.0, -3.0, -1e-3, 0.0])
    rate, low = voxels.new_tensor([0.06, 0.02, 0.06, 0.06]), voxels.new_zeros(4)
    ops.adam_step(voxels, gradient, first, second, rate, low, low + 1, t=1, epsilon=1e-30)
    assert_close(voxels[0, 1, 2, 3], torch.tensor([0.44, 0.52, 1.0, 0.3], dtype=torch.float64))
    assert_close(first[0, 1, 2, 3], torch.tensor([0.2, -0.3, -1e-4, 0.0], dtype=torch.float64))
    assert_close(second[0, 1, 2, 3], torch.tensor([0.04, 0.09, 1e-8, 0.0], dtype=torch.float64))


def test_equals_torch_over_several_steps(device: str) -> None:
    scene = make_scene(degree=2, device=device)
    mine, theirs = scene.voxels.clone(), torch.nn.Parameter(scene.voxels.clone())
    first, second = torch.zeros_like(mine), torch.zeros_like(mine)
    rate, bound = mine.new_full(mine.shape[-1:], 0.05), mine.new_full(mine.shape[-1:], 1e9)
    optimiser = torch.optim.Adam([theirs], lr=0.05, betas=(0.9, 0.99), eps=1e-8)
    for t in range(1, 6):
        gradient = normal(mine, *mine.shape, seed=t)
        theirs.grad = gradient
        optimiser.step()
        ops.adam_step(mine, gradient, first, second, rate, -bound, bound, t)
    assert_close(mine, theirs.detach().cpu())


def test_wrong_arguments_are_named(device: str) -> None:
    good = arguments("adam_step", make_scene(device=device))
    for i, wrong, match in (
        (0, good[0].transpose(1, 2), "voxels: is written in place and must be contiguous"),
        (1, good[1][1:], "gradient: expected shape"),
        (2, good[2].float(), "first: expected float64"),
        (3, good[3][1:], "second: expected shape"),
        (4, good[4][1:], "rate: expected shape"),
        (5, good[5][1:], "low: expected shape"),
        (6, good[6][1:], "high: expected shape"),
    ):
        with pytest.raises(RuntimeError, match=match):
            ops.adam_step(*good[:i], wrong, *good[i + 1 :])
