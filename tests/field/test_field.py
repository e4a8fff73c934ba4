"""SurfaceField: the public surface, and as a module in somebody else's optimiser and loss."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

import torch_surfcap as sc
from tests.ops.fields import GRADCHECK
from torch_surfcap import SurfaceField, ops
from torch_surfcap.reference import dense, march_forward

OPACITIES = ("transparency", "distance")


def random_field(
    degree: int = 1, opacity: str = "transparency", dtype: torch.dtype = torch.float64
) -> SurfaceField:
    """A field of 10 x 7 x 9 voxels, sizes that tiles do not divide, with an inside tile."""
    g = torch.Generator().manual_seed(0)
    size = (10, 7, 9)
    low, high = (0.2, 0.95) if opacity == "transparency" else (-2.0, 2.0)
    value = low + (high - low) * torch.rand(size, generator=g, dtype=dtype)
    value[4:8, :4, :4] = 0.01 if opacity == "transparency" else -4.0
    sh = torch.rand(*size, (degree + 1) ** 2, 3, generator=g, dtype=dtype) - 0.2
    return SurfaceField.from_dense(value, sh, [-1.0, 0.5, 2.0], 0.25, opacity=opacity)


def some_rays(field: SurfaceField, count: int = 40) -> tuple[Tensor, Tensor]:
    g = torch.Generator().manual_seed(1)
    target = field.origin + torch.rand(count, 3, generator=g, dtype=torch.float64) * 2
    directions = torch.nn.functional.normalize(
        torch.randn(count, 3, generator=g, dtype=torch.float64), dim=-1
    )
    return target - 3 * directions, directions


@pytest.mark.parametrize("opacity", OPACITIES)
def test_from_dense_keeps_the_values(opacity: str) -> None:
    field = random_field(degree=2, opacity=opacity)
    assert field.voxels.shape[1:] == (4, 4, 4, 28)
    assert not (field.tile_coords == torch.tensor([1, 0, 0])).all(1).any()  # the inside tile is not stored
    i, j, k = 9, 6, 8  # the last voxel of the grid
    center = field.origin + (torch.tensor([i, j, k]) + 0.5) * field.voxel_size
    tile = int((field.tile_coords == torch.tensor([2, 1, 2])).all(1).nonzero())
    up = torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64)
    value, color = field.sample(center[None], up)
    assert field.sample_opacity(center[None]).item() == pytest.approx(field.voxels[tile, 1, 2, 0, 0].item())
    basis = torch.tensor([1, 0, 1, 0, 0, 0, 1, 0, 0], dtype=torch.float64)
    torch.testing.assert_close(color[0], basis @ field.sh[tile, 1, 2, 0])
    if opacity == "transparency":
        assert value.item() == pytest.approx(field.transparency[tile, 1, 2, 0].item())


@pytest.mark.parametrize("opacity", OPACITIES)
@pytest.mark.parametrize("degree", [0, 1, 2])
def test_rays_equal_the_reference(degree: int, opacity: str) -> None:
    field = random_field(degree, opacity)
    origins, directions = some_rays(field)
    background = torch.rand(len(origins), 3, dtype=torch.float64)
    out = field(origins, directions, background)
    expected = march_forward(
        ops.padded(field.voxels), field.table, field.frame, origins, directions, torch.zeros(len(origins)).double(),
        background, *field.march(),
    )  # fmt: skip
    torch.testing.assert_close(out.color, expected[0])
    torch.testing.assert_close(out.transmittance, expected[1])


@pytest.mark.parametrize("opacity", OPACITIES)
def test_a_view_field_is_read_once_per_ray(opacity: str) -> None:
    """At the depth, with the weight of what the ray meets; a point has its colour whole, and none of its opacity."""
    plain, view = random_field(0, opacity), random_field(2, "distance")
    field = SurfaceField(plain.voxels, plain.grid, opacity, plain.step, view)
    origins, directions = some_rays(field)
    out, bare = field(origins, directions), plain(origins, directions)
    hit = ~bare.depth.isnan()
    points = origins[hit] + bare.depth[hit, None] * directions[hit]
    added = (1 - bare.transmittance[hit, None]) * view.sample(points, directions[hit])[1]
    assert hit.any()
    torch.testing.assert_close(out.color[hit], bare.color[hit] + added)
    assert torch.equal(out.transmittance, bare.transmittance)
    value, color = field.sample(points, directions[hit])
    alone, beneath = plain.sample(points, directions[hit])
    assert torch.equal(value, alone)
    torch.testing.assert_close(color, beneath + view.sample(points, directions[hit])[1])
    both = torch.autograd.grad(out.color[hit].sum(), [field.voxels, *view.parameters()])
    assert all(gradient.any() for gradient in both)


def test_no_background_is_black() -> None:
    field = random_field()
    origins, directions = some_rays(field)
    black = field(origins, directions, torch.zeros_like(origins))
    torch.testing.assert_close(field(origins, directions).color, black.color)
    away = field(origins, -directions)
    assert away.depth.isnan().all()
    assert not away.color.any()


def test_a_wall_is_where_its_depth_says() -> None:
    """A half space of solid voxels behind x = 2: rays along x see its colour at the depth of its first samples."""
    value = torch.ones(8, 8, 8)
    value[4:] = 0.0
    color = torch.tensor([0.2, 0.5, 0.8]).expand(8, 8, 8, 1, 3)
    field = SurfaceField.from_dense(value, color, [0.0, 0.0, 0.0], 0.5)
    out = field(torch.tensor([[-3.0, 2.0, 2.0]]), torch.tensor([[1.0, 0.0, 0.0]]))
    assert out.transmittance.item() < 1e-3
    assert out.depth.item() == pytest.approx(5.0, abs=math.sqrt(3) * 0.5)


@pytest.mark.parametrize("opacity", OPACITIES)
def test_gradcheck(opacity: str, device: str) -> None:
    field = random_field(degree=1, opacity=opacity)
    origins, directions = (r.to(device) for r in some_rays(field, 12))
    field = field.to(device)
    met = field(origins, directions).transmittance < 0.99
    origins, directions = origins[met], directions[met]
    background = torch.rand(len(origins), 3, dtype=torch.float64, device=device)

    def render(voxels: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        return torch.func.functional_call(field, {"voxels": voxels}, (origins, directions, background))

    assert torch.autograd.gradcheck(render, field.voxels.detach().requires_grad_(), **GRADCHECK)


@pytest.mark.parametrize("opacity", OPACITIES)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_trains_under_a_foreign_optimiser_and_loss(opacity: str, dtype: torch.dtype) -> None:
    """torch.optim and an L1 loss of one's own bring a field to the pictures of another one."""
    goal, field = (random_field(opacity=opacity, dtype=dtype) for _ in range(2))
    with torch.no_grad():
        field.sh.fill_(0.3)
    origins, directions = some_rays(field, 300)
    with torch.no_grad():
        target = goal(origins, directions).color
    optimiser = torch.optim.AdamW(field.parameters(), lr=0.05, weight_decay=0.0)
    losses = []
    for _ in range(40):
        optimiser.zero_grad()
        loss = (field(origins, directions).color - target).abs().mean()
        loss.backward()  # type: ignore[no-untyped-call]
        optimiser.step()
        losses.append(loss.item())
    assert losses[-1] < 0.2 * losses[0]


