"""A stage of the fit: one level with all that its iterations read and change."""

from __future__ import annotations

import time
from dataclasses import dataclass, field

import torch
from torch import Tensor

from torch_surfcap import codes, ops
from torch_surfcap.autograd import March
from torch_surfcap.data.capture import Capture
from torch_surfcap.data.floor import Floor
from torch_surfcap.field.field import MISSING, SLOPE
from torch_surfcap.field.tiles import TileGrid
from torch_surfcap.fitting.adam import TileAdam
from torch_surfcap.fitting.color_gain import Exposure
from torch_surfcap.fitting.levels import Level, cut_at_floor, next_level
from torch_surfcap.fitting.plateau import Plateau
from torch_surfcap.fitting.rays import RayBatch, choose_backdrop, gather_rays
from torch_surfcap.fitting.settings import FitSettings
from torch_surfcap.fitting.view_color import ViewColor, begin_view_color


@dataclass
class Studio:
    """What does not belong to one level: the photographs at every size and the cameras' exposure.

    pictures: the capture, halved 0, 1, ... times. backdrop: see ``RayBatch.expose``. generator: of the lattices' shifts.
    gains: whether the exposure is fitted; per_channel: or one gain and bias for all channels of a camera. floor: below
    which nothing is, where one was found.
    """

    pictures: list[Capture]
    backdrop: Tensor | None
    exposure: Exposure
    gains: bool
    per_channel: bool
    generator: torch.Generator
    floor: Floor | None = None

    def fit_exposure(self, stage: Stage, color: Tensor, transmittance: Tensor) -> None:
        """Takes the cameras' gains out of renderings of a stage's rays, [R, 3] and [R], and exposes the rays anew."""
        capture = self.pictures[stage.level.halvings]
        equations = stage.rays.equations(capture, self.backdrop, color, transmittance)
        self.exposure = equations.solve(self.per_channel)
        stage.rays.expose(capture, self.backdrop, self.exposure)


@dataclass
class Stage:
    """One level of the fit.

    number: of the level, from 0. level: its plan. grid, store: the field, padded records [T, 4, 4, 4, P] of floats or of
    codes (see ``torch_surfcap.codes``). moved:
    iterations at full rate since the integration ranges were found. compared: the rate at which the gathered gradient
    was held against the exact one last. seconds: spent per kind of work. view: the view-dependent colour, where it is not in
    the records.
    """

    number: int
    level: Level
    grid: TileGrid
    store: Tensor
    march: March
    rays: RayBatch
    adam: TileAdam
    rule: Plateau
    moved: float = 0.0
    compared: float = 0.0
    seconds: dict[str, float] = field(default_factory=dict)
    view: ViewColor | None = None

    def table(self, settings: FitSettings) -> Tensor:
        """The grid's table, where the whole box is visited without what it says about empty space."""
        return self.grid.table.clamp(min=ops.OUTSIDE) if settings.descent.visit == "box" else self.grid.table

    def decoded(self, opacity: str, floor: Floor | None) -> Tensor:
        """The records in floats, cut at the floor; those of the stage may be so, too."""
        store = codes.decode(self.store, *MISSING[opacity])
        cut_at_floor(self.grid, store, opacity, floor)
        return store


def march_of(settings: FitSettings, level: Level) -> March:
    """How the rays of a level are sampled."""
    step = settings.descent.step_of(level.last) * level.voxel_size
    return March(ops.OPACITY[settings.opacity], SLOPE, step, settings.descent.stop)


def begin_adam(store: Tensor, settings: FitSettings) -> TileAdam:
    """Adam at rest."""
    stochastic = settings.rounding == "stochastic"
    return TileAdam(store, settings.opacity, settings.descent, settings.seed, stochastic)


def begin_stage(
    settings: FitSettings,
    plan: list[Level],
    number: int,
    grid: TileGrid,
    store: Tensor,
    studio: Studio,
    view: ViewColor | None = None,
) -> Stage:
    """A level before its first iteration: rays gathered, Adam at rest. view: of the level before."""
    level, descent = plan[number], settings.descent
    floats, store = store, codes.encode(store, *MISSING[settings.opacity], settings.storage)
    march = march_of(settings, level)
    capture = studio.pictures[level.halvings]
    rays = gather_rays(capture, store, grid, settings.opacity, march, descent.bundle, descent.visit)
    rays.expose(capture, studio.backdrop, studio.exposure)
    adam = begin_adam(store, settings)
    view = begin_view_color(settings, grid, floats, rays, march, view)
    return Stage(
        number, level, grid, store, march, rays, adam, Plateau(limit=3 * level.iterations), view=view
    )


def open_studio(capture: Capture, settings: FitSettings, halvings: int, floor: Floor | None = None) -> Studio:
    """The pictures down to so many halvings, all exposed as they are."""
    pictures = [capture]
    while len(pictures) <= halvings:
        pictures.append(pictures[-1].halved())
    generator = torch.Generator().manual_seed(settings.seed)
    equal = Exposure.equal(len(capture))
    per_channel = settings.gain_per == "channel"
    gains = settings.gains != "off"
    return Studio(pictures, choose_backdrop(capture), equal, gains, per_channel, generator, floor)


def next_stage(stage: Stage, settings: FitSettings, plan: list[Level], studio: Studio) -> Stage:
    """The level after one that is done."""
    watch = Stopwatch({})
    done = stage.decoded(settings.opacity, studio.floor)
    grid, store = next_level(stage.grid, done, settings, stage.rays, stage.march)
    following = begin_stage(settings, plan, stage.number + 1, grid, store, studio, stage.view)
    watch.lap("prepare")
    following.seconds |= watch.seconds
    return following


class Stopwatch:
    """Adds up seconds by kind of work."""

    def __init__(self, seconds: dict[str, float]) -> None:
        self.seconds = seconds
        self.last = time.perf_counter()

    def lap(self, stage: str) -> None:
        now = time.perf_counter()
        self.seconds[stage] = self.seconds.get(stage, 0.0) + now - self.last
        self.last = now
