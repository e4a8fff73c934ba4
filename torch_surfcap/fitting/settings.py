"""The settings of a fit, and the defaults that were measured for each kind of field."""

from __future__ import annotations

import operator
from dataclasses import dataclass, field, fields, replace
from typing import Any

from torch_surfcap.field.field import DIAGONAL


@dataclass(frozen=True)
class Losses:
    """Weights. Ray terms are means over views and over the pixels of a voxel's face, voxel terms plain sums, so one set
    serves every level, image size and number of cameras."""

    photo: float = 1.0  # Huber(colour - photograph), eq. 8
    sample: float = 0.1  # each sample's own colour against the photograph, eq. 10
    mask: float | None = (
        None  # (transmittance - (1 - mask))^2; by default what suits the silhouettes, see MASK
    )
    huber: float = 0.1  # colour difference above which Huber's norm is linear
    tv_opacity: float = 3e-5  # squared steps of the opacity value, eq. 9
    tv_color: float = 6e-4  # squared steps of the colour coefficients
    parsimony: float = 1e-3  # Huber norm of the view-dependent coefficients, eq. 11
    ballooning: float = 0.0  # squared opacity value, eq. 12
    curvature: float = 1e-4  # Huber norm of the Laplacian of the opacity value
    bend: float = 0.8  # Laplacian, voxels^-1, above which it is linear: edges and thin parts survive
    coarse_curvature: float = 0.5  # share of the curvature's weight on the levels before the last
    detach_sample: bool = False  # the sample loss moves colours only
    sample_target: str = "observed"  # or "rendered": the ray's colour that samples are held against
    anneal: bool = False  # ballooning falls with the rates towards the end of a level


@dataclass(frozen=True)
class Descent:
    """Adam's rates and the lattice of samples."""

    rate_opacity: float = 0.1  # of the opacity value, per iteration
    rate_color: float = 0.06  # of the constant colour
    rate_view: float = 0.02  # of the view-dependent coefficients
    step: float = DIAGONAL  # between samples, voxels
    last_step: float = DIAGONAL  # the same at the finest level
    jitter: float = 1.0  # a ray's lattice is shifted by up to half this many steps, anew in every iteration
    visit: str = (
        "ranges"  # of a ray: its integration ranges, all "cells" that are not empty, or the whole "box"
    )
    bundle: int = 1  # consecutive rays (8 x 8 pixels are 64) that share a list of integration ranges
    stop: float = 1e-3  # a ray ends when its transmittance is lower
    fall: float = 0.02  # share of the loss that five iterations must take off it, else the rates are lowered
    drops: int = 2  # so many times, the last of which ends the level

    def step_of(self, last: bool) -> float:
        """Between samples at the last level or another, voxels."""
        return self.last_step if last else self.step


LOSSES = {
    "distance": Losses(),
    "transparency": Losses(
        sample=0.5, tv_opacity=4e-5, tv_color=1e-4, curvature=1e-3, bend=0.4, coarse_curvature=1.0
    ),
}
# Weight of the mask loss. Silhouettes that were found by plates err where subject and room look alike, and with plates
# the colours themselves say what is empty.
MASK = {"distance": 0.3, "transparency": 0.05}
MASK_BY_PLATES = 0.03
DESCENT = {
    "distance": Descent(last_step=0.7),
    # Shorter steps give a transparency a sharper surface, which holds on to concave parts.
    "transparency": Descent(rate_opacity=0.12, last_step=1.0),
}
# Rounds of Taubin smoothing: a transparency falls within a voxel, so that its surface is a staircase.
SMOOTH = {"distance": 5, "transparency": 120}

DEFAULT_DEGREE = 1
PARSIMONY_HUBER = 0.1  # view-dependent coefficient above which it costs linearly
VIEW_SPACINGS = (1, 4, 8)

CHOICES = {
    "gains": ("auto", "on", "off"),
    "gain_per": ("channel", "camera"),
    "reject": ("auto", "off"),
    "refine": ("auto", "on", "off"),
    "floor": ("auto", "off"),
    "start": ("hull", "constant"),
    "upscale": ("plain", "sqrt"),
    "images": ("auto", "device", "host"),
}
SAMPLE_TARGETS = ("observed", "rendered")
VISITS = ("ranges", "cells", "box")


