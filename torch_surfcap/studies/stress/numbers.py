"""What should change nothing: the world's unit, origin and axes, the order of the cameras, threads, rounding, the seed."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from torch_surfcap.data.cameras import Cameras
from torch_surfcap.data.capture import Capture
from torch_surfcap.studies.stress.condition import Condition, with_cameras

GROUP = "numbers"


def similarity(
    scale: float = 1.0, degrees: float = 0.0, shift: tuple[float, float, float] = (0, 0, 0)
) -> Tensor:
    """[4,4] float64: turned about (1, 2, 3), scaled, then shifted."""
    axis = np.radians(degrees) * np.array([1.0, 2.0, 3.0]) / np.sqrt(14.0)
    x, y, z = axis
    turn = torch.linalg.matrix_exp(torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=torch.float64))
    world = torch.eye(4, dtype=torch.float64)
    world[:3, :3], world[:3, 3] = scale * turn, torch.tensor(shift, dtype=torch.float64)
    return world


def moved(capture: Capture, world: Tensor) -> Capture:
    """The same pictures, held-out ones too, in a world that went through a similarity."""
    other = with_cameras(capture, world_to_camera=_moved(capture.cameras, world))
    if capture.test is not None:
        other.test = with_cameras(capture.test, world_to_camera=_moved(capture.test.cameras, world))
    return other


def _moved(cameras: Cameras, world: Tensor) -> Tensor:
    scale = float(torch.linalg.det(world[:3, :3])) ** (1 / 3)
    pose = cameras.world_to_camera @ torch.linalg.inv(world)
    pose[:, :3] *= scale  # back to a rotation; depths grow with the world
    return pose


def permuted(capture: Capture) -> Capture:
    """The cameras in another order, under their names."""
    return capture.subset(np.random.default_rng(11).permutation(len(capture)).tolist())


def rounded(capture: Capture) -> Capture:
    """A calibration that went through float32."""
    cameras = capture.cameras
    return with_cameras(capture, cameras.K.float().double(), cameras.world_to_camera.float().double())


def conditions() -> list[Condition]:
    """Worlds, orders, threads, rounding, seeds."""

    def world(name: str, severity: str, sentence: str, through: Tensor) -> Condition:
        return Condition(
            GROUP,
            name,
            severity,
            sentence,
            "same",
            capture=lambda capture: moved(capture, through),
            world=through,
        )

    return [
        world("unit", "mm", "Lengths are in millimetres.", similarity(1000.0)),
        world("unit", "km", "Lengths are in kilometres.", similarity(0.001)),
        world("far away", "1 km", "The origin is 1 km away.", similarity(shift=(600.0, -640.0, 480.0))),
        world("far away", "100 km", "The origin is 100 km away.", similarity(shift=(6e4, -6.4e4, 4.8e4))),
        world("rotated", "", "The world is turned by 50 degrees about (1, 2, 3).", similarity(degrees=50.0)),
        Condition(GROUP, "permuted", "", "The cameras come in another order.", "same", capture=permuted),
        Condition(
            GROUP, "float32", "", "The calibration is rounded to single precision.", "same", capture=rounded
        ),
        Condition(
            GROUP,
            "double",
            "",
            "All arithmetic of the fit is in double precision.",
            "same",
            settings={"storage": 64},
        ),
        Condition(GROUP, "threads", "1", "One thread.", "same", threads=1),
        Condition(GROUP, "repeated", "", "The clean run once more.", "same"),
        *(Condition(GROUP, "seed", f"{seed}", "Another seed.", settings={"seed": seed}) for seed in (1, 2)),
    ]
