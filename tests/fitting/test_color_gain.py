"""Gains and biases: by hand, out of noisy pictures, with plates and without, and in a whole fit."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor

from tests.fitting.sphere import ball
from torch_surfcap import Capture, fit
from torch_surfcap.fitting.color_gain import FARTHEST, Equations, Exposure

TRUE = torch.tensor([[1.25, 0.02], [0.8, -0.01], [1.0, 0.03], [0.9, -0.02]])  # gain and bias of four pictures


def test_two_rays_by_hand() -> None:
    """Field 0.2 and 0.6 photographed as 0.5 F + 0.1: gain 2, bias -0.2; the prior pulls a little towards 1 and 0."""
    field = torch.tensor([[0.2] * 3, [0.6] * 3]).repeat(50_000, 1)
    found = Equations.of(0.5 * field + 0.1, field).solve(gauge=False)
    torch.testing.assert_close(found.gain, torch.full((1, 3), 2.0), rtol=1e-4, atol=0)
    torch.testing.assert_close(found.bias, torch.full((1, 3), -0.2), rtol=0, atol=1e-4)


def test_what_a_gain_and_bias_do() -> None:
    exposure = Exposure(torch.tensor([[2.0, 1.0, 0.5]]), torch.tensor([[0.1, 0.0, -0.1]]))
    colors = torch.tensor([[0.2, 0.4, 0.6]])
    torch.testing.assert_close(exposure.common(0, colors), torch.tensor([[0.5, 0.4, 0.2]]))
    torch.testing.assert_close(exposure.own(0, exposure.common(0, colors), torch.ones(1)), colors)
    # Half of the light is the room's, whose own exposure was never left.
    own = exposure.own(0, torch.tensor([[0.45, 0.2, 0.1]]), torch.tensor([0.5]))
    torch.testing.assert_close(own, torch.tensor([[0.2, 0.2, 0.3]]))
    assert Exposure.equal(3).spread() == 0
    assert exposure.spread() == pytest.approx((0.6 + 0.0 + 0.35) / 3)  # 0.5 becomes 1.1, 0.5, 0.15


def photographed(field: Tensor, camera: int, seed: int) -> Tensor:
    gain, bias = TRUE[camera]
    noise = 0.02 * torch.randn(field.shape, generator=torch.Generator().manual_seed(seed))
    return (field - bias) / gain + noise


@pytest.mark.parametrize("plates", [False, True])
def test_gains_out_of_noisy_pictures(plates: bool) -> None:
    """Noise in the photographs does not flatten the gains; the gauge takes out what all cameras share."""
    g = torch.Generator().manual_seed(0)
    field = 0.1 + 0.6 * torch.rand(20_000, 3, generator=g)
    through = 0.3 * torch.rand(20_000, generator=g) if plates else torch.zeros(20_000)
    plate = torch.rand(20_000, 3, generator=g) if plates else None
    equations = []
    for camera in range(len(TRUE)):
        # F is the part of the field: opacity times its colour.
        own = photographed(field, camera, camera + 1)
        behind = 0.0 if plate is None else through[:, None] * plate
        picture = (1 - through[:, None]) * own + behind
        part = (1 - through[:, None]) * field
        equations.append(Equations.of(picture, part, through, plate))
    found = Equations.joined(equations).solve()
    scale = 1 / TRUE[:, 0].mean()
    bias = scale * TRUE[:, 1]
    for channel in range(3):
        torch.testing.assert_close(found.gain[:, channel], scale * TRUE[:, 0], rtol=0, atol=0.01)
        torch.testing.assert_close(found.bias[:, channel], bias - bias.mean(), rtol=0, atol=0.005)
    torch.testing.assert_close(found.gain.mean(0), torch.ones(3))
    torch.testing.assert_close(found.bias.mean(0), torch.zeros(3), rtol=0, atol=1e-7)
    shared = Equations.joined(equations).solve(per_channel=False)
    assert (shared.gain == shared.gain[:, :1]).all()
    torch.testing.assert_close(shared.gain[:, 0], scale * TRUE[:, 0], rtol=0, atol=0.01)


def test_what_is_saturated_or_seen_through_does_not_count() -> None:
    field = torch.linspace(0.05, 0.95, 999)[:, None].repeat(1, 3)
    picture = field.clone()
    through = torch.zeros(999)
    picture[field > 0.9], picture[field < 0.1] = 1.0, 0.0
    through[300:400] = 0.9
    picture[300:400] = 0.5
    found = Equations.of(picture, field, through, torch.rand(999, 3)).solve(gauge=False)
    torch.testing.assert_close(found.gain, torch.ones(1, 3), rtol=0, atol=1e-3)
    torch.testing.assert_close(found.bias, torch.zeros(1, 3), rtol=0, atol=1e-3)


def test_a_camera_that_sees_nothing_stays_as_it_is() -> None:
    nothing = Equations.of(torch.zeros(5, 3), torch.rand(5, 3))
    found = nothing.solve(gauge=False)
    assert torch.equal(found.gain, torch.ones(1, 3))
    assert torch.equal(found.bias, torch.zeros(1, 3))


@pytest.mark.parametrize("plates", [False, True])
def test_a_ball_in_different_light(plates: bool, device: str) -> None:
    """Its cameras' gains come out of the fit; the mesh is as good as without them, and off leaves pictures alone."""
    true = ball(12, 48, plates)
    gains = torch.linspace(0.8, 1.2, 12).roll(5)
    gains[3] = 1.1
    gains[7] = 0.85
    images = [image / gain for image, gain in zip(true.images, gains, strict=True)]
    plates_in = None
    if plates:
        assert true.plates is not None
        plates_in = [plate / gain for plate, gain in zip(true.plates, gains, strict=True)]
    capture = Capture(images, true.cameras.K, true.cameras.world_to_camera, true.masks, plates_in)
    capture.mask_source = true.mask_source
    settings: dict[str, Any] = {"sh_degree": 0, "levels": 2, "voxel": 1 / 40, "device": device}
    result = fit(capture, gains="on", **settings)
    assert result.chosen["gains"]["value"] == "on"
    error = (result.gain - (gains / gains.mean())[:, None]).abs()
    assert error.median() < 0.01
    assert result.bias.abs().median() < 0.02
    plain = fit(capture, gains="off", **settings)
    assert (plain.gain == 1).all()
    assert not plain.gains
    assert plain.chosen["gains"]["spread"] == 0
    assert result.history[-1]["photo"] < 0.5 * plain.history[-1]["photo"]


def test_a_camera_that_shows_something_else() -> None:
    """Its exposure is held to twice or half the others', which stay as they are."""
    field = torch.rand(3, 5000, 3)
    seen = [
        Equations.of(field[0], field[0]),
        Equations.of(field[1], field[1]),
        Equations.of(field[0], field[2]),
    ]
    found = Equations.joined(seen).solve()
    torch.testing.assert_close(
        found.gain[:, 0], torch.tensor([1.0, 1.0, FARTHEST]) / (4 / 3), rtol=0.01, atol=0
    )
