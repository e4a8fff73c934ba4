"""The course of a fit: its levels one after the other, what memory allows of them, and the cameras judged in between."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from torch_surfcap import devices, ops
from torch_surfcap.data.capture import Capture
from torch_surfcap.errors import InputError
from torch_surfcap.field.tiles import TileGrid
from torch_surfcap.fitting import alignment, outliers
from torch_surfcap.fitting.budget import Budget, estimate, lack, shortage
from torch_surfcap.fitting.checkpoint import Checkpoints, Record, Saved
from torch_surfcap.fitting.descent import descend
from torch_surfcap.fitting.late import Stopwatch
from torch_surfcap.fitting.levels import Level, first_field
from torch_surfcap.fitting.settings import FitSettings
from torch_surfcap.fitting.stage import (
    Outcome,
    Stage,
    Studio,
    begin_stage,
    may_refine,
    next_stage,
    rendered,
)


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


@dataclass
class Course:
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
        left = [i for i, name in enumerate(self.capture.names) if name not in so_far.left_out]
        grid, store = self._first_field(self.studio.pictures[-1].subset(left))
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
            moved_by = alignment.displacements(studio.given[0], studio.motion, stage.grid)
            known = [i for i, name in enumerate(self.capture.names) if name not in so_far.left_out]
            shift = moved_by.norm(dim=1)
            usual = float(shift[known].median())
            so_far.shift = {self.capture.names[i]: float(shift[i]) for i in known}
            if alignment.is_off(moved_by[known] / 2**stage.level.halvings):
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
