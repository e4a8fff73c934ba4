"""integration_ranges: the stretches of rays that are worth sampling, and the step that uses them."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor

from tests.ops.calls import MODES, arguments, ops
from tests.ops.fields import TOLERANCE, Scene, assert_close, doubled, make_scene, one_tile
from torch_surfcap import reference
from torch_surfcap.reference import OUTSIDE, TRANSPARENCY


def ranges_arguments(scene: Scene, stop: float = 0.0, quiet: float = 1e9) -> list[Any]:
    return [*scene.field, *scene.rays[:3], *scene.march(stop), quiet]


def test_by_hand(device: str) -> None:
    # The ray of test_march: samples at t = 0.5, 1.5, ... 7.5, the tile's four at 4.5 ... 7.5 with a = 1/2, 4/5, 1, 0, and
    # a = 1 before. Under 0.95 are those at 4.5, 5.5 and 7.5, the last one: 3.5 to 6.5 and, as it begins where the first
    # ends, on to 7.5 + 3. Under 0.6, 4.5 and 7.5 alone: 3.5 to 5.5 and 6.5 to 10.5. With stop = 0.45 the ray ends at
    # 5.5: under 0.95, 3.5 to 8.5. From behind, looking away, it meets nothing.
    voxels, table, frame = one_tile(device=device)
    voxels[0, :, 0, 0, 0] = voxels.new_tensor([0.5, 0.8, 1.0, 0.0])
    origins = voxels.new_tensor([[-4.0, 0.5, 0.5], [-9.0, 0.5, 0.5]])
    directions = voxels.new_tensor([[1.0, 0, 0], [-1.0, 0, 0]])
    for stop, quiet, expected in (
        (0.0, 0.95, [[3.5, 10.5]]),
        (0.0, 0.6, [[3.5, 5.5], [6.5, 10.5]]),
        (0.45, 0.95, [[3.5, 8.5]]),
    ):
        march = (TRANSPARENCY, 0.0, 1.0, stop)
        rays = (origins, directions, voxels.new_zeros(2))
        through, away = joined(ops.integration_ranges(voxels, table, frame, *rays, *march, quiet), step=1.0)
        assert_close(voxels.new_tensor(through), torch.tensor(expected, dtype=torch.float64))
        assert not away


def joined(found: tuple[Tensor, Tensor], step: float) -> list[list[list[float]]]:
    """Each ray's ranges, those joined that touch: whether they already are is up to the rounding."""
    (offsets, ranges), rays = found, []
    for first, last in zip(offsets[:-1].tolist(), offsets[1:].tolist(), strict=True):
        ray: list[list[float]] = []
        for begin, end in ranges[first:last].tolist():
            if ray and begin < ray[-1][1] + 1e-3 * step:
                ray[-1][1] = end
            else:
                ray.append([begin, end])
        rays.append(ray)
    return rays


@pytest.mark.parametrize("opacity", MODES)
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_equals_reference(dtype: torch.dtype, opacity: int, device: str) -> None:
    scene = make_scene(opacity=opacity, dtype=dtype, device=device, rays=100, side=4)
    for stop, share in ((0.0, 0.5), (0.2, 0.9)):
        given = ranges_arguments(scene, stop, quiet=float(scene.voxels[..., 0].quantile(share)))
        actual = joined(ops.integration_ranges(*given), scene.step)
        expected = joined(reference.integration_ranges(*doubled(given)), scene.step)
        for mine, theirs in zip(actual, expected, strict=True):
            assert_close(torch.tensor(mine), torch.tensor(theirs), TOLERANCE[torch.float32])


@pytest.mark.parametrize("opacity", MODES)
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_step_with_all_ranges(dtype: torch.dtype, opacity: int, device: str) -> None:
    """Where no value is quiet, knowing the ranges changes nothing but what reaches from outside into a run's start."""
    scene = make_scene(opacity=opacity, dtype=dtype, device=device, rays=200, side=5)
    scene.slope *= 4  # E = exp(-slope * 4) outside is rounding then
    for stop in (0.0, 0.2):
        ranges = ops.integration_ranges(*ranges_arguments(scene, stop))
        given = arguments("photometric_step", scene, stop)
        plain, quick = ops.photometric_step(*given), ops.photometric_step(*given, ranges=ranges)
        for a, b in zip(quick, plain, strict=True):
            assert_close(a, b.cpu(), 1e-4)


def test_no_rays_and_no_tiles(device: str) -> None:
    scene = make_scene(device=device)
    offsets, ranges = ops.integration_ranges(*ranges_arguments(scene.select(slice(0))))
    assert (offsets.tolist(), ranges.shape) == ([0], (0, 2))
    scene.table = torch.full_like(scene.table, OUTSIDE - 9)
    offsets, ranges = ops.integration_ranges(*ranges_arguments(scene.select(slice(3))))
    assert (offsets.tolist(), ranges.shape) == ([0] * 4, (0, 2))


def test_opcheck(device: str) -> None:
    given = ranges_arguments(make_scene(device=device, rays=5))
    torch.library.opcheck(torch.ops.torch_surfcap.integration_ranges.default, tuple(given))


def test_wrong_arguments_are_named(device: str) -> None:
    scene = make_scene(device=device)
    good = ranges_arguments(scene)
    with pytest.raises(RuntimeError, match="origins: expected shape"):
        ops.integration_ranges(*scene.field, scene.origins[:, :2], *good[4:])
    with pytest.raises(RuntimeError, match="directions: expected shape"):
        ops.integration_ranges(*good[:4], scene.directions[1:], *good[5:])
