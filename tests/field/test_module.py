"""SurfaceField as a module among others: optimisers, conversions, copies, files, torch.compile."""

from __future__ import annotations

import copy
import io
import math
from typing import Any

import pytest
import torch
from torch import Tensor

from tests.field.test_field import OPACITIES, random_field, some_rays
from tests.ops.fields import GRADCHECK
from torch_surfcap import SurfaceField, ops
from torch_surfcap.field.tiles import TileGrid, with_skips
from torch_surfcap.ops import OUTSIDE

BOTH = pytest.mark.parametrize("opacity", OPACITIES)
DEGREES = pytest.mark.parametrize("degree", [0, 1, 2])
DTYPES = pytest.mark.parametrize("dtype", [torch.float32, torch.float64])


@BOTH
@DEGREES
@pytest.mark.parametrize("optimiser", [torch.optim.Adam, torch.optim.SGD])
def test_any_optimiser_and_loss(optimiser: Any, degree: int, opacity: str) -> None:
    """Rays and points in one loss of one's own: it falls, and every kind of coefficient moves."""
    field = random_field(degree, opacity, torch.float32)
    before = field.voxels.detach().clone()
    origins, directions = (r.float() for r in some_rays(field, 200))
    points = origins + 3 * directions
    steps = optimiser(field.parameters(), lr=0.02 if optimiser is torch.optim.Adam else 0.5)
    losses = []
    for _ in range(8):
        steps.zero_grad()
        out = field(origins, directions, torch.ones_like(origins))
        color = field.sample(points, directions)[1]
        loss = (out.color - 0.4).square().mean() + out.transmittance.mean() + (color - 0.3).abs().mean()
        loss.backward()  # type: ignore[no-untyped-call]
        steps.step()
        losses.append(loss.item())
    assert losses[-1] < losses[0]
    assert (field.voxels != before).flatten(0, 3).any(0).all()


