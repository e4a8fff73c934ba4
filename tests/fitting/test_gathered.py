"""The gathered gradient in a fit: how far it is from the exact one, and that a level falls by it on any threads."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest
import torch
from torch import Tensor

from tests.fitting.sphere import CENTER, RADIUS, ball, color_at
from tests.fitting.stages import begun
from torch_surfcap import ops
from torch_surfcap.field.field import DIAGONAL, MISSING
from torch_surfcap.field.tiles import voxel_centers
from torch_surfcap.fitting.descent import RAY_ARGUMENTS, descend
from torch_surfcap.fitting.gathered import GatheredGradient, camera_windows, slot_rows
from torch_surfcap.fitting.late import Stopwatch
from torch_surfcap.fitting.settings import FitSettings

OPACITIES = ("transparency", "distance")


@pytest.fixture
def threads() -> Iterator[None]:
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


def swollen_ball(
    opacity: str, device: str, lattice: int = 32, views: int = 8
) -> tuple[GatheredGradient, dict[str, Any], Tensor]:
    """A ball half a voxel too large and too bright, as a fit may hold it, before its photographs; the step's arguments and
    the shifts of its cameras."""
    voxel = 0.024
    given: dict[str, Any] = {"opacity": opacity, "gradient": "gather", "lattice": lattice, "device": device}
    if opacity == "distance":
        given["descent"] = {"last_step": DIAGONAL}
    stage, _, settings = begun(ball(views, 64), voxel, 1, **given)
    grid, store, rays = stage.grid, stage.store, stage.rays
    points = voxel_centers(grid).float().cpu()
    away = ((points - torch.tensor(CENTER)).norm(dim=-1) - RADIUS) / voxel - 0.5
    value = away.clamp(-4, 4) if opacity == "distance" else (0.8 + 0.4 * away).clamp(0.01, 1.0)
    color = (color_at(points.view(-1, 3)).view(*away.shape, 3) + 0.1).clamp(0, 1)
    store[..., 0], store[..., 1:4] = value.to(device), color.to(device)
    rays.find_ranges(store, grid, opacity, stage.march)
    gathered = GatheredGradient(rays, grid, settings, stage.march)
    shift = torch.rand(views, generator=torch.Generator().manual_seed(0)).to(device) - 0.5
    loss = settings.losses
    arguments = {
        "voxels": store,
        "table": grid.table,
        "frame": grid.frame(*MISSING[opacity]),
        "shift": gathered.per_ray(shift),
        **{name: getattr(rays, name) for name in RAY_ARGUMENTS},
        **stage.march._asdict(),
        "huber": loss.huber,
        "weights": [loss.photo, loss.sample, loss.mask],
        "detach_sample": loss.detach_sample,
    }
    return gathered, arguments, shift


@pytest.mark.parametrize(("opacity", "least"), [("transparency", 0.98), ("distance", 0.93)])
def test_angle_to_the_exact_gradient(opacity: str, least: float, device: str) -> None:
    """As measured, from 24 views at 2.4 pixels to a voxel's face, a distance with steps of a voxel's diagonal: 0.986 and
    0.938 for the opacity value, 0.980 and 0.976 for colour. A distance's derivative changes its sign across the surface,
    within what a voxel reads. The sums over all voxels agree far better than that: the density of samples is the right
    factor."""
    gathered, arguments, shift = swollen_ball(opacity, device, views=24)
    losses, gradient, *_ = gathered.step(arguments, shift, Stopwatch({}))
    exact_losses, exact, *_ = ops.photometric_step(**arguments, ranges=gathered.rays.ranges)
    torch.testing.assert_close(losses, exact_losses)
    cosines = gathered.cosines(arguments)
    assert cosines[0] > least
    assert cosines[1] > 0.97
    sums = [g[..., :4].double().sum((0, 1, 2, 3)) for g in (gradient, exact)]
    torch.testing.assert_close(*sums, rtol=0.01, atol=0)
    for part, within in ((slice(0, 1), 0.1), (slice(1, None), 0.05)):
        a, b = gradient[..., part].double(), exact[..., part].double()
        assert float((a * b).sum() / (a * a).sum()) == pytest.approx(1.0, abs=within)


@pytest.mark.parametrize("opacity", OPACITIES)
def test_eight_bits_cost_no_angle(opacity: str, device: str) -> None:
    """Of a mean relative error of 1/20 per number, little is left in their sums; the scale uses the format's upper end."""
    wide, arguments, shift = swollen_ball(opacity, device)
    narrow, *_ = swollen_ball(opacity, device, lattice=8)
    _, exact, *_ = wide.step(arguments, shift, Stopwatch({}))
    _, coarse, *_ = narrow.step(arguments, shift, Stopwatch({}))
    assert 4 * narrow.slots.nbytes == wide.slots.nbytes
    assert float(torch.cosine_similarity(exact.flatten(), coarse.flatten(), dim=0)) > 0.998
    largest = torch.finfo(torch.float8_e5m2).max
    slots = narrow.slots.view(torch.float8_e5m2).float().abs()
    assert 2.0**-8 * largest < float(slots.max()) <= largest
    assert float((slots > 0).float().mean()) > 0.9 * float((wide.slots != 0).float().mean())


