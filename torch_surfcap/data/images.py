"""Reading pictures from files and making them smaller. Arrays are [H,W,C] in RGB(A) order.

EXIF rotation is ignored: calibration belongs to the pixels as they are stored.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from torch_surfcap.errors import InputError

Picture = NDArray[Any]
Plane = NDArray[np.float32]
SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff")


def _decode(path: Path) -> Picture:
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        raise InputError(f"{path}: no such file, expected a picture") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}), expected a picture") from error
    if not data:
        raise InputError(f"{path}: the file is empty, expected a PNG, JPEG or TIFF picture")
    # libpng complains on stderr by itself; a PNG without its last chunk is known to be cut off before it is asked
    cut = data[:4] == b"\x89PNG" and b"IEND" not in data[-64:]
    pixels = None if cut else cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if pixels is None:
        raise InputError(
            f"{path}: damaged or no picture ({len(data)} bytes), expected a PNG, JPEG or TIFF picture"
        )
    return pixels


def _unit(pixels: Picture, path: Path) -> Picture:
    """8-bit pictures stay as they are, everything else becomes float32 in [0, 1]."""
    if pixels.dtype == np.uint8:
        return pixels
    if pixels.dtype == np.uint16:
        return pixels.astype(np.float32) / np.float32(65535)
    if pixels.dtype.kind == "f":
        return pixels.astype(np.float32)
    raise InputError(f"{path}: pixels of type {pixels.dtype}, expected 8 or 16 bit or float")


def as_float(pixels: Picture) -> Plane:
    """Pixels as float32, 8-bit ones divided by 255."""
    if pixels.dtype == np.uint8:
        return pixels.astype(np.float32) / np.float32(255)
    return pixels.astype(np.float32, copy=False)


def read_picture(path: Path) -> tuple[Picture, Picture | None]:
    """Colours [H,W,3] and alpha [H,W] (None without one), uint8 or float32 in [0, 1].

    Grey pictures get three equal channels. Raises InputError naming the file where it is missing or unreadable.
    """
    pixels = _unit(_decode(path), path)
    channels = 1 if pixels.ndim == 2 else pixels.shape[2]
    if channels == 1:
        return np.repeat(pixels.reshape(*pixels.shape[:2], 1), 3, axis=2), None
    if channels == 2:
        return np.repeat(pixels[:, :, :1], 3, axis=2), np.ascontiguousarray(pixels[:, :, 1])
    if channels == 3:
        return cv2.cvtColor(pixels, cv2.COLOR_BGR2RGB), None
    if channels == 4:
        return cv2.cvtColor(pixels, cv2.COLOR_BGRA2RGB), np.ascontiguousarray(pixels[:, :, 3])
    raise InputError(f"{path}: {channels} channels, expected 1 to 4")


def read_mask(path: Path) -> Plane:
    """Mask [H,W], float32, 1 on the subject. Label pictures with values 0 and 1 are understood."""
    raw = _decode(path)
    if raw.ndim == 3:
        grey = {3: cv2.COLOR_BGR2GRAY, 4: cv2.COLOR_BGRA2GRAY}.get(raw.shape[2])
        raw = raw[:, :, 0] if grey is None else cv2.cvtColor(raw, grey)
    labels = raw.dtype.kind == "u" and raw.max() == 1
    plane = raw.astype(np.float32) if labels else as_float(_unit(raw, path))
    return np.clip(plane, 0.0, 1.0)


def undistort(pixels: Picture, K: NDArray[np.float64], distortion: tuple[float, ...]) -> Picture:
    """The picture that a lens without distortion would have taken with the same K [3,3].

    What the real lens did not see becomes 0. cv2 centres the first pixel at (0, 0), hence the half pixel.
    """
    centred = K.copy()
    centred[:2, 2] -= 0.5
    height, width = pixels.shape[:2]
    u, v = np.meshgrid(np.arange(width, dtype=np.float64), np.arange(height, dtype=np.float64))
    rays = np.linalg.solve(centred, np.stack([u.ravel(), v.ravel(), np.ones(u.size)]))
    # initUndistortRectifyMap ignores the skew of K, so the rays are bent by projectPoints and given K's skew here
    bent, _ = cv2.projectPoints(
        rays.T.copy(), np.zeros(3), np.zeros(3), np.eye(3), np.array(distortion, np.float64)
    )
    source = bent.reshape(-1, 2) @ centred[:2, :2].T + centred[:2, 2]
    x, y = (source[:, axis].reshape(height, width).astype(np.float32) for axis in (0, 1))
    straight: Picture = cv2.remap(
        pixels, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=0
    )
    return straight


def shrink(pixels: Picture, size: tuple[int, int], weight: Plane | None = None) -> Plane:
    """Area mean at `size` (width, height), float32.

    With `weight` [H,W] it is the weighted mean, and the plain one where all weights are 0: a photograph that will be
    composited with its mask m keeps mean(m·C) = mean(m)·result, so compositing and shrinking may change places.
    """
    if weight is None:
        return _area(as_float(pixels), size)
    peak = 255.0 if pixels.dtype == np.uint8 else 1.0
    mean = np.maximum(_area(weight, size), 1e-6)[:, :, None]
    weighted = cv2.multiply(pixels, cv2.merge([weight] * pixels.shape[2]), scale=1 / peak, dtype=cv2.CV_32F)
    plain = as_float(cv2.resize(pixels, size, interpolation=cv2.INTER_AREA))
    return np.where(mean > 1e-6, _area(weighted, size) / mean, plain)


def _area(pixels: Picture, size: tuple[int, int]) -> Plane:
    return np.asarray(cv2.resize(pixels, size, interpolation=cv2.INTER_AREA), dtype=np.float32)
