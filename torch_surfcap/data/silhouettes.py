"""Silhouettes of photographs that come without a mask: by a picture of the empty room, or by a black background; and
given masks that are wider than the subject before a background of one colour, cut back.

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
ONE_COLOR, UNIFORM = 0.02, 0.95  # how near to the background's colour, and what share of it is
TOO_WIDE = 0.5  # share of the masks' rims that shows the background
FARTHEST_CUT = 32  # pixels


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


def cut_back(photographs: Sequence[Picture], masks: Sequence[Plane]) -> tuple[list[Plane], int]:
    """The masks without the background that they include, and by how many pixels they were cut at most.

    Only where the background beyond the masks is of one colour in all pictures: as long as most of the masks' rims shows
    that colour, the pixels of the rims that do are taken away. Masks that follow the subject stay as they are, also
    where it is here and there of that colour itself.
    """
    beyond = [as_float(p[m == 0][::17]) for p, m in zip(photographs, masks, strict=True)]
    colors = np.concatenate([*beyond, np.empty((0, 3), np.float32)])
    if len(colors) == 0:
        return list(masks), 0
    background = np.median(colors, axis=0)
    if _alike(colors, background).mean() < UNIFORM:
        return list(masks), 0
    cut = list(masks)
    for pixels in range(FARTHEST_CUT):
        rims = [_rim(mask) for mask in cut]
        alike = [_alike(as_float(p[rim]), background) for p, rim in zip(photographs, rims, strict=True)]
        if not np.concatenate(alike).mean() > TOO_WIDE:  # nor where no rim is left
            return cut, pixels
        for i, (rim, away) in enumerate(zip(rims, alike, strict=True)):
            cut[i] = cut[i].copy()
            cut[i][rim] = np.where(away, 0, cut[i][rim])
    return list(masks), 0  # a subject of the background's colour, not a wide mask


def _alike(colors: Picture, background: Picture) -> NDArray[np.bool_]:
    return np.asarray(np.abs(colors - background).max(axis=-1) < ONE_COLOR)


def _rim(mask: Plane) -> NDArray[np.bool_]:
    """[H, W] the pixels within a mask that have one beyond it among their 8 neighbours."""
    binary = (mask >= 0.5).astype(np.uint8)
    return np.asarray(binary > cv2.erode(binary, np.ones((3, 3), np.uint8)))