def test_moves_and_converts_like_any_module() -> None:
    field = random_field()
    origins, directions = some_rays(field)
    before = field(origins, directions).color
    single = random_field().float()
    assert single.voxels.dtype == torch.float32
    torch.testing.assert_close(single(origins, directions).color, before.float(), rtol=0, atol=2e-4)
    other = random_field()
    with torch.no_grad():
        other.voxels.zero_()
    other.load_state_dict(field.state_dict())
    torch.testing.assert_close(other(origins, directions).color, before)
    assert [name for name, _ in field.named_parameters()] == ["voxels"]


@pytest.mark.parametrize("opacity", OPACITIES)
def test_saved_field_loads_again(opacity: str, tmp_path: Path) -> None:
    field = random_field(degree=2, opacity=opacity)
    field.save(tmp_path / "field.npz")
    loaded = SurfaceField.load(tmp_path / "field.npz")
    assert (loaded.opacity, loaded.sh_degree, loaded.voxel_size) == (opacity, 2, 0.25)
    assert torch.equal(loaded.voxels, field.voxels)
    origins, directions = some_rays(field)
    assert torch.equal(loaded(origins, directions).color, field(origins, directions).color)


def test_what_is_no_field_is_refused(tmp_path: Path) -> None:
    (tmp_path / "text.npz").write_text("no")
    np.savez(tmp_path / "other.npz", a=np.zeros(3))
    for name in ("text.npz", "other.npz", "missing.npz"):
        with pytest.raises(sc.InputError, match=name):
            SurfaceField.load(tmp_path / name)


