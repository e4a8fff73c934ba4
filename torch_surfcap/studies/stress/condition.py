"""What a condition of the stability suite is."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torch_surfcap.data.cameras import Cameras
from torch_surfcap.data.capture import Capture
from torch_surfcap.data.images import as_float
from torch_surfcap.studies.stress.scene import Scene

Array = np.ndarray  # of floats

# What is expected. "surface": a sound one. "surface or words": where it is none, the program says why. "words": the program
# says that the input cannot carry a surface, or which camera is out of line. "same": the clean mesh, up to rounding.
EXPECTED = ("surface", "surface or words", "words", "same")


def unchanged(x: Any) -> Any:
    """The same."""
    return x


@dataclass(frozen=True, eq=False)
class Condition:
    """One way to spoil an input.

    severity: as shown, empty where it has no meaning. sentence: what it does. expected: one of EXPECTED. scene, capture:
    what they do to the description of the scene and to the views to fit. settings: of the fit. world: [4,4] similarity
    that the capture's world goes through, None: it stays. threads: of the fit, 0: as many as there are.
    scenes: on which it means something, none: all.
    """

    group: str
    name: str
    severity: str
    sentence: str
    expected: str = "surface"
    scene: Callable[[Scene], Scene] = unchanged
    capture: Callable[[Capture], Capture] = unchanged
    settings: Mapping[str, Any] = field(default_factory=dict)
    world: Tensor | None = None
    threads: int = 0
    scenes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if self.expected not in EXPECTED:
            raise ValueError(f"expected is {self.expected!r}, must be one of {', '.join(EXPECTED)}")

    @property
    def title(self) -> str:
        """Name and severity."""
        return f"{self.name} {self.severity}".strip()


def copied(capture: Capture) -> Capture:
    """A copy whose lists may be replaced; pictures are shared."""
    return capture.subset(range(len(capture)))


def with_cameras(capture: Capture, K: Tensor | None = None, world_to_camera: Tensor | None = None) -> Capture:
    """The same pictures under another calibration."""
    other, cameras = copied(capture), capture.cameras
    other.cameras = Cameras(
        cameras.K if K is None else K,
        cameras.world_to_camera if world_to_camera is None else world_to_camera,
        cameras.size,
    )
    return other


def retouched(capture: Capture, change: Callable[[Array, int, np.random.Generator], Array]) -> Capture:
    """Photographs and plates, which one camera takes alike, through `change`: picture [H,W,3] in [0, 1], number of the
    camera, and a generator of this picture's own. The result is clipped and rounded to 8 bits."""
    other = copied(capture)
    other.images = [_retouch(image, i, 0, change) for i, image in enumerate(capture.images)]
    if capture.plates is not None:
        other.plates = [_retouch(plate, i, 1, change) for i, plate in enumerate(capture.plates)]
    return other


def _retouch(picture: Tensor, i: int, kind: int, change: Callable[..., Array]) -> Tensor:
    pixels = as_float(picture.numpy()).astype(np.float64)
    return eight_bits(change(pixels, i, np.random.default_rng([i, kind])))


def eight_bits(picture: Array) -> Tensor:
    """uint8 of a picture in [0, 1], clipped and rounded."""
    return torch.from_numpy(np.round(255 * np.clip(picture, 0, 1)).astype(np.uint8))
