"""A photograph against its plate: what is subject, and what the room looks like in the subject's shadow.

A shadow multiplies the room's colour B by one smooth factor f, so along the direction of B a photograph may darken,
across it (in chroma) it may not. The misfit of P ~ f B, in deviations of the noise that the two pictures themselves
show along and across B, is averaged edge-preservingly; where it stays high is subject. A shadow must be told by the
room's colour or texture in it: where a plain grey thing would look the same, the subject wins, since a silhouette that
loses a piece of the subject carves it out of the hull for good, and one that is a little fat does not.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from torch_surfcap.data.images import Picture, Plane, as_float
from torch_surfcap.data.morphology import Binary, cleaned, closed, square

FACTOR = (0.3, 1.1)  # of shadows and of light that the subject throws back; black shoes lie below
PENUMBRA = 0.06  # what a shadow's factor strays from its mean over the window
TINT = 0.015  # deviation of its colour from the room's, relative to the light that it takes
WINDOW = 2.0  # deviation of the Gaussian over which a shadow's factor is averaged, pixels
LIMIT = 30.0  # a pixel's misfit counts no further, in squared deviations: noise has tails
SUBJECT = 7.0  # mean misfit above which it is subject; the room's own is 3, one per colour channel
DOUBT = 8.0  # by how much the room must explain a shadow better than plain grey does
SMOOTHING, EDGE = 60.0, 2.0  # of the averaged misfit: its strength, and the step of misfit it does not cross
NOISE_FLOOR = 0.6 / 255  # deviation by quantisation, with something for compression
DETAIL = 0.7  # share of the noise that follows the plate's detail (aliasing, shake), the rest is even
DARK = 0.01  # below this a room's colour has no direction
BLOCK = 4  # exposures are compared on means over so many pixels a side, which have next to no noise
KEEP = 0.02  # pieces smaller than this share of the largest are no subject


@dataclass
class _Room:
    """The plate in the photograph's exposure, less the bias, and the noise between the two.

    color, axis: [H,W,3], axis of unit length along the color; light: [H,W] length of the color;
    along, across: [H,W] variance of the difference along the axis, and of each of the two components across.
    """

    color: Picture
    axis: Picture
    light: Picture
    along: Picture
    across: Picture

    @staticmethod
    def of(photograph: Plane, color: Picture) -> _Room:
        """The room [H,W,3] of a photograph [H,W,3] at the same exposure."""
        light = np.sqrt(_dot(color, color))
        axis = color / np.maximum(light, DARK)[:, :, None]
        bright, chroma = _along_and_across(photograph, axis)
        fine_light, fine_chroma = _along_and_across(color - _smooth(color, 1.5), axis)
        difference = bright - light
        grain = difference - _smooth(difference, WINDOW)  # shadows and subjects are smooth for the most part
        # 0.455 and 1.386 are the medians of chi-squared with one and with two degrees of freedom
        along = _variance(grain**2 / 0.455, fine_light**2)
        across = _variance(_dot(chroma, chroma) / 1.386, _dot(fine_chroma, fine_chroma))
        return _Room(color, axis, light, np.maximum(along, across), across)

    def whitened(self, difference: Picture) -> Plane:
        """[H,W,4] a difference of colours [H,W,3] in noise deviations: across the axis (3 axes, rank 2) and along it."""
        bright, chroma = _along_and_across(difference, self.axis)
        return np.dstack([chroma / np.sqrt(self.across)[:, :, None], bright / np.sqrt(self.along)])


def separate(photograph: Picture, plate: Picture) -> tuple[Plane, Picture]:
    """Subject and room of a photograph [H,W,3], by the plate [H,W,3] of the same camera.

    Returns the mask [H,W] in [0, 1], soft along its border, and the room without the subject but with its shadow [H,W,3],
    in the photograph's exposure and the plate's type; behind the subject the shadow goes on from around it.
    """
    P, B = as_float(photograph), as_float(plate)
    gain, bias = exposure(P, B)
    # a shadow takes its share of the light, not of the bias; what is saturated is so in both
    P, room = P - bias, _Room.of(P - bias, np.minimum(gain * B, 1 - bias))
    misfit, ratio, trust = _explain(P, room)
    # the misfit guides its own averaging: bits of room and bits of subject flow together, but not into each other
    guide = (255 / LIMIT * _smooth(misfit, 0.7)).astype(np.uint8)
    excess = cv2.ximgproc.fastGlobalSmootherFilter(guide, misfit - SUBJECT, SMOOTHING, 255 / LIMIT * EDGE)
    binary = cleaned(closed((excess > 0).astype(np.uint8)), KEEP)
    shadowed = _spread(ratio, trust * (cv2.dilate(binary, square(2)) == 0))[:, :, None] * room.color
    mask = _matted(binary, P, shadowed, room)
    shadowed = np.clip(shadowed + bias, 0, 1)
    return mask, np.rint(255 * shadowed).astype(np.uint8) if plate.dtype == np.uint8 else shadowed


def exposure(photograph: Plane, plate: Plane) -> tuple[Plane, Plane]:
    """Gain and bias [3] that bring a plate [H,W,3] to its photograph's exposure: a robust line through block means."""
    size = (max(1, plate.shape[1] // BLOCK), max(1, plate.shape[0] // BLOCK))
    small = [cv2.resize(X, size, interpolation=cv2.INTER_AREA) for X in (photograph, plate)]
    exposed = np.maximum(*small).max(axis=2) < 0.99
    lines = []
    for channel in range(3):
        p, b = (X[:, :, channel][exposed].astype(np.float64) for X in small)
        lines.append(_robust_line(b, p) if len(p) else (1.0, 0.0))
    gain, bias = np.array(lines, np.float32).T
    return gain, bias


def _robust_line(x: Picture, y: Picture) -> tuple[float, float]:
    """Slope and intercept of y over x by reweighted least squares: what is far off, the subject, does not vote."""
    ratio = float(np.median(y) / max(float(np.median(x)), 1e-3))
    # whichever explains more of the picture: a subject that fills half of it must not set the gain
    slope, intercept = min((1.0, ratio), key=lambda s: float(np.median(np.abs(y - s * x)))), 0.0
    for _ in range(8):
        residual = y - slope * x - intercept
        scale = max(2 * 1.4826 * float(np.median(np.abs(residual))), 1e-3)
        weight = (1 + (residual / scale) ** 2) ** -2.0
        weight /= weight.sum()
        center = float((weight * x).sum())
        spread = float((weight * (x - center) ** 2).sum())
        if spread < 1e-4:  # a plain wall tells no more than a ratio
            break
        slope = float(np.clip((weight * (x - center) * y).sum() / spread, 0.25, 4.0))
        intercept = float((weight * y).sum()) - slope * center
    return slope, intercept


def _explain(P: Plane, room: _Room) -> tuple[Picture, Picture, Picture]:
    """How well the room explains the photograph, as it is or in shadow; all [H,W].

    Returns the misfit, in squared noise deviations up to LIMIT, the light that is left, relative to the room's, and how
    far that can be trusted to be the room's.
    """
    bright, chroma = _along_and_across(P, room.axis)
    squared = _dot(chroma, chroma)
    plain = squared / room.across + (bright - room.light) ** 2 / room.along
    ratio = bright / np.maximum(room.light, DARK)
    possible = (ratio > FACTOR[0]) & (ratio < FACTOR[1])
    trust = possible * np.exp(-squared / room.across / 4) * room.light**2
    factor = np.clip(_smooth(trust * ratio, WINDOW) / np.maximum(_smooth(trust, WINDOW), 1e-6), *FACTOR)
    along = room.along + (PENUMBRA * room.light) ** 2
    tinted = room.across + (TINT * (1 - factor) * room.light) ** 2
    shadow = squared / tinted + (bright - factor * room.light) ** 2 / along
    grey = P.mean(axis=2)
    hue = P - grey[:, :, None]
    plain_grey = _dot(hue, hue) / tinted + 3 * (grey - _smooth(grey, WINDOW)) ** 2 / along
    evidence = _smooth(np.minimum(plain_grey, LIMIT) - np.minimum(shadow, LIMIT), WINDOW)
    shadow += np.maximum(DOUBT - evidence, 0)
    return np.minimum(np.minimum(plain, shadow), LIMIT), ratio, trust


def _spread(values: Plane, weight: Picture) -> Plane:
    """Weighted local means [H,W], from ever farther away where nothing near has any weight, and 1 in the end."""
    total, mass = np.full_like(values, 1e-7), np.full_like(values, 1e-7)
    for deviation, share in ((WINDOW, 1.0), (6 * WINDOW, 1e-3)):
        total += share * _smooth(weight * values, deviation)
        mass += share * _smooth(weight, deviation)
    return total / mass


def _matted(binary: Binary, P: Plane, shadowed: Plane, room: _Room) -> Plane:
    """The mask with fractions in its outermost pixels: a pixel's place between the room and the subject further in."""
    inner = cv2.erode(binary, square(1))
    # the farther in, the purer; thin parts have nothing but their border
    weight = cv2.erode(binary, square(2)) + 1e-3 * inner + 1e-6 * binary
    weight = weight.astype(np.float32)
    subject = _smooth(weight[:, :, None] * P, 1.5) / np.maximum(_smooth(weight, 1.5), 1e-12)[:, :, None]
    here, there = room.whitened(P - shadowed), room.whitened(subject - shadowed)
    contrast = _dot(there, there)
    fraction = np.clip(_dot(here, there) / np.maximum(contrast, 1e-6), 0, 1)
    unsure = (inner > 0) | (contrast < 9)  # three deviations
    return np.where(unsure, binary, binary * fraction).astype(np.float32)


def _along_and_across(X: Picture, axis: Picture) -> tuple[Plane, Plane]:
    """Colours [H,W,3] as their component along an axis [H,W,3], [H,W], and what remains across it, [H,W,3]."""
    along = _dot(X, axis)
    return along, X - along[:, :, None] * axis


def _dot(X: Picture, Y: Picture) -> Plane:
    """[H,W] scalar products of colours [H,W,C]."""
    return np.einsum("ijk,ijk->ij", X, Y)


def _variance(squares: Plane, detail: Plane) -> Plane:
    """[H,W] noise variance: of the picture as a whole (median of `squares`), distributed in part as the plate's detail."""
    even = float(np.median(squares[::2, ::2]))
    local = _smooth(detail, 6.0)
    local *= even / max(float(np.median(local[::2, ::2])), 1e-12)
    return np.maximum((1 - DETAIL) * even + DETAIL * local, NOISE_FLOOR**2).astype(np.float32)


def _smooth(values: Picture, deviation: float) -> Plane:
    return np.asarray(cv2.GaussianBlur(values, (0, 0), deviation), dtype=np.float32)
