"""The settings of the commands under train/: typed, with defaults, read from YAML and from key=value
arguments.

Only the commands know this class; the library takes plain arguments. A value that is None in Python is
written `auto` in YAML and is chosen by the program.
"""

from __future__ import annotations

import difflib
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass, replace
from pathlib import Path
from re import Pattern
from typing import Any

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from torch_surfcap import devices
from torch_surfcap.data.files import atomic_write
from torch_surfcap.data.readers import FORMATS
from torch_surfcap.errors import InputError
from torch_surfcap.field.field import MISSING
from torch_surfcap.fitting.settings import (
    CHOICES,
    LOSSES,
    SAMPLE_TARGETS,
    VIEW_SPACINGS,
    VISITS,
    FitSettings,
)


def _one_of(default: Any, *values: Any) -> Any:
    """A field that takes one of these values (or auto, where the default is None)."""
    return field(default=default, metadata={"values": values})


def _like(default: Any, pattern: Pattern[str], words: str) -> Any:
    """A field that takes a word of this pattern, such as these."""
    return field(default=default, metadata={"pattern": (pattern, words)})


def _within(default: Any, low: float, high: float = float("inf")) -> Any:
    """A field that takes a number low <= x <= high (or auto, where the default is None)."""
    return field(default=default, metadata={"range": (low, high)})


@dataclass
class DataConfig:
    path: str = ""  # the capture's folder or calibration file; must be given
    format: str = _one_of("auto", "auto", *FORMATS)  # of the calibration
    scale: float = _within(1.0, 1e-3, 1.0)  # size of the pictures used, as a fraction of the files'
    holdout: int = _within(0, 0)  # every so many-th view is kept for testing; 0: those that the capture names
    masks: bool = True  # use mask files and alpha channels
    plates: bool = True  # use pictures of the empty room
    box: list[float] | None = None  # [x0, y0, z0, x1, y1, z1] around the subject, capture's unit


@dataclass
class LossesConfig:
    """Weights of terms that are normalised so that one set serves every level; auto depends on `opacity`."""

    photo: float | None = _within(None, 0)  # weight of a ray's colour against the photograph
    sample: float | None = _within(None, 0)  # weight of each sample's own colour against the photograph
    mask: float | None = _within(None, 0)  # weight of transmittance against the silhouette
    huber: float | None = _within(None, 1e-6)  # colour difference (0 to 1) above which Huber's norm is linear
    tv_opacity: float | None = _within(None, 0)  # weight of squared steps of the opacity value between voxels
    tv_color: float | None = _within(None, 0)  # weight of squared steps of the colour between voxels
    parsimony: float | None = _within(None, 0)  # weight of Huber's norm of the view-dependent coefficients
    ballooning: float | None = _within(None, 0)  # weight of the squared opacity value
    curvature: float | None = _within(None, 0)  # weight of the bending of the opacity value
    bend: float | None = _within(None, 1e-6)  # Laplacian, voxels^-1, above which bending costs linearly
    coarse_curvature: float | None = _within(None, 0)  # share of the weight before the last level
    detach_sample: bool | None = None  # the sample loss moves colours only
    sample_target: str | None = _one_of(None, *SAMPLE_TARGETS)  # what samples are held against
    anneal: bool | None = None  # ballooning falls with the rates towards the end of a level


@dataclass
class DescentConfig:
    """Adam and the samples on a ray; auto depends on `opacity`."""

    rate_opacity: float | None = _within(None, 0)  # step of the opacity value, per iteration
    rate_color: float | None = _within(None, 0)  # step of the constant colour, per iteration
    rate_view: float | None = _within(None, 0)  # step of the view-dependent coefficients, per iteration
    step: float | None = _within(None, 0.1, 10)  # between samples, voxels
    last_step: float | None = _within(None, 0.1, 10)  # the same at the finest level, voxels
    jitter: float | None = _within(None, 0, 1)  # span of the random shifts of a ray's samples, steps
    visit: str | None = _one_of(None, *VISITS)  # of a ray: its ranges, the cells not empty, or the box
    bundle: int | None = _within(None, 1)  # consecutive rays that share a list of integration ranges
    stop: float | None = _within(None, 0, 1)  # transmittance below which a ray ends
    fall: float | None = _within(None, 0, 1)  # share of the loss that 5 iterations must take off it
    drops: int | None = _within(None, 1)  # of the rates; the last one ends a level


