"""The plan of levels, the first field out of the hull, and the change to finer voxels."""

from __future__ import annotations

import itertools

import pytest
import torch
from torch import Tensor

from tests.fitting.sphere import CENTER, RADIUS, ball, photographed, ring
from torch_surfcap import Cameras, InputError, SurfaceField, ops
from torch_surfcap.autograd import March
from torch_surfcap.field.field import CLAMP, ETA, SLOPE
from torch_surfcap.field.tiles import TileGrid, voxel_centers
from torch_surfcap.fitting.levels import FOG, ITERATIONS, first_field, next_level, plan_levels, subject_box
from torch_surfcap.fitting.rays import RayBatch, gather_rays
from torch_surfcap.fitting.settings import FitSettings

center = torch.tensor(CENTER, dtype=torch.float64)
BOX = (center - 0.35, center + 0.35)


@pytest.mark.parametrize(("side", "levels"), [(16, 1), (32, 1), (63, 1), (64, 2), (128, 3), (600, 4)])
def test_plan_halves_voxels_and_doubles_pictures(side: int, levels: int) -> None:
    capture = photographed(ring(3, side=8))
    capture.cameras = ring(3, side=side)
    plan = plan_levels(capture, BOX, None, None)
    assert len(plan) == levels
    assert [level.halvings for level in plan] == list(range(levels))[::-1]
    assert plan[-1].voxel_size == pytest.approx(1 / side)  # a pixel's footprint
    for coarse, fine in itertools.pairwise(plan):
        assert coarse.voxel_size == 2 * fine.voxel_size
    assert tuple(level.iterations for level in plan) == ITERATIONS[-levels:]


def test_plan_as_given() -> None:
    """More levels than the pictures can be halved for: their voxels grow, the pictures stay."""
    plan = plan_levels(ball(3, 16), BOX, 0.01, 6)
    assert [level.voxel_size for level in plan] == [0.01 * 2**i for i in range(6)][::-1]
    assert [level.halvings for level in plan] == [2, 2, 2, 2, 1, 0]
    assert plan[0].iterations == ITERATIONS[0]


def test_box_as_given() -> None:
    capture = ball(3, 8)
    low, high = subject_box(capture, (0.0, 1.0, 2.0, 3.0, 4.0, 5.0))
    assert (low.tolist(), high.tolist()) == ([0.0, 1.0, 2.0], [3.0, 4.0, 5.0])
    for wrong in ((0.0, 1.0), (0.0, 0.0, 0.0, 1.0, 1.0, 0.0), (0.0, 0.0, 0.0, 1.0, float("nan"), 1.0)):
        with pytest.raises(InputError, match=r"box: found .* expected x0"):
            subject_box(capture, wrong)


@pytest.mark.parametrize("degree", [0, 1, 2])
@pytest.mark.parametrize("opacity", ["transparency", "distance"])
def test_first_field_holds_the_ball(opacity: str, degree: int) -> None:
    """Its surface lies outside the ball, by little more than the pixel and the voxel that the hull is widened by."""
    capture, voxel = ball(), 0.03
    grid, store = first_field(capture, BOX, voxel, FitSettings.of(opacity=opacity, sh_degree=degree))
    assert store.shape == (len(grid.coords), 4, 4, 4, ops.pitch(degree))
    field = SurfaceField(store, grid, opacity)
    radius = (voxel_centers(grid) - center).norm(dim=-1)
    solid = store[..., 0] < (0.0 if opacity == "distance" else 0.99)
    assert solid[radius < RADIUS].all()
    assert not solid[radius > 1.15 * RADIUS + 3 * voxel].any()  # twelve views leave corners on the hull
    deep = -CLAMP if opacity == "distance" else FOG
    assert field.sample_opacity(center[None]).item() == pytest.approx(deep)
    if opacity == "distance":
        vertices = torch.from_numpy(field.extract_mesh().vertices)
        reach = (vertices - center).norm(dim=1) - RADIUS
        assert (reach.amin() > 0, reach.amax() < 0.15 * RADIUS + 3 * voxel) == (True, True)
    else:
        assert set(store[..., 0].unique().tolist()) == {torch.tensor(FOG).item(), 1.0}
    assert (store[..., 1:4] == 0.5).all()
    assert not store[..., 4:].any()


