"""CPU = CUDA for every op, at the size of a small fit: inputs are made once, on the CPU, and both devices get them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import pytest
import torch
from torch import Tensor

from tests.ops.calls import MODES, NAMES, TRANSMITTANCE, arguments, has_depth, normal, ops, run
from tests.ops.fields import Scene, make_scene
from torch_surfcap.reference import DISTANCE, TILE

SIDE, RAYS = 16, 8192  # 16³ cells, of which two fifths hold tiles: 100 000 voxels
DTYPES = (torch.float64, torch.float32)
EXACT = 1e-10  # in double, relative to the largest number
# In single precision: of colours, absolute, and of gradients, relative to the largest.
COLOR, REST = 1e-5, 1e-4
# Share of the numbers that may be farther off in single precision: where floor() or a comparison decides what is written
# where, rounding decides otherwise now and then. Colours change by 1 within a voxel beside missing tiles, and a position
# is known to some 5e-6 voxels: as many of them may be off by up to REST.
RARE = 1e-3
DECIDED = {
    "photometric_lattice": RARE,
    "gather_gradient": RARE,
    "visibility": RARE,
    "soft_hull": RARE,
    "rasterize": RARE,
    "integration_ranges": RARE,
    "march_backward": RARE / 10,  # the kink of a = min(1, ...)
    "photometric_step": RARE / 10,
}
COLORS = {"march_forward": 0, "photometric_step": 2, "photometric_lattice": 1}


def large_scene(degree: int, opacity: int, dtype: torch.dtype) -> Scene:
    """A scene whose values change over several voxels, as those of a fit do."""
    scene = make_scene(degree, opacity, rays=RAYS, side=SIDE)
    local = torch.cartesian_prod(*[torch.arange(TILE)] * 3).view(TILE, TILE, TILE, 3)
    place = (scene.coordinates[:, None, None, None] * TILE + local).double()
    channels = scene.voxels.shape[-1]
    waves = torch.sin(place @ (0.4 * normal(place, 3, channels)) + normal(place, channels, seed=2) * 3)
    used = 1 + 3 * (degree + 1) ** 2
    scene.voxels[..., :used] = 0.5 + 0.3 * waves[..., :used]
    scene.voxels[..., 4:used] = 0.1 * waves[..., 4:used]
    scene.voxels[..., 0] = 2 * waves[..., 0] if opacity == DISTANCE else 0.8 + 0.19 * waves[..., 0]
    floats = {
        name: x.to(dtype) for name, x in vars(scene).items() if torch.is_tensor(x) and x.is_floating_point()
    }
    return Scene(**{**vars(scene), **floats})


def given_to(name: str, scene: Scene) -> list[Any]:
    """Like ``arguments``, without what takes the dense reference, which such a size is too large for."""
    if name == "march_backward":
        solid = has_depth(ops.march_forward(*scene.marched())[1], 0.1)
        grads = [
            normal(solid, RAYS, 3, seed=1),
            normal(solid, RAYS, seed=2),
            normal(solid, RAYS, seed=3) * solid,
        ]
        return [*(g.to(scene.voxels) for g in grads), *scene.marched(), 4]
    if name == "integration_ranges":
        quiet = float(scene.voxels[..., 0].flatten()[::7].quantile(0.8))
        return [*scene.field, *scene.rays[:3], *scene.march(), quiet]
    return arguments(name, scene)


def results(name: str, given: Sequence[Any]) -> list[Tensor]:
    """What an op returns or writes; of ranges, how long they are together on each ray; of depths, those that are more
    than rounding."""
    if name == "integration_ranges":
        offsets, ranges = ops.integration_ranges(*given)
        ray = torch.arange(RAYS, device=offsets.device).repeat_interleave(offsets.diff())
        return [ranges.new_zeros(RAYS).index_add_(0, ray, ranges[:, 1] - ranges[:, 0])]
    found = run(ops, name, given)
    if name in TRANSMITTANCE:
        at = TRANSMITTANCE[name]
        found[at + 1] = found[at + 1].where(has_depth(found[at], 0.1), 0)
    return found


def agree(name: str, there: Sequence[Tensor], here: Sequence[Tensor], dtype: torch.dtype) -> None:
    """Raises AssertionError where the two differ by more than they may."""
    for i, (a, b) in enumerate(zip(there, here, strict=True)):
        assert a.shape == b.shape
        assert a.dtype == b.dtype
        scale = float(b.double().abs().max()) if b.numel() else 1.0
        bounds = {EXACT * scale: 0.0}
        if dtype == torch.float32:
            bounds = {REST * scale: DECIDED.get(name, 0.0)}
            bounds |= {COLOR: RARE} if i == COLORS.get(name) else {}
        for bound, share in bounds.items():
            beyond = int((~((a.cpu().double() - b.double()).abs() <= bound)).sum())
            what = f"{name}[{i}]: {beyond} of {b.numel()} differ by more than {bound:.1e}"
            assert beyond <= share * b.numel(), what


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")
@pytest.mark.parametrize("opacity", MODES)
@pytest.mark.parametrize("degree", [0, 1, 2])
@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("name", [*NAMES, "integration_ranges"])
def test_cuda_equals_cpu(name: str, dtype: torch.dtype, degree: int, opacity: int) -> None:
    given = given_to(name, large_scene(degree, opacity, dtype))
    moved = [x.cuda() if isinstance(x, Tensor) else x for x in given]
    agree(name, results(name, moved), results(name, given), dtype)


@pytest.mark.parametrize("name", [*NAMES, "integration_ranges"])
def test_what_they_are_compared_with(name: str) -> None:
    """Of every op there are numbers to compare; one that is off is found."""
    found = results(name, given_to(name, large_scene(1, DISTANCE, torch.float32)))
    assert all(float(x.double().abs().max()) > 0 for x in found)
    agree(name, found, found, torch.float32)
    last = found[-1].double()
    wrong = [*found[:-1], (last + 0.01 * last.abs().max() + last.dtype.is_floating_point).to(found[-1].dtype)]
    with pytest.raises(AssertionError, match="differ"):
        agree(name, wrong, found, torch.float32)
