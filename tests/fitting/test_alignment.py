"""Cameras whose calibration is off are turned to where their photographs lie; those of a sound capture stay."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor

from tests.fitting.sphere import ball
from tests.fitting.stages import begun
from torch_surfcap import Cameras, Capture, fit
from torch_surfcap.fitting.alignment import Pinholes, Registration, aligned, displacements, is_off, moved

VIEWS, SIDE = 12, 64
SMALL: dict[str, Any] = {"sh_degree": 0, "levels": 2, "voxel": 0.015}


def random_motion(pixels: float, zoom: float, roll: float, focal: float) -> Tensor:
    """[N, 4] of about this size."""
    size = torch.tensor([pixels / focal, pixels / focal, zoom, roll], dtype=torch.float64)
    return torch.randn(VIEWS, 4, generator=torch.Generator().manual_seed(3)).double() * size


def seen_by(capture: Capture, cameras: Cameras) -> Capture:
    """The same photographs under another calibration."""
    return Capture(capture.images, cameras.K, cameras.world_to_camera, capture.masks, capture.plates)


def test_rays_are_aimed_as_the_moved_cameras_look() -> None:
    stage, _, _ = begun(ball(VIEWS, 32), 0.06, 30)
    rays, given = stage.rays, stage.rays.cameras
    motion = random_motion(3.0, 0.05, 0.1, float(given.K[0, 0, 0]))
    Pinholes.of(given, torch.device("cpu")).aim(rays, motion)
    after = moved(given, motion)
    for i in range(VIEWS):
        part = rays.of_camera(i)
        origins, directions = after.rays(i, after.pixels(i)[rays.pixels[part].long()])
        torch.testing.assert_close(rays.directions[part], directions.float(), atol=2e-7, rtol=0)
        torch.testing.assert_close(rays.origins[part], origins.float())


def test_directions_project_as_the_moved_cameras_see_them() -> None:
    given = ball(VIEWS, 32).cameras
    motion = random_motion(3.0, 0.05, 0.1, float(given.K[0, 0, 0]))
    after = moved(given, motion)
    expected = after.K @ after.world_to_camera[:, :3, :3]
    torch.testing.assert_close(Pinholes.of(given, torch.device("cpu")).projections(motion), expected)


def test_no_motion_changes_no_bit() -> None:
    cameras = ball(VIEWS, 32).cameras
    same = moved(cameras, torch.zeros(VIEWS, 4))
    assert torch.equal(same.K, cameras.K)
    assert torch.equal(same.world_to_camera, cameras.world_to_camera)


def test_a_motion_of_the_scene_is_not_the_cameras() -> None:
    """What moves the scene as a whole leaves the pictures where they are, wherever the cameras stand."""
    stage, _, _ = begun(ball(VIEWS, 32), 0.06, 30)
    registration = Registration.of(stage.rays, stage.rays.cameras, stage.grid)
    similarity = torch.tensor([0.01, -0.02, 0.015, 0.03, -0.01, 0.02, 0.01], dtype=torch.float64)
    common = registration.common @ similarity
    torch.testing.assert_close(registration.inverse @ common, similarity)


@pytest.mark.parametrize("plates", [False, True])
def test_a_wrong_calibration_is_refined(plates: bool) -> None:
    capture = ball(VIEWS, SIDE, plates)
    focal = float(capture.cameras.K[0, 0, 0])
    wrong = moved(capture.cameras, random_motion(1.5, 0.003, 0.003, focal))
    result = fit(seen_by(capture, wrong), **SMALL)
    assert any(line.startswith("cameras: the photographs lie") for line in result.warnings)
    found = aligned(seen_by(capture, wrong), result.motion).cameras
    # Both calibrations see the ball's middle in the same places, but for a motion of the scene.
    stage, _, _ = begun(capture, 0.06, 30)
    registration = Registration.of(stage.rays, stage.rays.cameras, stage.grid)

    def off(cameras: Cameras) -> float:
        middle = torch.tensor([[0.4, -0.2, 1.3]], dtype=torch.float64)
        motion = torch.zeros(VIEWS, 4, dtype=torch.float64)
        for i in range(VIEWS):
            there, here = (c.project(i, middle)[0][0] for c in (cameras, capture.cameras))
            motion[i, :2] = (there - here) / focal
        motion = motion - (registration.common @ (registration.inverse @ motion.flatten())).view_as(motion)
        return float(displacements(capture.cameras, motion, stage.grid)[:, 0].median())

    before, after = off(wrong), off(found)
    assert before > 0.8
    assert after < 0.15 * before


@pytest.mark.parametrize("kind", range(3))
def test_displacements_are_those_of_what_is_seen(kind: int) -> None:
    """Of the middle by a shift, of what is beside it by zoom and roll; each kind alone tells a wrong calibration."""
    stage, _, _ = begun(ball(VIEWS, 32), 0.06, 30)
    given, motion = stage.rays.cameras, torch.zeros(VIEWS, 4, dtype=torch.float64)
    motion[:, (0, 2, 3)[kind]] = 0.001
    after, grid = moved(given, motion), stage.grid
    half = 2 * grid.voxel_size * torch.tensor(grid.size, dtype=torch.float64)
    middle = torch.tensor(grid.origin, dtype=torch.float64) + half
    expected = []
    for i in range(VIEWS):
        beside = given.world_to_camera[i, 0, :3] * (half.max() / 2 if kind else 0.0)
        points = torch.stack([middle, middle + beside])
        there, here = (c.project(i, points)[0] for c in (after, given))
        moved_by = there - here
        expected.append((moved_by[1] - moved_by[0] if kind else moved_by[0]).norm())
    found = displacements(given, motion, grid)
    torch.testing.assert_close(found[:, kind], torch.stack(expected), rtol=0.02, atol=0.0)
    assert float(found.sum()) == pytest.approx(float(found[:, kind].sum()))
    assert is_off(found / found[:, kind].median() * 0.21)
    assert not is_off(found / found[:, kind].median() * 0.14)


def test_a_right_calibration_stays() -> None:
    result = fit(ball(VIEWS, SIDE), **SMALL)
    assert result.motion == {}
    assert result.warnings == []
    shift = result.chosen["cameras"]["shift"]
    assert len(shift) == VIEWS
    assert max(shift.values()) < 0.2


def test_off_leaves_a_wrong_one() -> None:
    capture = ball(VIEWS, SIDE)
    wrong = moved(capture.cameras, random_motion(1.5, 0.0, 0.0, float(capture.cameras.K[0, 0, 0])))
    result = fit(seen_by(capture, wrong), refine="off", **SMALL)
    assert result.motion == {}
    assert result.chosen["cameras"]["shift"] == {}
