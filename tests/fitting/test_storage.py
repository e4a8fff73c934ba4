"""Fits in 8 and 16 bits: nearly as good as in floats, at a fraction of the memory, the same on any threads."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from typing import Any

import numpy as np
import pytest
import torch

from tests.fitting.sphere import CENTER, RADIUS, ball
from torch_surfcap import FitResult, codes, fit, ops
from torch_surfcap.distance import SurfaceDistance
from torch_surfcap.fitting.adam import TileAdam
from torch_surfcap.fitting.budget import bytes_per_number, partial_gradients
from torch_surfcap.fitting.settings import Descent, FitSettings

VOXEL = 1 / 27
MODES: tuple[dict[str, Any], ...] = (
    {"storage": 32},
    {"storage": 16},
    {"storage": 16, "accumulator": 16},
    {"storage": 8},
    {"storage": 8, "accumulator": 16},
    {"storage": 64},
)


@pytest.fixture
def threads() -> Iterator[None]:
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


@cache
def ball_fit(opacity: str, storage: int, accumulator: int, device: str, seed: int = 0) -> FitResult:
    bits: dict[str, Any] = {"storage": storage, "accumulator": accumulator, "seed": seed, "device": device}
    return fit(ball(side=32), opacity=opacity, sh_degree=1, levels=2, voxel=VOXEL, **bits)


def error(result: FitResult) -> float:
    """Mean distance of the vertices to the ball's surface."""
    return float(np.abs(np.linalg.norm(result.mesh.vertices - np.array(CENTER), axis=1) - RADIUS).mean())


def rest(opacity: str, storage: int, accumulator: int, device: str) -> float:
    """The photographs' loss in the end: of several iterations and seeds, which differ by a tenth among themselves."""
    fits = [ball_fit(opacity, storage, accumulator, device, seed) for seed in range(3)]
    return float(np.mean([row["photo"] for result in fits for row in result.history[-5:]]))


@pytest.mark.parametrize(("storage", "accumulator"), [(16, 16), (8, 32), (8, 16)])
@pytest.mark.parametrize("opacity", ["transparency", "distance"])
def test_ball(opacity: str, storage: int, accumulator: int, device: str) -> None:
    """As near the truth as a fit in floats, up to a twentieth of a voxel."""
    plain, narrow = (ball_fit(opacity, *bits, device) for bits in ((32, 32), (storage, accumulator)))
    assert narrow.field.voxels.dtype == torch.float32
    assert error(narrow) < error(plain) + 0.05 * VOXEL
    assert narrow.mesh.body_count == 1
    assert rest(opacity, storage, accumulator, device) < 1.2 * rest(opacity, 32, 32, device)


@pytest.mark.parametrize("mode", [{"sh_degree": 0}, {"sh_degree": 2, "view_spacing": 4}], ids=str)
def test_double_precision_gives_the_same_surface(mode: dict[str, Any], device: str) -> None:
    """Rounding to single precision moves it by less than a twentieth of a voxel."""
    given: dict[str, Any] = {"levels": 2, "voxel": VOXEL, "device": device} | mode
    single, double = (fit(ball(side=32), storage=bits, **given) for bits in (32, 64))
    assert double.field.voxels.dtype == torch.float32
    assert not np.array_equal(single.mesh.vertices, double.mesh.vertices)
    apart = SurfaceDistance(single.mesh)(np.asarray(double.mesh.vertices)).distance
    assert apart.mean() < 0.05 * VOXEL


def test_same_bits_on_any_threads(threads: None) -> None:
    fields = []
    for count, seed in ((1, 0), (2, 0), (2, 1)):
        torch.set_num_threads(count)
        result = fit(ball(8, 32), seed=seed, levels=2, voxel=0.05, storage=8, accumulator=16)
        fields.append(result.field.voxels)
    assert torch.equal(fields[0], fields[1])
    assert fields[0].shape != fields[2].shape or not torch.equal(fields[0], fields[2])


@pytest.mark.parametrize("mode", MODES, ids=str)
def test_bytes_are_those_allocated(mode: dict[str, Any]) -> None:
    settings = FitSettings.of(**mode)
    floats = torch.zeros(600, 4, 4, 4, ops.pitch(1))
    store = codes.encode(floats, 4.0, -4.0, settings.storage)
    adam = TileAdam(store, "distance", Descent())
    tensors = (store, adam.first, adam.second, partial_gradients(store, settings.accumulator))
    allocated = sum(t.numel() * t.element_size() for t in tensors)
    assert bytes_per_number(store.numel(), settings) == allocated / store.numel()


def test_less_than_half_of_the_floats() -> None:
    """Per coefficient of a large field: 28 bytes in floats with their four partial gradients, 11 and 7 in 8 bits."""
    assert [bytes_per_number(10**9, FitSettings.of(**mode)) for mode in MODES] == [28, 14, 10, 11, 7, 56]


@pytest.mark.parametrize(
    "wrong",
    [
        {"storage": 4},
        {"gradient": "gather", "storage": 64},
        {"rounding": "down"},
        {"accumulator": 16},
        {"storage": 8, "accumulator": 8},
    ],
)
def test_impossible_settings_are_named(wrong: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=next(reversed(wrong))):
        FitSettings.of(**wrong)