def test_a_transparency_that_falls_off_from_the_hull() -> None:
    """Clear at the hull's surface, and a fiftieth less for every voxel below it."""
    capture, voxel = ball(), 0.03
    settings = FitSettings.of(opacity="transparency", start="hull")
    grid, store = first_field(capture, BOX, voxel, settings)
    field = SurfaceField(store, grid, "transparency")
    depths = torch.tensor([0.0, 3.0, 6.0])[:, None] * voxel
    along = torch.tensor([[RADIUS, 0.0, 0.0]]) - depths * torch.tensor([[1.0, 0.0, 0.0]])
    value = field.sample_opacity(center + along)
    assert (value.diff() < 0).all()
    assert value[0] > 0.93
    torch.testing.assert_close(value.diff(), torch.full((2,), -0.06), rtol=0.2, atol=0)
    assert store[..., 0].max() == 1.0


def test_upscaling_keeps_the_light_or_the_value() -> None:
    """Between four voxels of a half, the next level has a half, or its root: twice as many voxels stop as much light."""
    grid, store = fog_around_ball()
    store[..., 0] = 0.5
    march = March(0, SLOPE, 0.04, 1e-3)
    for upscale, expected in (("plain", 0.5), ("sqrt", 0.5**0.5)):
        settings = FitSettings.of(opacity="transparency", upscale=upscale)
        _, values = next_level(
            grid, store, settings, gather_rays(ball(side=32), store, grid, "transparency", march), march
        )
        middle = values[..., 0].flatten().median()
        assert float(middle) == pytest.approx(expected)


def test_a_box_of_too_many_voxels() -> None:
    """Refused before anything of that size is allocated."""
    with pytest.raises(
        InputError, match=r"memory: the first level \(voxels of 1e-07\) needs .* GiB are free"
    ):
        first_field(ball(6, 16), BOX, 1e-7, FitSettings.of(opacity="distance"))


def test_nothing_in_the_box() -> None:
    far = (center + 5, center + 6)
    with pytest.raises(InputError, match="silhouettes: the visual hull is empty inside the box"):
        first_field(ball(6, 16), far, 0.1, FitSettings.of(opacity="distance"))


def plane() -> tuple[TileGrid, Tensor, Tensor, float]:
    """A signed distance, in voxels of 0.2, to an askew plane (normal, distance), and colours that rise along it."""
    normal = torch.nn.functional.normalize(torch.tensor([1.0, 0.3, -0.2], dtype=torch.float64), dim=0)
    steps = (torch.arange(32, dtype=torch.float64) + 0.5) * 0.2
    distance = torch.stack(torch.meshgrid(steps, steps, steps, indexing="ij"), -1) @ normal - 3.3
    color = (0.5 + 0.1 * distance.clamp(-2, 2))[..., None, None].expand(32, 32, 32, 1, 3)
    field = SurfaceField.from_dense(
        (distance / 0.2).clamp(-CLAMP, CLAMP), color, [0.0, 0.0, 0.0], 0.2, "distance"
    )
    return field.grid, ops.padded(field.voxels.detach()), normal, 3.3


def no_rays() -> RayBatch:
    empty, three = torch.zeros(0, dtype=torch.float64), torch.zeros(0, 3, dtype=torch.float64)
    ranges = (torch.zeros(1, dtype=torch.int64), torch.zeros(0, 2, dtype=torch.float64))
    cameras = Cameras(torch.zeros(0, 3, 3), torch.zeros(0, 4, 4), torch.zeros(0, 2))
    return RayBatch(three, three, three, three, empty, empty, ranges, [0], empty.int(), cameras)


def test_next_level_of_a_distance() -> None:
    """Half the voxel, so twice the distance in voxels; tiles along the surface only, solid ones behind it."""
    grid, store, normal, offset = plane()
    fine, values = next_level(
        grid, store, FitSettings.of(opacity="distance"), no_rays(), March(1, SLOPE, 1.0, 0.0)
    )
    assert fine.voxel_size == 0.1
    assert fine.size == tuple(2 * n for n in grid.size)
    assert len(fine.coords) < 8 * len(grid.coords)
    centers = voxel_centers(fine)
    away = centers @ normal - offset
    near = (away.abs() < 0.3) & ((centers > 0.2) & (centers < 6.2)).all(-1)
    assert near.sum() > 5000
    torch.testing.assert_close(values[..., 0][near], 10 * away[near], rtol=0, atol=1e-5)
    torch.testing.assert_close(values[..., 1][near], 0.5 + 0.1 * away[near], rtol=0, atol=1e-5)
    assert values[..., 0].abs().max() <= CLAMP
    x, y, z = fine.inside.nonzero().double().unbind(1)
    solid = (torch.stack([x, y, z], 1) + 0.5) * 0.4 @ normal - offset
    assert len(solid) > 0
    assert solid.max() < 0.0
    # No hole: every fine voxel at the surface is stored.
    steps = (torch.arange(64, dtype=torch.float64) + 0.5) * 0.1
    everywhere = torch.stack(torch.meshgrid(steps, steps, steps, indexing="ij"), -1) @ normal - offset
    tiles = (everywhere.abs() < 0.1).nonzero() // 4
    assert (fine.table[tuple((tiles + 1).T)] >= 0).all()


