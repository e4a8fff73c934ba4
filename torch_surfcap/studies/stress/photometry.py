"""Photographs whose values are not those that the common exposure would give."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
import torch

from torch_surfcap.data.capture import Capture
from torch_surfcap.studies.stress.condition import Array, Condition, copied, retouched
from torch_surfcap.studies.stress.scene import WRONG

GROUP = "photometry"


def gains(capture: Capture, most: float, channels: int = 1) -> Capture:
    """Each camera's photograph and plate times a factor of its own, of one channel or three, within 1 ± most."""
    factors = 1 + most * np.random.default_rng(5).uniform(-1, 1, (len(capture), channels))
    return retouched(capture, lambda picture, i, rng: picture * factors[i])


def vignetted(capture: Capture, most: float) -> Capture:
    """Darker from the middle outwards, by the square of the distance, by `most` in the corners."""

    def change(picture: Array, i: int, rng: np.random.Generator) -> Array:
        height, width = picture.shape[:2]
        v, u = np.mgrid[0:height, 0:width] + 0.5
        squared = ((u - width / 2) ** 2 + (v - height / 2) ** 2) / ((width**2 + height**2) / 4)
        return picture * (1 - most * squared)[:, :, None]

    return retouched(capture, change)


def noisy(capture: Capture, deviation: float) -> Capture:
    """Gaussian noise of this deviation on every value."""
    return retouched(capture, lambda picture, i, rng: picture + rng.normal(0, deviation, picture.shape))


def blurred(capture: Capture, deviation: float) -> Capture:
    """Under a Gaussian of this deviation, pixels."""
    return retouched(
        capture, lambda picture, i, rng: np.asarray(cv2.GaussianBlur(picture, (0, 0), deviation))
    )


def jpeg(capture: Capture, quality: int) -> Capture:
    """As JPEG of this quality keeps it."""

    def change(picture: Array, i: int, rng: np.random.Generator) -> Array:
        pixels = np.round(255 * picture[:, :, ::-1]).astype(np.uint8)
        _, code = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, quality])
        decoded = cv2.imdecode(code, cv2.IMREAD_COLOR)
        assert decoded is not None
        return decoded[:, :, ::-1] / 255.0

    return retouched(capture, change)


def over_exposed(capture: Capture, factor: float) -> Capture:
    """Every second camera exposed so many times as long: bright parts are clipped."""
    return retouched(capture, lambda picture, i, rng: picture * (factor if i % 2 else 1.0))


def black_frame(capture: Capture) -> Capture:
    """The photograph of one camera is black; its mask and plate are there."""
    other = copied(capture)
    other.images[WRONG] = torch.zeros_like(other.images[WRONG])
    return other


def conditions() -> list[Condition]:
    """Exposure, colour, lenses, noise, compression, a dead frame, a frame of another moment."""

    def three(
        name: str,
        sentence: str,
        change: Callable[[Capture, float], Capture],
        values: tuple[float, ...],
        form: str = "{:g}",
    ) -> list[Condition]:
        return [
            Condition(
                GROUP,
                name,
                form.format(value),
                sentence.format(form.format(value)),
                capture=lambda capture, value=value: change(capture, value),  # type: ignore[misc]
            )
            for value in values
        ]

    return [
        *three("gain", "Every camera has a gain of its own within {}.", gains, (0.05, 0.2, 0.4), "±{:.0%}"),
        *three(
            "colour cast",
            "Every camera has three gains, one per channel, within {}.",
            lambda capture, most: gains(capture, most, 3),
            (0.05, 0.15, 0.3),
            "±{:.0%}",
        ),
        *three("vignetting", "The pictures' corners are {} darker.", vignetted, (0.1, 0.3, 0.6), "{:.0%}"),
        *three("noise", "Gaussian noise of deviation {}.", noisy, (0.02, 0.05, 0.1)),
        *three("blur", "Gaussian blur of deviation {}.", blurred, (0.5, 1.0, 2.0), "{:g} px"),
        *three(
            "JPEG",
            "Compressed at quality {}.",
            lambda capture, quality: jpeg(capture, int(quality)),
            (80, 40, 15),
        ),
        *three(
            "over-exposure",
            "Every second camera took in {} times the light, and clips.",
            over_exposed,
            (1.3, 1.8, 3),
        ),
        Condition(GROUP, "black frame", "", "One photograph is black.", "words", capture=black_frame),
        Condition(
            GROUP,
            "another moment",
            "",
            "One camera saw the subject turned by 40 degrees.",
            "words",
            scene=lambda scene: replace(scene, moment=True),
        ),
    ]
