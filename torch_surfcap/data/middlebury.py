"""Middlebury multi-view stereo: NAME_par.txt beside its photographs, a black background and no masks.

First line: the number of views; then, one line each, the picture's name, K, R and t row by row. P = K [R|t], OpenCV
axes, integer pixel centres.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from torch_surfcap.data.parse import pose
from torch_surfcap.data.view import View
from torch_surfcap.errors import InputError

NUMBERS = 9 + 9 + 3


def find(path: Path) -> Path | None:
    """The calibration file of a folder, or the file itself where it is one of this format."""
    if path.is_dir():
        return next(iter(sorted(path.glob("*_par.txt"))), None)
    return path if path.name.endswith("_par.txt") else None


def read(path: Path) -> list[View]:
    """One view per line."""
    try:
        lines = [line.split() for line in path.read_text(encoding="utf-8").splitlines() if line.strip()]
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: cannot be read ({error}), expected a text file") from error
    if not lines or len(lines[0]) != 1 or not lines[0][0].isdigit():
        raise InputError(f"{path}: line 1 is no number, expected the number of views")
    stated = int(lines[0][0])
    if stated != len(lines) - 1:
        raise InputError(f"{path}: {len(lines) - 1} lines of cameras, expected {stated} as line 1 states")
    views = []
    for number, (name, *words) in enumerate(lines[1:], start=2):
        source = f"{path}, line {number}"
        try:
            values = np.array(words, dtype=np.float64)
        except ValueError:
            raise InputError(f"{source}: not numeric, expected a name and {NUMBERS} numbers") from None
        if len(values) != NUMBERS:
            raise InputError(f"{source}: {len(values)} numbers after {name}, expected {NUMBERS}")
        K = values[:9].reshape(3, 3).copy()
        K[:2, 2] += 0.5  # the first pixel's centre moves from (0, 0) to (0.5, 0.5)
        image = path.parent / name
        views.append(View(image.stem, image, source, K, pose(values[9:18].reshape(3, 3), values[18:])))
    return views
