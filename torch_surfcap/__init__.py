"""Calibrated photographs in, a detailed coloured triangle mesh out."""

from torch_surfcap.data.cameras import Cameras
from torch_surfcap.data.capture import Capture, load_capture
from torch_surfcap.errors import InputError
from torch_surfcap.field.field import RayOutput, SurfaceField
from torch_surfcap.fitting.fit import FitResult, fit
from torch_surfcap.version import VERSION as __version__  # noqa: F401

__all__ = [
    "Cameras",
    "Capture",
    "FitResult",
    "InputError",
    "RayOutput",
    "SurfaceField",
    "fit",
    "load_capture",
]
