"""Which format a capture is in. Each format is one file with `find(folder)` and `read(file)`."""

from __future__ import annotations

from pathlib import Path

from torch_surfcap.data import idr, middlebury, rig, transforms
from torch_surfcap.data.view import View
from torch_surfcap.errors import InputError

# in the order of preference where a folder holds more than one
FORMATS = {"transforms": transforms, "rig": rig, "idr": idr, "middlebury": middlebury}
EXPECTED = (
    "transforms.json or transforms_train.json, rig.json, cameras_sphere.npz or cameras.npz, or *_par.txt"
)


def read_views(path: Path, format: str = "auto") -> tuple[str, list[View]]:
    """Format and views of a capture folder, or of the calibration file itself. Raises InputError with what was expected."""
    if format != "auto" and format not in FORMATS:
        raise InputError(f"format={format}, expected one of auto, {', '.join(FORMATS)}")
    if not path.exists():
        raise InputError(f"{path}: no such file or folder, expected a capture")
    wanted = FORMATS if format == "auto" else {format: FORMATS[format]}
    for name, reader in wanted.items():
        calibration = reader.find(path)
        if calibration is not None:
            views = reader.read(calibration)
            if not views:
                raise InputError(f"{calibration}: no cameras, expected at least 3")
            return name, views
    raise InputError(f"{path}: no calibration found, expected {EXPECTED}")
