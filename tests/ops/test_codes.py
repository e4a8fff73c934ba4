"""Fields in 8 and 16 bits: what their codes stand for, that the ops read them so, and Adam on them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

from tests.ops.calls import GROUPS, MODES, arguments, has_depth, normal, ops, raw, run
from tests.ops.fields import Scene, assert_close, doubled, make_scene, one_tile
from torch_surfcap import codes, reference
from torch_surfcap.reference import DISTANCE
from torch_surfcap.reference.codes import e5m2, u53

BITS = (8, 16)
READ = ("photometric_step", "integration_ranges", "visibility", "voxel_terms")
HALF_ERROR = 3e-3  # of a gradient summed in halves, of its norm


@pytest.fixture
def threads() -> Iterator[None]:
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


def call(name: str, scene: Scene) -> list[Any]:
    """Arguments of an op, the gradients in float32."""
    if name == "integration_ranges":
        return [*scene.field, *scene.rays[:3], *scene.march(0.01), 0.8]
    given = arguments(name, replace(scene, voxels=codes.decode(scene.voxels, *scene.frame[4:])), 0.01)
    return [scene.voxels, *given[1:]]


def narrow_scene(bits: int, degree: int = 1, opacity: int = DISTANCE, rays: int = 24) -> Scene:
    scene = make_scene(degree, opacity, torch.float32, rays=rays)
    return replace(scene, voxels=codes.encode(scene.voxels, scene.frame[4], scene.frame[5], bits))


def test_codes_by_hand() -> None:
    # 8 bits have 254 steps. Opacity over [-4, 4]: one step is 8/254; 1 -> 5 * 254/8 = 158.75 -> 159. Colour: 0.5 -> 127,
    # 1 -> 254, 2 is clamped. View-dependent: -1 -> 0, 0 -> 127, 0.25 -> 1.25 * 127 = 158.75 -> 159. Padding: 0.
    record = torch.zeros(16)
    record[:7] = torch.tensor([1.0, 0.5, 1.0, 2.0, -1.0, 0.0, 0.25])
    code = codes.encode(record, 4.0, -4.0, 8)
    assert code.dtype == torch.uint8
    assert code.tolist() == [159, 127, 254, 254, 0, 127, 159, *[127] * 6, 0, 0, 0]
    values = codes.decode(code, 4.0, -4.0)
    expected = [159 * 8 / 254 - 4, 0.5, 1.0, 1.0, -1.0, 0.0, 32 / 127, *[0.0] * 9]
    torch.testing.assert_close(values, torch.tensor(expected))
    # A transparency falls from 1 outside to 0.02 inside: code 0 is the inside.
    assert codes.encode(torch.tensor([0.02, 0, 0, 0]), 1.0, 0.02, 16).tolist() == [0, 0, 0, 0]
    assert codes.encode(torch.tensor([1.0, 0, 0, 0]), 1.0, 0.02, 16).tolist() == [65534, 0, 0, 0]


@pytest.mark.parametrize("bits", BITS)
@pytest.mark.parametrize("degree", [0, 1, 2])
def test_every_code_comes_back(bits: int, degree: int) -> None:
    pitch, top = ops.pitch(degree), 2**bits - 2
    code = torch.arange(top + 1).to(torch.int32)[:, None].expand(-1, pitch).clone()
    code[:, ops.coefficients(degree) :] = 0
    given = code.to(codes.TYPES[bits])
    values = codes.decode(given, 4.0, -4.0)
    assert torch.equal(codes.encode(values, 4.0, -4.0, bits).int(), code)
    assert_close(values, reference.decoded(given, [0.0] * 4 + [4.0, -4.0]), 1e-6)


@pytest.mark.parametrize("opacity", MODES)
@pytest.mark.parametrize("degree", [0, 1, 2])
@pytest.mark.parametrize("bits", BITS)
@pytest.mark.parametrize("name", READ)
def test_equals_the_decoded_field_and_the_reference(name: str, bits: int, degree: int, opacity: int) -> None:
    scene = narrow_scene(bits, degree, opacity)
    given = call(name, scene)
    values = [codes.decode(given[0], *scene.frame[4:]), *given[1:]]
    results = run(ops, name, given)
    for actual, plain, expected in zip(
        results, run(ops, name, values), run(reference, name, doubled(given)), strict=True
    ):
        assert actual.dtype == plain.dtype
        assert_close(actual, plain.double(), 1e-5)
        assert_close(actual, expected, 2e-5)


@pytest.mark.parametrize("bits", BITS)
@pytest.mark.parametrize("name", READ)
def test_bounds_are_known_as_such(name: str, bits: int) -> None:
    """A field full of values at the two bounds, where only exact comparisons tell what lies strictly between."""
    scene = narrow_scene(bits, 0)
    ends = torch.tensor([0, 2**bits - 2])[(torch.arange(scene.voxels[..., 0].numel()) // 3) % 2]
    scene.voxels[..., 0] = ends.view(scene.voxels.shape[:4]).to(scene.voxels.dtype)
    given = call(name, scene)
    for actual, expected in zip(run(ops, name, given), run(reference, name, doubled(given)), strict=True):
        assert_close(actual, expected, 2e-5)


@pytest.mark.parametrize("degree", [0, 1, 2])
@pytest.mark.parametrize("bits", BITS)
def test_gradients_in_halves(bits: int, degree: int) -> None:
    """1024 times the gradient up to rounding, whatever the partial sums; also what the voxel terms add."""
    scene = narrow_scene(bits, degree, rays=200)
    given = call("photometric_step", scene)
    terms = call("voxel_terms", scene)[:7]
    gradients = torch.empty(GROUPS, *scene.voxels.shape, dtype=torch.float16)
    plain = ops.photometric_step(*given)[1]
    narrow = ops.photometric_step(*given, gradients=gradients)[1]
    for _ in range(2):
        error = narrow.double() / ops.HALF_SCALE - plain
        assert narrow.dtype == torch.float16
        assert 0 < error.norm() < HALF_ERROR * plain.norm()
        ops.voxel_terms(*terms, plain)
        ops.voxel_terms(*terms, narrow)


def test_halves_saturate() -> None:
    """A sum beyond the largest half stays finite."""
    scene = narrow_scene(8)
    given = call("photometric_step", scene)
    given[9] = torch.full_like(given[9], 1e9)
    gradients = torch.empty(GROUPS, *scene.voxels.shape, dtype=torch.float16)
    gradient = ops.photometric_step(*given, gradients=gradients)[1]
    assert gradient.isfinite().all()
    assert gradient.abs().max() == 65504


def adam_arguments(bits: int, degree: int = 1, seed: int = 0) -> list[Any]:
    """Codes, gradients of all sizes from 1e-9 to 1, no moments yet, and what settings give: step 3, seed 5."""
    scene = narrow_scene(bits, degree)
    v, like = scene.voxels, scene.origins
    gradient = normal(like, *v.shape, seed=seed) * 10.0 ** (
        -9 * normal(like, *v.shape, seed=seed + 1).abs() / 3
    )
    moments = [torch.zeros_like(v, dtype=codes.MOMENTS[v.dtype]) for _ in range(2)]
    low, high = codes.bounds(v.shape[-1], *scene.frame[4:])
    return [v, gradient, *moments, 0.02 * (high - low), low, high]


@pytest.mark.parametrize("stochastic", [True, False])
@pytest.mark.parametrize("degree", [0, 1, 2])
@pytest.mark.parametrize("bits", BITS)
def test_adam_equals_reference(bits: int, degree: int, stochastic: bool) -> None:
    """Code for code, but where a sum in float32 falls on the other side of the noise than in double."""
    oracle: Any = reference.adam_step
    mine = adam_arguments(bits, degree)
    theirs = [*(a.clone() for a in mine[:4]), *(a.double() for a in mine[4:])]
    for t in range(1, 5):
        gradient = adam_arguments(bits, degree, seed=t)[1]
        ops.adam_step(mine[0], gradient, *mine[2:], t=t, seed=5, stochastic=stochastic)
        oracle(theirs[0], gradient.double(), *theirs[2:], t=t, seed=5, stochastic=stochastic)
        for actual, expected in zip((mine[0], *mine[2:4]), (theirs[0], *theirs[2:4]), strict=True):
            if actual.is_floating_point():
                assert_close(actual, expected.double(), 1e-3)
            else:
                differs = (actual.int() - expected.int()).abs()
                assert (differs > 0).float().mean() < 2e-3
            expected.copy_(actual)


@pytest.mark.parametrize("stochastic", [True, False])
@pytest.mark.parametrize("bits", BITS)
def test_adam_is_within_a_step_of_the_float_one(bits: int, stochastic: bool) -> None:
    """In the first step the moments play no part: each coefficient moves by its rate, up to one step of its code."""
    given = adam_arguments(bits)
    frame = (4.0, -4.0)
    values = codes.decode(given[0], *frame)
    ops.adam_step(*given, t=1, stochastic=stochastic)
    first, second = torch.zeros_like(values), torch.zeros_like(values)
    ops.adam_step(values, given[1], first, second, *given[4:], t=1)
    step = (given[6] - given[5]) / (2**bits - 2)
    away = (codes.decode(given[0], *frame) - values).abs()
    assert (away <= (1.0 if stochastic else 0.5) * step + 1e-5).all()
    assert not given[0][..., 13:].any()


@pytest.mark.parametrize("bits", BITS)
def test_rounding_is_unbiased(bits: int) -> None:
    """A step of 0.3 codes, taken from the same 40 000 codes: 0.3 +- 0.0023 (one sigma) on average where rounding is
    stochastic, nothing at all where it is to the nearest. Every number is its own draw, and every seed."""
    top, t = 2**bits - 2, 1
    for stochastic in (True, False):
        moved = []
        for seed in (0, 1):
            v = torch.full((160, 4, 4, 4, 4), 100).to(codes.TYPES[bits])
            moments = [torch.zeros_like(v, dtype=codes.MOMENTS[v.dtype]) for _ in range(2)]
            low, high = torch.zeros(4), torch.ones(4)
            gradient = torch.full(v.shape, -0.01)
            ops.adam_step(
                v, gradient, *moments, high * 0.3 / top, low, high, t, seed=seed, stochastic=stochastic
            )
            moved.append(v.double() - 100)
        if stochastic:
            assert set(moved[0].unique().tolist()) == {0.0, 1.0}
            assert all(abs(m.mean().item() - 0.3) < 0.01 for m in moved)
            both = (moved[0] * moved[1]).mean().item()
            assert both == pytest.approx(0.09, abs=0.01)
        else:
            assert not moved[0].any()


def test_moments_by_hand() -> None:
    # After one step with gradient g the first moment is 0.1 g and the root of the second 0.1 |g|, times 1024. With g =
    # 5/512: 1.0, a number of both formats. 1.3 times it lies between 1.25 and 1.5 of e5m2, up with 0.2, and between 1.25
    # and 1.375 of u5.3, up with 0.4. The largest e5m2 is 57344 and the largest u5.3 61440.
    cases = ((5 / 512, 1.0, 1.0), (-6.5 / 512, -1.3, 1.3), (1e6, 57344.0, 61440.0), (0.0, 0.0, 0.0))
    for g, m, root in cases:
        v = torch.zeros(100, 4, 4, 4, 4, dtype=torch.uint8)
        first, second, low = torch.zeros_like(v), torch.zeros_like(v), torch.zeros(4)
        ops.adam_step(v, torch.full(v.shape, g), first, second, low + 0.1, low, low + 1, t=1)
        found = first.view(torch.float8_e5m2).double(), u53()[second.long()]
        for numbers, expected in zip(found, (m, root), strict=True):
            assert numbers.mean().item() == pytest.approx(expected, abs=0.01)
            assert len(numbers.unique()) == (2 if abs(expected) == 1.3 else 1)


def test_small_floats_are_what_they_are_called() -> None:
    assert e5m2()[:6].tolist() == [k * 2.0**-16 for k in range(5)] + [5 * 2.0**-16]
    assert e5m2()[-1] == 57344
    assert u53()[[0, 1, 7, 8, 9]].tolist() == [k * 2.0**-17 for k in (0, 1, 7, 8, 9)]
    assert u53()[-1] == 61440


@pytest.mark.parametrize("bits", BITS)
def test_adam_takes_gradients_in_halves(bits: int) -> None:
    """The same result as with the same numbers in float32."""
    one, two = adam_arguments(bits), adam_arguments(bits)
    one[1] = (one[1] * ops.HALF_SCALE).half()
    two[1] = one[1].float() / ops.HALF_SCALE
    for given in (one, two):
        ops.adam_step(*given, t=1)
    assert all(
        torch.equal(a.int(), b.int()) for a, b in zip((one[0], *one[2:4]), (two[0], *two[2:4]), strict=True)
    )


@pytest.mark.parametrize("bits", BITS)
@pytest.mark.parametrize("name", [*READ, "adam_step"])
def test_non_contiguous_empty_and_threads(name: str, bits: int, threads: None) -> None:
    def outputs(scene: Scene) -> list[Tensor]:
        if name == "adam_step":
            given = adam_arguments(bits)
            ops.adam_step(*given, t=2, seed=1)
            return [given[0], *given[2:4]]
        return run(ops, name, call(name, scene))

    scene = narrow_scene(bits, rays=300)
    torch.set_num_threads(1)
    plain = outputs(scene)
    for count in (2, 3):
        torch.set_num_threads(count)
        for other in (scene, scene.non_contiguous()):
            assert all(torch.equal(a, b) for a, b in zip(outputs(other), plain, strict=True))
    scene.table = torch.where(scene.table >= 0, reference.INSIDE, scene.table)
    scene.voxels, scene.coordinates = scene.voxels[:0], scene.coordinates[:0]
    if name != "adam_step":
        given = call(name, scene)
        for actual, expected in zip(run(ops, name, given), run(reference, name, doubled(given)), strict=True):
            assert_close(actual, expected, 2e-5)


@pytest.mark.parametrize("bits", BITS)
@pytest.mark.parametrize("name", ["photometric_step", "visibility", "voxel_terms", "adam_step"])
def test_opcheck(name: str, bits: int) -> None:
    scene = narrow_scene(bits, rays=12)
    values = codes.decode(scene.voxels, *scene.frame[4:])
    scene = scene.select(has_depth(ops.march_forward(values, *scene.marched()[1:])[1]))
    given = [*adam_arguments(bits), 3] if name == "adam_step" else call(name, scene)
    op, raw_arguments = raw(name, given)
    if name == "photometric_step":
        gradients = torch.empty(GROUPS, *scene.voxels.shape, dtype=torch.float16)
        raw_arguments = (*raw_arguments[:-1], gradients)
    torch.library.opcheck(op, raw_arguments)


def test_wrong_arguments_are_named() -> None:
    good = adam_arguments(8)
    with pytest.raises(RuntimeError, match="first: expected uint8"):
        ops.adam_step(*good[:2], good[2].half(), *good[3:], t=1)
    with pytest.raises(RuntimeError, match="gradient: expected float32"):
        ops.adam_step(good[0], good[1].double(), *good[2:], t=1)
    scene = make_scene(dtype=torch.float32)
    given = arguments("photometric_step", scene)
    gradients = torch.empty(GROUPS, *scene.voxels.shape, dtype=torch.float16)
    with pytest.raises(RuntimeError, match="gradients: expected float32"):
        ops.photometric_step(*given, gradients=gradients)
    with pytest.raises(RuntimeError, match="voxels: expected float32"):
        ops.sample_forward(*narrow_scene(8).field, scene.origins)
    voxels, table, frame = one_tile()
    double = make_scene()
    with pytest.raises(RuntimeError, match="origins: expected float32"):
        ops.visibility(voxels.byte(), table, frame, *double.rays[:3], *double.march())
