"""photometric_lattice and gather_gradient: gradients left at the samples, and voxels that read them (paper, eq. 19)."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor

from tests.ops.calls import GROUPS, MODES, arguments, normal, ops
from tests.ops.fields import Scene, assert_close, make_scene, one_tile
from torch_surfcap import reference as _reference
from torch_surfcap.reference import TRANSPARENCY

reference: Any = _reference  # untyped, as ops is
LARGEST = torch.finfo(torch.float8_e5m2).max


def whole_rows(scene: Scene) -> tuple[Tensor, Tensor]:
    """Rows for all samples that the rays of a scene can have."""
    count = reference.march(*scene.field, *scene.rays[:3], *scene.march()).t.shape[1]
    rays, device = len(scene.origins), scene.voxels.device
    return count * torch.arange(rays + 1, device=device), torch.zeros(rays, dtype=torch.int32, device=device)


def left_at_samples(scene: Scene, dtype: torch.dtype, exponent: int = 0) -> tuple[tuple[Tensor, ...], Tensor]:
    """What photometric_lattice returns and the slots that it fills."""
    starts, first = whole_rows(scene)
    slots = torch.full((int(starts[-1]), 4), 77, dtype=dtype, device=starts.device)
    step = arguments("photometric_step", scene)[:-1]
    return ops.photometric_lattice(*step, starts, first, exponent, slots), slots


def test_slots_by_hand(device: str) -> None:
    # The ray of test_photometric_step.test_by_hand: samples k = 4..7 with a = 1/2, 4/5, 1, 0 and red = 1, 1/2, 0, 1/4; the
    # photo loss pulls with 2 * 0.05 on red, w = 1/2, 1/10, 0, 2/5, dRed/da = -0.7, -0.125, 0.1, 0.02. The row holds k =
    # 3..6: nothing at 3, where a = 1 and w = 0, T (R - r) = 0.65 - 0.3 of the pull by a; the last sample is left out.
    voxels, table, frame = one_tile(device=device)
    voxels[0, :, 0, 0, 0] = voxels.new_tensor([0.5, 0.8, 1.0, 0.0])
    voxels[0, :, 0, 0, 1] = voxels.new_tensor([1.0, 0.5, 0.0, 0.25])
    numbers = ([[-4.0, 0.5, 0.5]], [[1.0, 0, 0]], [0.0], [[0.3, 0, 0]], [[0.6, 0, 0]], [0.75], [2.0])
    rays = [voxels.new_tensor(n) for n in numbers]
    slots = voxels.new_full((4, 4), 9.0)
    starts, first = torch.tensor([0, 4], device=device), torch.tensor([3], dtype=torch.int32, device=device)
    march, loss = (TRANSPARENCY, 0.0, 1.0, 0.0), (0.1, [1.0, 0.0, 0.0], False)
    losses, *_ = ops.photometric_lattice(voxels, table, frame, *rays, *march, *loss, starts, first, 0, slots)
    assert_close(losses, torch.tensor([0.0025, 0.06, 0.125], dtype=torch.float64))
    expected = 0.1 * torch.tensor(
        [[0.65, 0, 0, 0], [-0.7, 0.5, 0, 0], [-0.125, 0.1, 0, 0], [0.1, 0, 0, 0]], dtype=torch.float64
    )
    assert_close(slots, expected)


def test_gather_by_hand(device: str) -> None:
    # One camera at (-4, 0.5, 0.5) of focal length 2 that looks along x, its principal point in the middle of a picture of
    # 2 x 2 pixels, with step 1 and shift 1/4. The voxel (2, 0, 0) at (2.5, 0.5, 0.5) is 6.5 away on the axis, so at u = v
    # = 1, the middle between the four pixels, and at k = 6.5 - 1/2 - 1/4 = 5.75. Pixel i has 5, 6 -> 8 i and 8 i + 4 in
    # red: read 3/4 of the way 8 i + 3, in the mean 8 * 1.5 + 3 = 15. Samples per voxel: 2^2 * 6.5 / 6.5^3 = 4 / 6.5^2.
    voxels, table, frame = one_tile(degree=1, device=device)
    matrix = voxels.new_tensor([[1.0, -2.0, 0], [1.0, 0, -2.0], [1.0, 0, 0]])  # K R, right = -y, down = -z
    windows = torch.tensor([[-1, -1, 4, 4]], device=device)
    pixels = torch.full((4, 4), -1, dtype=torch.int32, device=device)
    pixels[1:3, 1:3] = torch.arange(4, dtype=torch.int32, device=device).view(2, 2)
    slots = voxels.new_zeros(4, 2, 4)
    slots[:, 0, 1] = 8.0 * torch.arange(4, device=device)
    slots[:, 1, 1] = slots[:, 0, 1] + 4
    starts = 2 * torch.arange(5, device=device)
    first = torch.full((4,), 5, dtype=torch.int32, device=device)
    gradient = torch.full_like(voxels, 7.0)
    places = torch.ones(1, 3, dtype=torch.int32, device=device)
    center, shift = voxels.new_tensor([[-4.0, 0.5, 0.5]]), voxels.new_tensor([0.25])
    cameras = (matrix[None], center, windows, pixels.flatten(), shift, 1.0)
    ops.gather_gradient(
        voxels, table, frame, places, *cameras, starts, first, 3, 8.0 * slots.view(8, 4), gradient
    )
    red = 15 * 4 / 6.5**2
    expected = torch.zeros(16, dtype=torch.float64)
    expected[1] = expected[10] = red  # l = 0, and x of the direction (1, 0, 0)
    assert_close(gradient[0, 2, 0, 0], expected)
    # The voxel (0, 0, 0) is 4.5 away, at k = 3.75: before the rows. (3, 0, 0) at k = 6.75 reads the last sample's quarter.
    assert not gradient[0, 0, 0, 0].any()
    assert_close(gradient[0, 3, 0, 0, 1], torch.tensor(0.25 * 16 * 4 / 7.5**2, dtype=torch.float64))


@pytest.mark.parametrize("opacity", MODES)
@pytest.mark.parametrize("degree", [0, 1, 2])
def test_slots_hold_the_exact_gradient(degree: int, opacity: int, device: str) -> None:
    """Scattered to the voxels that their samples read, the slots are photometric_step's gradient."""
    scene = make_scene(degree, opacity, device=device, rays=60)
    returned, slots = left_at_samples(scene, torch.float64, exponent=4)
    exact = ops.photometric_step(*arguments("photometric_step", scene))
    for mine, theirs in zip(returned, (exact[0], *exact[2:]), strict=True):
        assert_close(mine, theirs.cpu())
    t = reference.march(*scene.field, *scene.rays[:3], *scene.march()).t
    points = scene.origins[:, None] + t[..., None] * scene.directions[:, None]
    y = reference.harmonics(scene.directions, (degree + 1) ** 2)[:, None].expand(-1, t.shape[1], -1)
    g = slots.view(*t.shape, 4) / 2.0**4
    records = torch.zeros(*t.shape, scene.voxels.shape[-1], dtype=g.dtype, device=device)
    records[..., 0] = g[..., 0]
    by_color = (y[..., None] * g[..., None, 1:]).flatten(-2)
    records[..., 1 : 1 + by_color.shape[-1]] = by_color
    scattered = ops.sample_backward(records.flatten(0, 1), *scene.field, points.reshape(-1, 3), GROUPS)
    assert_close(scattered, exact[1].cpu())


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_eight_bits_are_the_format(dtype: torch.dtype, device: str) -> None:
    """The 8-bit slots are the nearest float8_e5m2 to the wide ones, so within 1/8 of them or half of 2^-16."""
    scene = make_scene(dtype=dtype, device=device, rays=200)
    exponent = 9
    _, wide = left_at_samples(scene, dtype, exponent)
    _, narrow = left_at_samples(scene, torch.uint8, exponent)
    read = narrow.view(torch.float8_e5m2).double()
    bound = torch.maximum(wide.double().abs() / 8, torch.tensor(2.0**-17, dtype=torch.float64))
    assert ((read - wide.double()).abs() <= bound).all()
    assert torch.equal(narrow & 0x7F, reference.coded(wide, torch.uint8) & 0x7F)
    assert len(read.abs().unique()) > 20


