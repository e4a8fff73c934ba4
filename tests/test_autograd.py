"""The autograd Functions as autograd sees them: who gets a gradient, how it scales, and that there is no second one."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor

from tests.ops.fields import Scene, assert_close, make_scene
from torch_surfcap.autograd import March, MarchRays, PhotometricStep, SampleTiles, ShadePoints, VoxelTerms

Call = Callable[[Scene], Tensor]


def sample(scene: Scene) -> Tensor:
    values: Tensor = SampleTiles.apply(*scene.field, scene.origins + 0.4 * scene.directions)
    return values.sum()


def shade(scene: Scene) -> Tensor:
    points = scene.origins + 0.4 * scene.directions
    values: Tensor = ShadePoints.apply(*scene.field, points, scene.directions)
    return values.sum()


def march(scene: Scene) -> Tensor:
    rays = (scene.table, scene.frame, scene.origins, scene.directions, scene.shift)
    color, transmittance, _ = MarchRays.apply(scene.voxels, scene.background, *rays, March(*scene.march()))
    return color.sum() + transmittance.sum()


def photometric(scene: Scene) -> Tensor:
    seen = (scene.target, scene.mask, scene.weight)
    total: Tensor = PhotometricStep.apply(
        *scene.field, *scene.rays, *seen, March(*scene.march()), 0.1, [1.0, 0.3, 0.5], False
    )[0]
    return total


def terms(scene: Scene) -> Tensor:
    total: Tensor = VoxelTerms.apply(*scene.field, scene.coordinates, [0.3, 0.7, 0.2, 0.4, 0.5], 0.1, 0.05)[0]
    return total


CALLS = pytest.mark.parametrize("call", [sample, shade, march, photometric, terms])


def scene_of(device: str, dtype: torch.dtype = torch.float64) -> Scene:
    scene = make_scene(dtype=dtype, device=device)
    scene.voxels.requires_grad_()
    return scene


@CALLS
def test_gradient_is_linear_in_what_comes_back(call: Call, device: str) -> None:
    scene = scene_of(device)
    (one,) = torch.autograd.grad(call(scene), scene.voxels)
    (scaled,) = torch.autograd.grad(-2.5 * call(scene), scene.voxels)
    assert one.any()
    torch.testing.assert_close(scaled, -2.5 * one)


@CALLS
def test_gradients_add_up_in_the_leaf(call: Call, device: str) -> None:
    scene = scene_of(device)
    for _ in range(2):
        call(scene).backward()  # type: ignore[no-untyped-call]
    (one,) = torch.autograd.grad(call(scene), scene.voxels)
    assert scene.voxels.grad is not None
    torch.testing.assert_close(scene.voxels.grad, 2 * one)


@CALLS
def test_no_second_gradient(call: Call, device: str) -> None:
    """It would be zero and wrong: asking for one is an error."""
    scene = scene_of(device)
    (first,) = torch.autograd.grad(call(scene), scene.voxels, create_graph=True)
    with pytest.raises(RuntimeError, match=r"once_differentiable|does not require grad"):
        first.sum().backward()  # type: ignore[no-untyped-call]


@CALLS
def test_nothing_is_kept_without_gradients(call: Call, device: str) -> None:
    scene = scene_of(device)
    with torch.no_grad():
        assert not call(scene).requires_grad
    scene.voxels.requires_grad_(False)
    assert not call(scene).requires_grad


@CALLS
def test_other_tensors_get_no_gradient(call: Call, device: str) -> None:
    """Rays, observations and points are constants to all Functions; what they are says so."""
    scene = scene_of(device)
    constants = [scene.origins, scene.directions, scene.shift, scene.target, scene.mask, scene.weight]
    for tensor in constants:
        tensor.requires_grad_()
    gradients = torch.autograd.grad(call(scene), [scene.voxels, *constants], allow_unused=True)
    assert gradients[0] is not None
    assert all(g is None for g in gradients[1:])


@CALLS
def test_changing_the_voxels_in_between_is_noticed(call: Call, device: str) -> None:
    """A Function that needs the voxels again refuses stale ones; one that has its gradient already does not care."""
    scene = make_scene(device=device)
    leaf = scene.voxels.clone().requires_grad_()
    scene.voxels = leaf * 1.0
    before = call(scene)
    (expected,) = torch.autograd.grad(before, leaf, retain_graph=True)
    with torch.no_grad():
        scene.voxels.add_(0.1)
    if call in (sample, shade, march):
        with pytest.raises(RuntimeError, match="modified by an inplace operation"):
            torch.autograd.grad(before, leaf)
    else:
        assert torch.equal(torch.autograd.grad(before, leaf)[0], expected)


def test_background_alone(device: str) -> None:
    """The gradient of a colour by its background is the transmittance."""
    scene = make_scene(device=device)
    scene.background.requires_grad_()
    rays = (scene.table, scene.frame, scene.origins, scene.directions, scene.shift)
    color, transmittance, _ = MarchRays.apply(scene.voxels, scene.background, *rays, March(*scene.march()))
    (by_background,) = torch.autograd.grad(color.sum(), scene.background)
    torch.testing.assert_close(by_background, transmittance[:, None].expand(-1, 3))


def test_upstream_gradients_of_any_layout(device: str) -> None:
    """Expanded, transposed and missing gradients, as a foreign loss hands them back."""
    scene = scene_of(device)
    rays = (scene.table, scene.frame, scene.origins, scene.directions, scene.shift)
    out: Any = MarchRays.apply(scene.voxels, scene.background, *rays, March(*scene.march()))
    weight = torch.rand(3, len(scene.origins), dtype=torch.float64, device=device)
    (strided,) = torch.autograd.grad(out[0], scene.voxels, weight.T, retain_graph=True)
    (plain,) = torch.autograd.grad(out[0], scene.voxels, weight.T.contiguous(), retain_graph=True)
    assert_close(strided, plain.cpu(), 1e-13)
    (expanded,) = torch.autograd.grad(
        out[1], scene.voxels, torch.ones(1).to(out[1]).expand(len(out[1])), retain_graph=True
    )
    (summed,) = torch.autograd.grad(out[1].sum(), scene.voxels)
    assert_close(expanded, summed.cpu(), 1e-13)


@CALLS
def test_single_precision_follows_double(call: Call, device: str) -> None:
    single, double = scene_of(device, torch.float32), scene_of(device)
    gradients = [torch.autograd.grad(call(scene), scene.voxels)[0] for scene in (single, double)]
    assert gradients[0].dtype == torch.float32
    error = (gradients[0].double() - gradients[1]).abs().max()
    assert error < 1e-4 * gradients[1].abs().max()
