"""shade_forward and shade_backward: what points look like from given directions, and the adjoint."""

from __future__ import annotations

import pytest
import torch

from tests.ops.calls import normal, points_of
from tests.ops.fields import GRADCHECK, assert_close, make_scene, one_tile
from torch_surfcap import ops
from torch_surfcap.autograd import ShadePoints


def test_by_hand(device: str) -> None:
    # Degree 1, all voxels of the one tile alike: opacity 0.5, red 0.2 + 0.4 x - 0.1 y. Along (0.6, 0.8, 0) red is
    # 0.2 + 0.24 - 0.08; far outside all is black and empty.
    voxels, table, frame = one_tile(degree=1, device=device)
    voxels[..., 0], voxels[..., 1] = 0.5, 0.2
    voxels[..., 4], voxels[..., 10] = -0.1, 0.4  # coefficients of y and x, red
    points = torch.tensor([[2.0, 2.5, 2.25], [-300, 9, 9]], dtype=torch.float64, device=device)
    along = torch.tensor([[0.6, 0.8, 0.0]] * 2, dtype=torch.float64, device=device)
    expected = torch.tensor([[0.5, 0.36, 0, 0], [1.0, 0, 0, 0]], dtype=torch.float64)
    assert_close(ops.shade_forward(voxels, table, frame, points, along), expected)


@pytest.mark.parametrize("degree", [0, 1, 2])
def test_adjoint(degree: int, device: str) -> None:
    """<A x, y> = <x, A^T y>; linear, so with nothing outside and inside."""
    scene = make_scene(degree, device=device, rays=100)
    frame = [*scene.frame[:4], 0.0, 0.0]
    seen = (points_of(scene), scene.directions)
    y = normal(scene.voxels, 100, 4)
    forward = ops.shade_forward(scene.voxels, scene.table, frame, *seen)
    backward = ops.shade_backward(y, scene.voxels, scene.table, frame, *seen, groups=3)
    torch.testing.assert_close((forward * y).sum(), (scene.voxels * backward).sum())


@pytest.mark.parametrize("degree", [0, 1, 2])
def test_gradcheck(degree: int, device: str) -> None:
    scene = make_scene(degree, device=device, rays=6, side=2)
    voxels = scene.voxels.requires_grad_()
    seen = (points_of(scene), scene.directions)
    assert torch.autograd.gradcheck(
        lambda v: ShadePoints.apply(v, scene.table, scene.frame, *seen), voxels, **GRADCHECK
    )


def test_directions_that_do_not_match_are_named(device: str) -> None:
    scene = make_scene(device=device)
    with pytest.raises(RuntimeError, match="directions: expected shape"):
        ops.shade_forward(*scene.field, scene.origins, scene.directions[:5])
