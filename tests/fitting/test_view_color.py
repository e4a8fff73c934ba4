"""View-dependent colour on a coarse grid: where it is read, its gradient, what it brings, and that it is kept."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch

from tests.fitting.sphere import ball
from tests.fitting.stages import begun
from torch_surfcap import Capture, SurfaceField, fit, ops
from torch_surfcap.field.tiles import TileGrid, voxel_centers
from torch_surfcap.fitting.descent import descend
from torch_surfcap.fitting.fit import FitResult
from torch_surfcap.fitting.view_color import ViewColor, covering
from torch_surfcap.metrics import psnr
from torch_surfcap.surface.render import volume

SHEEN = torch.tensor([0.2, -0.1, 0.15])  # of red, green, blue, times the y of the direction of view
QUICK: dict[str, Any] = {"levels": 2, "voxel": 0.03, "gains": "off"}


def sheen(capture: Capture) -> Capture:
    """The capture with colours that change with the direction of view, by a spherical harmonic of degree 1."""
    images = []
    for i, image in enumerate(capture.images):
        directions = capture.cameras.rays(i, capture.cameras.pixels(i).double() + 0.5)[1]
        images.append((image + directions[:, 1].view(*image.shape[:2], 1).float() * SHEEN).clamp(0, 1))
    changed = Capture(images, capture.cameras.K, capture.cameras.world_to_camera, capture.masks)
    changed.mask_source = "file"
    return changed


@pytest.mark.parametrize("spacing", [4, 8])
def test_the_coarse_grid_covers_the_fine_one(spacing: int) -> None:
    """A read anywhere within the fine tiles finds stored voxels only, and few tiles are stored for it."""
    stored = torch.rand(9, 5, 7, generator=torch.Generator().manual_seed(0)) < 0.2
    fine = TileGrid.build(stored, torch.zeros_like(stored), (1.0, -2.0, 0.5), 0.25)
    coarse = covering(fine, spacing)
    coarse.check()
    assert coarse.voxel_size == spacing * fine.voxel_size
    ones = torch.ones(len(coarse.coords), 4, 4, 4, 4, dtype=torch.float64)
    ends = voxel_centers(fine).view(-1, 3) + 0.499 * fine.voxel_size * torch.tensor([[[1.0]], [[-1.0]]])
    read = ops.sample_forward(ones, coarse.table, coarse.frame(0.0, 0.0), ends.view(-1, 3))
    torch.testing.assert_close(read, torch.ones_like(read))
    assert len(coarse.coords) < len(fine.coords)


def test_gradient() -> None:
    """That of the photometric loss is autograd's through the rendered field; the sample loss adds a share of it."""
    stage, studio, settings = begun(
        sheen(ball(6, 24)), 0.06, 3, sh_degree=1, view_spacing=4, losses={"tv_color": 0.0, "parsimony": 0.0}
    )
    for _ in descend(stage, studio, settings):
        pass
    view, rays = stage.view, stage.rays
    assert view is not None
    surface = SurfaceField(stage.store, stage.grid, "distance", view=view.field())
    assert surface.view is not None
    out = surface(rays.origins, rays.directions, rays.background, step=stage.march.step)
    view.depth = out.depth.detach().nan_to_num(0.0)
    loss = (rays.weight[:, None] * torch.nn.functional.huber_loss(
        out.color, rays.target, reduction="none", delta=settings.losses.huber
    )).sum()  # fmt: skip
    (expected,) = torch.autograd.grad(loss, surface.view.voxels)
    residual = (out.color - rays.target).detach()
    given = view.gradient(rays, residual, out.transmittance.detach(), settings.losses)
    share = 1 + settings.losses.sample / settings.losses.photo
    assert expected[..., 4:].any()
    torch.testing.assert_close(given[..., 4 : expected.shape[-1]], share * expected[..., 4:])


def fitted(capture: Capture, **given: Any) -> FitResult:
    return fit(capture, **QUICK, **given)


def score(result: FitResult, capture: Capture) -> float:
    """PSNR within the masks."""
    assert capture.masks is not None
    seen = [volume(result.field, capture.cameras, i, 0.0) for i in range(len(capture))]
    masks = [mask > 0.99 for mask in capture.masks]
    scores = [psnr(p, q, m) for p, q, m in zip(seen, capture.images, masks, strict=True)]
    return sum(scores) / len(scores)


@pytest.mark.parametrize("opacity", ["transparency", "distance"])
@pytest.mark.parametrize("gradient", ["scatter", "gather"])
def test_it_explains_what_depends_on_the_direction(opacity: str, gradient: str, device: str) -> None:
    capture = sheen(ball(12, 40))
    given: dict[str, Any] = {"opacity": opacity, "gradient": gradient, "device": device}
    plain = fitted(capture, sh_degree=0, **given)
    coarse = fitted(capture, sh_degree=1, view_spacing=4, **given)
    assert coarse.field.voxels.shape[-1] == 4
    assert score(coarse, capture) > score(plain, capture) + 2


def test_a_dull_scene_stays_dull() -> None:
    """Without anything to explain the coefficients stay small, and the pictures as good."""
    capture = ball(12, 40)
    plain, coarse = (fitted(capture, sh_degree=d, view_spacing=4) for d in (0, 1))
    assert coarse.field.view is not None
    assert score(coarse, capture) > score(plain, capture) - 0.6
    assert coarse.field.view.sh[..., 1:, :].abs().mean() < 0.02
    assert not coarse.field.view.voxels[..., :4].any()


def test_eight_bits_beside_it(device: str) -> None:
    capture = sheen(ball(12, 40))
    wide, narrow = (fitted(capture, sh_degree=1, view_spacing=8, storage=b, device=device) for b in (32, 8))
    assert score(narrow, capture) > score(wide, capture) - 0.7


def test_a_saved_field_keeps_it(tmp_path: Path) -> None:
    capture = sheen(ball(6, 24))
    field = fitted(capture, sh_degree=2, view_spacing=4).field
    field.save(tmp_path / "field.npz")
    again = SurfaceField.load(tmp_path / "field.npz")
    for i in (0, 3):
        one, two = (volume(f, capture.cameras, i, 0.0) for f in (field, again))
        assert torch.equal(one, two)


def test_none_without_degrees() -> None:
    stage, *_ = begun(ball(6, 24), 0.06, 1, sh_degree=0, view_spacing=4)
    assert stage.view is None
    stage, *_ = begun(ball(6, 24), 0.06, 1, sh_degree=1, view_spacing=4)
    assert isinstance(stage.view, ViewColor)
    with pytest.raises(ValueError, match="view_spacing is 3"):
        fit(ball(6, 24), view_spacing=3)
