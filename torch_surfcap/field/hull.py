"""The soft visual hull: where the subject can be, by its silhouettes alone.

At a point it is the least of the bilinearly read masks of the cameras that see the point, so its level 1/2 is the
classic visual hull with subpixel borders. Space that too few cameras see is outside, and so are phantoms: where the
silhouettes of two or three cameras meet beside the view of all others, nothing speaks against a subject.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from scipy.ndimage import label
from torch import Tensor

from torch_surfcap import ops
from torch_surfcap.data.cameras import Cameras
from torch_surfcap.data.capture import Capture
from torch_surfcap.data.checks import meeting_point
from torch_surfcap.errors import InputError

CHUNK = 1 << 20  # points a call, to bound the memory
BOX_CELLS = 64  # along the longest side of the search for the box
BOX_ROUNDS = 6


@dataclass(frozen=True)
class Silhouettes:
    """The masks of a capture, laid end to end with their cameras, as the op wants them.

    projections: [V, 3, 4] float64; masks: flat float32; sizes: [V, 2] int64; quorum: cameras that must see a point.
    """

    projections: Tensor
    masks: Tensor
    sizes: Tensor
    quorum: int

    @staticmethod
    def of(capture: Capture, grow: int = 0) -> Silhouettes:
        """The silhouettes of a capture, each grown by ``grow`` pixels (maximum over a square)."""
        if capture.masks is None:
            raise InputError("capture: no masks, expected silhouettes (Capture.masks) for the visual hull")
        return Silhouettes.of_masks([grown(mask, grow) for mask in capture.masks], capture.cameras)

    @staticmethod
    def of_masks(masks: list[Tensor], cameras: Cameras) -> Silhouettes:
        quorum = min(len(masks), max(2, len(masks) // 10))
        flat = torch.cat([mask.flatten() for mask in masks])
        return Silhouettes(cameras.projection_matrices(), flat, cameras.size, quorum)

    def hull(self, points: Tensor) -> Tensor:
        """Hull value at world points [..., 3]: float32 in [0, 1], 0 where fewer than ``quorum`` cameras look."""
        value, votes = self.ask(points)
        return torch.where(votes >= self.quorum, value, 0.0)

    def occupied(self, points: Tensor) -> Tensor:
        """Which points of a lattice [X, Y, Z, 3] lie in the hull: bool [X, Y, Z].

        A piece of which no point is seen by half as many cameras as the best seen point is a phantom and left out.
        """
        value, votes = self.ask(points)
        occupied = (value > 0.5) & (votes >= self.quorum)
        numbers, count = label(occupied.cpu().numpy(), np.ones((3, 3, 3)))
        pieces = torch.from_numpy(numbers).to(votes.device).long()
        seen = votes.new_zeros(count + 1)
        seen.scatter_reduce_(0, pieces.flatten(), votes.flatten(), "amax")
        seen[0] = 0  # what is not occupied
        return occupied & (2 * seen >= votes.max())[pieces]

    def ask(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Least mask and number of the cameras that see world points [..., 3], both [...], on the points' device."""
        flat = points.reshape(-1, 3)
        # Shifting the world to the points' middle keeps single precision exact to far below a pixel.
        center = flat.double().mean(0) if len(flat) else flat.new_zeros(3, dtype=torch.float64)
        shifted = self.projections.to(flat.device, copy=True)
        shifted[:, :, 3] += shifted[:, :, :3] @ center
        masks, sizes = self.masks.to(flat.device), self.sizes.to(flat.device)
        answers = [
            ops.soft_hull((chunk.double() - center).float(), shifted.float(), masks, sizes)
            for chunk in flat.split(CHUNK)
        ]
        value, votes = (torch.cat(column).reshape(points.shape[:-1]) for column in zip(*answers, strict=True))
        return value, votes


def grown(mask: Tensor, pixels: int) -> Tensor:
    """Maximum of a mask [H, W] over squares that reach ``pixels`` far."""
    if pixels <= 0:
        return mask
    if mask.device.type != "cpu":
        for reach in ((pixels, 0), (0, pixels)):
            window = (2 * reach[0] + 1, 2 * reach[1] + 1)
            mask = torch.nn.functional.max_pool2d(mask[None], window, 1, reach)[0]
        return mask
    square = np.ones((2 * pixels + 1, 2 * pixels + 1), np.uint8)
    return torch.from_numpy(cv2.dilate(mask.numpy(), square))