def test_values_of_shorter_steps_have_a_higher_level_and_are_rendered_with_them(tmp_path: Path) -> None:
    """One cube of matter: its transparencies of a path and, as their roots, of half the path give the same mesh and,
    where they are constant, the same light."""
    value = torch.full((12, 12, 12), 0.6)
    value[:2] = value[-2:] = value[:, :2] = value[:, -2:] = value[..., :2] = value[..., -2:] = 1.0
    grey = torch.full((12, 12, 12, 3), 0.5)
    long = SurfaceField.from_dense(value, grey, [0.0, 0.0, 0.0], 1.0)
    half = SurfaceField.from_dense(value.sqrt(), grey, [0.0, 0.0, 0.0], 1.0)
    half = SurfaceField(half.voxels, half.grid, half.opacity, step=long.step / 2)
    assert (long.level, half.level) == (0.81, pytest.approx(0.9))
    origins = torch.tensor([[5.0, 5.0, -20.0]])
    directions = torch.tensor([[0.0, 0.0, 1.0]])
    light = [field(origins, directions).transmittance.item() for field in (long, half)]
    assert light[1] == pytest.approx(
        light[0], rel=0.2
    )  # the ends of the path fall differently between samples
    assert half(origins, directions, step=long.step).transmittance.item() > 2 * light[0]
    half.save(tmp_path / "field.npz")
    loaded = SurfaceField.load(tmp_path / "field.npz")
    assert (loaded.step, loaded.level) == (half.step, half.level)
    a, b = (field.extract_mesh() for field in (long, half))
    assert abs(b.volume / a.volume - 1) < 0.03


def test_wrong_arguments_are_named() -> None:
    with pytest.raises(ValueError, match="sh: expected"):
        SurfaceField.from_dense(torch.ones(4, 4, 4), torch.ones(4, 4, 5, 1, 3), [0, 0, 0], 1.0)
    field = random_field()
    with pytest.raises(ValueError, match="opacity: expected transparency or distance"):
        SurfaceField(field.voxels, field.grid, "alpha")
    with pytest.raises(ValueError, match="voxels: expected"):
        SurfaceField(field.voxels[1:], field.grid)
    with pytest.raises(ValueError, match="step: expected a positive number"):
        SurfaceField(field.voxels, field.grid, step=0.0)


def test_dense_reference_holds_the_same_values() -> None:
    """The store behind a field is the grid that it was made of, one tile of border around it."""
    field = random_field(degree=0)
    grid = dense(ops.padded(field.voxels.detach()), field.table, field.frame)
    tile = field.tile_coords[5].long()
    x, y, z = (4 * (tile + 1) + torch.tensor([1, 2, 3])).tolist()
    torch.testing.assert_close(grid[x, y, z], field.voxels[5, 1, 2, 3].detach())
