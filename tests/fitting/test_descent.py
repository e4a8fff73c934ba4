"""One level: when it ends, how fast what moves, and that the loss falls the same way on any number of threads."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest
import torch
from torch import Tensor

from tests.fitting.sphere import ball
from tests.fitting.stages import begun
from torch_surfcap import ops
from torch_surfcap.field.field import MISSING
from torch_surfcap.fitting.adam import TileAdam
from torch_surfcap.fitting.budget import GROUP_BYTES, GROUPS, gradient_groups
from torch_surfcap.fitting.descent import descend
from torch_surfcap.fitting.plateau import Plateau
from torch_surfcap.fitting.settings import Descent, FitSettings


@pytest.fixture
def threads() -> Iterator[None]:
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


def test_plateau_by_hand() -> None:
    # Over two iterations the loss must fall by a tenth. 10 -> 8 does; 9 -> 8.5 does not: the rate is halved and the
    # memory starts anew, so that the next comparison is 6 with 8; it holds, as 6 -> 4; 4 -> 4 ends it.
    rule = Plateau(limit=100, gain=0.1, share=1.0, window=2, factor=0.5, drops=2)
    seen = []
    for loss in (10.0, 9.0, 8.0, 8.5, 8.0, 7.0, 6.0, 4.0, 4.0, 4.0):
        goes_on = rule.goes_on(loss)
        seen.append((rule.scale, goes_on))
    assert [scale for scale, _ in seen] == [1, 1, 1, 0.5, 0.5, 0.5, 0.5, 0.5, 0.5, 0.25]
    assert [goes_on for _, goes_on in seen] == [True] * 9 + [False]


def test_plateau_knows_what_cannot_be_explained() -> None:
    """1 + 0.1 * 0.9^i falls by little of itself at once, but by a twentieth of its way only until 0.9^(i - 5) - 0.9^i =
    0.69 * 0.9^i <= 0.05 (1 - 0.9^i), which is i = 26, the 27th iteration."""
    for share, ends in ((1.0, 6), (0.05, 27)):
        rule = Plateau(limit=1000, gain=0.05, share=share, drops=1)
        assert sum(rule.goes_on(1.0 + 0.1 * 0.9**i) for i in range(1000)) + 1 == ends


def test_plateau_ends_at_its_limit() -> None:
    rule = Plateau(limit=7)
    assert [rule.goes_on(0.5**i) for i in range(7)] == [True] * 6 + [False]
    assert rule.scale == 1.0


def test_plateau_takes_rising_for_standing() -> None:
    rule = Plateau(limit=1000, window=3, drops=1)
    assert sum(rule.goes_on(1.0 + i) for i in range(1000)) == 2 * 3 + 3 - 1


def test_plateau_forgives_an_overshoot() -> None:
    """A loss that first leaps up and then falls steadily costs no rate, and its way begins at the leap."""
    rule = Plateau(limit=1000)
    for i in range(12):
        assert rule.goes_on(571.0 if i == 0 else 500.0 + 1000.0 * 0.7 ** (i - 1))
    assert (rule.scale, rule.top) == (1.0, 1500.0)


def test_groups_follow_from_the_size_alone(threads: None) -> None:
    torch.set_num_threads(1)
    alone = [gradient_groups(n) for n in (0, 1, 10**6, 10**7, 10**9)]
    torch.set_num_threads(2)
    assert alone == [gradient_groups(n) for n in (0, 1, 10**6, 10**7, 10**9)]
    assert (alone[0], alone[-1]) == (GROUPS[1], GROUPS[0])
    assert all(GROUPS[0] <= n <= GROUPS[1] for n in alone)
    middle = gradient_groups(4 * 10**6)
    assert 4 * 4 * 10**6 * middle <= GROUP_BYTES


@pytest.mark.parametrize("opacity", ["transparency", "distance"])
@pytest.mark.parametrize("degree", [0, 1, 2])
def test_rates_and_bounds(degree: int, opacity: str) -> None:
    """Adam's first step is as long as the rate, whatever the gradient; the padding never moves."""
    rates = Descent(rate_opacity=0.01, rate_color=0.02, rate_view=0.03)
    store = torch.full((2, 4, 4, 4, ops.pitch(degree)), 0.5)
    count = ops.coefficients(degree)
    store[..., count:] = 0.0
    adam = TileAdam(store, opacity, rates)
    gradient = torch.randn(store.shape, generator=torch.Generator().manual_seed(0))
    gradient[..., count:] = 0.0
    before = store.clone()
    adam.step(gradient, scale=0.5)
    expected = torch.full((count,), 0.03)
    expected[0], expected[1:4] = 0.01, 0.02
    moved = before - store
    torch.testing.assert_close(
        moved[..., :count], 0.5 * expected * gradient[..., :count].sign(), rtol=1e-4, atol=1e-6
    )
    for sign in (1.0, -1.0):
        for _ in range(1500):
            adam.step(sign * torch.ones_like(store))
        high, low = MISSING[opacity]
        bound = torch.tensor([low, 0.0, 0.0, 0.0] if sign > 0 else [high, 1.0, 1.0, 1.0])
        assert torch.equal(store[0, 0, 0, 0, :4], bound)
        assert (store[..., 4:count] == -sign).all()
        assert not store[..., count:].any()


def run(opacity: str, iterations: int, **more: Any) -> tuple[Tensor, list[dict[str, float]]]:
    """A level of a small ball from its hull on."""
    stage, studio, settings = begun(ball(6, 32), 0.06, iterations, opacity=opacity, **more)
    rows = list(descend(stage, studio, settings))
    assert set(stage.seconds) >= {"march", "voxels", "adam"}
    return stage.store, rows


@pytest.mark.parametrize("opacity", ["transparency", "distance"])
def test_the_loss_falls_alike_on_any_threads(opacity: str, threads: None) -> None:
    results = []
    for count in (1, 2):
        torch.set_num_threads(count)
        results.append(run(opacity, 6))
    (one, rows), (two, others) = results
    assert torch.equal(one, two)
    assert rows == others
    assert len(rows) <= 18
    assert [row["iteration"] for row in rows] == list(range(len(rows)))
    assert rows[-1]["loss"] < 0.5 * rows[0]["loss"]
    weights = FitSettings.of(opacity=opacity).suited("file").losses
    names = ("photo", "sample", "mask", "tv_opacity", "tv_color", "parsimony", "ballooning", "curvature")
    for row in rows:
        assert row["loss"] == pytest.approx(sum(getattr(weights, name) * row[name] for name in names))


def test_ballooning_fades_with_the_rates() -> None:
    """Annealed, its share of the loss is scaled as the rates are."""
    losses = {"anneal": True, "ballooning": 1e-3}
    rows = run("transparency", 40, losses=losses)[1]
    names = ("photo", "sample", "mask", "tv_opacity", "tv_color", "parsimony", "curvature")
    weights = FitSettings.of(opacity="transparency", losses=losses).suited("file").losses
    assert {row["rate"] for row in rows} >= {1.0, 0.3}
    for row in rows:
        others = sum(getattr(weights, name) * row[name] for name in names)
        assert row["loss"] - others == pytest.approx(1e-3 * row["rate"] * row["ballooning"], rel=1e-4)
