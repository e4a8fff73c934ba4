"""A level of a small fit, before its first iteration."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from torch_surfcap import Capture
from torch_surfcap.fitting.levels import first_field, plan_levels, subject_box
from torch_surfcap.fitting.settings import FitSettings
from torch_surfcap.fitting.stage import Stage, Studio, begin_stage, open_studio


def begun(capture: Capture, voxel: float, iterations: int, **given: Any) -> tuple[Stage, Studio, FitSettings]:
    """The only level of a fit of SH degree 1, with its full pictures; what ``descend`` takes."""
    settings = FitSettings.of(**given).suited(capture.mask_source)
    box = subject_box(capture, None)
    plan = [replace(plan_levels(capture, box, voxel, 1)[0], iterations=iterations)]
    studio = open_studio(capture, settings, 0)
    grid, store = first_field(capture, box, voxel, settings)
    return begin_stage(settings, plan, 0, grid, store, studio), studio, settings
