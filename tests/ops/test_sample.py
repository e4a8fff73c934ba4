"""sample_forward and sample_backward: the trilinear read and its adjoint."""

from __future__ import annotations

import pytest
import torch

from tests.ops.calls import normal, points_of
from tests.ops.fields import GRADCHECK, assert_close, make_scene, one_tile
from torch_surfcap import ops
from torch_surfcap.autograd import SampleTiles


def test_by_hand(device: str) -> None:
    # One tile whose voxel (x, y, z), centred at (x + 1/2, y + 1/2, z + 1/2), holds x + 10 y + 100 z: linear, so
    # reproduced between the centres. At local (1.25, 2.5, 0.75): 1.25 + 25 + 75 = 101.25. Half a voxel beyond the first
    # centre in x, at local (-1/2, 2, 1): the mean of outside, 1, and of 0 + 20 + 100: 60.5. Far away: outside, 1.
    voxels, table, frame = one_tile(device=device)
    x, y, z = torch.meshgrid(*[torch.arange(4.0, dtype=torch.float64)] * 3, indexing="ij")
    voxels[0, ..., 0] = x + 10 * y + 100 * z
    voxels[0, ..., 2] = -x
    points = torch.tensor([[1.75, 3, 1.25], [0, 2.5, 1.5], [-300, 9, 9]], dtype=torch.float64, device=device)
    values = ops.sample_forward(voxels, table, frame, points)
    assert_close(values[:, 0], torch.tensor([101.25, 60.5, 1.0], dtype=torch.float64))
    assert_close(values[:, 2], torch.tensor([-1.25, 0.0, 0.0], dtype=torch.float64))
    assert_close(values[:, 1], torch.zeros(3, dtype=torch.float64))


def test_at_centers_reads_the_voxel_itself(device: str) -> None:
    scene = make_scene(degree=2, device=device)
    size, low = scene.frame[3], scene.voxels.new_tensor(scene.frame[:3])
    place = 4 * scene.coordinates + torch.tensor([1, 2, 3], device=device)
    centers = low + (place.double() + 0.5) * size
    values = ops.sample_forward(*scene.field, centers)
    torch.testing.assert_close(values, scene.voxels[:, 1, 2, 3])


@pytest.mark.parametrize("degree", [0, 1, 2])
def test_adjoint(degree: int, device: str) -> None:
    """<A x, y> = <x, A^T y>; linear, so with nothing outside and inside."""
    scene = make_scene(degree, device=device, rays=100)
    frame = [*scene.frame[:4], 0.0, 0.0]
    x, points = scene.voxels, points_of(scene)
    y = normal(x, len(points), x.shape[-1])
    forward = ops.sample_forward(x, scene.table, frame, points)
    backward = ops.sample_backward(y, x, scene.table, frame, points, groups=3)
    torch.testing.assert_close((forward * y).sum(), (x * backward).sum())


@pytest.mark.parametrize("degree", [0, 1, 2])
def test_gradcheck(degree: int, device: str) -> None:
    scene = make_scene(degree, device=device, rays=6, side=2)
    voxels = scene.voxels.requires_grad_()
    assert torch.autograd.gradcheck(
        lambda v: SampleTiles.apply(v, scene.table, scene.frame, points_of(scene)), voxels, **GRADCHECK
    )


def test_wrong_points_are_named(device: str) -> None:
    scene = make_scene(device=device)
    with pytest.raises(RuntimeError, match=r"points: expected shape \[\*, 3\], got \[24, 2\]"):
        ops.sample_forward(*scene.field, scene.origins[:, :2])
    with pytest.raises(RuntimeError, match="grad_values: expected shape"):
        ops.sample_backward(scene.origins, *scene.field, scene.origins)
