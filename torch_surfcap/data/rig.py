"""Our own calibration: one JSON file, in the package's convention, for rigs that no other format fits.

    {"cameras": [
        {"name": "left",
         "image": "left.png",
         "plate": "empty/left.png",
         "mask": "masks/left.png",
         "K": [[1000, 0, 320], [0, 1000, 240], [0, 0, 1]],
         "R": [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
         "t": [0, 0, 2],
         "distortion": [-0.1, 0.01, 0, 0],
         "held_out": false},
        ...]}

name        unique; by default the image's stem
image       file name relative to the JSON file, as are plate and mask; those two may be missing
K           pixels; the first pixel is centred at (0.5, 0.5), so a width of 640 and a central axis give cx = 320
R, t        a world point X lies at R X + t in the camera's axes: x right, y down, z forward; any unit of length
distortion  k1 k2 p1 p2 [k3 [k4 k5 k6]] as OpenCV defines them; undone when the pictures are read
held_out    true: never seen by a fit, used for scores only

The file is called rig.json, or is named itself. Pictures may differ in size from camera to camera.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from torch_surfcap.data.parse import matrix, pose, read_json
from torch_surfcap.data.view import View
from torch_surfcap.errors import InputError

KEYS = {"name", "image", "plate", "mask", "K", "R", "t", "distortion", "held_out"}
NEEDED = ("image", "K", "R", "t")
OPTIONAL = ", ".join(sorted(KEYS - set(NEEDED)))
DISTORTION = (0, 4, 5, 8)


def find(path: Path) -> Path | None:
    """The calibration file of a folder, or the file itself where it is one of this format."""
    if path.is_dir():
        return path / "rig.json" if (path / "rig.json").is_file() else None
    return path if path.suffix == ".json" and "cameras" in read_json(path) else None


def read(path: Path) -> list[View]:
    """One view per camera object."""
    cameras = read_json(path).get("cameras")
    if not isinstance(cameras, list):
        raise InputError(f"{path}: no list of cameras, expected the key 'cameras' with one object per camera")
    return [_view(camera, path, number) for number, camera in enumerate(cameras)]


def _view(camera: Any, path: Path, number: int) -> View:
    source = f"{path}, camera {number}"
    if not isinstance(camera, dict):
        raise InputError(f"{source}: a {type(camera).__name__}, expected an object with {', '.join(NEEDED)}")
    source = f"{path}, camera {camera.get('name', number)}"
    missing = [key for key in NEEDED if key not in camera]
    unknown = sorted(set(camera) - KEYS)
    if missing or unknown:
        found = f"{missing[0]} is missing" if missing else f"unknown key {unknown[0]}"
        raise InputError(
            f"{source}: {found}, expected {', '.join(NEEDED)} and optionally {', '.join(sorted(KEYS - set(NEEDED)))}"
        )
    distortion = camera.get("distortion") or ()
    if not isinstance(distortion, (list, tuple)) or len(distortion) not in DISTORTION:
        raise InputError(
            f"{source}: distortion {distortion}, expected 4, 5 or 8 numbers k1 k2 p1 p2 [k3 [k4 k5 k6]]"
        )
    held_out = camera.get("held_out", False)
    if not isinstance(held_out, bool):
        raise InputError(f"{source}: held_out is {held_out!r}, expected true or false")
    image = path.parent / str(camera["image"])
    return View(
        name=str(camera.get("name", image.stem)),
        image=image,
        source=source,
        K=matrix(camera["K"], (3, 3), "K", source),
        world_to_camera=pose(
            matrix(camera["R"], (3, 3), "R", source), matrix(camera["t"], (3,), "t", source)
        ),
        mask=path.parent / str(camera["mask"]) if camera.get("mask") else None,
        plate=path.parent / str(camera["plate"]) if camera.get("plate") else None,
        distortion=tuple(matrix(distortion, (len(distortion),), "distortion", source).tolist()),
        held_out=held_out,
    )
