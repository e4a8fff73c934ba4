"""Reading calibration text: JSON objects and number arrays, with errors that say where and what."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from torch_surfcap.data.view import Matrix
from torch_surfcap.errors import InputError


def read_json(path: Path) -> dict[str, Any]:
    """The JSON object in a file."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}), expected a JSON file") from error
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: no valid JSON ({error}), expected an object") from error
    if not isinstance(content, dict):
        raise InputError(f"{path}: a JSON {type(content).__name__}, expected an object")
    return content


def matrix(values: Any, shape: tuple[int, ...], what: str, source: str) -> Matrix:
    """`values` as float64 of `shape`; `what` and `source` are named in the InputError otherwise."""
    expected = "x".join(str(n) for n in shape)
    try:
        array = np.array(values, dtype=np.float64)
    except (TypeError, ValueError):
        raise InputError(f"{source}: {what} is not numeric, expected {expected} numbers") from None
    if array.shape != shape:
        found = "x".join(str(n) for n in array.shape) or "a single number"
        raise InputError(f"{source}: {what} is {found}, expected {expected} numbers")
    return array


def pose(R: Matrix, t: Matrix) -> Matrix:
    """[4,4] from a rotation [3,3] and a translation [3]."""
    world_to_camera = np.eye(4)
    world_to_camera[:3, :3], world_to_camera[:3, 3] = R, t.reshape(3)
    return world_to_camera