def test_rows_hold_every_shift() -> None:
    # Ranges 2.5 to 4 and 6 to 7 steps: k + 1/2 + shift in [2.5, 7) is k = 2 to 5 with shift 1/2 and k = 3 to 6 with -1/2. A
    # ray without ranges has no row; none begins before 0.
    step = 0.25
    ranges = step * torch.tensor([[2.5, 4.0], [6.0, 7.0], [-0.3, 0.4]])
    starts, first = slot_rows((torch.tensor([0, 2, 2, 3]), ranges), step, 1, 3)
    assert starts.tolist() == [0, 5, 5, 6]
    assert first.tolist() == [2, 0, 0]


@pytest.mark.parametrize("opacity", OPACITIES)
def test_rows_hold_every_sample(opacity: str, device: str) -> None:
    """Rows twice as wide take up nothing more."""
    gathered, arguments, shift = swollen_ball(opacity, device)
    _, gradient, *_ = gathered.step(arguments, shift, Stopwatch({}))
    narrow = gradient.clone()
    counts = gathered.starts.diff()
    gathered.first = gathered.first - 4
    gathered.starts = torch.cat([counts.new_zeros(1), (counts + 8).cumsum(0)])
    gathered.slots = torch.empty(int(gathered.starts[-1]), 4, device=device)
    _, gradient, *_ = gathered.step(arguments, shift, Stopwatch({}))
    torch.testing.assert_close(gradient, narrow)


def test_windows_by_hand() -> None:
    # Two cameras with rays through (column, row) = (3, 5), (4, 7) and (0, 0), and one between them without any.
    # The pictures are 10, 20 and 5 pixels wide.
    pixels = torch.tensor([53, 74, 0], dtype=torch.int32)
    windows, rays = camera_windows(pixels, [0, 2, 2, 3], torch.tensor([10, 20, 5]))
    assert windows.tolist() == [[2, 4, 4, 5], [0, 0, 0, 0], [-1, -1, 3, 3]]
    assert rays[:20].view(5, 4).tolist() == [[-1] * 4, [-1, 0, -1, -1], [-1] * 4, [-1, -1, 1, -1], [-1] * 4]
    assert rays[20:].view(3, 3).tolist() == [[-1] * 3, [-1, 2, -1], [-1] * 3]


@pytest.mark.parametrize("lattice", [32, 8])
def test_the_loss_falls_alike_on_any_threads(lattice: int, threads: None) -> None:
    results = []
    for count in (1, 2):
        torch.set_num_threads(count)
        stage, studio, settings = begun(
            ball(6, 32), 0.06, 6, gradient="gather", lattice=lattice, descent={"last_step": DIAGONAL}
        )
        rows = list(descend(stage, studio, settings))
        assert set(stage.seconds) >= {"march", "gather", "compare", "voxels", "adam"}
        results.append((stage.store, rows))
    (one, rows), (two, others) = results
    assert torch.equal(one, two)
    assert [row["loss"] for row in rows] == [row["loss"] for row in others]
    assert rows[-1]["loss"] < 0.5 * rows[0]["loss"]
    assert rows[0]["cosine_opacity"] > 0.9
    rates = [row["rate"] for row in rows]
    for i in range(1, len(rows)):
        assert ("cosine_color" in rows[i]) == (rates[i] != rates[i - 1])


def test_unknown_kinds_are_refused() -> None:
    for given in ({"gradient": "guess"}, {"lattice": 16}):
        with pytest.raises(ValueError, match=next(iter(given))):
            FitSettings.of(**given)
