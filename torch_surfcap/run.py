"""A finished run, read back from the folder that train/fit.py wrote."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import trimesh

from torch_surfcap import config as settings
from torch_surfcap import devices
from torch_surfcap.data.geometry import read_mesh
from torch_surfcap.data.parse import read_json
from torch_surfcap.errors import InputError
from torch_surfcap.field.field import SurfaceField

FILES = ("config.yaml", "field.npz", "mesh.ply")  # without which a run can be neither scored nor shown


def check_run(run: Path) -> None:
    """Raises InputError naming the file that a finished run lacks."""
    for name in FILES:
        if not (run / name).is_file():
            raise InputError(f"{run / name}: not there, expected the folder of a finished fit")


def read_run(run: Path, device: str = "cpu") -> tuple[settings.Config, SurfaceField, trimesh.Trimesh]:
    """Config, field and mesh of a finished run, the field on a device (auto, cpu, cuda, cuda:0, ...).

    Raises InputError naming the file that is missing or damaged, or the device that cannot be used.
    """
    there = devices.resolve(device)
    check_run(run)
    config = settings.load(run / "config.yaml")
    return config, SurfaceField.load(run / "field.npz").to(there), read_mesh(run / "mesh.ply")


def gains_fitted(run: Path) -> bool:
    """Whether a finished run brought its cameras to a common exposure, by its metrics.json; False without one."""
    return _chosen(run, "gains").get("value") == "on"


def motions(run: Path) -> dict[str, list[float]]:
    """How the cameras of a finished run were refined, see ``FitResult.motion``."""
    found = _chosen(run, "cameras").get("motion", {})
    return found if isinstance(found, dict) else {}


def _chosen(run: Path, name: str) -> dict[str, Any]:
    """What a run's metrics.json says of a choice."""
    path = run / "metrics.json"
    chosen = read_json(path).get("chosen", {}) if path.is_file() else {}
    found = chosen.get(name, {}) if isinstance(chosen, dict) else {}
    return found if isinstance(found, dict) else {}
