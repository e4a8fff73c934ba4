"""The fit: from a capture to a field and a mesh, level by level."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from torch import Tensor

from torch_surfcap import ops
from torch_surfcap.data.capture import Capture
from torch_surfcap.data.checks import prepare
from torch_surfcap.data.floor import find_floor
from torch_surfcap.errors import InputError
from torch_surfcap.field.field import SurfaceField
from torch_surfcap.fitting.budget import Budget, estimate, shortage
from torch_surfcap.fitting.checkpoint import Checkpoints, Record
from torch_surfcap.fitting.descent import descend
from torch_surfcap.fitting.levels import Level, first_field, plan_levels, subject_box
from torch_surfcap.fitting.settings import FitSettings
from torch_surfcap.fitting.stage import Stage, Stopwatch, Studio, begin_stage, next_stage, open_studio

if TYPE_CHECKING:
    import trimesh


@dataclass
class FitResult:
    """What a fit gives.

    field, mesh: the surface. history: one row per iteration, with its level. gain, bias: [N, 3] per camera.
    chosen: what the program chose and why. seconds: per stage and level. warnings: one sentence each. resumed_from:
    [level, iteration] of the checkpoint that the fit began with, None without one. iterations_run: since then.
    """

    field: SurfaceField
    mesh: trimesh.Trimesh
    history: list[dict[str, float]]
    gain: Tensor
    bias: Tensor
    chosen: dict[str, Any]
    seconds: dict[str, Any] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)
    resumed_from: list[int] | None = None
    iterations_run: int = 0

    @property
    def gains(self) -> bool:
        """Whether the cameras were brought to a common exposure."""
        return bool(self.chosen["gains"]["value"] == "on")


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


def fit(
    capture: Capture,
    progress: Callable[[Progress], None] | None = None,
    checkpoints: Checkpoints | None = None,
    **settings: Any,
) -> FitResult:
    """Fit a field to the photographs of a capture and take its mesh.

    Args:
        capture: its training views; held-out views are never looked at.
        progress: called before the first level and after every iteration.
        checkpoints: where the fit leaves them, and whether it begins with one.
        settings: see :class:`torch_surfcap.fitting.settings.FitSettings`.

    Raises:
        InputError: no silhouettes, no common view volume, an empty hull, no memory for even the first level, a
            checkpoint of another fit.
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
    s = s.suited(capture.mask_source)
    saved = None if checkpoints is None else checkpoints.load()
    if saved is not None and checkpoints is not None:
        checkpoints.check(saved, s, capture)
    box = subject_box(capture, s.box) if saved is None else saved.box
    plan = plan_levels(capture, box, s.voxel, s.levels)
    watch.lap("box")
    floor = find_floor(capture, box) if s.floor == "auto" else None
    watch.lap("floor")
    studio = open_studio(capture, s, plan[0].halvings, floor)
    so_far = Record(list(capture.warnings))
    if saved is None:
        grid, store = first_field(studio.pictures[-1], box, plan[0].voxel_size, s, floor)
        watch.lap("hull")
        budget = estimate(capture, plan, grid, store, s)
        so_far.level_bytes = budget.level_bytes
        report(Progress(0, len(plan), plan[0], 0, {}, budget))
        missing = short_of(plan, 0, so_far.level_bytes)
        if missing:
            raise InputError(f"memory: {missing}")
        stage = begin_stage(s, plan, 0, grid, store, studio)
    else:
        stage, so_far = saved.stage(s, plan, studio), Record(**saved.plain["record"])
        watch.lap("resume")
    resumed = len(so_far.history)

    while True:
        for row in descend(stage, studio, s):
            so_far.history.append({"level": float(stage.number)} | row)
            report(Progress(stage.number, len(plan), stage.level, len(stage.store) * ops.TILE**3, row))
            if checkpoints is not None and checkpoints.due():
                checkpoints.save(s, capture, box, stage, studio, so_far)
        so_far.seconds.append(stage.seconds)
        if stage.number == len(plan) - 1:
            break
        missing = short_of(plan, stage.number + 1, so_far.level_bytes)
        if missing:
            so_far.warnings.append(f"{missing}; the fit ends with the level before")
            break
        stage = next_stage(stage, s, plan, studio)
        if checkpoints is not None:
            checkpoints.save(s, capture, box, stage, studio, so_far)
    watch.lap("fit")
    step = stage.march.step / stage.grid.voxel_size
    view = None if stage.view is None else stage.view.field()
    surface = SurfaceField(stage.decoded(s.opacity, floor), stage.grid, s.opacity, step, view)
    mesh = surface.extract_mesh(s.threshold, s.smooth, s.specks)
    watch.lap("mesh")
    if len(mesh.faces) == 0:
        raise InputError("surface: the fit ended without any, expected a subject inside the silhouettes")
    seconds["levels"] = so_far.seconds
    return FitResult(
        surface,
        mesh,
        so_far.history,
        studio.exposure.gain,
        studio.exposure.bias,
        _chosen(s, box, stage, plan, studio),
        seconds,
        so_far.warnings,
        None if saved is None else saved.place,
        len(so_far.history) - resumed,
    )


def short_of(plan: list[Level], number: int, level_bytes: list[int]) -> str | None:
    """What a level lacks, None where there is memory for it."""
    missing = shortage(level_bytes[number])
    return (
        missing and f"level {number + 1} of {len(plan)} (voxels of {plan[number].voxel_size:.4g}) {missing}"
    )


def _chosen(
    s: FitSettings, box: tuple[Tensor, Tensor], stage: Stage, plan: list[Level], studio: Studio
) -> dict[str, Any]:
    """What the fit chose, and why."""
    cut = "memory" if stage.number < len(plan) - 1 else None
    return {
        "sh_degree": {"value": s.degree, "reason": "default" if s.sh_degree is None else "given"},
        "voxel": {
            "value": stage.grid.voxel_size,
            "reason": cut or ("a pixel's footprint" if s.voxel is None else "given"),
        },
        "levels": {
            "value": stage.number + 1,
            "reason": cut or ("size of the pictures" if s.levels is None else "given"),
        },
        "box": {
            "value": [*box[0].tolist(), *box[1].tolist()],
            "reason": "silhouettes" if s.box is None else "given",
        },
        "floor": {
            "value": studio.floor and [*studio.floor.normal.tolist(), studio.floor.offset],
            "reason": "off" if s.floor == "off" else "plates" if studio.floor else "none seen",
        },
        "mask": {"value": s.losses.mask, "reason": f"silhouettes by {studio.pictures[0].mask_source}"},
        "gains": {
            "value": "on" if studio.gains else "off",
            "spread": studio.exposure.spread(),
            "reason": "default" if s.gains == "auto" else "given",
            "cameras": {
                name: {"gain": gain.tolist(), "bias": bias.tolist()}
                for name, gain, bias in zip(
                    studio.pictures[0].names, studio.exposure.gain, studio.exposure.bias, strict=True
                )
                if studio.gains
            },
        },
    }
