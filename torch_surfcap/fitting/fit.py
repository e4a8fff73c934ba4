"""The fit: from a capture to a field and a mesh, level by level."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from torch_surfcap import devices, ops
from torch_surfcap.data.capture import Capture
from torch_surfcap.data.checks import leave_out, prepare
from torch_surfcap.data.floor import Floor, find_floor
from torch_surfcap.errors import InputError
from torch_surfcap.field.field import SurfaceField
from torch_surfcap.field.tiles import TileGrid
from torch_surfcap.fitting import alignment, outliers
from torch_surfcap.fitting.budget import Budget, estimate, lack, shortage
from torch_surfcap.fitting.checkpoint import Checkpoints, Record, Saved
from torch_surfcap.fitting.descent import descend
from torch_surfcap.fitting.late import Stopwatch
from torch_surfcap.fitting.levels import Level, first_field, plan_levels, subject_box
from torch_surfcap.fitting.settings import FitSettings
from torch_surfcap.fitting.stage import (
    Outcome,
    Stage,
    Studio,
    begin_stage,
    may_refine,
    next_stage,
    open_studio,
    rendered,
)

if TYPE_CHECKING:
    import trimesh


@dataclass
class FitResult:
    """What a fit gives.

    field, mesh: the surface, the field on the device of the fit, or on the CPU where memory ran out there. history: one
    row per iteration, with its level. gain, bias: [N, 3] per camera.
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

    @property
    def motion(self) -> dict[str, list[float]]:
        """By the names of the cameras whose calibration was refined: shift (2), zoom and roll of the picture plane."""
        return self.chosen.get("cameras", {}).get("motion", {})


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
        InputError: a device that cannot be used, no silhouettes, no common view volume, an empty hull, no memory for even
            the first level, a checkpoint of another fit.
        TypeError, ValueError: unknown or impossible settings.

    >>> import torch_surfcap as sc
    >>> result = sc.fit(sc.load_capture("capture"), sh_degree=0)  # doctest: +SKIP
    >>> result.mesh.export("mesh.ply")  # doctest: +SKIP
    """
    s = FitSettings.of(**settings)
    device = devices.resolve(s.device)
    with devices.current(device):
        return _fit(capture, progress or (lambda _: None), checkpoints, replace(s, device=str(device)))


def _fit(
    capture: Capture, report: Callable[[Progress], None], checkpoints: Checkpoints | None, s: FitSettings
) -> FitResult:
    """See :func:`fit`."""
    seconds: dict[str, Any] = {}
    watch = Stopwatch(seconds)
    capture = prepare(capture)
    left_out: dict[str, str] = {}
    if s.reject == "auto":
        capture, left_out = _without_contradicting(capture)
        watch.lap("reject")
    s = s.suited(capture.mask_source)
    saved = None if checkpoints is None else checkpoints.load()
    if saved is not None and checkpoints is not None:
        checkpoints.check(saved, s, capture)
    box = subject_box(capture, s.box) if saved is None else saved.box
    plan = plan_levels(capture, box, s.voxel, s.levels, s.voxel_pixels)
    watch.lap("box")
    floor = find_floor(capture, box) if s.floor == "auto" else None
    watch.lap("floor")
    studio = open_studio(capture, s, plan[0].halvings, floor, origin=(box[0] + box[1]) / 2)
    so_far = Record(list(capture.warnings)) if saved is None else Record(**saved.plain["record"])
    so_far.left_out = left_out | so_far.left_out
    run = _Run(s, capture, box, plan, studio, so_far, saved, checkpoints, report)
    resumed = len(so_far.history)
    outcome = run.outcome(watch)
    watch.lap("fit")
    surface = outcome.surface(s.opacity, studio)
    mesh = surface.extract_mesh(s.threshold, s.smooth, s.specks)
    watch.lap("mesh")
    if len(mesh.faces) == 0:
        raise InputError("surface: the fit ended without any, expected a subject inside the silhouettes")
    seconds["levels"] = so_far.seconds
    if so_far.abandoned:
        seconds["abandoned"] = so_far.abandoned
    exposure = studio.exposure = studio.exposure.cpu()
    return FitResult(
        surface,
        mesh,
        so_far.history,
        exposure.gain,
        exposure.bias,
        _chosen(s, box, floor, outcome, plan, studio, so_far),
        seconds,
        so_far.warnings,
        None if saved is None else saved.place,
        len(so_far.history) - resumed,
    )


def _without_contradicting(capture: Capture) -> tuple[Capture, dict[str, str]]:
    """The capture without the cameras whose silhouettes contradict the others', and why, by name."""
    found = outliers.by_silhouettes(capture)
    if not found:
        return capture, {}
    kept = leave_out(capture, found)
    kept.prepared, kept.test = capture.prepared, capture.test
    return kept, {capture.names[i]: why for i, why in found.items()}


