"""From views, as a calibration file states them, to pixels: read, undistorted, made smaller, several at a time."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from difflib import get_close_matches
from pathlib import Path
from typing import TypeVar

import numpy as np
import torch

from torch_surfcap.data.cameras import calibration_fault
from torch_surfcap.data.images import Picture, Plane, read_mask, read_picture, shrink, undistort
from torch_surfcap.data.silhouettes import find_silhouette
from torch_surfcap.data.view import Matrix, View
from torch_surfcap.errors import InputError

In = TypeVar("In")
Out = TypeVar("Out")


@dataclass
class Loaded:
    """What a capture is made of; one entry per view. masks is None where no file or alpha states any."""

    names: list[str] = field(default_factory=list)
    images: list[Picture] = field(default_factory=list)
    K: list[Matrix] = field(default_factory=list)
    world_to_camera: list[Matrix] = field(default_factory=list)
    masks: list[Plane] | None = None
    plates: list[Picture] | None = None
    mask_source: str | None = None


@dataclass
class _Pixels:
    image: Picture
    alpha: Picture | None
    mask: Plane | None
    plate: Picture | None
    K: Matrix


def in_threads(function: Callable[[In], Out], items: Iterable[In]) -> list[Out]:
    """[function(item) for item in items], several at a time: cv2 and numpy let go of the interpreter's lock."""
    with ThreadPoolExecutor(max_workers=min(8, os.cpu_count() or 1)) as pool:
        return list(pool.map(function, items))


def without(views: list[View], skip: Sequence[str | int]) -> list[View]:
    """The views that are not named, or numbered, in `skip`. Raises InputError for a name that no view has."""
    names = [view.name for view in views]
    left_out = set()
    for item in skip:
        numbered = isinstance(item, int) or (item not in names and item.isdigit())
        index = int(item) if numbered else names.index(str(item)) if item in names else -1
        if not 0 <= index < len(views):
            near = get_close_matches(str(item), names, 1)
            hint = f"did you mean {near[0]}" if near else f"expected a name such as {names[0]} or a number"
            raise InputError(f"cameras to skip: no camera {item} among {len(views)}, {hint}")
        left_out.add(index)
    return [view for i, view in enumerate(views) if i not in left_out]


