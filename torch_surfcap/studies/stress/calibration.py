"""Cameras that are not where, and not what, their calibration says. Errors are in pixels at the subject."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
import torch
from torch import Tensor

from torch_surfcap.data.capture import Capture
from torch_surfcap.data.checks import meeting_point
from torch_surfcap.studies.stress.condition import Condition, copied, with_cameras
from torch_surfcap.studies.stress.scene import WRONG

GROUP = "calibration"
PIXELS = (0.25, 1.0, 4.0)


def _directions(capture: Capture, pixels: float) -> Tensor:
    """[N,2] shifts of the picture by so many pixels, each camera's into a direction of its own."""
    angle = torch.from_numpy(np.random.default_rng(7).uniform(0, 2 * np.pi, len(capture)))
    return pixels * torch.stack([angle.cos(), angle.sin()], dim=1)


def rotated(capture: Capture, pixels: float) -> Capture:
    """Every camera turned about its own centre, so that its picture's middle moves by `pixels`."""
    cameras, pose = capture.cameras, capture.cameras.world_to_camera.clone()
    shift = _directions(capture, pixels)
    for i in range(len(cameras)):
        angles = torch.atan(shift[i] / cameras.K[i, [0, 1], [0, 1]])
        axis = torch.stack(
            [-angles[1], angles[0], angles.new_zeros(())]
        )  # moves the forward axis along the shift
        turn = torch.linalg.matrix_exp(_cross(axis))
        pose[i, :3] = turn @ pose[i, :3]
    return with_cameras(capture, world_to_camera=pose)


def _cross(axis: Tensor) -> Tensor:
    x, y, z = axis.tolist()
    return torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=torch.float64)


def translated(capture: Capture, pixels: float) -> Capture:
    """Every camera moved across its line of sight, so that the subject moves by `pixels` in its picture."""
    cameras, pose = capture.cameras, capture.cameras.world_to_camera.clone()
    subject = torch.cat([meeting_point(capture), torch.ones(1, dtype=torch.float64)])
    depth = (pose @ subject)[:, 2:3]
    pose[:, :2, 3] += _directions(capture, pixels) * depth / cameras.K[:, [0, 1], [0, 1]]
    return with_cameras(capture, world_to_camera=pose)


def zoomed(capture: Capture, pixels: float) -> Capture:
    """Focal lengths too long and too short by turns, so that the picture's border moves by `pixels`."""
    K = capture.cameras.K.clone()
    sign = torch.tensor([(-1.0) ** i for i in range(len(K))], dtype=torch.float64)
    factor = 1 + sign * pixels / (0.5 * capture.cameras.size[:, 0])
    K[:, 0, 0] *= factor
    K[:, 1, 1] *= factor
    return with_cameras(capture, K=K)


def off_centre(capture: Capture, pixels: float) -> Capture:
    """Every principal point moved by `pixels` into a direction of its own."""
    K = capture.cameras.K.clone()
    K[:, :2, 2] += _directions(capture, pixels)
    return with_cameras(capture, K=K)


def one_wrong(capture: Capture) -> Capture:
    """One camera with the pose of the one farthest from it."""
    pose, centers = capture.cameras.world_to_camera.clone(), capture.cameras.centers
    pose[WRONG] = pose[int((centers - centers[WRONG]).norm(dim=1).argmax())]
    return with_cameras(capture, world_to_camera=pose)


def distorted(capture: Capture, pixels: float) -> Capture:
    """Pictures through a barrel-shaped lens that moves the middle of their sides by `pixels`; the calibration says none."""
    other = copied(capture)
    parts = [part for part in (other.images, other.masks, other.plates) if part is not None]
    for i, (width, height) in enumerate(capture.cameras.size.tolist()):
        v, u = np.mgrid[0:height, 0:width].astype(np.float32)
        x, y = (u + 0.5) / width * 2 - 1, (v + 0.5) / height * 2 - 1
        outward = 1 + pixels / (0.5 * width) * (x**2 + y**2)
        at = ((x * outward + 1) * width / 2 - 0.5, (y * outward + 1) * height / 2 - 0.5)
        for part in parts:
            border = cv2.BORDER_REPLICATE
            warped = cv2.remap(
                part[i].numpy(),
                at[0].astype(np.float32),
                at[1].astype(np.float32),
                cv2.INTER_LINEAR,
                borderMode=border,
            )
            part[i] = torch.from_numpy(warped)
    return other


def conditions() -> list[Condition]:
    """Poses, focal lengths, principal points, one camera wholly wrong, a lens's distortion."""
    kinds: dict[str, tuple[str, Callable[[Capture, float], Capture]]] = {
        "rotation": ("Every camera is turned, so that its picture moves by {:g} pixels.", rotated),
        "translation": (
            "Every camera is moved sideways, so that its picture moves by {:g} pixels.",
            translated,
        ),
        "focal length": ("Focal lengths are off, so that the pictures' borders move by {:g} pixels.", zoomed),
        "principal point": ("Every principal point is off by {:g} pixels.", off_centre),
        "distortion ignored": ("Lenses move the middle of the pictures' sides by {:g} pixels.", distorted),
    }
    found = [
        Condition(
            GROUP,
            name,
            f"{pixels:g} px",
            sentence.format(pixels),
            "surface" if pixels < 4 else "surface or words",
            capture=lambda capture, change=change, pixels=pixels: change(capture, pixels),  # type: ignore[misc]
        )
        for name, (sentence, change) in kinds.items()
        for pixels in PIXELS
    ]
    wrong = "One camera has the pose of the one farthest from it."
    return [*found, Condition(GROUP, "one camera wrong", "", wrong, "words", capture=one_wrong)]