@dataclass
class _Run:
    """The levels of a fit, one after the other."""

    settings: FitSettings
    capture: Capture
    box: tuple[Tensor, Tensor]
    plan: list[Level]
    studio: Studio
    so_far: Record
    saved: Saved | None
    checkpoints: Checkpoints | None
    report: Callable[[Progress], None]
    begin_again: bool = False

    def outcome(self, watch: Stopwatch) -> Outcome:
        """Of the last level, or of the one before that for which there is no memory.

        Raises InputError where that is the first one, or the first one after a checkpoint.
        """
        s, device, before = self.settings, torch.device(self.settings.device), None
        number = 0 if self.saved is None else self.saved.place[0]
        self._leave_out()
        try:
            stage = self._begin(watch)
            self._descend(stage)
        except torch.OutOfMemoryError as error:
            raise InputError(f"memory: {self._short_of(number, ran_out=True)}") from error
        while number < len(self.plan) - 1:
            if self.begin_again:
                number, before, stage = 0, None, self._again()
                continue
            number += 1
            missing = self._short_of(number)
            if missing is None:
                # The level before is needed again only where memory may run out in the midst of this one.
                before = Outcome.of(stage).to(devices.CPU) if devices.may_run_out(device) else None
                try:
                    stage = next_stage(stage, s, self.plan, self.studio)
                    self._save(stage)
                    self._descend(stage)
                except torch.OutOfMemoryError:
                    missing = self._short_of(number, ran_out=True)
            if missing is not None:
                self.so_far.warnings.append(f"{missing}; the fit ends with the level before")
                return Outcome.of(stage) if before is None or stage.number < number else before
        return Outcome.of(stage)

    def _begin(self, watch: Stopwatch) -> Stage:
        """The first stage, out of the hull or out of the checkpoint."""
        s, plan, studio, so_far = self.settings, self.plan, self.studio, self.so_far
        if self.saved is not None:
            studio.keep_pictures(s.images, so_far.level_bytes)
            stage = self.saved.stage(s, plan, studio)
            watch.lap("resume")
            return stage
        grid, store = self._first_field(studio.pictures[-1])
        watch.lap("hull")
        budget = estimate(self.capture, plan, grid, store, s)
        so_far.level_bytes = budget.level_bytes
        self.report(Progress(0, len(plan), plan[0], 0, {}, budget))
        missing = self._short_of(0)
        if missing is not None:
            raise InputError(f"memory: {missing}")
        studio.keep_pictures(s.images, so_far.level_bytes)
        return begin_stage(s, plan, 0, grid, store, studio)

    def _first_field(self, pictures: Capture) -> tuple[TileGrid, Tensor]:
        """Of the coarsest level, out of the hull of its pictures."""
        low, high = (corner - self.studio.origin for corner in self.box)
        return first_field(pictures, (low, high), self.plan[0].voxel_size, self.settings, self.studio.floor)

    def _again(self) -> Stage:
        """The first level anew, done, without the cameras that were left out after one: what they carved off the hull, no
        level would give back."""
        self.begin_again = False
        so_far, s = self.so_far, self.settings
        so_far.abandoned += sum(sum(level.values()) for level in so_far.seconds)
        so_far.seconds.clear()
        self.studio.motion = torch.zeros_like(self.studio.motion)
        self.studio.refines = may_refine(s, self.plan[0].halvings)
        self.studio.look_again()
        coarsest, names = self.plan[0], self.capture.names
        left = [i for i, name in enumerate(names) if name not in so_far.left_out]
        pictures = self.studio.pictures[coarsest.halvings].subset(left)
        grid, store = self._first_field(pictures)
        stage = begin_stage(s, self.plan, 0, grid, store, self.studio)
        self._save(stage)
        self._descend(stage)
        return stage

    def _descend(self, stage: Stage) -> None:
        """All that is left of a level."""
        for row in descend(stage, self.studio, self.settings):
            self.so_far.history.append({"level": float(stage.number)} | row)
            voxels = len(stage.store) * ops.TILE**3
            self.report(Progress(stage.number, len(self.plan), stage.level, voxels, row))
            if self.checkpoints is not None and self.checkpoints.due():
                self._save(stage)
        self._judge(stage)
        self.so_far.seconds.append(stage.seconds)

    def _judge(self, stage: Stage) -> None:
        """How far the photographs are from the level's field; those that are far have no part in the next level."""
        so_far, watch, names = self.so_far, Stopwatch(stage.seconds, stage.store.device), self.capture.names
        difference = outliers.differences(stage.rays, rendered(stage, self.settings)).cpu()
        so_far.difference = {n: float(x) for n, x in zip(names, difference, strict=True) if x.isfinite()}
        if self.settings.reject == "auto" and stage.number < len(self.plan) - 1:
            found = outliers.by_photographs(difference, len(so_far.left_out))
            self.begin_again = bool(found)
            for i, why in found.items():
                so_far.left_out[names[i]] = why
                so_far.warnings.append(f"camera {names[i]} is left out: {why}")
            self._leave_out()
        self._judge_calibration(stage)
        watch.lap("judge")
        watch.stop()

    def _judge_calibration(self, stage: Stage) -> None:
        """After the second level of three or more, else the first: whether the cameras go on to be refined, or are what
        they were."""
        studio, so_far = self.studio, self.so_far
        if stage.number == min(1, len(self.plan) - 2) and studio.refines:
            shift = alignment.shifts(studio.given[0], studio.motion)
            known = [i for i, name in enumerate(self.capture.names) if name not in so_far.left_out]
            usual = float(shift[known].median())
            so_far.shift = {self.capture.names[i]: float(shift[i]) for i in known}
            off = usual > alignment.OFF * 2**stage.level.halvings
            if off:
                so_far.warnings.append(
                    f"cameras: the photographs lie {usual:.2f} pixels beside what the others show (the median camera), "
                    "the calibration is refined"
                )
            elif self.settings.refine == "auto":
                studio.refines, studio.motion = False, torch.zeros_like(studio.motion)
        studio.look_again()

    def _leave_out(self) -> None:
        """Takes the rays of the cameras that are left out after a level from the levels to come."""
        gone = {i for i, name in enumerate(self.capture.names) if name in self.so_far.left_out}
        if gone:
            self.studio.leave_out(gone)

    def _save(self, stage: Stage) -> None:
        if self.checkpoints is not None:
            s, capture, so_far = self.settings, self.capture, self.so_far
            self.checkpoints.save(s, capture, self.box, stage, self.studio, so_far)

    def _short_of(self, number: int, ran_out: bool = False) -> str | None:
        """What a level lacks, None where there is memory for it; ``ran_out``: where there was not."""
        device, plan = torch.device(self.settings.device), self.plan
        known = self.so_far.level_bytes
        needed = known[number] if known else 0  # not yet known while the first field is made
        missing = lack(needed, devices.free_bytes(device)) if ran_out else shortage(needed, device=device)
        return (
            missing
            and f"level {number + 1} of {len(plan)} (voxels of {plan[number].voxel_size:.4g}) {missing}"
        )


