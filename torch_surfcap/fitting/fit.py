"""The fit: from a capture to a field and a mesh, level by level."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

from torch import Tensor

from torch_surfcap import devices
from torch_surfcap.data.capture import Capture
from torch_surfcap.data.checks import leave_out, prepare
from torch_surfcap.data.floor import Floor, find_floor
from torch_surfcap.errors import InputError
from torch_surfcap.field.field import SurfaceField
from torch_surfcap.fitting import outliers
from torch_surfcap.fitting.checkpoint import Checkpoints, Record
from torch_surfcap.fitting.course import Course, Progress
from torch_surfcap.fitting.late import Stopwatch
from torch_surfcap.fitting.levels import Level, plan_levels, subject_box
from torch_surfcap.fitting.settings import FitSettings
from torch_surfcap.fitting.stage import (
    Outcome,
    Studio,
    open_studio,
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
    run = Course(s, capture, box, plan, studio, so_far, saved, checkpoints, report)
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
    return leave_out(capture, found), {capture.names[i]: why for i, why in found.items()}


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
