"""The fit: from a capture to a field and a mesh, level by level."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from torch_surfcap import codes, ops
from torch_surfcap.autograd import March
from torch_surfcap.data.capture import Capture
from torch_surfcap.data.checks import prepare
from torch_surfcap.errors import InputError
from torch_surfcap.field.field import MISSING, SLOPE, SurfaceField
from torch_surfcap.fitting.budget import Budget, estimate, shortage
from torch_surfcap.fitting.descent import Stopwatch, descend
from torch_surfcap.fitting.levels import Level, first_field, next_level, plan_levels, subject_box
from torch_surfcap.fitting.rays import choose_backdrop, gather_rays
from torch_surfcap.fitting.settings import FitSettings

if TYPE_CHECKING:
    import trimesh

DEFAULT_DEGREE = 1


@dataclass
class FitResult:
    """What a fit gives.

    field, mesh: the surface. history: one row per iteration, with its level. gain, bias: [N, 3] per camera.
    chosen: what the program chose and why. seconds: per stage and level. warnings: one sentence each.
    """

    field: SurfaceField
    mesh: trimesh.Trimesh
    history: list[dict[str, float]]
    gain: Tensor
    bias: Tensor
    chosen: dict[str, Any]
    seconds: dict[str, Any] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class Progress:
    """Where a fit is: level ``number`` (from 0) of ``levels``, its ``voxels``, and the row of history just finished;
    before the first level, ``row`` is empty and ``budget`` says what the fit will need."""

    number: int
    levels: int
    level: Level
    voxels: int
    row: dict[str, float]
    budget: Budget | None = None


def fit(capture: Capture, progress: Callable[[Progress], None] | None = None, **settings: Any) -> FitResult:
    """Fit a field to the photographs of a capture and take its mesh.

    Args:
        capture: its training views; held-out views are never looked at.
        progress: called before the first level and after every iteration.
        settings: see :class:`torch_surfcap.fitting.settings.FitSettings`.

    Raises:
        InputError: no silhouettes, no common view volume, an empty hull, no memory for even the first level.
        TypeError, ValueError: unknown or impossible settings.

    >>> import torch_surfcap as sc
    >>> result = sc.fit(sc.load_capture("capture"), sh_degree=0)  # doctest: +SKIP
    >>> result.mesh.export("mesh.ply")  # doctest: +SKIP
    """
    s = FitSettings.of(**settings)
    report = progress or (lambda _: None)
    if s.device != "cpu":
        raise InputError(f"device: found {s.device}, expected cpu: this build has no CUDA kernels")
    seconds: dict[str, Any] = {}
    watch = Stopwatch(seconds)
    capture = prepare(capture)
    degree = DEFAULT_DEGREE if s.sh_degree is None else s.sh_degree
    box = subject_box(capture, s.box)
    plan = plan_levels(capture, box, s.voxel, s.levels)
    pictures = [capture]
    while len(pictures) <= plan[0].halvings:
        pictures.append(pictures[-1].halved())
    backdrop = choose_backdrop(capture)
    grid, store = first_field(pictures[plan[0].halvings], box, plan[0].voxel_size, s.opacity, degree)
    watch.lap("hull")
    budget = estimate(capture, plan, grid, store, s)
    report(Progress(0, len(plan), plan[0], 0, {}, budget))

    history: list[dict[str, float]] = []
    warnings = list(capture.warnings)
    by_level: list[dict[str, float]] = []
    generator = torch.Generator().manual_seed(s.seed)
    rays, march = None, None
    for number, level in enumerate(plan):
        missing = shortage(budget.level_bytes[number])
        if missing:
            sentence = f"level {number + 1} of {len(plan)} (voxels of {level.voxel_size:.4g}) {missing}"
            if number == 0:
                raise InputError(f"memory: {sentence}")
            warnings.append(f"{sentence}; the fit ends with the level before")
            break
        spent: dict[str, float] = {}
        level_watch = Stopwatch(spent)
        if rays is not None and march is not None:
            store = codes.decode(store, *MISSING[s.opacity])
            grid, store = next_level(grid, store, s.opacity, rays, march)
        store = codes.encode(store, *MISSING[s.opacity], s.storage)
        step = s.descent.last_step if number == len(plan) - 1 else s.descent.step
        march = March(ops.OPACITY[s.opacity], SLOPE, step * level.voxel_size, s.descent.stop)
        rays = gather_rays(pictures[level.halvings], store, grid, s.opacity, march, backdrop)
        level_watch.lap("prepare")
        for row in descend(store, grid, rays, s, march, level.iterations, generator, spent):
            history.append({"level": float(number)} | row)
            report(Progress(number, len(plan), level, len(store) * ops.TILE**3, row))
        by_level.append(spent)
    watch.lap("fit")
    surface = SurfaceField(codes.decode(store, *MISSING[s.opacity]), grid, s.opacity)
    mesh = surface.extract_mesh(s.threshold, s.smooth, s.specks)
    watch.lap("mesh")
    if len(mesh.faces) == 0:
        raise InputError("surface: the fit ended without any, expected a subject inside the silhouettes")
    seconds["levels"] = by_level
    identity = torch.ones(len(capture), 3)
    cut = "memory" if len(by_level) < len(plan) else None
    chosen = {
        "sh_degree": {"value": degree, "reason": "default" if s.sh_degree is None else "given"},
        "voxel": {
            "value": surface.voxel_size,
            "reason": cut or ("a pixel's footprint" if s.voxel is None else "given"),
        },
        "levels": {
            "value": len(by_level),
            "reason": cut or ("size of the pictures" if s.levels is None else "given"),
        },
        "box": {
            "value": [*box[0].tolist(), *box[1].tolist()],
            "reason": "silhouettes" if s.box is None else "given",
        },
    }
    return FitResult(surface, mesh, history, identity, torch.zeros_like(identity), chosen, seconds, warnings)