def evenly(views: list[In], take: int) -> list[In]:
    """`take` of the views, as far apart in their order as can be; all for 0. Raises InputError where there are fewer."""
    if not take:
        return views
    if not 0 < take <= len(views):
        raise InputError(
            f"cameras to take: {take} of {len(views)} training views, expected 0 (all) to {len(views)}"
        )
    return [views[i * len(views) // take] for i in range(take)]


def load_views(views: list[View], scale: float, masks: bool, plates: bool) -> Loaded:
    """Read the pixels of all views. Raises InputError naming the first file that cannot be used."""
    if not 0 < scale <= 1:
        raise InputError(f"scale={scale:g}, expected a factor above 0 and up to 1")
    if not views:
        raise InputError("capture: no training views are left, expected at least 3")
    for view in views:
        _check_calibration(view)
    bare = next((view for view in views if plates and view.plate is None), None)
    if bare is not None and any(view.plate for view in views):
        raise InputError(
            f"{bare.source}: no plate for camera {bare.name}, expected one for every camera or none"
        )
    pixels = in_threads(lambda view: _read(view, masks, plates), views)
    loaded = Loaded(names=[view.name for view in views], K=[p.K for p in pixels])
    loaded.world_to_camera = [view.world_to_camera for view in views]
    _choose_masks(loaded, pixels)
    if plates and bare is None:
        loaded.plates = [p.plate for p in pixels if p.plate is not None]
    loaded.images = [p.image for p in pixels]
    if scale < 1:
        _scale(loaded, scale)
    return loaded


def _check_calibration(view: View) -> None:
    K = np.eye(3) if callable(view.K) else view.K
    if np.shape(K) != (3, 3) or np.shape(view.world_to_camera) != (4, 4):
        raise InputError(
            f"{view.source}: K {list(np.shape(K))} and pose {list(np.shape(view.world_to_camera))}, "
            "expected 3x3 and 4x4"
        )
    fault = calibration_fault(torch.from_numpy(np.array(K)), torch.from_numpy(np.array(view.world_to_camera)))
    if fault is None and not np.isfinite(view.distortion).all():
        fault = "the distortion holds NaN or infinite values, expected finite numbers"
    if fault:
        raise InputError(f"{view.source}: {fault}")


def _read(view: View, masks: bool, plates: bool) -> _Pixels:
    image, alpha = read_picture(view.image)
    height, width = image.shape[:2]
    if view.size is not None and (width, height) != view.size:
        stated = f"{view.size[0]} x {view.size[1]}"
        raise InputError(f"{view.image}: {width} x {height} pixels, expected {stated} as in {view.source}")
    mask = read_mask(view.mask) if masks and view.mask else None
    plate = read_picture(view.plate)[0] if plates and view.plate else None
    for other, path in ((mask, view.mask), (plate, view.plate)):
        if other is not None and other.shape[:2] != (height, width):
            found = f"{other.shape[1]} x {other.shape[0]}"
            raise InputError(f"{path}: {found} pixels, expected {width} x {height} as in {view.image}")
    K = np.array(view.calibration(width, height), dtype=np.float64)
    pixels = _Pixels(image, alpha if masks else None, mask, plate, K)
    if any(view.distortion):
        for name in ("image", "alpha", "mask", "plate"):
            distorted = getattr(pixels, name)
            if distorted is not None:
                setattr(pixels, name, undistort(distorted, K, view.distortion))
    return pixels


def _choose_masks(loaded: Loaded, pixels: list[_Pixels]) -> None:
    """Mask files first, then alpha, then, where only some views have either, what plate or background tell."""
    # an alpha that is opaque in every picture says nothing; opaque in one of them, it is that camera's full mask
    opaque = all(p.alpha is None or bool((p.alpha == p.alpha.max()).all()) for p in pixels)
    found: list[Plane | None] = []
    sources = set()
    for p in pixels:
        mask, source = p.mask, "file"
        if mask is None and p.alpha is not None and not opaque:
            peak = 255.0 if p.alpha.dtype == np.uint8 else 1.0
            mask, source = (p.alpha.astype(np.float32) / np.float32(peak)), "alpha"
        found.append(mask)
        if mask is not None:
            sources.add(source)
    if not sources:
        return
    loaded.mask_source = "alpha" if "alpha" in sources else "file"
    loaded.masks = []
    for p, mask in zip(pixels, found, strict=True):
        if mask is None:
            mask = find_silhouette(p.image, p.plate)
            loaded.mask_source = "threshold" if p.plate is None else "plate"
        loaded.masks.append(np.zeros(p.image.shape[:2], np.float32) if mask is None else mask)


def _scale(loaded: Loaded, scale: float) -> None:
    """Make all pictures smaller by area means; K by the same ratios, which differ a little where sizes are odd."""

    def smaller(i: int) -> None:
        height, width = loaded.images[i].shape[:2]
        size = (max(1, round(width * scale)), max(1, round(height * scale)))
        mask = None if loaded.masks is None else loaded.masks[i]
        weight = mask if loaded.plates is None else None
        loaded.images[i] = shrink(loaded.images[i], size, weight)
        if loaded.masks is not None:
            loaded.masks[i] = shrink(loaded.masks[i], size)
        if loaded.plates is not None:
            loaded.plates[i] = shrink(loaded.plates[i], size)
        loaded.K[i] = np.diag([size[0] / width, size[1] / height, 1.0]) @ loaded.K[i]

    in_threads(smaller, range(len(loaded.images)))


def picture_beside(stem: Path, suffixes: Sequence[str]) -> Path:
    """`stem` itself where it exists, else with the first of `suffixes` that makes an existing file."""
    candidates = [stem, *(stem.with_name(stem.name + end) for s in suffixes for end in (s, s.upper()))]
    return next((path for path in candidates if path.is_file()), stem)
