"""What every op owes: the reference's numbers, a schema that tells the truth, and the same bits on any threads."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
import torch
from torch import Tensor

from tests.ops.calls import MODES, NAMES, arguments, has_depth, raw, run
from tests.ops.fields import TOLERANCE, assert_close, doubled, make_scene
from torch_surfcap import ops, reference

DTYPES = (torch.float64, torch.float32)


@pytest.fixture
def threads() -> Iterator[None]:
    """Leaves the number of threads as it was."""
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


@pytest.mark.parametrize("opacity", MODES)
@pytest.mark.parametrize("degree", [0, 1, 2])
@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("name", NAMES)
def test_equals_reference(name: str, dtype: torch.dtype, degree: int, opacity: int, device: str) -> None:
    for seed, stop in ((0, 0.0), (1, 0.3)):
        given = arguments(name, make_scene(degree, opacity, dtype, device, seed=seed), stop)
        for actual, expected in zip(run(ops, name, given), run(reference, name, doubled(given)), strict=True):
            assert_close(actual, expected, TOLERANCE[dtype])


@pytest.mark.parametrize("name", NAMES)
def test_non_contiguous(name: str, device: str) -> None:
    scene = make_scene(device=device)
    plain = run(ops, name, arguments(name, scene))
    for actual, expected in zip(run(ops, name, arguments(name, scene.non_contiguous())), plain, strict=True):
        if device == "cpu":
            assert torch.equal(actual, expected)
        else:  # the order of sums is left to chance
            assert_close(actual, expected.cpu(), 1e-13)


@pytest.mark.parametrize("rays", [0, 1])
@pytest.mark.parametrize("name", NAMES)
def test_few_rays(name: str, rays: int, device: str) -> None:
    given = arguments(name, make_scene(device=device).select(slice(rays)))
    for actual, expected in zip(run(ops, name, given), run(reference, name, doubled(given)), strict=True):
        assert_close(actual, expected)


@pytest.mark.parametrize("name", NAMES)
def test_no_tiles(name: str, device: str) -> None:
    """A field of nothing but missing tiles, some of them inside."""
    scene = make_scene(device=device)
    scene.table = torch.where(scene.table >= 0, reference.INSIDE, scene.table)
    scene.voxels, scene.coordinates = scene.voxels[:0], scene.coordinates[:0]
    given = arguments(name, scene)
    for actual, expected in zip(run(ops, name, given), run(reference, name, doubled(given)), strict=True):
        assert_close(actual, expected)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("name", NAMES)
def test_same_bits_on_any_number_of_threads(name: str, dtype: torch.dtype, threads: None) -> None:
    given = arguments(name, make_scene(dtype=dtype, rays=300))
    results: list[list[Tensor]] = []
    for count in (1, 2, 3, 1):
        torch.set_num_threads(count)
        results.append(run(ops, name, given))
    for other in results[1:]:
        assert all(
            torch.equal(a.nan_to_num(), b.nan_to_num()) for a, b in zip(results[0], other, strict=True)
        )


@pytest.mark.parametrize("name", NAMES)
def test_opcheck(name: str, device: str) -> None:
    scene = make_scene(rays=12, device=device)
    scene = scene.select(has_depth(ops.march_forward(*scene.marched())[1]))
    op, given = raw(name, arguments(name, scene))
    torch.library.opcheck(op, given)


@pytest.mark.parametrize(
    "name", [name for name in NAMES if name not in ("adam_step", "soft_hull", "rasterize")]
)
def test_wrong_field_is_named(name: str, device: str) -> None:
    good = arguments(name, make_scene(device=device))
    at = next(i for i, a in enumerate(good) if isinstance(a, Tensor) and a.dim() == 5)

    def fails(i: int, wrong: object, match: str) -> None:
        with pytest.raises(RuntimeError, match=match):
            run(ops, name, [*good[:i], wrong, *good[i + 1 :]])

    fails(at, good[at][..., :5], "voxels: expected 4, 16 or 32")
    fails(at, good[at][:, :3], "voxels: expected shape")
    fails(at + 1, good[at + 1][0], "table: expected shape")
    fails(at + 1, good[at + 1].long(), "table: expected int32")
    fails(at + 2, good[at + 2][:5], "frame: expected")
    fails(at + 2, [0.0, 0.0, 0.0, -1.0, 1.0, 0.0], "frame: expected a positive voxel size")


@pytest.mark.parametrize(
    "name", [name for name in NAMES if "march" in name or name in ("photometric_step", "visibility")]
)
def test_wrong_rays_are_named(name: str, device: str) -> None:
    scene = make_scene(device=device)
    good = arguments(name, scene)
    at = next(i for i, a in enumerate(good) if a is scene.origins)
    march = next(i for i, a in enumerate(good) if isinstance(a, int))

    def fails(i: int, wrong: object, match: str) -> None:
        with pytest.raises(RuntimeError, match=match):
            run(ops, name, [*good[:i], wrong, *good[i + 1 :]])

    fails(at, scene.origins[:, :2], "origins: expected shape")
    fails(at, scene.origins.float(), "origins: expected float64")
    fails(at + 1, scene.directions[1:], "directions: expected shape")
    fails(at + 2, scene.shift[1:], "shift: expected shape")
    fails(march, 2, "opacity: expected 0")
    fails(march + 2, 0.0, "step: expected a positive")
