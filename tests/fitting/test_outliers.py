"""Cameras that contradict the others are found, named and left out; those of a sound capture stay."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch

from tests.fitting.sphere import CENTER, RADIUS, ball
from torch_surfcap import Cameras, Capture, fit
from torch_surfcap.data.checks import prepare
from torch_surfcap.fitting import outliers

WRONG = 3  # number of the camera that is spoilt
SMALL: dict[str, Any] = {"sh_degree": 0, "levels": 2, "voxel": 0.03}


def turned(capture: Capture, degrees: float) -> Capture:
    """With one camera turned about its vertical axis."""
    a = math.radians(degrees)
    turn = torch.tensor([[math.cos(a), 0, math.sin(a)], [0, 1, 0], [-math.sin(a), 0, math.cos(a)]])
    poses = capture.cameras.world_to_camera.clone()
    poses[WRONG, :3] = turn.double() @ poses[WRONG, :3]
    cameras = Cameras(capture.cameras.K, poses, capture.cameras.size)
    return Capture(capture.images, cameras.K, poses, masks=capture.masks)


def spoilt(capture: Capture) -> Capture:
    """With the negative of one photograph: its silhouette is right."""
    images = list(capture.images)
    images[WRONG] = 1.0 - images[WRONG]
    return Capture(images, capture.cameras.K, capture.cameras.world_to_camera, masks=capture.masks)


def worst(vertices: np.ndarray) -> float:
    return float(np.abs(np.linalg.norm(vertices - np.array(CENTER), axis=1) - RADIUS).max())


@pytest.mark.parametrize("views", [5, 12, 30])
def test_a_sound_capture_keeps_its_cameras(views: int) -> None:
    assert outliers.by_silhouettes(prepare(ball(views, 32))) == {}


@pytest.mark.parametrize("degrees", [6.0, -8.0])
def test_a_turned_camera_is_found_by_its_silhouette(degrees: float) -> None:
    found = outliers.by_silhouettes(prepare(turned(ball(12, 32), degrees)))
    assert list(found) == [WRONG]
    assert "excludes" in found[WRONG]


def test_too_few_to_say() -> None:
    assert outliers.by_silhouettes(prepare(turned(ball(4, 32), 6.0))) == {}


def test_photographs_far_from_the_others() -> None:
    difference = torch.tensor([0.05, 0.06, torch.nan, 0.3, 0.05, 0.07, 0.05, 0.06])
    assert list(outliers.by_photographs(difference)) == [3]
    assert outliers.by_photographs(0.01 * difference) == {}  # none is wrong by anything that shows
    half = torch.tensor([0.05, 0.05, 0.05, 0.3, 0.3, 0.3, 0.05, 0.05])
    assert outliers.by_photographs(half) == {}  # so many are no outliers
    assert outliers.by_photographs(difference[:4]) == {}


def test_a_fit_without_the_turned_camera() -> None:
    capture = turned(ball(12, 48), 6.0)
    result, spoiled = (fit(capture, reject=word, **SMALL) for word in ("auto", "off"))
    name = capture.names[WRONG]
    assert list(result.chosen["cameras"]["left_out"]) == [name]
    assert any(name in line for line in result.warnings)
    assert len(result.gain) == 11
    assert spoiled.chosen["cameras"]["left_out"] == {}
    assert worst(result.mesh.vertices) < 0.5 * worst(spoiled.mesh.vertices)


def test_a_fit_without_the_wrong_photograph(device: str) -> None:
    capture = spoilt(ball(12, 48))
    result = fit(capture, gains="off", device=device, **SMALL)
    name = capture.names[WRONG]
    assert list(result.chosen["cameras"]["left_out"]) == [name]
    assert name not in result.chosen["cameras"]["difference"]  # the last level has no rays of it
    assert any(line.startswith(f"camera {name} is left out: its photograph") for line in result.warnings)
    assert [row["level"] for row in result.history if row["iteration"] == 0] == [
        0,
        0,
        1,
    ]  # begun again without it
