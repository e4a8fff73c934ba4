"""The fit: from a capture to a field and a mesh."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from torch_surfcap import ops
from torch_surfcap.autograd import March
from torch_surfcap.data.capture import Capture
from torch_surfcap.field.field import MISSING, SLOPE, SurfaceField
from torch_surfcap.field.tiles import TileGrid
from torch_surfcap.fitting.adam import TileAdam
from torch_surfcap.fitting.levels import Level, first_field, next_level, plan_levels, subject_box
from torch_surfcap.fitting.rays import RayBatch, choose_backdrop, find_ranges, gather_rays
from torch_surfcap.fitting.settings import FitSettings

if TYPE_CHECKING:
    import trimesh

RATE_DECAY = 0.1  # of the learning rates over a level's iterations
GROUP_BYTES = 256 << 20  # for partial gradients; their number follows from the size of the problem alone
GROUPS = (4, 32)


@dataclass
class FitResult:
    """field, mesh; history: one row per iteration; gain, bias [N, 3] per camera; chosen: what the program chose."""

    field: SurfaceField
    mesh: trimesh.Trimesh
    history: list[dict[str, float]]
    gain: Tensor
    bias: Tensor
    chosen: dict[str, Any]
    seconds: dict[str, Any] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)


Progress = Callable[[int, Level, int, dict[str, float]], None]


def fit(capture: Capture, progress: Progress | None = None, **settings: Any) -> FitResult:
    s = FitSettings.of(**settings)
    start = time.perf_counter()
    degree = 1 if s.sh_degree is None else s.sh_degree
    box = subject_box(capture, s.box)
    plan = plan_levels(capture, box, s.voxel, s.levels)
    pictures = [capture]
    while len(pictures) <= plan[0].halvings:
        pictures.append(pictures[-1].halved())
    backdrop = None if capture.mask_source == "plate" else choose_backdrop(capture)
    seconds: dict[str, Any] = {"hull": time.perf_counter() - start, "levels": []}
    history: list[dict[str, float]] = []
    generator = torch.Generator().manual_seed(s.seed)
    grid, store, rays = None, None, None
    for number, level in enumerate(plan):
        begin = time.perf_counter()
        if grid is None:
            grid, store = first_field(pictures[level.halvings], box, level.voxel_size, s.opacity, degree)
        else:
            grid, store = next_level(grid, store, s.opacity, rays, s.descent.step * 2 * level.voxel_size, s.descent.stop)
        last = number == len(plan) - 1
        march = March(ops.OPACITY[s.opacity], SLOPE, (s.descent.last_step if last else s.descent.step) * level.voxel_size, s.descent.stop)
        rays = gather_rays(pictures[level.halvings], store, grid, s.opacity, march, backdrop)
        spent = {"prepare": time.perf_counter() - begin, "march": 0.0, "voxels": 0.0, "adam": 0.0}
        for row in descend(store, grid, rays, s, level, march, generator, spent):
            row["level"] = number
            history.append(row)
            if progress:
                progress(number, level, len(store) * 64, row)
        seconds["levels"].append(spent)
    begin = time.perf_counter()
    result = SurfaceField(store, grid, s.opacity)
    mesh = result.extract_mesh(s.threshold, s.smooth, s.specks)
    seconds["mesh"] = time.perf_counter() - begin
    seconds["total"] = time.perf_counter() - start
    views = len(capture)
    return FitResult(result, mesh, history, torch.ones(views, 3), torch.zeros(views, 3), {}, seconds, [])


REFRESH = 8  # iterations after which the integration ranges are found anew


def descend(store, grid, rays, s, level, march, generator, spent):
    frame = grid.frame(*MISSING[s.opacity])
    adam = TileAdam(store, s.opacity, s.descent)
    loss = s.losses
    groups = max(GROUPS[0], min(GROUPS[1], GROUP_BYTES // (4 * store.numel())))
    ray_weights = [loss.photo, loss.sample, loss.mask]
    voxel_weights = [loss.tv_opacity, loss.tv_color, loss.parsimony, loss.ballooning]
    for i in range(level.iterations):
        t0 = time.perf_counter()
        if i and i % REFRESH == 0:
            rays.ranges = find_ranges(store, grid, s.opacity, march, rays.origins, rays.directions)
            spent['ranges'] = spent.get('ranges', 0) + time.perf_counter() - t0
            t0 = time.perf_counter()
        adam.scale = RATE_DECAY ** (i / level.iterations)
        shift = (torch.rand(len(rays), generator=generator) - 0.5) * s.descent.jitter
        ray_losses, gradient, _, _ = ops.photometric_step(
            store, grid.table, frame, rays.origins, rays.directions, shift, rays.background, rays.target, rays.mask,
            rays.weight, *march, loss.huber, ray_weights, loss.detach_sample, groups, rays.ranges,
        )
        t1 = time.perf_counter()
        voxel_losses = ops.voxel_terms(store, grid.table, frame, grid.places, voxel_weights, 0.1, gradient)
        t2 = time.perf_counter()
        adam.step(gradient)
        t3 = time.perf_counter()
        spent["march"] += t1 - t0; spent["voxels"] += t2 - t1; spent["adam"] += t3 - t2
        yield {"iteration": i, "photo": float(ray_losses[0]), "sample": float(ray_losses[1]), "mask": float(ray_losses[2]),
            "loss": float(ray_losses @ ray_losses.new_tensor(ray_weights) + voxel_losses @ voxel_losses.new_tensor(voxel_weights))}
