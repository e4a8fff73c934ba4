"""Sections of a field whose tiles are counted by hand, and of a ball."""

import math

import numpy as np
import pytest
import torch
import trimesh

from tests.surface.shapes import CENTER, RADIUS, VOXEL, ball, ball_distance, field_of, signed
from torch_surfcap.errors import InputError
from torch_surfcap.field.field import SLOPE, SurfaceField
from torch_surfcap.surface.section import INSIDE_COLOR, OUTSIDE_COLOR, cut, in_words, middle_plane


@pytest.fixture(scope="module")
def tiles() -> SurfaceField:
    """3 x 3 x 3 tiles of edge 2 from (10, 20, 30): along x one stored (transparency 0.5), one inside, one outside."""
    values = torch.ones(12, 12, 12)
    values[:4], values[4:8] = 0.5, 0.01
    return SurfaceField.from_dense(values, torch.zeros(12, 12, 12, 3), [10.0, 20.0, 30.0], 0.5)


def test_tiles_by_hand(tiles: SurfaceField) -> None:
    # One pixel a voxel: 4 + 4 + 4 + 4 columns, a tile of margin and 12 voxels and a tile of margin for the rows.
    section = cut(tiles, 2, 33.0, size=20)
    picture = section.picture()
    assert picture.shape == (20, 16, 3)
    stored, inside = picture[4:16, 4:8], picture[4:16, 8:12]
    torch.testing.assert_close(stored, torch.full((12, 4, 3), 0.5))
    assert (inside == torch.tensor(INSIDE_COLOR)).all()
    others = picture.clone()
    others[4:16, 4:12] = torch.tensor(OUTSIDE_COLOR)
    assert (others == torch.tensor(OUTSIDE_COLOR)).all()
    assert section.extent == pytest.approx((8, 16, 18, 28))
    assert sorted(section.stored.tolist()) == [[10, 20], [10, 22], [10, 24]]
    assert section.edge == 2
    # The level 0.81 is crossed around the block of 12 x 8 voxels: a line of so many pixels above and left of a step.
    assert section.surface().sum() == 2 * 12 + 2 * 8 - 1  # one pixel has a step to the right and one below


@pytest.mark.parametrize(
    ("up", "axes", "extent", "inside"),
    [
        ([0.0, -1, 0], (0, 1), (8, 16, 28, 18), (5, 9)),  # turned over, and alike
        ([0.9, 0.2, 0], (1, 0), (18, 28, 8, 16), (5, 5)),  # x upwards: inside (x 12 to 14) is above stored
        ([0.0, 0, 1], (0, 1), (8, 16, 18, 28), (5, 9)),  # the plane knows no such direction: y upwards
    ],
)
def test_orientation(
    tiles: SurfaceField,
    up: list[float],
    axes: tuple[int, int],
    extent: tuple[float, ...],
    inside: tuple[int, int],
) -> None:
    section = cut(tiles, 2, 33.0, size=20, up=torch.tensor(up))
    assert (section.across, section.upward) == axes
    assert section.extent == pytest.approx(extent)
    assert section.picture()[inside].tolist() == pytest.approx(INSIDE_COLOR)
    corners = [[{0: 10, 1: y}[axis] for axis in axes] for y in (20, 22, 24)]
    assert sorted(section.stored.tolist()) == corners


def test_positions_in_words() -> None:
    assert [in_words(x, 0.02) for x in (0.1, -0.01234, 60000.12345)] == ["0.1", "-0.012", "60000.123"]
    assert in_words(-64000123.4, 20.0) == "-64000123"


@pytest.mark.parametrize("position", [29.9, 36.1, 100, -100])
def test_a_plane_beside_the_field_is_refused(tiles: SurfaceField, position: float) -> None:
    with pytest.raises(InputError, match=f"no tile of the field at z={position:g}, expected 30 to 36"):
        cut(tiles, 2, position)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_section_of_a_ball_is_a_disc(axis: int) -> None:
    origin, _, distance = ball_distance()
    field = field_of(signed(distance), origin, opacity="distance")
    section = cut(field, axis, CENTER[axis] + 0.6 * RADIUS, size=400)
    assert section.level == 0
    area = (section.value < 0).sum() * section.pixel[0] ** 2
    assert float(area) == pytest.approx(math.pi * (0.8 * RADIUS) ** 2, rel=0.01)
    rows, columns = np.nonzero((section.value < 0).numpy())
    (left, top), (dx, dy) = section.corner, section.pixel
    middle = left + (columns.mean() + 0.5) * dx, top + (rows.mean() + 0.5) * dy
    assert middle == pytest.approx(CENTER[[section.across, section.upward]], abs=VOXEL / 4)
    torch.testing.assert_close(section.transparency, torch.sigmoid(SLOPE * section.value))


def test_a_window_of_the_plane() -> None:
    field = ball()
    section = cut(field, 0, CENTER[0], size=100, around=(CENTER[1], CENTER[2] + RADIUS), width=5 * VOXEL)
    assert section.value.shape == (100, 100)
    left, right, bottom, top = section.extent
    assert (right - left, top - bottom) == pytest.approx((5 * VOXEL, 5 * VOXEL))
    # The ball's top is in the middle: matter below, none above.
    assert float(section.value[10, 50]) > field.level > float(section.value[90, 50])


def test_middle_plane_is_across_the_thinnest_side() -> None:
    body, arm = trimesh.creation.box((4, 1, 6)), trimesh.creation.icosphere(1, 0.1)
    body = body.subdivide().subdivide()
    arm.apply_translation([0, 2.5, 0])
    both = trimesh.util.concatenate([body, arm])
    assert isinstance(both, trimesh.Trimesh)
    axis, position = middle_plane(both)
    assert axis == 1
    assert abs(position) <= 0.5  # within the body, whatever the arm