@dataclass
class CamerasConfig:
    skip: list[str] = field(default_factory=list)  # names or numbers of cameras to leave out
    take: int = _within(0, 0)  # so many training cameras, evenly spread; 0: all
    reject: str = _one_of("auto", *CHOICES["reject"])  # auto: leave out those that contradict the others
    refine: str = _one_of("auto", *CHOICES["refine"])  # auto: correct a calibration that is off


@dataclass
class MeshConfig:
    threshold: float | None = None  # opacity value of the surface; auto: the field's level
    smooth: int | None = _within(None, 0)  # rounds of Taubin smoothing
    specks: float | None = _within(None, 0, 1)  # pieces under this fraction of the largest area go


@dataclass
class Config:
    data: DataConfig = field(default_factory=DataConfig)
    out: str = "out"  # folder of the results
    device: str = _like("auto", devices.WORD, devices.WORDS)  # auto: a GPU where one can be used
    images: str = _one_of("auto", *CHOICES["images"])  # where they are kept; auto: on the device if they fit
    seed: int = _within(0, 0)
    sh_degree: int | None = _one_of(None, 0, 1, 2)  # of the colour's dependence on the direction of view
    view_spacing: int = _one_of(1, *VIEW_SPACINGS)  # voxels between the nodes of view-dependent coefficients
    voxel: float | None = _within(None, 1e-9)  # edge of the finest voxels, capture's unit; auto: voxel_pixels
    voxel_pixels: float = _within(1.0, 0.1, 100)  # the same in footprints of a pixel, where `voxel` is auto
    levels: int | None = _within(None, 1, 12)  # resolutions from coarse to fine
    opacity: str | None = _one_of(None, *LOSSES)  # what a voxel stores
    gains: str = _one_of("auto", *CHOICES["gains"])  # gain and bias per camera
    gain_per: str = _one_of("channel", *CHOICES["gain_per"])  # what has a gain and bias of its own
    floor: str = _one_of("auto", *CHOICES["floor"])  # nothing lies below the one that the plates show
    start: str | None = _one_of(None, *CHOICES["start"])  # the first field of a transparency
    upscale: str | None = _one_of(None, *CHOICES["upscale"])  # of a transparency to the next level
    gradient: str = _one_of("scatter", "scatter", "gather")  # exact, or read by the voxels (paper, eq. 19)
    lattice: int = _one_of(32, 32, 8)  # bits of a number of the samples' gradients that "gather" keeps
    storage: int = _one_of(32, 64, 32, 16, 8)  # bits of a coefficient in the fit, and of each of its moments
    rounding: str = _one_of("stochastic", "stochastic", "nearest")  # of coefficients of 16 or 8 bits
    accumulator: int = _one_of(32, 32, 16)  # bits of the gradients' sums; 16 needs storage=16 or 8
    losses: LossesConfig = field(default_factory=LossesConfig)
    descent: DescentConfig = field(default_factory=DescentConfig)
    cameras: CamerasConfig = field(default_factory=CamerasConfig)
    mesh: MeshConfig = field(default_factory=MeshConfig)
    overwrite: bool = False  # replace the results in `out`
    resume: bool = False  # go on from the checkpoint in `out`
    checkpoint: float = _within(60.0, 0)  # seconds between checkpoints within a level


def load(path: str | os.PathLike[str] | None = None, overrides: Sequence[str] = ()) -> Config:
    """The defaults, changed by a YAML file and then by "key=value" arguments (values are YAML too).

    Raises InputError, naming the file or argument and the key, for what cannot be read, for unknown keys
    (with the nearest known one) and for values of the wrong type or out of range.

    >>> load(None, ["losses.huber=1e-1", "voxel=auto"]).losses.huber
    0.1
    """
    merged = OmegaConf.structured(Config)
    if path is not None:
        merged = _merge(merged, _read(Path(path)), str(path))
    for override in overrides:
        if "=" not in override:
            raise InputError(f"{override}: expected key=value")
        try:
            given = OmegaConf.from_dotlist([override])
        except (OmegaConfBaseException, YAMLError, ValueError) as error:
            raise InputError(f"{override}: not YAML: {error}") from error
        merged = _merge(merged, given, override)
    return _to_config(merged, str(path or "settings"))


