"""Silhouettes of photographs that come without a mask: by a picture of the empty room, or by a black background.

A silhouette that loses a piece of the subject carves it out of the hull for good, one that is a little fat does not:
where it is doubtful, the subject wins.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from torch_surfcap.data.images import Picture, Plane, as_float

Binary = NDArray[np.uint8]

PLATE_SIGMAS = 4.0  # a pixel that differs from the plate by more than this many noise deviations is subject
PLATE_FLOOR = (
    0.02  # ... and by at least this much of the range [0, 1]: compressed plates have next to no noise
)
SHADOW_SIGMAS = 2.0  # what is left of a shadow once its factor is known, in noise deviations
CLOSING = 0.005  # radius of the gaps that are closed, relative to the picture's longer side
SHADOW = (
    0.4,
    1.0,
)  # the plate darkened by a factor in this range, its texture unchanged, is a shadow on the room
VALLEY_SLACK = 1.15  # histogram levels up to this multiple of the valley's bottom belong to the valley
DARK = 0.25  # a background whose median is brighter than this is not black


def find_silhouette(photograph: Picture, plate: Picture | None) -> Plane | None:
    """Mask [H,W] by the plate where there is one, else by a black background; None where that is not black."""
    return black_silhouette(photograph) if plate is None else plate_silhouette(photograph, plate)


def plate_silhouette(photograph: Picture, plate: Picture) -> Plane:
    """Mask [H,W] in [0, 1] of what differs from the empty room's picture [H,W,3], shadows on the room excepted.

    Gain and bias of photograph against plate are fitted per channel first, on the pixels that agree.
    """
    P = as_float(photograph)
    B = _exposed_alike(P, as_float(plate))
    difference = P - B
    score = _deviation(difference)
    # a shadow is the plate times one factor: fit the factor over a window and see what is left
    window = (9, 9)
    product, square = (cv2.boxFilter((X * B).sum(axis=2), -1, window) for X in (P, B))
    factor = np.clip(product / np.maximum(square, 1e-6), *SHADOW)
    unshadowed = cv2.boxFilter(_deviation(P - factor[:, :, None] * B, like=difference), -1, (5, 5))
    subject = (score > PLATE_SIGMAS) & (unshadowed > SHADOW_SIGMAS)
    binary = _cleaned(_closed(subject.astype(np.uint8)), keep=0.02)
    # smoothing made it fat by a pixel or two: there a pixel must differ by itself
    fat = (binary > 0) & (cv2.erode(binary, np.ones((5, 5), np.uint8)) == 0)
    binary[fat & (_deviation(difference, blur=0.3) < PLATE_SIGMAS / 2)] = 0
    return _soft_edge(_cleaned(binary, keep=0.02), _smooth(np.abs(difference).mean(axis=2), 0.5))


def _smooth(values: Plane, sigma: float) -> Plane:
    return np.asarray(cv2.GaussianBlur(values, (0, 0), sigma), dtype=np.float32)


def _deviation(difference: Plane, like: Plane | None = None, blur: float = 1.0) -> Plane:
    """[H,W] how many noise deviations a difference picture [H,W,3] is away from zero, averaged over its neighbours.

    Photographs are noisy and subjects are larger than a pixel. The noise is that of `like`, by default itself.
    """
    smooth = _smooth(difference, blur)
    noise = smooth if like is None else _smooth(like, blur)
    sigma = np.maximum(1.4826 * np.median(np.abs(noise), axis=(0, 1)), PLATE_FLOOR / PLATE_SIGMAS)
    return np.sqrt(((smooth / sigma) ** 2).mean(axis=2))


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
    binary = _cleaned((levels > valley).astype(np.uint8), keep=0.05)
    return _soft_edge(_cleaned(_closed(binary), keep=0.05), brightness)


def _exposed_alike(photograph: Plane, plate: Plane) -> Plane:
    """The plate [H,W,3] in the photograph's exposure: gain and bias per channel from the pixels that agree."""
    fitted = np.empty_like(plate)
    for channel in range(3):
        p, b = photograph[:, :, channel].ravel(), plate[:, :, channel].ravel()
        usable = (p < 0.99) & (b < 0.99)
        p, b = p[usable], b[usable]
        ratio = float(np.median(p) / max(float(np.median(b)), 1e-3)) if len(p) else 1.0
        # whichever explains more of the picture: a subject that fills half of it must not set the gain
        gain = min((1.0, ratio), key=lambda g: float(np.median(np.abs(p - g * b))) if len(p) else 0.0)
        bias = 0.0
        if len(p) >= 100 and b.std() > 1e-3:
            for _ in range(8):  # least squares on the agreeing part, which the fit then decides anew
                residual = np.abs(p - gain * b - bias)
                agree = residual <= max(2.5 * float(np.median(residual)), 1e-3)
                spread = b[agree] - b[agree].mean()
                if (spread**2).mean() < 1e-6:
                    break
                gain = float(np.clip((spread * p[agree]).mean() / (spread**2).mean(), 0.25, 4.0))
                bias = float(p[agree].mean() - gain * b[agree].mean())
        fitted[:, :, channel] = gain * plate[:, :, channel] + bias
    return np.clip(fitted, 0.0, 1.0)


def _closed(binary: Binary) -> Binary:
    """Gaps narrower than about 1 % of the picture's longer side closed."""
    radius = max(1, round(CLOSING * max(binary.shape)))
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
    # on a wider canvas, so that a subject that leaves the picture is not bitten at the border
    wide = cv2.copyMakeBorder(binary, radius, radius, radius, radius, cv2.BORDER_REPLICATE)
    closed = cv2.morphologyEx(wide, cv2.MORPH_CLOSE, disc)[radius:-radius, radius:-radius]
    return np.ascontiguousarray(closed)


def _cleaned(binary: Binary, keep: float) -> Binary:
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
