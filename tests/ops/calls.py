"""How each op is called on a Scene, so that what all ops owe is tested once, for all."""

from __future__ import annotations

from collections.abc import Sequence
from types import ModuleType
from typing import Any

import torch
from torch import Tensor

from tests.ops.fields import Scene
from torch_surfcap import ops as _ops
from torch_surfcap import reference
from torch_surfcap.reference import TRANSPARENCY

ops: Any = _ops  # untyped: the tests unpack lists of arguments into its functions
WRITES = {"voxel_terms": [7], "adam_step": [0, 2, 3]}  # arguments that an op changes in place
NAMES = (
    "sample_forward",
    "sample_backward",
    "march_forward",
    "march_backward",
    "photometric_step",
    "visibility",
    "voxel_terms",
    "adam_step",
    "soft_hull",
    "upscale",
)
GROUPS = 4


def normal(like: Tensor, *shape: int, seed: int = 1) -> Tensor:
    """Normal numbers, the same for every dtype and device."""
    g = torch.Generator().manual_seed(seed)
    return torch.randn(*shape, generator=g, dtype=torch.float64).to(like)


def points_of(scene: Scene) -> Tensor:
    """One point on each ray, some of them outside the table."""
    return scene.origins + 0.4 * scene.directions


def has_depth(transmittance: Tensor) -> Tensor:
    """Rays whose depth is more than rounding: where next to nothing is met, the quotient means little."""
    return transmittance < 0.999


def arguments(name: str, scene: Scene, stop: float = 0.0) -> list[Any]:
    """The arguments of op `name` on this scene."""
    v, march = scene.voxels, scene.march(stop)
    rays, count = len(scene.origins), v.shape[-1]
    if name == "sample_forward":
        return [*scene.field, points_of(scene)]
    if name == "sample_backward":
        return [normal(v, rays, count), *scene.field, points_of(scene), GROUPS]
    if name == "march_forward":
        return scene.marched(stop)
    if name == "march_backward":
        solid = has_depth(reference.march_forward(*scene.marched(stop))[1])
        grads = [normal(v, rays, 3), normal(v, rays, seed=2), normal(v, rays, seed=3) * solid]
        return [*grads, *scene.field, *scene.rays, *march, GROUPS]
    if name == "photometric_step":
        seen = (scene.target, scene.mask, scene.weight)
        return [*scene.field, *scene.rays, *seen, *march, 0.1, [1.0, 0.7, 0.3], False, GROUPS]
    if name == "visibility":
        return [*scene.field, *scene.rays[:3], *march, GROUPS]
    if name == "voxel_terms":
        return [*scene.field, scene.coordinates, [0.3, 0.7, 0.2, 0.4, 0.5], 0.1, 0.05, normal(v, *v.shape)]
    if name == "adam_step":
        rate, high = normal(v, count).abs() * 0.1, v.new_full((count,), 0.9)
        return [
            v,
            normal(v, *v.shape),
            normal(v, *v.shape),
            normal(v, *v.shape).abs(),
            rate,
            high - 0.8,
            high,
            3,
        ]
    if name == "soft_hull":
        return hull_arguments(scene)
    if name == "upscale":
        fine = torch.cartesian_prod(*[torch.arange(4, dtype=torch.int32)] * 3)[::2].to(scene.table)
        low = [x + 2.1 * scene.frame[3] for x in scene.frame[:3]]
        return [*scene.field, fine, [*low, 0.6 * scene.frame[3], *scene.frame[4:]]]
    raise KeyError(name)


def hull_arguments(scene: Scene) -> list[Any]:
    """Points, three cameras at different sides with pictures of different sizes, and random masks."""
    v = scene.voxels
    low = torch.tensor(scene.frame[:3], dtype=torch.float64)
    middle = low + 2 * len(scene.table) * scene.frame[3]
    sizes, projections = [(9, 6), (5, 8), (1, 3)], []
    for (width, height), eye in zip(
        sizes, torch.tensor([[0, 0, -2.0], [0.5, 0, 2.2], [1.8, 0.3, 0]]), strict=True
    ):
        forward = torch.nn.functional.normalize(-eye.double(), dim=0)
        right = torch.linalg.cross(torch.tensor([0.0, 1.0, 0.1], dtype=torch.float64), forward)
        right = right / right.norm()
        rotation = torch.stack([right, torch.linalg.cross(forward, right), forward])
        camera = torch.cat([rotation, -(rotation @ (middle + eye))[:, None]], 1)
        k = torch.tensor([[width, 0, width / 2], [0, width, height / 2], [0, 0, 1]], dtype=torch.float64)
        projections.append(k @ camera)
    pixels = sum(width * height for width, height in sizes)
    masks = normal(v, pixels).abs().clamp(max=1)
    points = scene.origins * 0.6 + 0.4 * middle.to(v)
    return [points, torch.stack(projections).to(v), masks, torch.tensor(sizes, device=v.device)]


def cloned(arguments: Sequence[Any]) -> list[Any]:
    return [a.clone() if isinstance(a, Tensor) else a for a in arguments]


def run(module: ModuleType, name: str, arguments: Sequence[Any]) -> list[Tensor]:
    """All that an op returns or writes."""
    given = list(arguments)
    for i in WRITES.get(name, []):
        given[i] = given[i].clone(memory_format=torch.contiguous_format)
    returned = getattr(module, name)(*given)
    outputs = [] if returned is None else [returned] if isinstance(returned, Tensor) else list(returned)
    if name == "march_forward":
        outputs[2] = outputs[2].where(has_depth(outputs[1]), 0)
    return outputs + [given[i] for i in WRITES.get(name, [])]


def raw(name: str, arguments: Sequence[Any]) -> tuple[Any, tuple[Any, ...]]:
    """The overload in torch.ops and its arguments, which for some ops stand in another order."""
    given = tuple(cloned(arguments))
    if name == "adam_step":
        given = (*given[:7], 0.9, 0.99, 1e-8, given[7], 5, True)
    if name == "photometric_step":
        voxels, groups = given[0], given[-1]
        gradients = given[3].new_empty(groups, *voxels.shape)
        given = (*given[:10], None, None, *given[10:-1], gradients)
    return getattr(torch.ops.torch_surfcap, name).default, given


MODES = (TRANSPARENCY, reference.DISTANCE)