def _to_config(merged: DictConfig, source: str) -> Config:
    try:
        config = OmegaConf.to_object(merged)
    except OmegaConfBaseException as error:
        raise InputError(f"{source}: {error}") from error
    assert isinstance(config, Config)
    _check(config, source)
    return config


def capture_arguments(config: Config) -> dict[str, Any]:
    """What `torch_surfcap.load_capture` takes of a config."""
    data, cameras = config.data, config.cameras
    return {
        "path": data.path,
        "format": data.format,
        "scale": data.scale,
        "holdout": data.holdout,
        "masks": data.masks,
        "plates": data.plates,
        "skip": cameras.skip,
        "take": cameras.take,
    }


def fit_arguments(config: Config) -> dict[str, Any]:
    """What `torch_surfcap.fit` takes of a config, but for the device, which the command chooses. What is None is
    left out: the library's default."""
    arguments = {
        "opacity": config.opacity,
        "sh_degree": config.sh_degree,
        "view_spacing": config.view_spacing,
        "voxel": config.voxel,
        "voxel_pixels": config.voxel_pixels,
        "levels": config.levels,
        "gains": config.gains,
        "gain_per": config.gain_per,
        "reject": config.cameras.reject,
        "refine": config.cameras.refine,
        "floor": config.floor,
        "start": config.start,
        "upscale": config.upscale,
        "box": None if config.data.box is None else tuple(config.data.box),
        "seed": config.seed,
        "images": config.images,
        "gradient": config.gradient,
        "lattice": config.lattice,
        "storage": config.storage,
        "rounding": config.rounding,
        "accumulator": config.accumulator,
        "threshold": config.mesh.threshold,
        "smooth": config.mesh.smooth,
        "specks": config.mesh.specks,
        "losses": dict(vars(config.losses)),
        "descent": dict(vars(config.descent)),
    }
    return {name: value for name, value in arguments.items() if value is not None}


def resolved(config: Config) -> Config:
    """The config with the library's defaults in place of None, but for what is chosen by the capture. Raises
    InputError for values that do not go together."""
    try:
        s = FitSettings.of(**fit_arguments(config))
    except ValueError as error:
        raise InputError(f"settings: {error}") from error
    outside, inside = MISSING[s.opacity]
    if s.threshold is not None and not inside < s.threshold < outside:
        expected = f"more than {inside:g} and less than {outside:g} for opacity={s.opacity}"
        raise InputError(f"mesh.threshold is {s.threshold:g}, expected {expected}")
    return replace(
        config,
        opacity=s.opacity,
        start=s.start,
        upscale=s.upscale,
        losses=LossesConfig(**vars(s.losses)),
        descent=DescentConfig(**vars(s.descent)),
        mesh=MeshConfig(s.threshold, s.smooth, s.specks),
    )


def differences(a: Config, b: Config) -> dict[str, tuple[Any, Any]]:
    """The keys whose values differ, with both values."""
    left, right = (dict(_flatten(_plain(config))) for config in (a, b))
    return {key: (left[key], right[key]) for key in left if left[key] != right[key]}


def to_yaml(config: Config) -> str:
    """Every setting as YAML; :func:`of_yaml` gives the same Config back."""
    return OmegaConf.to_yaml(_replace(_plain(config), None, "auto"))


def of_yaml(text: str, source: str) -> Config:
    """The config of YAML text; ``source`` names it in errors."""
    given = OmegaConf.create(text)
    assert isinstance(given, DictConfig)
    return _to_config(_merge(OmegaConf.structured(Config), given, source), source)


def save(config: Config, path: str | os.PathLike[str]) -> None:
    """Write every setting as YAML; `load` gives the same Config back."""
    with atomic_write(path) as partial:
        partial.write_text(to_yaml(config), encoding="utf-8")


