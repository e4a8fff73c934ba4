"""The rays of a level: which there are, in what order, what they should see, and where they are worth sampling."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from tests.fitting.sphere import CENTER, RADIUS, ball, cast, photographed, ring
from torch_surfcap import Capture, ops
from torch_surfcap.autograd import March
from torch_surfcap.field.field import MISSING, SLOPE
from torch_surfcap.field.tiles import TileGrid, voxel_centers
from torch_surfcap.fitting.color_gain import Exposure
from torch_surfcap.fitting.levels import first_field
from torch_surfcap.fitting.rays import (
    BLOCK,
    RangeFinder,
    RayBatch,
    choose_backdrop,
    gather_rays,
    shared_ranges,
)
from torch_surfcap.fitting.settings import FitSettings

center = torch.tensor(CENTER, dtype=torch.float64)
BOX = (center - 0.35, center + 0.35)
VOXEL = 0.03
OPACITIES = ("transparency", "distance")


def fitted(opacity: str, capture: Capture) -> tuple[TileGrid, Tensor, March]:
    """A field that holds the ball as a fit would leave it, with noise in its colours."""
    grid, store = first_field(capture, BOX, VOXEL, FitSettings.of(opacity=opacity))
    g = torch.Generator().manual_seed(0)
    away = ((voxel_centers(grid) - center).norm(dim=-1) - RADIUS) / VOXEL
    store[..., 0] = (away.clamp(-4, 4) if opacity == "distance" else 0.81 + 0.3 * away).clamp(
        *((-4.0, 4.0) if opacity == "distance" else (0.01, 1.0))
    )
    store[..., 1:13] = torch.rand(*store.shape[:4], 12, generator=g)
    return grid, store, March(ops.OPACITY[opacity], SLOPE, 3**0.5 * VOXEL, 1e-3)


def exposed(
    capture: Capture, store: Tensor, grid: TileGrid, opacity: str, march: March, backdrop: Tensor | None
) -> RayBatch:
    """The rays with the colours of the pictures as they are."""
    rays = gather_rays(capture, store, grid, opacity, march)
    rays.expose(capture, backdrop, Exposure.equal(len(capture)))
    return rays


@pytest.mark.parametrize("opacity", OPACITIES)
def test_every_ray_that_meets_the_surface_is_there(opacity: str) -> None:
    """What meets the ball is kept and stands for its own pixel; what passes far from it is culled."""
    capture = ball()
    grid, store, march = fitted(opacity, capture)
    rays = exposed(capture, store, grid, opacity, march, torch.zeros(3))
    assert len(rays.camera_starts) == len(capture) + 1
    assert rays.camera_starts[-1] == len(rays)
    assert len(rays) < 0.8 * 12 * 64 * 64
    for i in range(len(capture)):
        part = slice(rays.camera_starts[i], rays.camera_starts[i + 1])
        torch.testing.assert_close(
            rays.origins[part].double(), capture.cameras.centers[i].expand(part.stop - part.start, 3),
            rtol=0, atol=1e-6,
        )  # fmt: skip
        uv, _ = capture.cameras.project(i, (rays.origins[part] + rays.directions[part]).double())
        column, row = (uv - 0.5).round().long().unbind(1)
        torch.testing.assert_close(uv, torch.stack([column, row], 1).double() + 0.5, rtol=0, atol=1e-3)
        assert len({*zip(row.tolist(), column.tolist(), strict=True)}) == len(row)  # none twice
        hit, _ = cast(*capture.cameras.rays(i))
        present = torch.zeros(64, 64, dtype=torch.bool)
        present[row, column] = True
        assert present[hit.view(64, 64)].all()
        assert capture.masks is not None
        torch.testing.assert_close(rays.mask[part], capture.masks[i][row, column])
        block = (row // BLOCK) * 99 + column // BLOCK
        runs = 1 + int((block.diff() != 0).sum())
        assert runs == len(block.unique())  # block by block


def test_samples_are_counted_over_the_ranges() -> None:
    """Ranges of 1 and 0.5, with samples 0.25 apart: 4 and 2."""
    one = torch.zeros(2, 3)
    ranges = (torch.tensor([0, 1, 2]), torch.tensor([[1.0, 2.0], [3.0, 3.5]]))
    rays = RayBatch(one, one, one, one, one[:, 0], one[:, 0], ranges, [0, 2], one[:, 0].int(), ring(1))
    assert rays.samples(0.25) == 6


def test_bundles_share_what_any_of_their_rays_has() -> None:
    # Rays with 1 to 2; nothing; 1.5 to 3 and 5 to 6 | 0 to 1 and 4 to 5; 1 to 2. The ranges of the last two touch.
    stretches = torch.tensor([[1.0, 2.0], [1.5, 3.0], [5.0, 6.0], [0.0, 1.0], [4.0, 5.0], [1.0, 2.0]])
    offsets, united = shared_ranges((torch.tensor([0, 1, 1, 3, 5, 6]), stretches), 3)
    assert offsets.tolist() == [0, 2, 4]
    assert united.tolist() == [[1.0, 3.0], [5.0, 6.0], [0.0, 2.0], [4.0, 5.0]]
    offsets, united = shared_ranges((torch.zeros(6, dtype=torch.int64), stretches[:0]), 2)
    assert offsets.tolist() == [0, 0, 0, 0]
    assert united.shape == (0, 2)


@pytest.mark.parametrize("opacity", OPACITIES)
def test_bundles_take_no_other_samples_with_weight(opacity: str) -> None:
    """Shared ranges are longer, by little for 8 rays of a row and more for 64 of a block; losses stay as they are."""
    capture = ball()
    grid, store, march = fitted(opacity, capture)
    frame = grid.frame(*MISSING[opacity])
    counts, losses = [], []
    for bundle in (1, 8, 64):
        rays = gather_rays(capture, store, grid, opacity, march, bundle)
        rays.expose(capture, torch.zeros(3), Exposure.equal(len(capture)))
        seen = (rays.background, rays.target, rays.mask, rays.weight)
        counts.append(rays.samples(march.step))
        losses.append(
            ops.photometric_step(
                store, grid.table, frame, rays.origins, rays.directions, torch.zeros_like(rays.mask), *seen,
                *march, 0.1, [1.0, 0.3, 0.3], ranges=rays.ranges, bundle=bundle,
            )[0]
        )  # fmt: skip
    assert counts[0] < counts[1] < counts[2] < 3 * counts[0]
    for other in losses[1:]:
        torch.testing.assert_close(other, losses[0], rtol=3e-3, atol=0)


def test_weights_do_not_depend_on_cameras_pixels_or_voxels() -> None:
    """A ray's weight is 1/(views * pixels of a voxel's face), so their sum over a face's pixels and views is 1."""
    capture = photographed(ring(4, side=[32, 64, 64, 48]))
    grid, store, march = fitted("distance", capture)
    rays = exposed(capture, store, grid, "distance", march, torch.zeros(3))
    middle = torch.tensor(grid.origin) + torch.tensor(grid.size) * 2 * VOXEL
    for i, side in enumerate((32, 64, 64, 48)):
        distance = float((capture.cameras.centers[i] - middle).norm())
        weight = rays.weight[rays.camera_starts[i] : rays.camera_starts[i + 1]]
        pixels = (VOXEL * 1.5 * side / distance) ** 2
        torch.testing.assert_close(weight, torch.full_like(weight, 1 / (4 * pixels)))


