"""Where the subject's border is beside that of its masks, told by the photographs alone.

A photograph changes across the subject's outline more than along it, in all views at the same distance from a mask's
border: at it, where the masks are right. Textures of subject and room change as much along as across, and cancel.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from torch_surfcap.data.images import Picture, Plane, as_float
from torch_surfcap.data.load import evenly, in_threads

REACH = 12  # pixels on either side of a mask's border
VIEWS = 16  # that are looked at
CLEAR = 2.5  # times the next highest change, that of the outline stands out by
NEAR = 2  # pixels over which an outline is spread


def border_offset(photographs: Sequence[Picture], masks: Sequence[Plane]) -> int:
    """By how many pixels the subject reaches beyond its masks, or, negative, ends within them; 0 where nothing is clear."""
    views = [view for view in zip(photographs, masks, strict=True) if _has_border(*view)]
    if not views:
        return 0
    views = evenly(views, min(VIEWS, len(views)))
    sums = np.sum(in_threads(lambda view: _changes(*view), views), axis=0)
    change = sums[0] / np.maximum(sums[1], 1)
    peak = int(change.argmax())
    near = slice(max(0, peak - NEAR), peak + NEAR + 1)
    others = np.delete(change, np.r_[near])
    if change[peak] <= CLEAR * max(0.0, float(others.max())):
        return 0
    weight = np.maximum(change[near], 0)
    return round(float(weight @ np.arange(-REACH, REACH + 1)[near] / weight.sum()))


def _has_border(photograph: Picture, mask: Plane) -> bool:
    """Whether there are a subject and a background, in numbers."""
    finite = np.isfinite(photograph.min()) and np.isfinite(photograph.max()) and np.isfinite(mask.sum())
    return bool(finite and mask.max() >= 0.5 > mask.min())


def _changes(photograph: Picture, mask: Plane) -> NDArray[np.float64]:
    """[2, 2 REACH + 1] by distance outwards from the mask's border: how much more the picture changes across than along it,
    summed, and the number of pixels."""
    inside = (mask >= 0.5).astype(np.uint8)
    outwards = cv2.distanceTransform(1 - inside, cv2.DIST_L2, 5) - cv2.distanceTransform(
        inside, cv2.DIST_L2, 5
    )
    place = np.round(outwards + inside - 0.5).astype(int) + REACH
    near = (place >= 0) & (place <= 2 * REACH)
    rows, columns = (
        (slice(a.min(), a.max() + 1) for a in np.nonzero(near)) if near.any() else (slice(0, 1),) * 2
    )
    outwards, place, near = outwards[rows, columns], place[rows, columns], near[rows, columns]
    picture = as_float(photograph[rows, columns]).astype(np.float32)
    (x, y), (u, v) = (
        [cv2.Sobel(plane, cv2.CV_32F, *axis, ksize=3, scale=0.125) for axis in ((1, 0), (0, 1))]
        for plane in (outwards, picture)
    )
    length = np.maximum(np.hypot(x, y), 1e-6)
    x, y = (x / length)[..., None], (y / length)[..., None]
    more = np.abs(u * x + v * y).max(axis=2) - np.abs(v * x - u * y).max(axis=2)
    counts = [np.bincount(place[near], weights, 2 * REACH + 1) for weights in (more[near], None)]
    return np.array(counts, dtype=np.float64)