@dataclass(frozen=True)
class FitSettings:
    """Everything that :func:`torch_surfcap.fit` takes; None means chosen by the program.

    opacity:   "distance" or "transparency", what a voxel stores
    sh_degree: 0, 1, 2, of the colour's dependence on the direction of view
    view_spacing: voxels between the nodes that the view-dependent coefficients stand at: 1, in every voxel; 4 or 8, on a
               coarser grid that is read once per ray (see ``torch_surfcap.fitting.view_color``)
    voxel:     edge of the finest voxels, world units; by default `voxel_pixels` footprints of a pixel
    levels:    number of resolutions; by default as many, up to 4, as the pictures can be halved
    box:       (x0, y0, z0, x1, y1, z1) around the subject; found by default
    gains:     "auto", "on", "off": gain and bias per camera; auto is on: it costs 0.1 dB where cameras are equal, and
               brings far more where they are not. View-dependent colours (sh_degree > 0) take a part of what are gains:
               their values are then less true, the pictures are not
    gain_per:  "channel" or "camera", what has a gain and bias of its own
    reject:    "auto": cameras that contradict the others are left out (see ``torch_surfcap.fitting.outliers``); "off"
    refine:    "auto": where photographs lie beside what the field shows of them, the cameras are turned towards it (see
               ``torch_surfcap.fitting.alignment``); "on": however little it is; "off"
    floor:     "auto": nothing lies below the floor that the plates show, where they show one; "off"
    start:     "hull": the first field falls off at the hull's surface; "constant": a transparency is the same fog inside
    upscale:   "plain" or "sqrt": a transparency at a change of level stays, or becomes its root, so that two fine voxels
               stop as much light as the coarse one did
    device:    "cpu", "cuda", "cuda:1", ..., or "auto": a GPU where this build and torch can use one
    images:    where the photographs of all sizes are kept: on the "device", or in "host" memory, from where they go to the
               device camera by camera whenever they are read; "auto": there if they fit beside the levels
    gradient:  "scatter", the exact gradient of the ray terms, or "gather", the paper's eq. 19: close to it, and without
               sums that threads share
    lattice:   32 or 8, bits of a number of the samples' gradients that "gather" keeps
    threshold: opacity value of the surface, by default the field's level. specks: pieces under this fraction of the
               largest one's area are removed
    smooth:    rounds of Taubin smoothing of the mesh, by default what suits the opacity
    storage:   bits of a coefficient during the fit, 64, 32, 16 or 8, and of each of its moments; with 64 all arithmetic of
               the fit is in double precision, to tell what rounding does
    rounding:  of narrow coefficients, "stochastic" or "nearest"
    accumulator: bits of the gradients' sums; 32 (64 with 64 bits of storage), or 16 where storage is less than 32 and the
               gradient is scattered
    losses, descent: see there; `losses=dict(mask=0.1)` changes one entry
    """

    opacity: str = "distance"
    sh_degree: int | None = None
    view_spacing: int = 1
    voxel: float | None = None
    voxel_pixels: float = 1.0
    levels: int | None = None
    box: tuple[float, ...] | None = None
    gains: str = "auto"
    gain_per: str = "channel"
    reject: str = "auto"
    refine: str = "auto"
    floor: str = "auto"
    start: str = "constant"
    upscale: str = "plain"
    seed: int = 0
    device: str = "cpu"
    images: str = "auto"
    gradient: str = "scatter"
    lattice: int = 32
    threshold: float | None = None
    smooth: int = SMOOTH["distance"]
    specks: float = 0.01
    storage: int = 32
    rounding: str = "stochastic"
    accumulator: int = 32
    losses: Losses = field(default_factory=Losses)
    descent: Descent = field(default_factory=Descent)

    @property
    def degree(self) -> int:
        """Of the spherical harmonics."""
        return DEFAULT_DEGREE if self.sh_degree is None else self.sh_degree

    @property
    def voxel_degree(self) -> int:
        """The same of the voxels' own records."""
        return self.degree if self.view_spacing == 1 else 0

    def suited(self, mask_source: str | None) -> FitSettings:
        """The settings with the mask's weight that suits where a capture's silhouettes are from."""
        if self.losses.mask is not None:
            return self
        weight = MASK_BY_PLATES if mask_source == "plate" else MASK[self.opacity]
        return replace(self, losses=replace(self.losses, mask=weight))

    @staticmethod
    def of(**given: Any) -> FitSettings:
        """Settings from keyword arguments. Raises TypeError for an unknown name."""
        opacity = given.get("opacity", FitSettings.opacity)
        if opacity not in LOSSES:
            raise ValueError(f"opacity: expected distance or transparency, got {opacity!r}")
        for name, defaults in (("losses", LOSSES[opacity]), ("descent", DESCENT[opacity])):
            value = given.get(name, {})
            if isinstance(value, dict):
                given[name] = replace(defaults, **{k: v for k, v in value.items() if v is not None})
        given.setdefault("smooth", SMOOTH[opacity])
        known = {f.name for f in fields(FitSettings)}
        unknown = set(given) - known
        if unknown:
            raise TypeError(
                f"fit: unknown setting {sorted(unknown)[0]!r}, expected one of {', '.join(sorted(known))}"
            )
        settings = FitSettings(**given)
        visits = VISITS if settings.gradient == "scatter" else VISITS[:1]
        narrow = (32, 16, 8)
        may_halve = settings.storage < 32 and settings.gradient == "scatter"
        for name, sound in (
            ("sh_degree", settings.sh_degree in (None, 0, 1, 2)),
            ("view_spacing", settings.view_spacing in VIEW_SPACINGS),
            ("voxel", settings.voxel is None or settings.voxel > 0),
            ("voxel_pixels", settings.voxel_pixels > 0),
            ("storage", settings.storage in ((64, *narrow) if settings.gradient == "scatter" else narrow)),
            ("rounding", settings.rounding in ("stochastic", "nearest")),
            ("accumulator", settings.accumulator in ((32, 16) if may_halve else (32,))),
            ("levels", settings.levels is None or settings.levels >= 1),
            *((name, getattr(settings, name) in words) for name, words in CHOICES.items()),
            ("losses.sample_target", settings.losses.sample_target in SAMPLE_TARGETS),
            ("descent.visit", settings.descent.visit in visits),
            ("gradient", settings.gradient in ("scatter", "gather")),
            ("lattice", settings.lattice in (32, 8)),
        ):
            if not sound:
                raise ValueError(
                    f"fit: {name} is {operator.attrgetter(name)(settings)!r}, see FitSettings for what it may be"
                )
        return settings
