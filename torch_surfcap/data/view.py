"""One view as a calibration file states it, before any pixel is read. Readers return lists of these."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

Matrix = NDArray[np.float64]


@dataclass
class View:
    """A named photograph with its files and calibration, in the package's own convention.

    name:            unique within the capture
    image:           the photograph
    source:          what to name in an error about the calibration, such as "cams/transforms.json, frame 3"
    K:               [3,3] in pixels with the first pixel centred at (0.5, 0.5), or a function of the picture's
                     (width, height) where the file states angles only
    world_to_camera: [4,4], OpenCV axes
    mask, plate:     further pictures of the same size, if any
    distortion:      k1 k2 p1 p2 [k3 [k4 k5 k6]] as cv2 orders them; empty: none
    size:            width and height that the calibration was made for, None where not stated
    held_out:        never to be seen by a fit
    """

    name: str
    image: Path
    source: str
    K: Matrix | Callable[[int, int], Matrix]
    world_to_camera: Matrix
    mask: Path | None = None
    plate: Path | None = None
    distortion: tuple[float, ...] = ()
    size: tuple[int, int] | None = None
    held_out: bool = False

    def calibration(self, width: int, height: int) -> Matrix:
        """K [3,3] for a picture of this width and height."""
        return self.K(width, height) if callable(self.K) else self.K