def test_what_rays_should_see() -> None:
    """With masks the photograph over the backdrop, in the mask's proportion; with plates all as it is."""
    backdrop = torch.tensor([0.1, 0.9, 0.3])
    for plates in (False, True):
        capture = ball(6, 48, plates)
        grid, store, march = fitted("distance", capture)
        rays = exposed(capture, store, grid, "distance", march, None if plates else backdrop)
        uv, _ = capture.cameras.project(0, (rays.origins + rays.directions).double()[: rays.camera_starts[1]])
        column, row = (uv - 0.5).round().long().unbind(1)
        photograph, mask = capture.photograph(0)[row, column], rays.mask[: rays.camera_starts[1], None]
        background = capture.plate(0)[row, column] if plates else backdrop.expand_as(photograph)
        target = photograph if plates else mask * photograph + (1 - mask) * backdrop
        torch.testing.assert_close(rays.background[: len(row)], background)
        torch.testing.assert_close(rays.target[: len(row)], target)
        assert ((mask > 0) & (mask < 1)).any()


@pytest.mark.parametrize("opacity", OPACITIES)
def test_ranges_hold_all_samples_with_weight(opacity: str) -> None:
    """Found for unshifted samples they serve every shift of up to half a step: losses stay the same, and all but a
    twentieth of the gradient; samples beyond 1.5 voxels of distance, of 0.25 % opacity each, have it.

    The values of a transparency may dip between the samples that the ranges were found by: a little more is lost there.
    """
    capture = ball()
    grid, store, march = fitted(opacity, capture)
    rays = exposed(capture, store, grid, opacity, march, torch.zeros(3))
    again = RangeFinder(store, grid, opacity, march).ranges(rays.origins, rays.directions)
    assert rays.ranges is not None
    assert torch.equal(again[0], rays.ranges[0])
    assert torch.equal(again[1], rays.ranges[1])
    frame = grid.frame(*MISSING[opacity])
    seen = (rays.background, rays.target, rays.mask, rays.weight)
    for shift in (-0.5, 0.0, 0.5):
        shifts = torch.full_like(rays.mask, shift)
        losses, gradients = [], []
        for ranges in (None, rays.ranges):
            found = ops.photometric_step(
                store, grid.table, frame, rays.origins, rays.directions, shifts, *seen, march.opacity,
                march.slope, march.step, march.stop, 0.1, [1.0, 0.3, 0.3], ranges=ranges,
            )  # fmt: skip
            losses.append(found[0])
            gradients.append(found[1].clone())
        torch.testing.assert_close(losses[1], losses[0], rtol=1e-3 if opacity == "distance" else 3e-3, atol=0)
        # Empty space far from the surface gets no gradient within a transparency's ranges.
        if opacity == "distance":
            assert (gradients[1] - gradients[0]).norm() < 0.05 * gradients[0].norm()
    assert rays.ranges is not None
    covered = float((rays.ranges[1][:, 1] - rays.ranges[1][:, 0]).sum()) / len(rays)
    assert covered < 16 * march.step  # and they save something: the ball is 20 voxels thick, the grid 26


