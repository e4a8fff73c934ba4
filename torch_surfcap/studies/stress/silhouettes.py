"""Masks that are too wide, too narrow, broken or missing, and photographs cut out badly."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
import torch

from torch_surfcap.data.capture import Capture
from torch_surfcap.data.morphology import widened
from torch_surfcap.studies.stress.condition import Array, Condition, copied, eight_bits

GROUP = "silhouettes"
HOLE = 0.04  # radius of a hole, of the picture's width
FRINGE = 2  # pixels of the room that stay around a subject that was cut out


def grown(capture: Capture, pixels: int) -> Capture:
    """Masks grown by so many pixels to all sides, shrunk where negative."""
    return _masked(capture, lambda mask, i: widened(mask, pixels))


def holed(capture: Capture, holes: int) -> Capture:
    """So many round holes in every mask, each in a place of its own."""

    def change(mask: Array, i: int) -> Array:
        rng, holed = np.random.default_rng(i), mask.copy()
        rows, columns = np.nonzero(mask > 0.5)
        for at in rng.integers(len(rows), size=holes) if len(rows) else ():
            center = (int(columns[at]), int(rows[at]))
            cv2.circle(holed, center, round(HOLE * mask.shape[1]), 0.0, -1)
        return holed

    return _masked(capture, change)


def missing(capture: Capture, every: int) -> Capture:
    """Every so many-th mask is empty."""
    return _masked(capture, lambda mask, i: mask * 0 if i % every == 0 else mask)


def without(capture: Capture, plates: bool) -> Capture:
    """No masks at all; the plates stay, or go too."""
    other = copied(capture)
    other.masks = other.mask_source = None
    return other if plates else without_plates(other)


def without_plates(capture: Capture) -> Capture:
    """No pictures of the empty room."""
    other = copied(capture)
    other.plates = None
    return other


def composited(capture: Capture, level: float) -> Capture:
    """Cut out and put before a background of one grey, with a fringe of the room around the subject; no plates."""
    assert capture.masks is not None
    other = without_plates(capture)
    kernel = np.ones((2 * FRINGE + 1, 2 * FRINGE + 1), np.uint8)
    for i, mask in enumerate(capture.masks):
        alpha = cv2.dilate(mask.numpy(), kernel)[:, :, None]
        other.images[i] = eight_bits(alpha * capture.photograph(i).numpy() + (1 - alpha) * level)
    return other


def _masked(capture: Capture, change: Callable[[Array, int], Array]) -> Capture:
    other = copied(capture)
    assert capture.masks is not None
    other.masks = [torch.from_numpy(change(mask.numpy(), i)) for i, mask in enumerate(capture.masks)]
    return other


def conditions() -> list[Condition]:
    """Width, holes, absence, shadows, fringes."""
    found = []
    for name, sign in (("eroded", -1), ("dilated", 1)):
        for pixels in (1, 3, 8):
            sentence = f"All masks are {name} by {pixels} pixels."
            expected = "surface" if pixels < 8 or sign > 0 else "surface or words"
            change: Callable[[Capture], Capture] = lambda c, n=sign * pixels: grown(c, n)  # type: ignore[misc]  # noqa: E731
            found.append(Condition(GROUP, name, f"{pixels} px", sentence, expected, capture=change))
    for name, pixels in (("eroded, no plates", -3), ("dilated, no plates", 3)):
        found.append(
            Condition(
                GROUP,
                name,
                "3 px",
                f"All masks are {name.partition(',')[0]} by 3 pixels, and there are no plates.",
                capture=lambda capture, n=pixels: grown(without_plates(capture), n),  # type: ignore[misc]
            )
        )
    for holes in (1, 3, 8):
        found.append(
            Condition(
                GROUP,
                "holes",
                f"{holes}",
                f"Every mask has {holes} round holes of 8 % of the picture's width.",
                "surface or words",
                capture=lambda capture, n=holes: holed(capture, n),  # type: ignore[misc]
            )
        )
    for every in (10, 3):
        found.append(
            Condition(
                GROUP,
                "missing",
                f"1 of {every}",
                f"One mask in {every} is empty.",
                "words",
                capture=lambda capture, n=every: missing(capture, n),  # type: ignore[misc]
            )
        )
    return [
        *found,
        Condition(GROUP, "none, with plates", "", "There are no masks.", capture=lambda c: without(c, True)),
        Condition(
            GROUP,
            "none, no plates",
            "",
            "There are neither masks nor plates.",
            "words",
            capture=lambda c: without(c, False),
        ),
        Condition(
            GROUP,
            "shadow",
            "",
            "The masks hold the subject's shadow on the floor.",
            scene=lambda scene: replace(scene, shadow=True),
        ),
        *(
            Condition(
                GROUP,
                f"on {word}",
                "",
                f"Cut out and put on {word} with 2 pixels of the room around it; no plates.",
                capture=lambda capture, level=level: composited(capture, level),  # type: ignore[misc]
            )
            for word, level in (("white", 1.0), ("black", 0.0))
        ),
    ]
