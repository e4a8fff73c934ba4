"""integration_ranges: the stretches of rays in non-empty cells, and the step that uses them."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from tests.ops.calls import MODES, arguments, ops
from tests.ops.fields import Scene, assert_close, doubled, make_scene, one_tile
from torch_surfcap import reference
from torch_surfcap.reference import OUTSIDE

HAIR = 2e-3  # voxels by which a range may begin later than its cell


def test_by_hand(device: str) -> None:
    # One tile at [0, 4]^3. Cells begin at voxel centres: a ray along x at y = z = 1.5 is in non-empty cells from the
    # centre of the first voxel before the tile, x = -3.5, that shares a cell with it, to x = 4.5: from its origin at
    # x = -6.5, t = 3 to 11. The second begins inside, at x = 2.5, and looks back: t = 0 to 6. The third misses.
    voxels, table, frame = one_tile(device=device)
    origins = voxels.new_tensor([[-6.5, 1.5, 1.5], [2.5, 1.5, 1.5], [2.5, 1.5, 9.0]])
    directions = voxels.new_tensor([[1.0, 0, 0], [-1.0, 0, 0], [-1.0, 0, 0]])
    offsets, ranges = ops.integration_ranges(voxels, table, frame, origins, directions)
    assert offsets.tolist() == [0, 1, 2, 2]
    torch.testing.assert_close(
        ranges.cpu(), torch.tensor([[3.0, 11.0], [0.0, 6.0]]).double(), rtol=0, atol=HAIR
    )


def lengths(offsets: Tensor, ranges: Tensor) -> Tensor:
    """Sum of the lengths of each ray's ranges."""
    total = torch.cat([ranges.new_zeros(1), (ranges[:, 1] - ranges[:, 0]).cumsum(0)])
    return total[offsets[1:]] - total[offsets[:-1]]


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_equals_reference(dtype: torch.dtype, device: str) -> None:
    """Lengths are equal up to a hair at each border; ranges are in order and do not overlap."""
    scene = make_scene(dtype=dtype, device=device, rays=200, side=5)
    given = [*scene.field, scene.origins, scene.directions]
    offsets, ranges = (x.cpu() for x in ops.integration_ranges(*given))
    expected = reference.integration_ranges(*doubled(given))
    assert len(offsets) == 201
    assert offsets[-1] == len(ranges)
    assert (ranges[:, 1] >= ranges[:, 0]).all()
    inner = torch.ones(len(ranges), dtype=torch.bool)
    inner[offsets[:-1][offsets[:-1] < len(ranges)]] = False  # the first of each ray
    assert (ranges[1:, 0] >= ranges[:-1, 1])[inner[1:]].all()
    torch.testing.assert_close(
        lengths(offsets, ranges).double(), lengths(*expected), rtol=0, atol=10 * HAIR * scene.frame[3]
    )


@pytest.mark.parametrize("opacity", MODES)
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_step_with_ranges(dtype: torch.dtype, opacity: int, device: str) -> None:
    """Knowing the ranges changes nothing that the step returns, also where rays end early."""
    scene = make_scene(opacity=opacity, dtype=dtype, device=device, rays=200, side=5)
    ranges = ops.integration_ranges(*scene.field, scene.origins, scene.directions)
    for stop in (0.0, 0.2):
        given = arguments("photometric_step", scene, stop)
        plain, quick = ops.photometric_step(*given), ops.photometric_step(*given, ranges=ranges)
        for a, b in zip(quick, plain, strict=True):
            assert_close(a, b.cpu(), 1e-3 if dtype == torch.float32 else 1e-4)


def fewer(scene: Scene, rays: int) -> list[object]:
    part = scene.select(slice(rays))
    return [*part.field, part.origins, part.directions]


def test_no_rays_and_no_tiles(device: str) -> None:
    scene = make_scene(device=device)
    offsets, ranges = ops.integration_ranges(*fewer(scene, 0))
    assert (offsets.tolist(), ranges.shape) == ([0], (0, 2))
    scene.table = torch.full_like(scene.table, OUTSIDE - 9)
    offsets, ranges = ops.integration_ranges(*fewer(scene, 3))
    assert (offsets.tolist(), ranges.shape) == ([0] * 4, (0, 2))


def test_opcheck(device: str) -> None:
    torch.library.opcheck(
        torch.ops.torch_surfcap.integration_ranges.default, tuple(fewer(make_scene(device=device), 5))
    )


def test_wrong_arguments_are_named(device: str) -> None:
    scene = make_scene(device=device)
    with pytest.raises(RuntimeError, match="origins: expected shape"):
        ops.integration_ranges(*scene.field, scene.origins[:, :2], scene.directions)
    with pytest.raises(RuntimeError, match="directions: expected shape"):
        ops.integration_ranges(*scene.field, scene.origins, scene.directions[1:])
