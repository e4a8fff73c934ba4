"""The soft hull against kornia, and the box that silhouettes and cameras give."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from tests.fitting.sphere import CENTER, RADIUS, ball, photographed, ring
from torch_surfcap import Cameras, Capture, InputError
from torch_surfcap.field.hull import Silhouettes, find_box, grown, pixel_footprint

center = torch.tensor(CENTER, dtype=torch.float64)


def hull_by_kornia(capture: Capture, points: Tensor) -> tuple[Tensor, Tensor]:
    """Least mask over the cameras that see each point, and their number, in double precision."""
    assert capture.masks is not None
    least, votes = torch.ones(len(points), dtype=torch.float64), torch.zeros(len(points), dtype=torch.int64)
    for i, mask in enumerate(capture.masks):
        uv, depth = capture.cameras.project(i, points)
        size = capture.cameras.size[i].double()
        sees = (depth > 0) & (uv >= 0).all(1) & (uv <= size).all(1)
        place = (2 * uv / size - 1)[
            None, None
        ]  # with align_corners=False, -1 and 1 are the picture's borders
        read = torch.nn.functional.grid_sample(
            mask.double()[None, None], place, padding_mode="border", align_corners=False
        )
        least = torch.where(sees, torch.minimum(least, read[0, 0, 0]), least)
        votes += sees
    return torch.where(votes > 0, least, 0.0), votes


@pytest.mark.parametrize("offset", [0.0, 5000.0])
def test_equals_kornia_and_grid_sample(offset: float) -> None:
    """Also far from the world's origin, where single precision alone would be a tenth of a pixel wrong."""
    g = torch.Generator().manual_seed(0)
    cameras = ring(7, side=[40, 64, 33, 50, 50, 50, 50])
    cameras.K[2, 0, 1] = 3.0  # skew
    capture = photographed(cameras)
    pose = capture.cameras.world_to_camera.clone()
    shift = torch.full((3,), offset, dtype=torch.float64)
    pose[:, :3, 3] -= pose[:, :3, :3] @ shift
    moved = Capture(capture.images, cameras.K, pose, capture.masks)
    points = center + (torch.rand(3000, 3, generator=g, dtype=torch.float64) - 0.5) * 2.5
    silhouettes = Silhouettes.of(moved)
    assert silhouettes.quorum == 2
    expected, votes = hull_by_kornia(capture, points)
    border = 1e-3  # of the picture, in pixels: there rounding decides whether a camera sees the point
    clear = torch.ones(len(points), dtype=torch.bool)
    for i in range(len(cameras)):
        uv, _ = capture.cameras.project(i, points)
        clear &= ((uv.abs() > border) & ((uv - capture.cameras.size[i]).abs() > border)).all(1)
    assert clear.float().mean() > 0.9
    expected = torch.where(votes >= 2, expected, 0.0)
    found = silhouettes.hull((points + shift).view(30, 100, 3))
    assert found.shape == (30, 100)
    torch.testing.assert_close(found.flatten()[clear].double(), expected[clear], rtol=0, atol=2e-4)
    assert (found > 0.5).sum() > 20


def test_hull_of_no_points() -> None:
    assert Silhouettes.of(ball(3)).hull(torch.zeros(0, 4, 3)).shape == (0, 4)


def test_grown_by_hand() -> None:
    mask = torch.zeros(4, 5)
    mask[0, 0], mask[2, 3] = 0.5, 1.0
    expected = torch.tensor([[0.5, 0.5, 0, 0, 0], [0.5, 0.5, 1, 1, 1], [0, 0, 1, 1, 1], [0, 0, 1, 1, 1]])
    assert torch.equal(grown(mask, 1), expected)
    assert torch.equal(grown(mask, 0), mask)


def test_pixel_footprint() -> None:
    """64 pixels over 1/1.5 of the distance 1.5: one is 1/64 wide."""
    assert pixel_footprint(ring(), center) == pytest.approx(1 / 64)


