"""Binary pictures made whole: gaps closed, holes filled, specks removed."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from torch_surfcap.data.images import Plane

Binary = NDArray[np.uint8]

CLOSING = 0.005  # radius of the gaps that are closed, relative to the picture's longer side


def square(reach: int) -> Binary:
    """The structuring element that reaches so many pixels to all sides."""
    return np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)


def widened(mask: Plane, pixels: int) -> Plane:
    """The mask grown by so many pixels to all sides, shrunk where negative; edges stay as soft as they are."""
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * abs(pixels) + 1,) * 2)
    return np.asarray((cv2.dilate if pixels > 0 else cv2.erode)(mask, disc))


def closed(binary: Binary) -> Binary:
    """Gaps narrower than about 1 % of the picture's longer side closed."""
    radius = max(1, round(CLOSING * max(binary.shape)))
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
    # on a wider canvas, so that a subject that leaves the picture is not bitten at the border
    wide = cv2.copyMakeBorder(binary, radius, radius, radius, radius, cv2.BORDER_REPLICATE)
    shut = cv2.morphologyEx(wide, cv2.MORPH_CLOSE, disc)[radius:-radius, radius:-radius]
    return np.ascontiguousarray(shut)


def cleaned(binary: Binary, keep: float) -> Binary:
    """Without holes under 1/1000 of the picture, and without pieces under `keep` times the largest one's area."""
    count, labels, stats, _ = cv2.connectedComponentsWithStats(1 - binary, connectivity=4)
    areas = stats[:, cv2.CC_STAT_AREA]
    small = areas < binary.size / 1000
    small[0] = False
    binary = np.where(small[labels], 1, binary).astype(np.uint8) if count > 1 else binary
    count, labels, stats, _ = cv2.connectedComponentsWithStats(binary, connectivity=8)
    areas = stats[:, cv2.CC_STAT_AREA].copy()
    if count < 2:
        return binary
    areas[0] = 0
    return (areas >= keep * areas.max()).astype(np.uint8)[labels] * binary