def _chosen(
    s: FitSettings,
    box: tuple[Tensor, Tensor],
    floor: Floor | None,
    outcome: Outcome,
    plan: list[Level],
    studio: Studio,
    so_far: Record,
) -> dict[str, Any]:
    """What the fit chose, and why."""
    footprints = "a pixel's footprint" if s.voxel_pixels == 1 else f"{s.voxel_pixels:g} footprints of a pixel"
    cut = "memory" if outcome.number < len(plan) - 1 else None
    return {
        "sh_degree": {"value": s.degree, "reason": "default" if s.sh_degree is None else "given"},
        "voxel": {
            "value": outcome.grid.voxel_size,
            "reason": cut or (footprints if s.voxel is None else "given"),
        },
        "levels": {
            "value": outcome.number + 1,
            "reason": cut or ("size of the pictures" if s.levels is None else "given"),
        },
        "box": {
            "value": [*box[0].tolist(), *box[1].tolist()],
            "reason": "silhouettes" if s.box is None else "given",
        },
        "cameras": {
            "value": len(so_far.difference),
            "left_out": so_far.left_out,
            "difference": so_far.difference,
            "shift": so_far.shift,
            "motion": studio.motions(),
            "reason": "all that agree" if s.reject == "auto" else "all, as given",
        },
        "floor": {
            "value": floor and [*floor.normal.tolist(), floor.offset],
            "reason": "off" if s.floor == "off" else "plates" if floor else "none seen",
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
