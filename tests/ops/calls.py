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
# Arguments that an op changes in place.
WRITES = {"photometric_lattice": [20], "gather_gradient": [14], "voxel_terms": [7], "adam_step": [0, 2, 3]}
# Where, among what an op returns, the rays' transmittance is; their depth follows.
TRANSMITTANCE = {"march_forward": 1, "photometric_step": 3, "photometric_lattice": 2}
NAMES = (
    "sample_forward",
    "sample_backward",
    "shade_forward",
    "shade_backward",
    "march_forward",
    "march_backward",
    "photometric_step",
    "photometric_lattice",
    "gather_gradient",
    "visibility",
    "voxel_terms",
    "adam_step",
    "soft_hull",
    "rasterize",
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


def has_depth(transmittance: Tensor, least: float = 0.001) -> Tensor:
    """Rays whose depth is more than rounding: where next to nothing is met, the quotient means little."""
    return transmittance < 1 - least


def arguments(name: str, scene: Scene, stop: float = 0.0) -> list[Any]:
    """The arguments of op `name` on this scene."""
    v, march = scene.voxels, scene.march(stop)
    rays, count = len(scene.origins), v.shape[-1]
    if name == "sample_forward":
        return [*scene.field, points_of(scene)]
    if name == "sample_backward":
        return [normal(v, rays, count), *scene.field, points_of(scene), GROUPS]
    if name == "shade_forward":
        return [*scene.field, points_of(scene), scene.directions]
    if name == "shade_backward":
        return [normal(v, rays, 4), *arguments("shade_forward", scene), GROUPS]
    if name == "march_forward":
        return scene.marched(stop)
    if name == "march_backward":
        solid = has_depth(reference.march_forward(*scene.marched(stop))[1])
        grads = [normal(v, rays, 3), normal(v, rays, seed=2), normal(v, rays, seed=3) * solid]
        return [*grads, *scene.field, *scene.rays, *march, GROUPS]
    if name == "photometric_step":
        seen = (scene.target, scene.mask, scene.weight)
        return [*scene.field, *scene.rays, *seen, *march, 0.1, [1.0, 0.7, 0.3], False, GROUPS]
    if name == "photometric_lattice":
        step = arguments("photometric_step", scene, stop)[:-1]
        return [*step, *slot_rows(scene), 3, normal(v, int(slot_rows(scene)[0][-1]), 4)]
    if name == "gather_gradient":
        return gather_arguments(scene)
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
    if name == "rasterize":
        return triangles(scene)
    if name == "upscale":
        fine = torch.cartesian_prod(*[torch.arange(4, dtype=torch.int32)] * 3)[::2].to(scene.table)
        low = [x + 2.1 * scene.frame[3] for x in scene.frame[:3]]
        return [*scene.field, fine, [*low, 0.6 * scene.frame[3], *scene.frame[4:]]]
    raise KeyError(name)


def triangles(scene: Scene) -> list[Any]:
    """As many faces as there are rays over a picture of 13 x 17 pixels, some beyond it, some behind the camera."""
    v, count = scene.voxels, len(scene.origins)
    corners = normal(v, 40, 3) * normal(v, 3).new_tensor([8.0, 6.0, 0.6])
    corners = corners + normal(v, 3).new_tensor([8.0, 6.0, 1.2])
    faces = torch.arange(3 * count, device=v.device).view(-1, 3) * 7 % 40
    return [corners, faces.int(), 13, 17]


SIZES = ((9, 6), (5, 8), (1, 3))  # width, height of three cameras' pictures


def cameras(scene: Scene) -> list[tuple[Tensor, Tensor, Tensor]]:
    """K, R and centre of three cameras at different sides, in double; the field fills their pictures."""
    low = torch.tensor(scene.frame[:3], dtype=torch.float64)
    middle = low + 2 * len(scene.table) * scene.frame[3]
    found = []
    eyes = torch.tensor([[0, 0, -2.0], [0.5, 0, 2.2], [1.8, 0.3, 0]], dtype=torch.float64)
    for (width, height), eye in zip(SIZES, eyes, strict=True):
        forward = torch.nn.functional.normalize(-eye, dim=0)
        right = torch.linalg.cross(torch.tensor([0.0, 1.0, 0.1], dtype=torch.float64), forward)
        right = right / right.norm()
        rotation = torch.stack([right, torch.linalg.cross(forward, right), forward])
        k = torch.tensor([[width, 0, width / 2], [0, width, height / 2], [0, 0, 1]], dtype=torch.float64)
        found.append((k, rotation, middle + eye))
    return found


def hull_arguments(scene: Scene) -> list[Any]:
    """Points, three cameras with pictures of different sizes, and random masks."""
    v = scene.voxels
    middle = torch.tensor(scene.frame[:3], dtype=torch.float64) + 2 * len(scene.table) * scene.frame[3]
    projections = [k @ torch.cat([r, -(r @ center)[:, None]], 1) for k, r, center in cameras(scene)]
    masks = normal(v, sum(width * height for width, height in SIZES)).abs().clamp(max=1)
    points = scene.origins * 0.6 + 0.4 * middle.to(v)
    return [points, torch.stack(projections).to(v), masks, torch.tensor(SIZES, device=v.device)]


def slot_rows(scene: Scene) -> tuple[Tensor, Tensor]:
    """Rows of 0 to 24 slots, 12 in the mean, that begin before or after their rays' first samples."""
    rays, device = len(scene.origins), scene.voxels.device
    counts = torch.tensor([24 * (i % 2) for i in range(rays)], dtype=torch.int64, device=device)
    if rays % 2:
        counts[-1] = 12
    starts = torch.cat([counts.new_zeros(1), counts.cumsum(0)])
    return starts, (torch.arange(rays, device=device) % 7 - 3).int()


def gather_arguments(scene: Scene) -> list[Any]:
    """Three cameras, a third of whose pixels have no ray, and rows of random slots around the field's distance."""
    v = scene.voxels
    found, windows, pixels, rays = cameras(scene), [], [], 0
    for width, height in SIZES:
        window = torch.full((height + 2, width + 2), -1, dtype=torch.int32)
        kept = normal(v, height, width, seed=rays + 1).cpu() > -0.4
        window[1:-1, 1:-1][kept] = torch.arange(rays, rays + int(kept.sum()), dtype=torch.int32)
        windows.append([-1, -1, width + 2, height + 2])
        pixels.append(window.flatten())
        rays += int(kept.sum())
    counts = (8 + 4 * normal(v, rays)).long().clamp(min=0)
    starts = torch.cat([counts.new_zeros(1), counts.cumsum(0)])
    first = (10 + 3 * normal(v, rays, seed=2)).int()
    return [
        *scene.field,
        scene.coordinates,
        torch.stack([k @ r for k, r, _ in found]).to(v),
        torch.stack([center for *_, center in found]).to(v),
        torch.tensor(windows, device=v.device),
        torch.cat(pixels).to(v.device),
        0.4 * normal(v, len(found)).clamp(-1, 1),
        scene.step,
        starts,
        first,
        5,
        normal(v, int(starts[-1]), 4),
        normal(v, *v.shape),
    ]


def settled(name: str, outputs: Sequence[Tensor]) -> list[Tensor]:
    """What an op returned, with 0 for depths that are rounding."""
    settled = list(outputs)
    if name in TRANSMITTANCE:
        at = TRANSMITTANCE[name]
        least = (
            0.001 if name == "march_forward" else 0.01
        )  # what codes and floats are held to is narrower there
        settled[at + 1] = settled[at + 1].where(has_depth(settled[at], least), 0)
    return settled


def cloned(arguments: Sequence[Any]) -> list[Any]:
    return [a.clone() if isinstance(a, Tensor) else a for a in arguments]


def run(module: ModuleType, name: str, arguments: Sequence[Any]) -> list[Tensor]:
    """All that an op returns or writes."""
    given = list(arguments)
    for i in WRITES.get(name, []):
        given[i] = given[i].clone(memory_format=torch.contiguous_format)
    returned = getattr(module, name)(*given)
    outputs = [] if returned is None else [returned] if isinstance(returned, Tensor) else list(returned)
    outputs = settled(name, outputs)
    outputs += [given[i] for i in WRITES.get(name, [])]
    if name == "photometric_lattice":
        outputs[-1] = outputs[-1] * reads_voxels(given)[:, None]
    return outputs


def reads_voxels(lattice_arguments: Sequence[Any]) -> Tensor:
    """[S] bool: slots whose samples read a stored voxel. Elsewhere distances do not change along a ray, so that rounding
    decides whether a_k = min(1, ...) has a derivative."""
    _, table, frame, origins, directions, shift, *_ = lattice_arguments
    step, (starts, first) = lattice_arguments[12], lattice_arguments[17:19]
    ray = torch.arange(len(first), device=first.device).repeat_interleave(starts.diff())
    k = torch.arange(len(ray), device=first.device) - starts[ray] + first[ray]
    points = origins[ray] + ((k + 0.5 + shift[ray]) * step)[:, None] * directions[ray]
    index, weight, _ = reference.corners(points, table, frame)
    return ((table[(index // reference.TILE).unbind(-1)] >= 0) & (weight > 1e-6)).any(-1)


def raw(name: str, arguments: Sequence[Any]) -> tuple[Any, tuple[Any, ...]]:
    """The overload in torch.ops and its arguments, which for some ops stand in another order."""
    given = tuple(cloned(arguments))
    if name == "adam_step":
        given = (*given[:7], 0.9, 0.99, 1e-8, given[7], 5, True)
    if name == "photometric_lattice":
        given = (*given[:10], None, None, 1, *given[10:17], False, *given[17:])
    if name == "photometric_step":
        voxels, groups = given[0], given[-1]
        gradients = given[3].new_empty(groups, *voxels.shape)
        given = (*given[:10], None, None, 1, *given[10:-1], False, gradients)
    return getattr(torch.ops.torch_surfcap, name).default, given


MODES = (TRANSPARENCY, reference.DISTANCE)