@BOTH
@DEGREES
def test_gradcheck_of_rays(degree: int, opacity: str, device: str) -> None:
    """By the voxels and the background, of colour, transmittance and depth."""
    field = random_field(degree, opacity)
    origins, directions = (r.to(device) for r in some_rays(field, 16))
    field = field.to(device)
    met = field(origins, directions).transmittance < 0.99
    rays = (origins[met], directions[met])
    background = torch.rand(len(rays[0]), 3, dtype=torch.float64, device=device, requires_grad=True)

    def render(voxels: Tensor, behind: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        return torch.func.functional_call(field, {"voxels": voxels}, (*rays, behind))

    voxels = field.voxels.detach().requires_grad_()
    assert torch.autograd.gradcheck(render, (voxels, background), **GRADCHECK)


@BOTH
@DEGREES
def test_gradcheck_of_points(degree: int, opacity: str, device: str) -> None:
    field = random_field(degree, opacity)
    origins, directions = (r.to(device) for r in some_rays(field, 16))
    field = field.to(device)
    points = origins + 3 * directions

    class Read(torch.nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.field = field

        def forward(self) -> tuple[Tensor, Tensor, Tensor]:
            return (*self.field.sample(points, directions), self.field.sample_opacity(points))

    read = Read()

    def values(voxels: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        return torch.func.functional_call(read, {"field.voxels": voxels}, ())

    assert torch.autograd.gradcheck(values, field.voxels.detach().requires_grad_(), **GRADCHECK)


def test_empty_rays_pass_no_nan() -> None:
    """A depth of NaN, where a ray meets nothing, leaves the gradients of a masked loss finite."""
    field = random_field()
    origins, directions = some_rays(field, 30)
    out = field(torch.cat([origins, origins + 9]), torch.cat([directions, directions.abs()]))
    empty = out.depth.isnan()
    assert empty[30:].all()
    assert not empty[:30].all()
    out.depth.nan_to_num(0.0).sum().backward()  # type: ignore[no-untyped-call]
    assert field.voxels.grad is not None
    assert field.voxels.grad.isfinite().all()
    assert field.voxels.grad.any()


def test_no_rays_no_points() -> None:
    field = random_field()
    none = torch.zeros(0, 3)
    out = field(none, none)
    assert (out.color.shape, out.transmittance.shape, out.depth.shape) == ((0, 3), (0,), (0,))
    transparency, color = field.sample(none, none)
    assert (transparency.shape, color.shape) == ((0,), (0, 3))


@BOTH
def test_a_field_without_tiles(opacity: str) -> None:
    """All outside, with a solid block that nothing is stored for: it blocks the light and is black."""
    value = torch.full((8, 8, 8), 1.0 if opacity == "transparency" else 4.0)
    field = SurfaceField.from_dense(value, torch.ones(8, 8, 8, 3), [0.0, 0.0, 0.0], 1.0, opacity)
    assert len(field.voxels) == 0
    rays = (torch.tensor([[2.0, 2.0, -9.0]]), torch.tensor([[0.0, 0.0, 1.0]]))
    white = torch.ones(1, 3)
    assert field(*rays, white).color.tolist() == [[1.0, 1.0, 1.0]]
    value[:4, :4, :4] = 0.01 if opacity == "transparency" else -4.0
    solid = SurfaceField.from_dense(value, torch.ones(8, 8, 8, 3), [0.0, 0.0, 0.0], 1.0, opacity)
    assert len(solid.voxels) == 0
    out = solid(*rays, white)
    assert out.color.max() < 0.05
    assert out.depth.item() == pytest.approx(9.0, abs=math.sqrt(3))
    out.transmittance.sum().backward()  # type: ignore[no-untyped-call]


@BOTH
@DEGREES
@DTYPES
def test_copies_and_state(degree: int, opacity: str, dtype: torch.dtype) -> None:
    """The padding behind the parameter may get lost in a copy; the numbers and the pictures do not."""
    field = random_field(degree, opacity, dtype)
    origins, directions = some_rays(field)
    with torch.no_grad():
        expected = field(origins, directions)
        buffer = io.BytesIO()
        torch.save(field.state_dict(), buffer)
        buffer.seek(0)
        loaded = random_field(degree, opacity, dtype)
        loaded.voxels.fill_(9.0)
        loaded.load_state_dict(torch.load(buffer, weights_only=True))
        replaced = random_field(degree, opacity, dtype)
        replaced.voxels.data = field.voxels.detach().contiguous()
        for other in (copy.deepcopy(field), loaded, replaced, field.double().to(dtype)):
            assert torch.equal(other.voxels, field.voxels)
            for one, two in zip(other(origins, directions), expected, strict=True):
                assert torch.equal(one.nan_to_num(), two.nan_to_num())
    assert copy.deepcopy(field).voxels.data_ptr() != field.voxels.data_ptr()


@BOTH
def test_conversion_moves_nothing(opacity: str) -> None:
    """A field far from the world's origin stays where it is in single precision and back, and in its file."""
    g = torch.Generator().manual_seed(0)
    value = torch.rand(8, 8, 8, generator=g) * 0.5
    origin = [1234.56789, -0.1, 77.7]
    field = SurfaceField.from_dense(value, torch.ones(8, 8, 8, 3), origin, 0.01, opacity)
    assert field.half().double().grid.origin == tuple(origin)
    assert field.half().origin.tolist() == origin
    assert field.frame[:3] == [o - 0.04 for o in origin]


@BOTH
def test_single_precision_far_from_the_origin(opacity: str) -> None:
    """100 km away a field of voxels of 0.25 looks as it does at the origin, its view-dependent part too."""
    shift = torch.tensor([6e4, -6.4e4, 4.8e4], dtype=torch.float64)
    plain, view = random_field(0, opacity, torch.float32), random_field(2, "distance", torch.float32)
    coarse = TileGrid(view.table, view.tile_coords, (-1.2, 0.3, 1.9), 2 * view.voxel_size)
    near, far = (
        SurfaceField(
            plain.voxels,
            plain.grid.moved(by),
            opacity,
            plain.step,
            SurfaceField(view.voxels, coarse.moved(by), "distance"),
        )
        for by in (0 * shift, shift)
    )
    origins, directions = some_rays(near, 200)
    points = origins + 3 * directions
    with torch.no_grad():
        here = (*near(origins, directions), *near.sample(points, directions), near.sample_opacity(points))
        origins, points = origins + shift, points + shift
        there = (*far(origins, directions), *far.sample(points, directions), far.sample_opacity(points))
    for one, two in zip(here, there, strict=True):
        torch.testing.assert_close(two, one, rtol=0, atol=1e-4, equal_nan=True)


def test_a_field_trusts_no_table() -> None:
    grid = random_field().grid
    table = grid.table.clone()
    table[table == 3] = 10**6
    with pytest.raises(ValueError, match="table: expected the"):
        SurfaceField(random_field().voxels, TileGrid(table, grid.coords, grid.origin, grid.voxel_size))


@BOTH
@DTYPES
def test_skips_change_nothing(opacity: str, dtype: torch.dtype) -> None:
    """The field renders the same whether its table tells how far empty space reaches or only where it is."""
    field = random_field(1, opacity, dtype)
    wide = torch.full([n + 24 for n in field.table.shape], OUTSIDE, dtype=torch.int32)  # mostly empty
    inner = torch.where(field.table < OUTSIDE, OUTSIDE, field.table)
    wide[5:-19, 8:-16, 12:-12] = inner
    low = [o - k * 4 * field.voxel_size for o, k in zip(field.grid.origin, (5, 8, 12), strict=True)]
    coords = field.tile_coords + torch.tensor([5, 8, 12], dtype=torch.int32)
    pictures = []
    skips = with_skips(wide)
    for table in (torch.where(skips < OUTSIDE, OUTSIDE - 1, skips), skips):
        grid = TileGrid(table, coords, (low[0], low[1], low[2]), field.voxel_size)
        other = SurfaceField(field.voxels, grid, opacity)
        with torch.no_grad():
            pictures.append(other(*some_rays(field, 100)))
    assert skips.min() < OUTSIDE - 3
    for naive, skipped in zip(*pictures, strict=True):
        torch.testing.assert_close(skipped, naive, rtol=1e-5, atol=1e-6, equal_nan=True)


@BOTH
def test_compiles_whole(opacity: str) -> None:
    """Forward, reading at points and the gradient, without a break of the graph."""
    torch._dynamo.reset()
    field = random_field(1, opacity, torch.float32)
    origins, directions = (r.float() for r in some_rays(field))

    def loss(module: SurfaceField) -> Tensor:
        out = module(origins, directions)
        transparency, color = module.sample(origins + 3 * directions, directions)
        return out.color.sum() + out.transmittance.sum() + transparency.sum() + color.sum()

    compiled = torch.compile(loss, fullgraph=True, backend="aot_eager")
    gradients = []
    for compute in (loss, compiled):
        field.zero_grad()
        value = compute(field)
        value.backward()
        assert field.voxels.grad is not None
        gradients.append((value.detach(), field.voxels.grad.clone()))
    for eager, traced in zip(*gradients, strict=True):
        torch.testing.assert_close(traced, eager)


@BOTH
def test_from_dense_leaves_out_what_is_constant(opacity: str) -> None:
    """Values beyond the outside or inside one mean no more than these; what is in between is kept as it is."""
    outside, inside = (1.0, 0.01) if opacity == "transparency" else (4.0, -4.0)
    value = torch.full((16, 5, 4), outside)
    value[0:4, :4], value[4:8, :4] = outside + 1, inside - 0.01
    value[8, 0, 0], value[15, 4, 3] = 0.5, 0.25
    field = SurfaceField.from_dense(value, torch.rand(16, 5, 4, 1, 3), [0.0, 0.0, 0.0], 1.0, opacity)
    assert sorted(field.tile_coords.tolist()) == [[2, 0, 0], [3, 1, 0]]
    assert field.grid.size == (4, 2, 1)
    assert field.grid.inside.nonzero().tolist() == [[1, 0, 0]]
    at = torch.tensor(
        [[8.5, 0.5, 0.5], [15.5, 4.5, 3.5], [5.5, 2.0, 2.0], [2.0, 2.0, 2.0], [-99.0, 0.0, 0.0]]
    )
    values = field.sample_opacity(at)
    torch.testing.assert_close(values, torch.tensor([0.5, 0.25, inside, outside, outside]))


def test_opacity_is_named_where_it_is_wrong() -> None:
    with pytest.raises(ValueError, match="opacity: expected transparency or distance"):
        SurfaceField.from_dense(torch.ones(4, 4, 4), torch.ones(4, 4, 4, 3), [0, 0, 0], 1.0, "alpha")
    with pytest.raises(ValueError, match="voxels: expected 4, 13, 16, 28 or 32"):
        SurfaceField.from_dense(torch.zeros(4, 4, 4), torch.ones(4, 4, 4, 2, 3), [0, 0, 0], 1.0)


def test_padding_is_used_where_no_gradient_is_asked() -> None:
    """Rendering without gradients reads the memory behind the parameter: no copy is made of it."""
    field = random_field(1)
    with torch.no_grad():
        assert field._store().data_ptr() == field.voxels.data_ptr()
        assert field._store().shape[-1] == ops.pitch(1)


@BOTH
def test_a_field_that_moves(opacity: str, device: str) -> None:
    """There it sees the same, in memory that is padded as before; what stays where it is, is not copied."""
    view = random_field(1, "distance", torch.float32)
    field = random_field(1, opacity, torch.float32)
    field = SurfaceField(field.voxels.detach(), field.grid, opacity, view=view)
    rays = [r.float() for r in some_rays(field, 100)]
    with torch.no_grad():
        here = field(*rays)
        place = field.voxels.data_ptr()
        moved = field.to(device).double().float()
        there = moved(*rays)
        assert moved._store().data_ptr() == moved.voxels.data_ptr() != place
    assert there.color.device.type == device
    for one, two in zip(here, there, strict=True):
        torch.testing.assert_close(two.cpu(), one, equal_nan=True)
    place = moved.voxels.data_ptr()
    assert moved.to(device).voxels.data_ptr() == place
