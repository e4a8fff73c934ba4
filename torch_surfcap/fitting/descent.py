"""One level: full-batch gradient descent until the loss stops falling."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import torch

from torch_surfcap import ops
from torch_surfcap.field.field import MISSING
from torch_surfcap.fitting.alignment import Registration
from torch_surfcap.fitting.budget import partial_gradients
from torch_surfcap.fitting.gathered import COSINES, GatheredGradient
from torch_surfcap.fitting.late import Reading, Row, Stopwatch
from torch_surfcap.fitting.settings import PARSIMONY_HUBER, FitSettings
from torch_surfcap.fitting.stage import Stage, Studio

REFRESH = 8.0  # iterations at full rate after which the integration ranges are found anew: less than a voxel of motion

RAY_ARGUMENTS = ("origins", "directions", "background", "target", "mask", "weight")
RAY_LOSSES = ("photo", "sample", "mask")
VOXEL_LOSSES = ("tv_opacity", "tv_color", "parsimony", "ballooning", "curvature")
BALLOONING, CURVATURE = (VOXEL_LOSSES.index(name) for name in ("ballooning", "curvature"))
GAINS_EVERY = 5  # iterations between two fits of the cameras' gains
FIRST_GAINS = 10  # iterations before the first: until then the field is grey and says nothing
ALIGN_EVERY = 5  # iterations between two registrations of the photographs
FIRST_ALIGN = 30  # iterations before the first: until then the field is coarser than the pictures
LAST_ALIGN = 10  # iterations of the last level after which cameras stay: what is left is too little to see


def descend(stage: Stage, studio: Studio, settings: FitSettings) -> Iterator[dict[str, float]]:
    """Fits ``stage.store`` in place until the level ends, and yields a row of losses (each unweighted, and their weighted
    sum) per iteration; smoothness and parsimony of a view-dependent colour on its own grid are not among them. Between two
    rows, all that the next one depends on lies in ``stage`` and ``studio``.

    On a GPU an iteration waits for nothing but new integration ranges, whose number the host must know: its row comes
    after the next iteration was begun, and the rule that ends the level knows the losses up to the one before.
    """
    loss = settings.losses
    ray_weights, voxel_weights = (
        [getattr(loss, name) for name in names] for names in (RAY_LOSSES, VOXEL_LOSSES)
    )
    if not stage.level.last:
        voxel_weights[CURVATURE] *= loss.coarse_curvature
    store, grid, rays, rule, view = stage.store, stage.grid, stage.rays, stage.rule, stage.view
    lag = 0 if store.device.type == "cpu" else 1
    frame = grid.frame(*MISSING[settings.opacity])
    arguments: dict[str, Any] = {
        "voxels": store,
        "table": stage.table(settings),
        "frame": frame,
        **{name: getattr(rays, name) for name in RAY_ARGUMENTS},
        **stage.march._asdict(),
        "huber": loss.huber,
        "weights": ray_weights,
        "detach_sample": loss.detach_sample,
        "rendered_sample": loss.sample_target == "rendered",
        "bundle": rays.bundle,
    }
    gathered = GatheredGradient(rays, grid, settings, stage.march) if settings.gradient == "gather" else None
    gradients = None if gathered else partial_gradients(store, settings.accumulator)
    samples = rays.samples(stage.march.step)
    given = studio.given[stage.level.halvings]
    registration = Registration.of(rays, given, grid) if studio.refines else None
    if gathered and registration:
        gathered.look(registration.pinholes.projections(studio.motion))
    watch = Stopwatch(stage.seconds, store.device)
    while stage.goes_on:
        iteration = rule.count + len(stage.waiting)
        if stage.moved >= REFRESH:
            stage.moved = 0.0
            rays.find_ranges(store, grid, settings.opacity, stage.march)
            samples = rays.samples(stage.march.step)
            if gathered:
                gathered.lay_out()
            watch.lap("ranges")
        lattices = len(rays.cameras) if gathered else len(rays)
        shift = torch.rand(lattices, generator=studio.generator, device=store.device) - 0.5
        shift = (shift * settings.descent.jitter).to(rays.mask.dtype)
        if view:
            offset = view.seen_by(rays)
            arguments |= {"target": rays.target - offset, "background": rays.background - offset}
            watch.lap("view")
        arguments["shift"] = gathered.per_ray(shift) if gathered else shift
        cosines = []
        if gathered:
            ray_losses, gradient, color, transmittance, depth = gathered.step(arguments, shift, watch)
            if rule.scale != stage.compared:
                cosines, stage.compared = [gathered.cosines(arguments)], rule.scale
                watch.lap("compare")
        else:
            ray_losses, gradient, color, transmittance, depth = ops.photometric_step(
                **arguments, ranges=rays.ranges, gradients=gradients
            )
            watch.lap("march")
        if view:
            residual = color - arguments["target"]
            view.step(rays, residual, transmittance, depth, loss, rule.scale)
            color += offset
            watch.lap("view")
        if loss.anneal:  # the bias helps to find a surface, and then stands in its way
            voxel_weights[BALLOONING] = loss.ballooning * rule.scale
        voxel_losses = ops.voxel_terms(
            store, grid.table, frame, grid.places, voxel_weights, PARSIMONY_HUBER, loss.bend, gradient
        )
        watch.lap("voxels")
        stage.adam.step(gradient, rule.scale)
        stage.moved += rule.scale
        watch.lap("adam")
        if studio.gains and (stage.number > 0 or iteration >= FIRST_GAINS) and iteration % GAINS_EVERY == 0:
            studio.fit_exposure(stage, color, transmittance)
            watch.lap("gains")
        if registration and iteration % ALIGN_EVERY == 0 and _may_align(stage, iteration):
            studio.align(stage, registration, color, transmittance)
            if gathered:
                gathered.look(registration.pinholes.projections(studio.motion))
            watch.lap("align")
        known = {
            "samples": samples,
            "iteration": float(iteration),
            "loss": math.nan,  # until it is read
            "rate": rule.scale,
        }
        values = Reading(torch.cat([ray_losses, voxel_losses, *cosines]))
        names = RAY_LOSSES + VOXEL_LOSSES + COSINES * len(cosines)
        stage.waiting.append(Row(known, values, names, [*ray_weights, *voxel_weights]))
        while len(stage.waiting) > lag:
            yield stage.told()
    while stage.waiting:
        yield stage.told()
    watch.stop()


def _may_align(stage: Stage, iteration: int) -> bool:
    """Whether cameras are refined at this time of a level."""
    if stage.level.last:
        return iteration <= LAST_ALIGN
    return stage.number > 0 or iteration >= FIRST_ALIGN
