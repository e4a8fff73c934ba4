"""The z-buffer, by hand."""

from __future__ import annotations

import pytest
import torch

from torch_surfcap import ops

# A square of 4 x 4 pixels at depth 2 as two triangles, one of either orientation, and a triangle over its middle.
CORNERS = [[1, 1, 2], [5, 1, 2], [5, 5, 2], [1, 5, 2], [2, 2, 1], [4, 2, 1], [2, 4, 1]]
FACES = [[0, 1, 2], [0, 2, 3], [4, 6, 5]]


def square(device: str, dtype: torch.dtype = torch.float32) -> tuple[torch.Tensor, torch.Tensor]:
    corners = torch.tensor(CORNERS, dtype=dtype, device=device)
    return corners, torch.tensor(FACES, dtype=torch.int32, device=device)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_square_behind_a_triangle(device: str, dtype: torch.dtype) -> None:
    seen = ops.rasterize(*square(device, dtype), 6, 7)
    # On the diagonal both halves of the square, and on its side the triangle, hold the pixel's centre.
    expected = [
        [-1, -1, -1, -1, -1, -1, -1],
        [-1, 0, 0, 0, 0, -1, -1],
        [-1, 1, 2, 2, 0, -1, -1],
        [-1, 1, 2, 0, 0, -1, -1],
        [-1, 1, 1, 1, 0, -1, -1],
        [-1, -1, -1, -1, -1, -1, -1],
    ]
    assert seen.tolist() == expected


def test_the_nearer_of_two_tilted_faces(device: str) -> None:
    """Depths 1 to 3 and 3 to 1 from left to right cross in the middle; 1/depth, not depth, is linear between."""
    one: list[list[float]] = [[0, -9, 1], [8, -9, 3], [8, 9, 3], [0, 9, 1]]
    other = [[x, y, 4 - z] for x, y, z in one]
    corners = torch.tensor(one + other, dtype=torch.float32, device=device)
    faces = torch.tensor([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]], dtype=torch.int32, device=device)
    seen = ops.rasterize(corners, faces, 1, 8)[0]
    assert [int(face) // 2 for face in seen] == [0, 0, 0, 0, 1, 1, 1, 1]


@pytest.mark.parametrize("seed", range(4))
def test_no_hole_along_shared_sides(seed: int, device: str) -> None:
    """A fan of thin triangles around an inner point covers every pixel of the picture."""
    g = torch.Generator().manual_seed(seed)
    turn = torch.cat([torch.rand(200, generator=g).sort().values, torch.zeros(1)]) * 2 * torch.pi
    rim = torch.stack([20 + 99 * turn.cos(), 20 + 99 * turn.sin(), torch.ones(201)], 1)
    inner = torch.cat([10 + 20 * torch.rand(2, generator=g), torch.ones(1)])
    corners = torch.cat([rim, inner[None]]).to(device)
    ring = torch.arange(201)
    faces = torch.stack([ring, (ring + 1) % 201, torch.full((201,), 201)], 1).int().to(device)
    assert (ops.rasterize(corners, faces, 40, 40) >= 0).all()


def test_faces_that_reach_behind_the_camera_are_left_out(device: str) -> None:
    corners, faces = square(device)
    corners[4, 2] = -1.0
    assert set(ops.rasterize(corners, faces, 6, 7).flatten().tolist()) == {-1, 0, 1}


def test_empty(device: str) -> None:
    corners, faces = square(device)
    assert (ops.rasterize(corners, faces[:0], 2, 3) == -1).all()
    assert ops.rasterize(corners, faces, 0, 3).shape == (0, 3)


def test_wrong_arguments_are_named(device: str, looked_into: bool) -> None:
    corners, faces = square(device)
    for wrong, match in (
        ((corners[:, :2], faces, 6, 7), "corners: expected shape"),
        ((corners, faces.long(), 6, 7), "faces: expected int32"),
        ((corners, faces, -1, 7), "height, width: expected"),
        *[((corners, faces + 1, 6, 7), "faces: expected 0 to less")] * looked_into,
    ):
        with pytest.raises(RuntimeError, match=match):
            ops.rasterize(*wrong)
