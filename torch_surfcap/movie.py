"""Films of rendered frames, as MP4 or GIF."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from torch_surfcap.data.files import atomic_write
from torch_surfcap.errors import InputError
from torch_surfcap.report import as_bytes

RATE = 24.0  # frames per second
CODEC = "mp4v"  # MPEG-4 part 2: without licence fees, hence in every OpenCV that writes MP4 at all


def film_suffix(size: tuple[int, int]) -> str:
    """ ".mp4" if this OpenCV encodes films of this width and height, else ".gif"."""
    with tempfile.TemporaryDirectory() as folder:
        writer = _writer(Path(folder) / "probe.mp4", size)
        opened: bool = writer.isOpened()
        writer.release()
    return ".mp4" if opened else ".gif"


@contextmanager
def write_film(path: str | os.PathLike[str], size: tuple[int, int]) -> Iterator[Callable[[Tensor], None]]:
    """Yield the function that adds a frame [H, W, 3] in [0, 1] (clipped); the film is complete or absent.

    path: its suffix is ".mp4" or ".gif" (which repeats for ever). size: (width, height) of the frames, even for MP4.
    Raises InputError where the frames of an MP4 cannot all be read back.
    """
    with atomic_write(path) as partial:
        yield from (_gif if partial.suffix == ".gif" else _mp4)(partial, Path(path), size)


def frames_in(path: Path) -> int:
    """How many frames of a film can be decoded."""
    film, count = cv2.VideoCapture(str(path)), 0
    while film.read()[0]:
        count += 1
    film.release()
    return count


def _mp4(partial: Path, path: Path, size: tuple[int, int]) -> Iterator[Callable[[Tensor], None]]:
    writer, count = _writer(partial, size), 0

    def add(picture: Tensor) -> None:
        nonlocal count
        count += 1
        writer.write(cv2.cvtColor(as_bytes(picture), cv2.COLOR_RGB2BGR))

    try:
        yield add
    finally:
        writer.release()
    if frames_in(partial) != count:
        raise InputError(f"{path}: {frames_in(partial)} of {count} frames could be encoded, try a .gif")


def _gif(partial: Path, path: Path, size: tuple[int, int]) -> Iterator[Callable[[Tensor], None]]:
    frames: list[NDArray[np.uint8]] = []
    yield lambda picture: frames.append(as_bytes(picture))
    first, *others = (Image.fromarray(frame) for frame in frames)
    first.save(partial, save_all=True, append_images=others, duration=round(1000 / RATE), loop=0)


def _writer(path: Path, size: tuple[int, int]) -> cv2.VideoWriter:
    return cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*CODEC), RATE, size)
