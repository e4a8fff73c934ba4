"""Silhouettes of photographs that come without a mask: by a picture of the empty room, or by a black background; and
given masks that are wider or narrower than the subject before a background of one colour, corrected.

A silhouette that loses a piece of the subject carves it out of the hull for good, one that is a little fat does not:
where it is doubtful, the subject wins.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from torch_surfcap.data.images import Picture, Plane, as_float
from torch_surfcap.data.morphology import Binary, cleaned, closed
from torch_surfcap.data.plates import separate

VALLEY_SLACK = 1.15  # histogram levels up to this multiple of the valley's bottom belong to the valley
DARK = 0.25  # a background whose median is brighter than this is not black
ONE_COLOR, UNIFORM = 0.02, 0.9  # how near to the background's colour, and what share of it is
TOO_WIDE, TOO_NARROW = 0.5, 0.75  # share of the pixels at the masks' borders that are on the wrong side
UNMIXED = 0.85  # mean contrast of pixels at the border, relative to those further in
FARTHEST = 32  # pixels that a mask is corrected by


def find_silhouette(photograph: Picture, plate: Picture | None) -> Plane | None:
    """Mask [H,W] by the plate where there is one, else by a black background; None where that is not black."""
    return black_silhouette(photograph) if plate is None else separate(photograph, plate)[0]


def black_silhouette(photograph: Picture) -> Plane | None:
    """Mask [H,W] in [0, 1] of a subject before a black background; None where the background is not black.

    The threshold lies at the dark end of the valley between the two modes of the brightness histogram, since the
    subject's shadows are dark too; then narrow gaps are closed and small holes filled.
    """
    brightness = as_float(photograph).max(axis=2)
    levels = np.clip(brightness * 255 + 0.5, 0, 255).astype(np.uint8)
    otsu, _ = cv2.threshold(levels, 0, 255, cv2.THRESH_OTSU)
    background = levels[levels <= otsu]
    if np.median(background) > DARK * 255 or len(background) == levels.size:
        return None
    histogram = gaussian_filter1d(np.bincount(levels.ravel(), minlength=256).astype(np.float64), 4.0)
    first = int(min(np.percentile(background, 75), otsu))
    valley = first + int(np.argmin(histogram[first : int(otsu) + 1]))
    floor = VALLEY_SLACK * histogram[valley] + 1e-6 * levels.size
    while valley > first and histogram[valley - 1] <= floor:
        valley -= 1
    binary = cleaned((levels > valley).astype(np.uint8), keep=0.05)
    return _soft_edge(cleaned(closed(binary), keep=0.05), brightness)


def _soft_edge(binary: Binary, contrast: Plane) -> Plane:
    """The binary mask with fractions along its border: a border pixel's contrast relative to the subject's nearby."""
    ring = np.ones((3, 3), np.uint8)
    inner, outer = cv2.erode(binary, ring), cv2.dilate(binary, ring)
    nearby = cv2.dilate(np.where(inner > 0, contrast, 0).astype(np.float32), np.ones((5, 5), np.uint8))
    fraction = np.clip(contrast / np.maximum(nearby, 1e-3), 0.0, 1.0)
    # binary pixels keep at least one half and the others stay below: 0.5 is where a hull puts its surface
    fraction = np.where(binary > 0, np.maximum(fraction, 0.5), np.minimum(fraction, 0.5))
    border = (outer > inner) & ((nearby > 1e-3) | (binary > 0))
    return np.where(border, fraction, binary).astype(np.float32)


def fit_to_background(
    photographs: Sequence[Picture], masks: Sequence[Plane]
) -> tuple[list[Plane], int | None]:
    """Masks that end where the background does, and by how many pixels at most they were widened (cut where negative);
    None where that cannot be told.

    Only where the background beyond the masks is of one colour in all pictures it can. As long as most of the masks'
    outermost pixels show that colour, those that do are taken away; as long as nearly all pixels beside the masks do not,
    these are added. Masks that follow the subject stay as they are, also where it is here and there of that colour itself.
    """
    beyond = [p[m == 0][::17] for p, m in zip(photographs, masks, strict=True)]
    colors = as_float(np.concatenate(beyond))
    if len(colors) == 0:
        return list(masks), None
    background = np.median(colors, axis=0)
    if (np.abs(colors - background).max(axis=1) < ONE_COLOR).mean() < UNIFORM:
        return list(masks), None
    contrast = [np.abs(as_float(p) - background).max(axis=2) for p in photographs]
    empty = [c < ONE_COLOR for c in contrast]
    for sign in (-1, 1):
        fitted = list(masks)
        for pixels in range(FARTHEST):
            rims = [_rim(mask, sign) for mask in fitted]
            wrong = [rim & (e if sign < 0 else ~e) for rim, e in zip(rims, empty, strict=True)]
            share = sum(map(np.count_nonzero, wrong)) / max(1, sum(map(np.count_nonzero, rims)))
            right = share <= (TOO_WIDE if sign < 0 else TOO_NARROW)
            if right and pixels == 0:
                break
            if not right or sign > 0:  # at last pixels that hold only a little of the subject
                fitted = [np.where(w, np.float32(sign > 0), m) for m, w in zip(fitted, wrong, strict=True)]
            if right:
                return _with_coverage(fitted, contrast), sign * pixels
    return list(masks), 0  # else a subject of the background's colour, or a background that is not one


def _with_coverage(masks: Sequence[Plane], contrast: Sequence[Plane]) -> list[Plane]:
    """Masks that hold every pixel with some of the subject, their outermost ones as their contrast to the background is to
    that of the pixels nearby that hold nothing else.

    Where these contrasts do not differ, the photographs' colours are not mixed with the background (the colours of an
    alpha picture): the outermost pixels then count half.
    """
    found = []
    for mask, against in zip(masks, contrast, strict=True):
        binary = (mask >= 0.5).astype(np.float32)
        inner = cv2.erode(binary, np.ones((3, 3), np.uint8))
        nearby, count = (cv2.blur(plane, (5, 5)) for plane in (inner * against, inner))
        rim = (binary > inner) & (nearby > 1e-3 * count)
        binary[rim] = np.clip(against[rim] * count[rim] / nearby[rim], 0, 1)
        found.append((binary, rim))
    mixed = np.concatenate([mask[rim] for mask, rim in found])
    if len(mixed) and mixed.mean() > UNMIXED:
        return [np.where(rim, np.float32(0.5), mask) for mask, rim in found]
    return [mask for mask, _ in found]


def _rim(mask: Plane, sign: int) -> NDArray[np.bool_]:
    """[H, W] the pixels of a mask that touch those beyond it (8 neighbours), or, with sign 1, those beyond that touch it."""
    ring = np.ones((3, 3), np.uint8)
    if sign < 0:
        binary = (mask >= 0.5).astype(np.uint8)
        return np.asarray(binary > cv2.erode(binary, ring))
    binary = (mask > 0).astype(np.uint8)
    return np.asarray(binary < cv2.dilate(binary, ring))
