"""The floor that plates show, and the cut there."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from tests.fitting.sphere import ball
from torch_surfcap import Capture, ops
from torch_surfcap.data.floor import Floor, find_floor
from torch_surfcap.data.sample_figure import room_colors
from torch_surfcap.data.sample_scene import sample_cameras
from torch_surfcap.field.field import MISSING
from torch_surfcap.field.tiles import TileGrid, voxel_centers
from torch_surfcap.fitting.levels import cut_at_floor

BOX = (torch.tensor([-0.5, -0.3, -0.1]).double(), torch.tensor([0.5, 0.3, 1.9]).double())
SIZE = 128


def room(what: str, noise: float = 0.01) -> Capture:
    """Ten cameras in the sample scene's room; the exposures differ."""
    cameras, rng, plates = sample_cameras(10, SIZE), np.random.default_rng(0), []
    for i in range(len(cameras)):
        origins, directions = (x.numpy() for x in cameras.rays(i))
        colors = room_colors(origins, directions, 0) if what == "textured" else np.full((SIZE**2, 3), 0.5)
        colors = (1 + 0.3 * rng.random()) * colors + noise * rng.standard_normal(colors.shape)
        plates.append(torch.from_numpy(colors.reshape(SIZE, SIZE, 3)).float().clamp(0, 1))
    return Capture(plates, cameras.K, cameras.world_to_camera, plates=None if what == "no plates" else plates)


def test_the_floor_is_found_to_a_fraction_of_a_pixel() -> None:
    floor = find_floor(room("textured"), BOX)
    assert floor is not None
    feet = torch.tensor([[x, y, 0.0] for x in (-0.3, 0.3) for y in (-0.2, 0.2)], dtype=torch.float64)
    assert floor.height(feet).abs().max() < 0.004  # a pixel covers 17 mm
    assert floor.agreement > 0.5


@pytest.mark.parametrize("what", ["plain", "no plates"])
def test_no_floor_is_made_up(what: str) -> None:
    assert find_floor(room(what), BOX) is None


def test_cameras_that_look_every_way_up_know_no_floor() -> None:
    capture = ball(8, 32, True)
    turned = capture.cameras.world_to_camera.clone()
    turned[::2, :2] *= -1  # rolled by half a turn
    assert find_floor(Capture(capture.images, capture.cameras.K, turned, plates=capture.plates), BOX) is None


@pytest.mark.parametrize("opacity", ["distance", "transparency"])
def test_the_cut_is_the_intersection_with_what_is_above(opacity: str) -> None:
    """Of a slab of tiles, at a tilted plane: the surface lies in the plane below what was solid, nothing above changes."""
    stored = torch.ones(3, 3, 3, dtype=torch.bool)
    grid = TileGrid.build(stored, torch.zeros_like(stored), (0.1, 0.2, 0.3), 0.05)
    normal = torch.nn.functional.normalize(torch.tensor([0.1, 0.2, 1.0]).double(), dim=0)
    middle = torch.tensor([0.4, 0.5, 0.6]).double()
    floor = Floor(normal, float(normal @ middle), 1.0)
    outside, solid = MISSING[opacity][0], (-2.0 if opacity == "distance" else 0.1)
    store = torch.full((27, 4, 4, 4, ops.pitch(0)), solid)
    before = store.clone()
    cut_at_floor(grid, store, opacity, None)
    assert torch.equal(store, before)
    cut_at_floor(grid, store, opacity, floor)
    height = floor.height(voxel_centers(grid)) / grid.voxel_size
    assert torch.equal(store[height > 2], before[height > 2])
    assert torch.equal(store[..., 1:], before[..., 1:])
    assert (store[..., 0][height < -4] == outside).all()

    def value(points: Tensor) -> Tensor:
        return ops.sample_forward(store, grid.table, grid.frame(*MISSING[opacity]), points.float())[:, 0]

    on_it = middle + torch.tensor([[0.0, 0.0], [0.07, 0.03], [-0.05, 0.02]]).double() @ torch.stack(
        [torch.tensor([1.0, 0.0, -0.1]).double(), torch.tensor([0.0, 1.0, -0.2]).double()]
    )
    level, within = (0.0, 0.03) if opacity == "distance" else (0.55, 0.08)  # the latter's slope ends in kinks
    torch.testing.assert_close(value(on_it), torch.full((3,), level), rtol=0, atol=within)
