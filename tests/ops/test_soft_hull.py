"""soft_hull: the least mask of the cameras that see a point."""

from __future__ import annotations

import pytest
import torch

from tests.ops.calls import arguments, ops
from tests.ops.fields import assert_close, make_scene


def test_by_hand(device: str) -> None:
    # Two cameras at the origin with u = x/z, v = y/z, looking along z. The first has 3 x 2 pixels with masks
    #   0.0  0.5  1.0
    #   0.2  0.2  0.2
    # and pixel (0, 0) centred at (0.5, 0.5); the second has one pixel of 0.4.
    # (0.5, 0.5): both see it, min(0, 0.4). (1.5, 0.5): only the first, 0.5. (2, 0.5): between 0.5 and 1: 0.75.
    # (3, 0): the picture's corner still counts, mask of the outermost pixel, 1. (1.5, 1): (0.5 + 0.2)/2 = 0.35.
    # (3.1, 0.5): outside; the last lies behind both.
    uv = [[0.5, 0.5], [1.5, 0.5], [2.0, 0.5], [3.0, 0.0], [1.5, 1.0], [3.1, 0.5], [0.5, 0.5]]
    depth = torch.tensor([1.0, 2, 3, 1, 1, 1, -1], dtype=torch.float64, device=device)
    points = torch.tensor([[u, v, 1.0] for u, v in uv], dtype=torch.float64, device=device) * depth[:, None]
    projections = torch.eye(3, 4, dtype=torch.float64, device=device).repeat(2, 1, 1)
    masks = torch.tensor([0, 0.5, 1, 0.2, 0.2, 0.2, 0.4], dtype=torch.float64, device=device)
    sizes = torch.tensor([[3, 2], [1, 1]], device=device)
    value, votes = ops.soft_hull(points, projections, masks, sizes)
    assert votes.tolist() == [2, 1, 1, 1, 1, 0, 0]
    assert_close(value, torch.tensor([0, 0.5, 0.75, 1, 0.35, 0, 0], dtype=torch.float64))


def test_no_cameras(device: str) -> None:
    points, projections, masks, sizes = arguments("soft_hull", make_scene(device=device))
    value, votes = ops.soft_hull(points, projections[:0], masks[:0], sizes[:0])
    assert not value.any()
    assert not votes.any()


def test_wrong_arguments_are_named(device: str, looked_into: bool) -> None:
    good = arguments("soft_hull", make_scene(device=device))
    for i, wrong, match in (
        (0, good[0][:, :2], "points: expected shape"),
        (1, good[1][:, :2], "projections: expected shape"),
        (1, good[1].float(), "projections: expected float64"),
        *[(2, good[2][1:], "masks: expected")] * looked_into,
        (3, good[3][1:], "sizes: expected shape"),
        (3, good[3].int(), "sizes: expected int64"),
    ):
        with pytest.raises(RuntimeError, match=match):
            ops.soft_hull(*good[:i], wrong, *good[i + 1 :])