@pytest.mark.parametrize("opacity", OPACITIES)
def test_rays_beside_the_surface_are_kept(opacity: str) -> None:
    """Where the field may still grow, the rays that would object are there: what counts is the tiles, not their values."""
    capture = ball(6, 32)
    grid, store, march = fitted(opacity, capture)
    now = exposed(capture, store, grid, opacity, march, torch.zeros(3))
    store[..., 0] = 0.5
    assert len(now) == len(exposed(capture, store, grid, opacity, march, torch.zeros(3)))


def painted(color: list[float], source: str) -> Capture:
    """Three pictures of one colour; a tenth of the subject's pixels are black."""
    picture = torch.tensor(color).expand(20, 20, 3).clone()
    picture[4:6] = 0.0
    cameras = ring(3, side=20)
    mask = torch.zeros(20, 20)
    mask[4:16, 4:16] = 1.0
    capture = Capture([picture] * 3, cameras.K, cameras.world_to_camera, [mask] * 3, [picture] * 3)
    capture.mask_source = source
    return capture


def test_backdrop_is_far_from_the_subject() -> None:
    def chosen(color: list[float], source: str = "file") -> list[float] | None:
        backdrop = choose_backdrop(painted(color, source))
        return None if backdrop is None else backdrop.tolist()

    assert chosen([0.1, 0.2, 0.1]) == [1.0, 1.0, 1.0]
    assert chosen([0.9, 0.4, 0.1], "alpha") == [0.0, 1.0, 1.0]
    assert chosen([0.1, 0.2, 0.1], "threshold") == [0.0, 0.0, 0.0]
    assert chosen([0.1, 0.2, 0.1], "plate") is None


def test_no_rays_where_nothing_is() -> None:
    capture = ball(3, 16)
    grid, store, march = fitted("distance", capture)
    none = torch.zeros(grid.size, dtype=torch.bool)
    empty = TileGrid.build(none, none, grid.origin, grid.voxel_size)
    rays = exposed(capture, store[:0], empty, "distance", march, torch.zeros(3))
    assert len(rays) == 0
    assert rays.camera_starts == [0, 0, 0, 0]
    assert rays.ranges is not None
    assert rays.ranges[0].tolist() == [0]