def test_every_code_there_and_back(device: str) -> None:
    """All finite numbers of the format survive, halfway cases go to the even one, and what is too large is held."""
    codes = torch.arange(256, dtype=torch.uint8)
    numbers = codes.view(torch.float8_e5m2).float()
    numbers = numbers[numbers.isfinite()]
    middles = (numbers[:123] + numbers[1:124]) / 2
    beyond = torch.tensor([1e5, 3e38, -1e5, 1e-30, -1e-30])
    given = torch.cat([numbers, middles, middles * (1 + 1e-6), middles * (1 - 1e-6), -middles, beyond])
    expected = given.clamp(-LARGEST, LARGEST).to(torch.float8_e5m2)
    slots = through_a_sample(given.to(device))
    assert torch.equal(slots.cpu().view(torch.float8_e5m2).float(), expected.float())


def through_a_sample(numbers: Tensor) -> Tensor:
    """The numbers as a uint8 slot holds them: each is the weight of a ray that meets one solid voxel, whose red is one
    too high for a linear Huber norm of slope 1, so that dL/dred is the weight."""
    voxels, table, frame = one_tile(device=str(numbers.device))
    voxels = voxels.to(numbers)
    voxels[0, ..., 1] = 9.0
    count = len(numbers)
    origins = voxels.new_tensor([[-4.0, 0.5, 0.5]]).expand(count, 3)
    directions = voxels.new_tensor([[1.0, 0, 0]]).expand(count, 3)
    none, black = voxels.new_zeros(count), voxels.new_zeros(count, 3)
    starts = torch.arange(count + 1, device=numbers.device)
    first = torch.full((count,), 4, dtype=torch.int32, device=numbers.device)
    slots = torch.zeros(count, 4, dtype=torch.uint8, device=numbers.device)
    ops.photometric_lattice(
        voxels, table, frame, origins, directions, none, black, black, none, numbers,
        TRANSPARENCY, 0.0, 1.0, 0.0, 1.0, [1.0, 0.0, 0.0], False, starts, first, 0, slots,
    )  # fmt: skip
    return slots[:, 1].contiguous()