def test_next_level_of_a_steep_distance() -> None:
    """No hole where the distance leaps from one side to the other between two voxels, stored or missing."""
    grid, store, normal, offset = plane()
    store[..., 0] = torch.where(store[..., 0] < 0, -CLAMP, CLAMP)
    fine, _ = next_level(
        grid, store, FitSettings.of(opacity="distance"), no_rays(), March(1, SLOPE, 1.0, 0.0)
    )
    at = torch.tensor([[i, j, k] for i in range(32) for j in range(32) for k in range(32)])
    away = (at + 0.5).double() * 0.2 @ normal - offset
    surface = ((at > 0) & (at < 31)).all(1) & (
        away.abs() < 0.2 * normal.abs().max() / 2
    )  # its neighbours differ
    assert surface.sum() > 500
    assert (fine.table[tuple((at[surface] // 2 + 1).T)] >= 0).all()


def test_first_field_has_no_phantoms() -> None:
    """In the margin and the last tiles around the box few cameras look: nothing may start there."""
    capture, voxel = ball(side=48), 1 / 24
    grid, store = first_field(
        capture, subject_box(capture, None), voxel, FitSettings.of(opacity="transparency")
    )
    reach = ((voxel_centers(grid) - center).norm(dim=-1) - RADIUS)[store[..., 0] < 0.99]
    assert reach.max() < 4 * voxel


def test_next_level_leaves_empty_space_empty() -> None:
    """Transparent voxels beside the ball that no ray happens to read are not solid."""
    grid, store = fog_around_ball()
    march = March(0, SLOPE, 0.04, 1e-3)
    rays = gather_rays(ball(side=32), store, grid, "transparency", march)
    fine, _ = next_level(grid, store, FitSettings.of(opacity="transparency"), rays, march)
    inside = (fine.inside.nonzero().double() + 0.5) * 4 * fine.voxel_size + torch.tensor(fine.origin)
    assert len(inside) > 0
    assert ((inside - center).norm(dim=1) < RADIUS).all()


def fog_around_ball() -> tuple[TileGrid, Tensor]:
    """Every tile of a box twice as large as the ball is stored; the voxels outside of it are fully transparent."""
    size = (6, 6, 6)
    corner = (center - 0.48).tolist()
    grid = TileGrid.build(
        torch.ones(size, dtype=torch.bool),
        torch.zeros(size, dtype=torch.bool),
        (corner[0], corner[1], corner[2]),
        0.04,
    )
    store = torch.full((len(grid.coords), 4, 4, 4, 4), 0.5)
    store[..., 0] = torch.where((voxel_centers(grid) - center).norm(dim=-1) < RADIUS, ETA, 1.0)
    return grid, store


def test_next_level_of_a_transparency() -> None:
    """Tiles where samples have weight; what no light reaches is solid, what it passes is dropped."""
    capture, voxel = ball(side=32), 0.04
    grid, store = first_field(
        capture, (center - 0.3, center + 0.3), voxel, FitSettings.of(opacity="transparency", sh_degree=0)
    )
    radius = (voxel_centers(grid) - center).norm(dim=-1)
    store[..., 0] = torch.where(radius < RADIUS, ETA, 1.0)
    march = March(0, SLOPE, voxel, 1e-3)
    rays = gather_rays(capture, store, grid, "transparency", march)
    fine, values = next_level(grid, store, FitSettings.of(opacity="transparency"), rays, march)
    assert fine.voxel_size == voxel / 2
    assert values.shape == (len(fine.coords), 4, 4, 4, 4)
    away = (voxel_centers(fine) - center).norm(dim=-1) - RADIUS
    assert away.abs().amin((1, 2, 3)).max() < 5 * voxel
    inside = (fine.inside.nonzero().double() + 0.5) * 4 * fine.voxel_size + torch.tensor(fine.origin)
    assert len(inside) > 0
    assert ((inside - center).norm(dim=1) < RADIUS).all()
    field = SurfaceField(values, fine, "transparency")
    ways = torch.nn.functional.normalize(
        torch.randn(500, 3, generator=torch.Generator().manual_seed(0)), dim=1
    ).double()
    for reach, solid in ((0.85, True), (1.2, False)):
        value = field.sample_opacity(center + reach * RADIUS * ways)
        assert ((value < 0.5) == solid).all()