def lattice(reach: float, count: int = 60) -> Tensor:
    """[X, Y, Z, 3] cell centres of a cube around the ball's centre."""
    steps = ((torch.arange(count, dtype=torch.float64) + 0.5) / count * 2 - 1) * reach
    return center + torch.stack(torch.meshgrid(steps, steps, steps, indexing="ij"), -1)


def test_phantoms_are_left_out() -> None:
    """Beside the view of most cameras two of them agree on solids that nobody denies; they are no part of the hull."""
    silhouettes = Silhouettes.of(ball())
    points = lattice(1.2)
    everything, kept = silhouettes.hull(points) > 0.5, silhouettes.occupied(points)
    radius = (points - center).norm(dim=-1)
    assert radius[everything].max() > 2 * RADIUS
    assert radius[kept].max() < 1.3 * RADIUS
    assert kept[radius < RADIUS - 0.04].all()
    assert not (kept & ~everything).any()


def test_parts_that_few_cameras_see_are_kept() -> None:
    """A camera that stands close and sees only a part of the ball takes nothing away: a piece counts as a whole."""
    cameras = ring(9)
    for i in range(1, 9):  # most see little more than half of the ball
        cameras.K[i, 1, 2] += 27 * (-1) ** i
    capture = photographed(cameras)
    points = lattice(0.5, 40)
    kept = Silhouettes.of(capture).occupied(points)
    assert kept[(points - center).norm(dim=-1) < RADIUS - 0.04].all()


@pytest.mark.parametrize(
    ("cameras", "most"),
    [
        (ring(), 1.3),
        (ring(4), 2.6),
        (ring(6, side=[32, 64, 48, 100, 64, 40]), 1.6),
        (ring(12, arc=math.pi / 2), 3.0),  # from one side the hull reaches back
    ],
    ids=["ring", "four", "sizes", "one side"],
)
def test_box_holds_the_ball(cameras: Cameras, most: float) -> None:
    low, high = find_box(photographed(cameras))
    assert (low <= center - RADIUS).all()
    assert (high >= center + RADIUS).all()
    assert (high - low).max() < most * 2 * RADIUS


def test_box_holds_a_thin_rod() -> None:
    """A rod thinner than the cells of the search and askew to them, seen by turned cameras, is found to its ends."""
    cameras = ring(8)
    along = torch.nn.functional.normalize(torch.tensor([1.0, 0.7, 0.5], dtype=torch.float64), dim=0)
    way = torch.linspace(-0.3, 0.3, 2000, dtype=torch.float64)[:, None] * along
    masks = []
    for i in range(len(cameras)):
        uv, _ = cameras.project(i, center + way)
        mask = torch.zeros(64, 64)
        u, v = uv.floor().long().unbind(1)
        mask[v, u] = 1.0
        masks.append(mask)
    capture = Capture([torch.zeros(64, 64, 3)] * 8, cameras.K, cameras.world_to_camera, masks)
    low, high = find_box(capture)
    ends = torch.stack([center + way[0], center + way[-1]])
    assert (low <= ends).all()
    assert (high >= ends).all()
    assert ((high - low) < 1.5 * (ends[1] - ends[0]).abs() + 0.1).all()


def wrong(capture: Capture, message: str) -> None:
    with pytest.raises(InputError, match=message) as caught:
        find_box(capture)
    assert "\n" not in str(caught.value)


def test_no_box_is_said_in_one_line() -> None:
    good = ball(6)
    assert good.masks is not None
    away = good.cameras.world_to_camera.clone()
    away[:, 2] *= -1  # the cameras look away from one another
    away[:, 1] *= -1
    wrong(Capture(good.images, good.cameras.K, away, good.masks), "silhouettes: .* no common volume")
    masks = [mask.clone() for mask in good.masks]
    masks[3].zero_()
    wrong(Capture(good.images, good.cameras.K, good.cameras.world_to_camera, masks), "camera 003: empty")
    none = Capture(good.images, good.cameras.K, good.cameras.world_to_camera)
    wrong(none, "capture: no masks")
    with pytest.raises(InputError, match="capture: no masks"):
        Silhouettes.of(none)
