"""visibility: what reaches each voxel and what each voxel shows."""

from __future__ import annotations

import torch

from tests.ops.fields import assert_close, make_scene, one_tile
from torch_surfcap import ops
from torch_surfcap.reference import TRANSPARENCY


def test_by_hand(device: str) -> None:
    # The ray of test_march: samples at the centres of voxels (0..3, 0, 0), T = 1, 1/2, 2/5, 2/5, w = 1/2, 1/10, 0, 2/5.
    # A second ray comes from the other side: a = 0 at voxel 3 stops it there with T = w = 1; behind it T = w = 0.
    voxels, table, frame = one_tile(device=device)
    voxels[0, :, 0, 0, 0] = voxels.new_tensor([0.5, 0.8, 1.0, 0.0])
    origins = voxels.new_tensor([[-4.0, 0.5, 0.5], [8.0, 0.5, 0.5]])
    directions = voxels.new_tensor([[1.0, 0, 0], [-1.0, 0, 0]])
    seen = ops.visibility(
        voxels,
        table,
        frame,
        origins,
        directions,
        torch.zeros_like(origins[:, 0]),
        TRANSPARENCY,
        0.0,
        1.0,
        0.0,
    )
    expected = torch.zeros(1, 4, 4, 4, 2, dtype=torch.float64)
    expected[0, :, 0, 0, 0] = expected.new_tensor([1, 0.5, 0.4, 1])
    expected[0, :, 0, 0, 1] = expected.new_tensor([0.5, 0.1, 0, 1])
    assert_close(seen, expected)


def test_a_ray_that_has_ended_sees_nothing_more(device: str) -> None:
    scene = make_scene(device=device, rays=200)
    march = (scene.opacity, scene.slope, scene.step)
    all_seen = ops.visibility(*scene.field, *scene.rays[:3], *march, 0.0)
    seen = ops.visibility(*scene.field, *scene.rays[:3], *march, 0.5)
    assert (seen <= all_seen).all()
    read = seen[..., 0] > 0
    assert (seen[..., 0][read] >= 0.5).all()
    assert not read.all()
