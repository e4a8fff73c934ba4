"""voxel_terms: total variation, parsimony, ballooning and curvature."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor

from tests.ops.calls import arguments, ops
from tests.ops.fields import GRADCHECK, assert_close, make_scene, one_tile
from torch_surfcap.autograd import VoxelTerms
from torch_surfcap.reference import INSIDE


def test_by_hand(device: str) -> None:
    # One tile of a = 1/2 between outside (1) and, on its high x side, inside (0): 6 faces of 16 pairs, each (1/2)^2, so
    # TV = 24. Voxel (1, 1, 1) has red 0.3 where the others have 0: 6 pairs of 0.09 = 0.54; nothing at the tile's edge,
    # since colour has no missing neighbours. Degree 1: one coefficient 0.05, Huber 0.05^2/2 = 0.00125, and one -0.2,
    # 0.1 (0.2 - 0.05) = 0.015, in voxels of their own inside the tile: 6 pairs of 0.0025 and of 0.04, 0.255 more.
    # Ballooning: 64 / 4 = 16.
    voxels, table, frame = one_tile(degree=1, device=device)
    table[2, 1, 1] = INSIDE
    voxels[..., 0] = 0.5
    voxels[0, 1, 1, 1, 1] = 0.3
    voxels[0, 2, 2, 2, 4] = 0.05
    voxels[0, 1, 2, 1, 9] = -0.2
    coordinates = torch.ones(1, 3, dtype=torch.int32, device=device)
    gradient = torch.zeros_like(voxels)
    losses = ops.voxel_terms(voxels, table, frame, coordinates, [1.0, 1.0, 1.0, 1.0, 0.0], 0.1, 0.4, gradient)
    assert_close(losses, torch.tensor([24.0, 0.54 + 0.255, 0.01625, 16.0, 0.0], dtype=torch.float64))
    # Corner (0, 0, 0) has three outside neighbours: 2 * 3 * (1/2 - 1) + 2 * 1/2 = -2. In the middle only ballooning: 1.
    # Red of voxel (1, 1, 1): 2 * 6 * 0.3. Coefficient 4 of (2, 2, 2): 2 * 6 * 0.05 + 0.05; 9 of (1, 2, 1): -2.4 - 0.1.
    for at, expected in {
        (0, 0, 0, 0): -2.0,
        (1, 1, 1, 0): 1.0,
        (3, 1, 1, 0): 2 * (0.5 - 0) + 1,
        (1, 1, 1, 1): 3.6,
        (2, 2, 2, 4): 0.65,
        (1, 2, 1, 9): -2.5,
        (0, 1, 1, 1): -0.6,
    }.items():
        assert gradient[0][at].item() == pytest.approx(expected), at


def test_curvature_by_hand(device: str) -> None:
    # Values rise by 0.1 per voxel along x: the Laplacian is 0. A bump of 0.1 at (1, 2, 2) makes it -0.6 there and +0.1 at
    # the neighbours (1, 1, 2), (1, 2, 1) and (2, 2, 2); those at x = 0, y = 3 and z = 3 touch the outside and do not
    # count. Huber over 0.4: 0.4 (0.6 - 0.2) + 3 * 0.1^2 / 2 = 0.175; its derivatives are -0.4 and 0.1. Gradient at the
    # bump: -6 * -0.4 + 3 * 0.1 = 2.7; at (0, 2, 2), whose own Laplacian is unknown, -0.4; at (2, 2, 2): -6 * 0.1 - 0.4 =
    # -1.0; at (3, 2, 2): 0.1.
    voxels, table, frame = one_tile(degree=0, device=device)
    voxels[..., 0] = 0.3 + 0.1 * torch.arange(4, dtype=torch.float64, device=device).view(4, 1, 1)
    voxels[0, 1, 2, 2, 0] += 0.1
    coordinates = torch.ones(1, 3, dtype=torch.int32, device=device)
    gradient = torch.zeros_like(voxels)
    losses = ops.voxel_terms(voxels, table, frame, coordinates, [0.0, 0.0, 0.0, 0.0, 1.0], 0.1, 0.4, gradient)
    assert losses[4].item() == pytest.approx(0.175)
    for at, expected in {
        (1, 2, 2): 2.7,
        (0, 2, 2): -0.4,
        (2, 2, 2): -1.0,
        (3, 2, 2): 0.1,
        (0, 0, 0): 0.0,
    }.items():
        assert gradient[0][at][0].item() == pytest.approx(expected, abs=1e-12), at
    voxels[0, 2, 2, 2, 0] = frame[4]  # at its bound: nothing is known there and beside it, the bump included
    losses = ops.voxel_terms(voxels, table, frame, coordinates, [0.0, 0.0, 0.0, 0.0, 1.0], 0.1, 0.4, gradient)
    assert losses[4].item() == pytest.approx(0.01)


def test_gradient_is_added(device: str) -> None:
    given = arguments("voxel_terms", make_scene(device=device))
    fresh, added = torch.zeros_like(given[7]), given[7].clone()
    ops.voxel_terms(*given[:7], fresh)
    ops.voxel_terms(*given[:7], added)
    assert_close(added - given[7], fresh.cpu())


@pytest.mark.parametrize("degree", [0, 1, 2])
def test_gradcheck(degree: int, device: str) -> None:
    scene = make_scene(degree, device=device, side=2)

    def total(voxels: Tensor) -> Any:
        return VoxelTerms.apply(
            voxels, scene.table, scene.frame, scene.coordinates, [0.3, 0.7, 0.2, 0.4, 0.5], 0.1, 0.05
        )[0]

    assert torch.autograd.gradcheck(total, scene.voxels.requires_grad_(), **GRADCHECK)


def test_wrong_arguments_are_named(device: str, looked_into: bool) -> None:
    good = arguments("voxel_terms", make_scene(device=device))
    for i, wrong, match in (
        (3, good[3][1:], "coordinates: expected shape"),
        *[(3, torch.zeros_like(good[3]), "coordinates: expected every tile inside")] * looked_into,
        (4, [1.0], "weights: expected"),
        (7, good[7][..., :2], "gradient: expected shape"),
        (7, good[7].transpose(1, 2), "gradient: is written in place and must be contiguous"),
    ):
        with pytest.raises(RuntimeError, match=match):
            ops.voxel_terms(*good[:i], wrong, *good[i + 1 :])