def key_names(schema: Any = Config, prefix: str = "") -> Iterator[str]:
    """Every key that may be set, such as "losses.huber"."""
    for entry in fields(schema):
        nested = entry.default_factory
        if isinstance(nested, type) and is_dataclass(nested):
            yield from key_names(nested, f"{prefix}{entry.name}.")
        else:
            yield prefix + entry.name


def _plain(config: Config) -> dict[Any, Any]:
    plain = OmegaConf.to_container(OmegaConf.structured(config))
    assert isinstance(plain, dict)
    return plain


def _read(path: Path) -> DictConfig:
    try:
        given = OmegaConf.load(path)
    except OSError as error:
        raise InputError(f"{path}: cannot read this config file: {error.strerror}") from error
    except (OmegaConfBaseException, YAMLError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: not a YAML file: {error}") from error
    if not isinstance(given, DictConfig):
        raise InputError(f"{path}: found a list, expected keys with values")
    return given


def _merge(config: DictConfig, given: DictConfig, source: str) -> DictConfig:
    """`config` with what is `given`; `source` names it in messages."""
    known = set(key_names())
    plain = OmegaConf.to_container(given)
    assert isinstance(plain, dict)
    for key, value in _flatten(plain):
        if key not in known:
            inner = [name for name in known if name.startswith(f"{key}.")]
            if inner:
                raise InputError(f"{source}: {key} is {value!r}, expected keys such as {min(inner)}")
            raise InputError(f"{source}: unknown key {key}, nearest known key: {_nearest(key, known)}")
        if key in _SAYS_ON and isinstance(value, bool):
            value = "on" if value else "off"
        try:
            OmegaConf.update(config, key, None if value == "auto" and key not in _SAYS_AUTO else value)
        except OmegaConfBaseException as error:
            reason = str(error).splitlines()[0]
            raise InputError(f"{source}: {key} is {value!r}: {reason}") from error
    return config


def _nearest(key: str, known: set[str]) -> str:
    """The known key most like `key`, by its whole name or by its last part."""
    last = {name.rpartition(".")[2]: name for name in sorted(known)}
    whole = difflib.get_close_matches(key, known, n=1, cutoff=0.6)
    part = difflib.get_close_matches(key.rpartition(".")[2], last, n=1, cutoff=0.0)
    return whole[0] if whole else last[part[0]]


def _flatten(plain: Mapping[Any, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for name, value in plain.items():
        if isinstance(value, Mapping) and value:
            yield from _flatten(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value


def _replace(plain: Mapping[Any, Any], old: Any, new: Any) -> dict[Any, Any]:
    return {
        name: _replace(value, old, new) if isinstance(value, Mapping) else new if value is old else value
        for name, value in plain.items()
    }


def _check(config: Any, source: str, prefix: str = "") -> None:
    """Raise InputError for a value outside its field's choices or range."""
    for entry in fields(config):
        key, value = prefix + entry.name, getattr(config, entry.name)
        if is_dataclass(value):
            _check(value, source, f"{key}.")
        if value is None:
            continue
        values, limits = entry.metadata.get("values"), entry.metadata.get("range")
        if values and value not in values:
            choices = ", ".join(map(str, values))
            raise InputError(f"{source}: {key} is {value!r}, expected one of {choices}")
        pattern, words = entry.metadata.get("pattern", (None, ""))
        if pattern and not pattern.fullmatch(value):
            raise InputError(f"{source}: {key} is {value!r}, expected one of {words}")
        if limits and not limits[0] <= value <= limits[1]:
            expected = f"a number from {limits[0]} to {limits[1]}"
            raise InputError(f"{source}: {key} is {value!r}, expected {expected}")
    if isinstance(config, DataConfig) and config.box is not None:
        low, high = config.box[:3], config.box[3:]
        if len(config.box) != 6 or not all(a < b for a, b in zip(low, high, strict=True)):
            expected = "[x0, y0, z0, x1, y1, z1] with x0 < x1, y0 < y1, z0 < z1"
            raise InputError(f"{source}: data.box is {config.box}, expected {expected}")


# Fields in which "auto" is a word like any other.
_SAYS_ON = {"cameras.refine", "gains", "floor"}  # and on and off, which YAML takes for true and false
_SAYS_AUTO = {"cameras.refine", "cameras.reject", "data.format", "device", "images", "gains", "floor"}