def test_gather_of_eight_bits(device: str) -> None:
    """It reads what the codes stand for: the same as of wide slots with these numbers."""
    given = arguments("gather_gradient", make_scene(device=device))
    codes = reference.coded(given[13], torch.uint8)
    narrow, wide = torch.empty_like(given[14]), torch.empty_like(given[14])
    ops.gather_gradient(*given[:13], codes, narrow)
    ops.gather_gradient(*given[:13], codes.view(torch.float8_e5m2).double(), wide)
    assert wide.any()
    assert torch.equal(narrow, wide)


def test_slots_are_cleared(device: str) -> None:
    """What an iteration leaves where the next one has no sample would be a gradient of the past."""
    scene = make_scene(device=device)
    _, before = left_at_samples(scene, torch.float64)
    scene.weight = torch.zeros_like(scene.weight)
    _, after = left_at_samples(scene, torch.float64)
    assert before.any()
    assert not after.any()


def test_wrong_slots_are_named(device: str, looked_into: bool) -> None:
    scene = make_scene(device=device)
    for name in ("photometric_lattice", "gather_gradient"):
        good = arguments(name, scene)
        at = 17 if name == "photometric_lattice" else 10
        starts, first, _, slots = good[at : at + 4]

        def fails(i: int, wrong: Any, match: str, name: str = name, good: list[Any] = good) -> None:
            with pytest.raises(RuntimeError, match=match):
                getattr(ops, name)(*good[:i], wrong, *good[i + 1 :])

        fails(at, starts[1:], "starts: expected shape")
        fails(at + 1, first.long(), "first: expected int32")
        fails(at + 2, 1000, "exponent: expected")
        fails(at + 3, slots[:, :3], "slots: expected shape")
        fails(at + 3, slots.float(), "slots: expected uint8 or float64")
        fails(at + 3, slots.t().contiguous().t(), "slots: expected contiguous")
        if looked_into:
            fails(at, starts.flip(0), "starts: expected numbers that begin with 0")
            fails(at + 3, slots[:-1], "starts: expected numbers")


def test_wrong_cameras_are_named(device: str, looked_into: bool) -> None:
    good = arguments("gather_gradient", make_scene(device=device))

    def fails(i: int, wrong: Any, match: str) -> None:
        with pytest.raises(RuntimeError, match=match):
            ops.gather_gradient(*good[:i], wrong, *good[i + 1 :])

    fails(4, good[4][:2], "centers: expected shape")
    fails(9, 0.0, "step: expected a positive")
    fails(14, normal(good[0], 1, 4, 4, 4, 16), "gradient: expected shape")
    if looked_into:
        flat = good[6] * torch.tensor([1, 1, 1, 0], device=device)
        fails(3, good[3] - 1, "coordinates: expected every tile inside")
        fails(6, flat, "windows: expected none or at least 2 x 2")
        fails(7, good[7][1:], "window_rays: expected")
        fails(7, good[7] + len(good[11]), "window_rays: expected -1 to less than")
