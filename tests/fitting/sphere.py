"""A ball with a smooth texture, photographed exactly: the smallest capture whose surface is known."""

from __future__ import annotations

import functools
import math

import torch
from torch import Tensor

from torch_surfcap import Cameras, Capture

CENTER, RADIUS = (0.4, -0.2, 1.3), 0.3
DISTANCE, FOCAL = 1.5, 1.5  # of the cameras from the centre, in units of the picture's width
SUBPIXELS = 3  # along a pixel's side


def look_at(eye: Tensor, target: Tensor) -> Tensor:
    """[4, 4] world to camera, OpenCV axes, the world's z up."""
    forward = torch.nn.functional.normalize(target - eye, dim=0)
    right = torch.linalg.cross(forward, torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64))
    right = torch.nn.functional.normalize(right, dim=0)
    rotation = torch.stack([right, torch.linalg.cross(forward, right), forward])
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3], pose[:3, 3] = rotation, -(rotation @ eye)
    return pose


def ring(views: int = 12, arc: float = 2 * math.pi, side: int | list[int] = 64) -> Cameras:
    """Cameras on an arc around the ball, in turn a little below and a little above it, of one or of several sizes."""
    center = torch.tensor(CENTER, dtype=torch.float64)
    sides = [side] * views if isinstance(side, int) else side
    poses, ks = [], []
    for i in range(views):
        angle, height = arc * i / views, 0.5 * (-1) ** i
        way = torch.tensor([math.cos(angle), math.sin(angle), height], dtype=torch.float64)
        poses.append(look_at(center + DISTANCE * way / way.norm(), center))
        f, c = FOCAL * sides[i], sides[i] / 2
        ks.append(torch.tensor([[f, 0.0, c], [0.0, f, c], [0.0, 0.0, 1.0]], dtype=torch.float64))
    return Cameras(torch.stack(ks), torch.stack(poses), torch.tensor([[s, s] for s in sides]))


def color_at(points: Tensor) -> Tensor:
    """[P, 3] colour of the ball at world points."""
    place = (points - torch.tensor(CENTER, dtype=points.dtype)) / RADIUS
    phase = torch.tensor([0.0, 1.0, 2.5], dtype=points.dtype)
    return 0.5 + 0.3 * torch.sin(4 * place.flip(-1) + phase) * torch.cos(3 * place)


def cast(origins: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
    """Whether rays [R, 3] meet the ball, and the colour that they see there."""
    to_center = torch.tensor(CENTER, dtype=torch.float64) - origins
    along = (to_center * directions).sum(-1)
    under = RADIUS**2 - (to_center.square().sum(-1) - along.square())
    t = along - under.clamp(min=0).sqrt()
    return under > 0, color_at(origins + t[:, None] * directions)


def photographed(cameras: Cameras, plates: bool = False) -> Capture:
    """The ball before black; with ``plates``, before a backdrop that is known, and with the masks that follow."""
    images, masks, backdrops = [], [], []
    step = torch.arange(SUBPIXELS, dtype=torch.float64) + 0.5
    inner = torch.cartesian_prod(step, step) / SUBPIXELS - 0.5
    for i in range(len(cameras)):
        width, height = cameras.size[i].tolist()
        pixels = (cameras.pixels(i)[:, None] + inner).reshape(-1, 2)
        hit, color = cast(*cameras.rays(i, pixels))
        hit, color = hit.double().view(-1, SUBPIXELS**2, 1), color.view(-1, SUBPIXELS**2, 3)
        cover = hit.mean(1)
        seen = (hit * color).sum(1) / hit.sum(1).clamp(min=1)  # straight: not darkened at the rim
        v, u = cameras.pixels(i).flip(1).T
        backdrop = torch.stack([u / width, v / height, 0.5 + 0.0 * u], -1)
        if plates:
            seen = cover * seen + (1 - cover) * backdrop
        images.append(seen.view(height, width, 3).float())
        masks.append(cover.view(height, width).float())
        backdrops.append(backdrop.view(height, width, 3).float())
    capture = Capture(images, cameras.K, cameras.world_to_camera, masks, backdrops if plates else None)
    capture.mask_source = "plate" if plates else "file"
    return capture


@functools.cache
def ball(views: int = 12, side: int = 64, plates: bool = False) -> Capture:
    """The ball from a full ring, made once: not to be changed."""
    return photographed(ring(views, side=side), plates)