def find_box(capture: Capture) -> tuple[Tensor, Tensor]:
    """The subject's box by silhouettes and cameras: (low [3], high [3]) float64, a few percent larger than the hull.

    A cube around the point nearest to all central rays is sampled with masks that are widened to the sampling, and
    shrunk to what is occupied until it stays put.

    Raises InputError if a mask is missing or empty, or if the silhouettes have no common volume.
    """
    if capture.masks is None:
        raise InputError("capture: no masks, expected silhouettes (Capture.masks) for the scene's box")
    center, radius = first_guess(capture)
    low, high = center - radius, center + radius
    volume = torch.prod(high - low)
    for _ in range(BOX_ROUNDS):
        cell = float((high - low).max()) / BOX_CELLS
        points, spacing = _lattice(low, high, cell)
        reach = _pixels_per_unit(capture.cameras, (low + high) / 2) * cell * math.sqrt(3.0) / 2
        occupied = points[_widened(capture, reach).occupied(points)]
        if len(occupied) == 0:
            raise InputError(
                "silhouettes: their cones have no common volume, expected masks of one subject and world-to-camera poses "
                "with OpenCV axes (train/check.py tries the usual conventions)"
            )
        low, high = occupied.amin(0) - spacing, occupied.amax(0) + spacing
        smaller = torch.prod(high - low)
        if smaller > 0.9 * volume:
            break
        volume = smaller
    return low, high


def first_guess(capture: Capture) -> tuple[Tensor, float]:
    """A cube that holds the hull: the point where the cameras' looks meet, and twice how far the silhouettes reach around
    it as the cameras see them (the median over the cameras)."""
    cameras = capture.cameras
    assert capture.masks is not None
    subjects = [mask.numpy() > 0.5 for mask in capture.masks]  # numpy: no threads to wake for so little
    for name, subject in zip(capture.names, subjects, strict=True):
        if not subject.any():
            raise InputError(f"mask of camera {name}: empty, expected a silhouette")
    center = meeting_point(capture)
    reach = []
    for i, subject in enumerate(subjects):
        v, u = (np.flatnonzero(subject.any(axis)) for axis in (1, 0))
        corners = torch.tensor(
            [[x, y] for x in (u[0], u[-1] + 1) for y in (v[0], v[-1] + 1)], dtype=torch.float64
        )
        toward = center - cameras.centers[i]
        _, directions = cameras.rays(i, corners)
        cosine = (directions @ toward / toward.norm()).amin().clamp(0.1, 1.0)
        reach.append(toward.norm() * torch.sqrt(1 / cosine**2 - 1))
    return center, 2.0 * float(torch.stack(reach).median())


def _lattice(low: Tensor, high: Tensor, cell: float) -> tuple[Tensor, Tensor]:
    """Cell centres [X, Y, Z, 3] of a box, and the cells' extent [3]."""
    counts = torch.ceil((high - low) / cell - 1e-6).clamp(min=1).long()
    spacing = (high - low) / counts
    axes = [low[a] + (torch.arange(int(counts[a]), dtype=torch.float64) + 0.5) * spacing[a] for a in range(3)]
    return torch.stack(torch.meshgrid(*axes, indexing="ij"), -1), spacing


def _pixels_per_unit(cameras: Cameras, point: Tensor) -> Tensor:
    """[V] pixels that a world unit covers at a point."""
    focal = (cameras.K[:, 0, 0] + cameras.K[:, 1, 1]) / 2
    return focal / (cameras.centers - point).norm(dim=1).clamp(min=1e-12)


def _widened(capture: Capture, reach: Tensor) -> Silhouettes:
    """Silhouettes grown by ``reach`` [V] in pixels, half a cell's diagonal, so that no thin part is lost between the
    cells; at half the size as long as the reach is over four pixels."""
    masks, cameras = capture.masks, capture.cameras
    assert masks is not None
    while float(reach.median()) > 4.0 and int(cameras.size.min()) > 8:
        masks = [torch.nn.functional.max_pool2d(mask[None, None], 2)[0, 0] for mask in masks]
        cameras, reach = cameras.scaled_half(), reach / 2
    pixels = torch.ceil(reach).long() + 1
    return Silhouettes.of_masks([grown(mask, int(p)) for mask, p in zip(masks, pixels, strict=True)], cameras)


def pixel_footprint(cameras: Cameras, point: Tensor) -> float:
    """World size of a pixel at a point, the median over the cameras."""
    return float((1.0 / _pixels_per_unit(cameras, point)).median())
