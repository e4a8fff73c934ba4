"""Turntable cameras: upright, all around, and with the mesh in the frame."""

import math

import pytest
import torch
import trimesh

from torch_surfcap.data.cameras import Cameras
from torch_surfcap.surface.render import cast
from torch_surfcap.surface.turntable import MARGIN, turntable, up_direction

UP = torch.tensor([0.0, 0.6, 0.8], dtype=torch.float64)


@pytest.fixture(scope="module")
def statue() -> trimesh.Trimesh:
    """A slab, 1 x 0.4 x 2 along its own axes, standing along UP far from the origin."""
    mesh = trimesh.creation.box((1.0, 0.4, 2.0))
    turn = trimesh.geometry.align_vectors([0, 0, 1], UP.numpy())
    turn[:3, 3] = [5.0, -3.0, 2.0]
    mesh.apply_transform(turn)
    return mesh


@pytest.mark.parametrize("elevation", [-40.0, 0.0, 25.0, 90.0])
def test_the_mesh_fills_the_frame(statue: trimesh.Trimesh, elevation: float) -> None:
    cameras = turntable(statue, UP, 24, elevation, size=200)
    width, height = cameras.size[0].tolist()
    assert max(width, height) == 200
    assert width % 2 == height % 2 == 0
    seen = torch.stack([cameras.project(i, torch.from_numpy(statue.vertices))[0] for i in range(24)])
    low, high = seen.amin((0, 1)), seen.amax((0, 1))
    free = MARGIN * 200
    assert (low > free - 2).all()
    assert (cameras.size[0] - high > free - 2).all()
    # The longer side is used up but for its margins; the axis stands in the middle.
    longer = 0 if width > height else 1
    assert high[longer] - low[longer] > 200 - 2 * free - 3
    axis = torch.tensor([[5.0, -3.0, 2.0]], dtype=torch.float64) + UP
    torch.testing.assert_close(
        cameras.project(7, axis)[0][0, 0], torch.tensor(width / 2, dtype=torch.float64)
    )


def test_cameras_go_around_upright(statue: trimesh.Trimesh) -> None:
    middle = torch.tensor([5.0, -3.0, 2.0], dtype=torch.float64)
    cameras = turntable(statue, UP, 4, 30.0, front=middle + torch.tensor([9.0, 0, 0]))
    out = torch.nn.functional.normalize(cameras.centers - middle, dim=1)
    torch.testing.assert_close(out @ UP, torch.full((4,), 0.5, dtype=torch.float64))  # sin 30 degrees
    assert float(out[0, 0]) == pytest.approx(math.cos(math.radians(30)))
    # Counter-clockwise from above: a quarter turn leads from x to UP x x.
    torch.testing.assert_close(out[1] - 0.5 * UP, torch.linalg.cross(UP, out[0] - 0.5 * UP))
    for i in range(4):
        (foot, head), depth = cameras.project(i, torch.stack([middle - UP, middle + UP]))
        assert head[1] < foot[1]
        assert head[0] == pytest.approx(foot[0])
        assert (depth > 0).all()
        assert len(cast(statue, cameras, i).pixel) > 0


def around(angles: list[float], elevation: float, rolls: tuple[float, float] = (0.0, 0.0)) -> Cameras:
    """Cameras that look at the origin from these angles about UP, rolled by turns by one of two angles; degrees."""
    ring = turntable(trimesh.creation.icosphere(2), UP, 360, elevation, size=64)
    chosen = ring.subset([round(a) % 360 for a in angles])
    for k, pose in enumerate(chosen.world_to_camera):
        turn = math.radians(rolls[k % 2])
        rolled = torch.tensor([[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]])
        pose[:2] = rolled.double() @ pose[:2]
    return chosen


@pytest.mark.parametrize(
    ("angles", "elevation", "rolls", "degrees"),
    [
        ([0, 90, 180, 270], 30.0, (0.0, 0.0), 1e-6),
        (
            [-30, -15, 0, 15, 30],
            40.0,
            (0.0, 0.0),
            2.0,
        ),  # from one side, from above: the pictures' mean leans by 40
        ([0, 45, 90, 135, 180, 225], 20.0, (-3.0, 3.0), 2.0),
        ([0, 60, 120, 180, 240, 300], 10.0, (90.0, 90.0), 1e-6),  # all on one side, or on the other
        ([0, 60, 120, 180, 240, 300], 10.0, (-87.0, -93.0), 2.0),
        ([10], 10.0, (0.0, 0.0), 10.001),  # one camera knows no better than its picture
    ],
)
def test_up_direction(
    angles: list[float], elevation: float, rolls: tuple[float, float], degrees: float
) -> None:
    found = up_direction(around(angles, elevation, rolls).world_to_camera)
    assert float(found.norm()) == pytest.approx(1.0)
    assert math.degrees(math.acos(min(1.0, float(found @ UP)))) <= degrees
