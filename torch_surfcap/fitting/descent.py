"""One level: full-batch gradient descent until the loss stops falling."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from dataclasses import dataclass, field

import torch
from torch import Tensor

from torch_surfcap import ops
from torch_surfcap.autograd import March
from torch_surfcap.field.field import MISSING
from torch_surfcap.field.tiles import TileGrid
from torch_surfcap.fitting.adam import TileAdam
from torch_surfcap.fitting.rays import RayBatch, find_ranges
from torch_surfcap.fitting.settings import FitSettings

REFRESH = 8.0  # iterations at full rate after which the integration ranges are found anew: less than a voxel of motion
GROUP_BYTES = 256 << 20  # for partial gradients; their number follows from the size of the problem alone
GROUPS = (4, 32)  # fewest, most
CODE_GROUPS = 2  # the same beside codes, whose reason is to save memory
PARSIMONY_HUBER = 0.1
BEND = (
    0.4  # voxels^-1, the sum of curvatures above which bending costs linearly: edges and thin parts survive
)

RAY_LOSSES = ("photo", "sample", "mask")
VOXEL_LOSSES = ("tv_opacity", "tv_color", "parsimony", "ballooning", "curvature")


@dataclass
class Plateau:
    """When to lower the rates and when to end a level.

    Each time the loss fell, over ``window`` iterations, by no more than ``gain`` of itself and no more than ``share`` of
    its way since the top (photographs leave a rest that no field explains), the rates fall by ``factor``; the last of
    ``drops`` times ends the level, as do ``limit`` iterations. The top is where the loss was highest in the first two
    windows: after a change of level Adam's first steps overshoot.

    >>> rule = Plateau(limit=100)
    >>> sum(rule.goes_on(1.0) for _ in range(100))
    11
    """

    limit: int
    gain: float = 0.02
    share: float = 0.03
    window: int = 5
    factor: float = 0.3
    drops: int = 2
    scale: float = 1.0
    count: int = 0
    top: float = -math.inf
    losses: list[float] = field(default_factory=list)

    def goes_on(self, loss: float) -> bool:
        """Takes the loss of an iteration; whether another one follows."""
        self.count += 1
        if loss > self.top and self.count <= 2 * self.window:
            self.top = loss
            self.losses.clear()
        self.losses.append(loss)
        if len(self.losses) > self.window:
            least = max(0.0, min(self.gain * loss, self.share * (self.top - loss)))
            if self.losses[-1 - self.window] - loss <= least:
                self.drops -= 1
                self.scale *= self.factor
                self.losses.clear()
        return self.drops > 0 and self.count < self.limit


def gradient_groups(numbers: int) -> int:
    """How many partial gradients a field of so many numbers gets: as many as fit a fixed memory, whatever the threads."""
    return max(GROUPS[0], min(GROUPS[1], GROUP_BYTES // (4 * max(numbers, 1))))


def partial_gradients(store: Tensor, accumulator: int) -> Tensor:
    """Memory for the partial gradients [groups, T, 4, 4, 4, P] of a field of floats or codes, in so many bits."""
    groups = gradient_groups(store.numel()) if store.is_floating_point() else CODE_GROUPS
    return torch.empty(groups, *store.shape, dtype={32: torch.float32, 16: torch.float16}[accumulator])


def descend(
    store: Tensor,
    grid: TileGrid,
    rays: RayBatch,
    settings: FitSettings,
    march: March,
    iterations: int,
    generator: torch.Generator,
    seconds: dict[str, float],
) -> Iterator[dict[str, float]]:
    """Fits ``store`` in place and yields a row of losses (each unweighted, and their weighted sum) per iteration.

    Args:
        iterations: what such a level usually takes; three times as many are the limit.
        generator: of the lattices' shifts. seconds: receives the time spent per stage.
    """
    loss = settings.losses
    ray_weights, voxel_weights = (
        [getattr(loss, name) for name in names] for names in (RAY_LOSSES, VOXEL_LOSSES)
    )
    weights = torch.tensor([*ray_weights, *voxel_weights], dtype=torch.float64)
    frame = grid.frame(*MISSING[settings.opacity])
    bundle = (rays.origins, rays.directions)
    seen = (rays.background, rays.target, rays.mask, rays.weight)
    gradients = partial_gradients(store, settings.accumulator)
    stochastic = settings.rounding == "stochastic"
    adam = TileAdam(store, settings.opacity, settings.descent, settings.seed, stochastic)
    rule = Plateau(limit=3 * iterations)
    watch = Stopwatch(seconds)
    goes_on, moved = True, 0.0
    while goes_on:
        if moved >= REFRESH:
            moved = 0.0
            rays.ranges = find_ranges(store, grid, settings.opacity, march, *bundle)
            watch.lap("ranges")
        shift = (torch.rand(len(rays), generator=generator) - 0.5) * settings.descent.jitter
        ray_losses, gradient, _, _ = ops.photometric_step(
            store,
            grid.table,
            frame,
            *bundle,
            shift,
            *seen,
            **march._asdict(),
            huber=loss.huber,
            weights=ray_weights,
            detach_sample=loss.detach_sample,
            ranges=rays.ranges,
            gradients=gradients,
        )
        watch.lap("march")
        voxel_losses = ops.voxel_terms(
            store, grid.table, frame, grid.places, voxel_weights, PARSIMONY_HUBER, BEND, gradient
        )
        watch.lap("voxels")
        adam.step(gradient, rule.scale)
        moved += rule.scale
        watch.lap("adam")
        losses = torch.cat([ray_losses, voxel_losses])
        total = float(losses @ weights)
        row = {"iteration": float(rule.count), "loss": total, "rate": rule.scale}
        goes_on = rule.goes_on(total)
        yield row | dict(zip(RAY_LOSSES + VOXEL_LOSSES, losses.tolist(), strict=True))


class Stopwatch:
    """Adds up seconds by stage."""

    def __init__(self, seconds: dict[str, float]) -> None:
        self.seconds = seconds
        self.last = time.perf_counter()

    def lap(self, stage: str) -> None:
        now = time.perf_counter()
        self.seconds[stage] = self.seconds.get(stage, 0.0) + now - self.last
        self.last = now
