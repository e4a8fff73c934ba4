"""A stage of the fit: one level with all that its iterations read and change."""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
from torch import Tensor

from torch_surfcap import codes, devices, ops
from torch_surfcap.autograd import March
from torch_surfcap.data.cameras import Cameras
from torch_surfcap.data.capture import Capture
from torch_surfcap.data.floor import Floor
from torch_surfcap.field.field import MISSING, SLOPE, SurfaceField
from torch_surfcap.field.tiles import TileGrid
from torch_surfcap.fitting.adam import TileAdam
from torch_surfcap.fitting.alignment import Pinholes, Registration, moved
from torch_surfcap.fitting.color_gain import Exposure
from torch_surfcap.fitting.late import Row, Stopwatch
from torch_surfcap.fitting.levels import Level, cut_at_floor, next_level
from torch_surfcap.fitting.plateau import Plateau
from torch_surfcap.fitting.rays import RayBatch, choose_backdrop, gather_rays
from torch_surfcap.fitting.settings import FitSettings
from torch_surfcap.fitting.view_color import KIND, ViewColor, begin_view_color

PICTURES_SHARE = 0.8  # of the device's memory that the largest level leaves, for pictures


@dataclass
class Studio:
    """What does not belong to one level: the photographs at every size and the cameras' exposure.

    In it all positions, those of cameras, floor and grids, are relative to a place near the subject, in the world ``origin``
    [3] float64: rays are in single precision, which far from the world's origin would tell no voxel from the next.

    pictures: the capture, halved 0, 1, ... times. backdrop: see ``RayBatch.expose``. generator: of the lattices' shifts.
    gains: whether the exposure is fitted; per_channel: or one gain and bias for all channels of a camera. floor: below
    which nothing is, where one was found. given: the cameras of the pictures, as calibrated. motion: [N, 4] by which their
    pictures have moved since (see ``torch_surfcap.fitting.alignment``); looked: by how much when the level began; refines:
    whether they go on to.
    """

    pictures: list[Capture]
    backdrop: Tensor | None
    exposure: Exposure
    gains: bool
    per_channel: bool
    generator: torch.Generator
    floor: Floor | None
    origin: Tensor
    given: list[Cameras]
    motion: Tensor
    looked: Tensor
    refines: bool

    def keep_pictures(self, images: str, level_bytes: list[int]) -> None:
        """Takes the pictures to the device where ``images`` says so; "auto": if they fit beside the largest level."""
        device = self.exposure.gain.device
        needed = sum(capture.nbytes for capture in self.pictures)
        if images == "auto":
            left = devices.free_bytes(device) - max(level_bytes)
            images = "device" if needed <= PICTURES_SHARE * left else "host"
        if images == "device":
            self.pictures = [capture.on(device) for capture in self.pictures]

    def leave_out(self, cameras: set[int]) -> None:
        """From the next level on these cameras have no rays: their silhouettes are empty."""
        for n, capture in enumerate(self.pictures):
            assert capture.masks is not None
            without = capture.subset(range(len(capture)))
            without.masks = [torch.zeros_like(m) if i in cameras else m for i, m in enumerate(capture.masks)]
            self.pictures[n] = without

    def align(self, stage: Stage, registration: Registration, color: Tensor, transmittance: Tensor) -> None:
        """Registers the photographs to renderings of a stage's rays, [R, 3] and [R], and aims the rays anew."""
        self.motion = registration.refined(self.motion, stage.rays, color, transmittance)
        registration.pinholes.aim(stage.rays, self.motion)

    def aim(self, rays: RayBatch, level: Level) -> None:
        """The rays of a level as the cameras now look."""
        if self.refines:
            Pinholes.of(self.given[level.halvings], rays.pixels.device).aim(rays, self.motion)

    def motions(self) -> dict[str, list[float]]:
        """The same by the cameras' names; none where the calibration stands."""
        named = zip(self.pictures[0].names, self.motion.cpu().tolist(), strict=True)
        return {name: motion for name, motion in named if any(motion)}

    def look_again(self) -> None:
        """Rays of the levels to come are those of the cameras as they now look."""
        self.looked = self.motion
        for capture, given in zip(self.pictures, self.given, strict=True):
            capture.cameras = moved(given, self.motion)

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
    the records. waiting: rows of the iterations that were not told of yet.
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
    waiting: list[Row] = field(default_factory=list)

    def table(self, settings: FitSettings) -> Tensor:
        """The grid's table, where the whole box is visited without what it says about empty space."""
        return self.grid.table.clamp(min=ops.OUTSIDE) if settings.descent.visit == "box" else self.grid.table

    @property
    def goes_on(self) -> bool:
        """Whether another iteration follows those done, told of or not."""
        return not self.rule.ended and self.rule.count + len(self.waiting) < self.rule.limit

    def told(self) -> dict[str, float]:
        """The first row that waits; the rule learns its loss."""
        row = self.waiting.pop(0).read()
        self.rule.goes_on(row["loss"])
        return row


