"""Cameras on a circle around a mesh, all of one size, that it fills in every one."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
import trimesh
from torch import Tensor
from torch.nn.functional import normalize

from torch_surfcap.data.cameras import Cameras

AWAY = 4.0  # distance of the cameras from the middle, in radii of the mesh: a long lens
MARGIN = 0.05  # of the longer side, left free on all sides
SLIM = 0.5  # least width for a height, and least height for a width
SIDEWAYS = 0.05  # lead in flatness that the y axes need to be taken for the horizontal ones
LEVEL = 1e-3  # mean square of a level camera's roll in radians, roughly


def up_direction(world_to_camera: Tensor) -> Tensor:
    """Unit vector [3], world: up for people who held the cameras [N, 4, 4] level, upright or on their sides.

    The mean u_0 of the pictures' own upward directions leans backward where the cameras look down from one side. A
    level camera's x axis is horizontal, so what u_0 has along directions in which the x axes x_i spread is taken away:
    u ~ (mean x_i x_i^T + LEVEL)^-1 u_0, which stays near u_0 where there are too few cameras to tell. Of cameras on their
    sides the y axes are horizontal and spread in a plane; which end of their x axes is up is told by most looking down.
    """
    right, down, forward = world_to_camera[:, :3, :3].double().unbind(1)
    level, up = right, -down.mean(0)
    if _flatness(down) > 2 * _flatness(right) + SIDEWAYS:
        level, up = down, right.mean(0)
        up = -up if up @ forward.mean(0) > 0 else up
    spread = level.T @ level / len(level) + LEVEL * torch.eye(3, dtype=torch.float64)
    return normalize(torch.linalg.solve(spread, up), dim=0)


def _flatness(directions: Tensor) -> float:
    """1/2 for unit vectors [N, 3] all around in one plane; 0 where they are parallel or in all directions alike."""
    least, middle, _ = torch.linalg.eigvalsh(directions.T @ directions / len(directions))
    return float(middle - least)


def turntable(
    mesh: trimesh.Trimesh,
    up: Tensor,
    count: int,
    elevation: float = 15.0,
    size: int = 720,
    front: Tensor | Sequence[float] | None = None,
) -> Cameras:
    """Cameras at `count` equal angles, counter-clockwise seen from above, looking at the middle of the mesh.

    up: [3], the axis of the turntable, world. elevation: of the cameras over its plane, degrees. size: longer side of
    the pictures, pixels; both sides are even, as films want them. front: a point [3] on whose side the first camera
    stands. The frame holds the mesh at every angle, with its axis in the middle.
    """
    up = normalize(torch.as_tensor(up, dtype=torch.float64), dim=0)
    vertices = torch.from_numpy(np.array(mesh.vertices, dtype=np.float64))
    towards = torch.eye(3, dtype=torch.float64)[up.abs().argmin()]
    if front is not None:
        towards = torch.as_tensor(front, dtype=torch.float64) - vertices.mean(0)
    side = normalize(torch.linalg.cross(up, towards), dim=0)
    axes = torch.stack(
        [torch.linalg.cross(side, up), side, up]
    )  # rows: to the first camera, to its right, up
    local = vertices @ axes.T
    middle = (local.amin(0) + local.amax(0)) / 2
    local -= middle
    away = AWAY * float(local.norm(dim=1).max())
    tilt = math.radians(elevation)
    width, low, high = _extent(local[:, :2].norm(dim=1), local[:, 2], tilt, away)
    height = high - low
    width, height = max(width, SLIM * height), max(height, SLIM * width)
    focal = (1 - 2 * MARGIN) * size / max(width, height)
    pixels = [2 * round(focal * length / 2 + MARGIN * size) for length in (width, height)]
    K = torch.eye(3, dtype=torch.float64)
    K[0, 0] = K[1, 1] = focal
    K[0, 2], K[1, 2] = pixels[0] / 2, pixels[1] / 2 + focal * (low + high) / 2
    poses = [_pose(2 * math.pi * k / count, tilt, axes, axes.T @ middle, away) for k in range(count)]
    return Cameras(K.expand(count, 3, 3), torch.stack(poses), torch.tensor(pixels).expand(count, 2))


def _extent(radius: Tensor, height: Tensor, tilt: float, away: float) -> tuple[float, float, float]:
    """What points turning about the axis at this radius and height [V] cover, at focal length 1: the width to both
    sides, and from where to where it goes up.

    At angle φ from the camera a point shows at r sin φ / (A - B cos φ) and (h cos t - r sin t cos φ) / (A - B cos φ),
    A = away - h sin t and B = r cos t. The first is at most r / sqrt(A^2 - B^2), the second is extreme at cos φ = ±1.
    """
    a, b = away - height * math.sin(tilt), radius * math.cos(tilt)
    wide = radius / (a * a - b * b).sqrt()
    ends = torch.stack(
        [(height * math.cos(tilt) - s * radius * math.sin(tilt)) / (a - s * b) for s in (-1.0, 1.0)]
    )
    return 2 * float(wide.max()), float(ends.min()), float(ends.max())


def _pose(angle: float, tilt: float, axes: Tensor, middle: Tensor, away: float) -> Tensor:
    """World-to-camera [4, 4] of the camera at an angle on the circle."""
    first, side, up = axes
    outward = math.cos(angle) * first + math.sin(angle) * side
    right = math.cos(angle) * side - math.sin(angle) * first
    back = math.cos(tilt) * outward + math.sin(tilt) * up
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = torch.stack([right, torch.linalg.cross(right, back), -back])
    pose[:3, 3] = -pose[:3, :3] @ (middle + away * back)
    return pose