@dataclass
class Outcome:
    """What a level leaves. number, grid, store: of the stage. step: between samples, voxels. view: grid and records of the
    view-dependent colour, where it has its own."""

    number: int
    grid: TileGrid
    store: Tensor
    step: float
    view: tuple[TileGrid, Tensor] | None

    @staticmethod
    def of(stage: Stage) -> Outcome:
        view = None if stage.view is None else (stage.view.grid, stage.view.store)
        return Outcome(stage.number, stage.grid, stage.store, stage.march.step / stage.grid.voxel_size, view)

    def to(self, device: torch.device) -> Outcome:
        view = self.view and (self.view[0].to(device), self.view[1].to(device))
        return Outcome(self.number, self.grid.to(device), self.store.to(device), self.step, view)

    def decoded(self, opacity: str, floor: Floor | None) -> Tensor:
        """The records in floats, cut at the floor; those of the stage may be so, too."""
        store = codes.decode(self.store, *MISSING[opacity])
        cut_at_floor(self.grid, store, opacity, floor)
        return store

    def surface(self, opacity: str, studio: Studio) -> SurfaceField:
        """As a module in single precision, where it is in the world."""
        view = self.view and SurfaceField(self.view[1].float(), self.view[0].moved(studio.origin), KIND)
        grid = self.grid.moved(studio.origin)
        return SurfaceField(self.decoded(opacity, studio.floor).float(), grid, opacity, self.step, view)


def rendered(stage: Stage, settings: FitSettings) -> Tensor:
    """[R, 3] what the rays of a stage see now, in the common exposure."""
    rays, shift = stage.rays, torch.zeros_like(stage.rays.mask)
    offset = None if stage.view is None else stage.view.seen_by(rays)
    background = rays.background if offset is None else rays.background - offset
    missing = MISSING[settings.opacity]
    store = codes.decode(stage.store, *missing)
    seen = (rays.origins, rays.directions, shift, background)
    color = ops.march_forward(store, stage.grid.table, stage.grid.frame(*missing), *seen, *stage.march)[0]
    return color if offset is None else color + offset


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
    floats = store.to(codes.real(codes.TYPES[settings.storage]))
    store = codes.encode(floats, *MISSING[settings.opacity], settings.storage)
    march = march_of(settings, level)
    capture = studio.pictures[level.halvings]
    rays = gather_rays(capture, store, grid, settings.opacity, march, descent.bundle, descent.visit)
    rays.expose(capture, studio.backdrop, studio.exposure)
    studio.aim(rays, level)
    adam = begin_adam(store, settings)
    rule = Plateau.of(3 * level.iterations, descent)
    view = begin_view_color(settings, grid, floats, rays, march, view)
    return Stage(number, level, grid, store, march, rays, adam, rule, view=view)


def open_studio(
    capture: Capture,
    settings: FitSettings,
    halvings: int,
    floor: Floor | None = None,
    origin: Tensor | None = None,
) -> Studio:
    """The pictures down to so many halvings, all exposed as they are. origin: of the studio, by default the world's."""
    origin = torch.zeros(3, dtype=torch.float64) if origin is None else origin
    pictures = [capture.moved(-origin)]
    while len(pictures) <= halvings:
        pictures.append(pictures[-1].halved())
    generator = torch.Generator(settings.device).manual_seed(settings.seed)
    equal = Exposure.equal(len(capture), settings.device)
    backdrop = choose_backdrop(capture)
    backdrop = None if backdrop is None else backdrop.to(settings.device)
    per_channel = settings.gain_per == "channel"
    gains = settings.gains != "off"
    floor = floor and floor.moved(-origin)
    given = [picture.cameras for picture in pictures]
    motion = torch.zeros(len(capture), 4, dtype=torch.float64, device=settings.device)
    refines = may_refine(settings, halvings)
    return Studio(
        pictures,
        backdrop,
        equal,
        gains,
        per_channel,
        generator,
        floor,
        origin,
        given,
        motion,
        motion,
        refines,
    )


def may_refine(settings: FitSettings, halvings: int) -> bool:
    """Whether cameras are refined until there is evidence: not where there is no coarser level to find it on."""
    return settings.refine != "off" and halvings > 0


def next_stage(stage: Stage, settings: FitSettings, plan: list[Level], studio: Studio) -> Stage:
    """The level after one that is done."""
    watch = Stopwatch({}, stage.store.device)
    done = Outcome.of(stage).decoded(settings.opacity, studio.floor)
    grid, store = next_level(stage.grid, done, settings, stage.rays, stage.march)
    following = begin_stage(settings, plan, stage.number + 1, grid, store, studio, stage.view)
    watch.lap("prepare")
    watch.stop()
    following.seconds |= watch.seconds
    return following
