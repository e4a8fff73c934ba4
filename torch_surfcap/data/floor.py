"""The floor that a subject stands on, found in the plates.

No camera sees a sole. What lies under it is bounded by what is seen beside it, and that is the contact shadow, too dark
to tell from a shoe: silhouettes leave a lump under the feet. But the pictures of the empty room show the floor from
everywhere: it is the plane on which all cameras agree about what is where.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from scipy.optimize import minimize
from torch import Tensor

from torch_surfcap.data.capture import Capture

RADIUS = 0.5  # of the piece of floor that is looked at, in half diagonals of the subject's box
SIDE = 71  # points along its diameter
SPACING = 1 / 80  # of its diameter: pixels at first, and a step of the search
DEPTHS = (0.2, 1.3)  # below the box's middle, in the same unit, where a floor is looked for
COARSE, FINE = 6.0, 2.0  # pixels, the scale of the texture that is compared, first and last
AGREE = 0.4  # correlation between the cameras that a floor must reach
NO_FLOOR = 0.5  # and the share of it that a fifth of all depths may
GRAZING = 0.25  # sine of the angle under which a camera must see the piece: flatter, its pixels there are long streaks
SEEN = 0.5  # share of the piece that a camera must see to have a say
FEWEST = 3  # cameras with a say


@dataclass(frozen=True)
class Floor:
    """Points x with normal . x > offset are above it. normal: unit [3] float64; offset: world units; agreement: mean
    correlation of what the cameras see there."""

    normal: Tensor
    offset: float
    agreement: float

    def height(self, points: Tensor) -> Tensor:
        """Of points [..., 3] above the floor, [...] float64."""
        return points.double() @ self.normal.to(points.device) - self.offset

    def moved(self, shift: Tensor) -> Floor:
        """The floor of a world whose points have all moved by `shift` [3]."""
        return replace(self, offset=self.offset + float(self.normal @ shift))


def find_floor(capture: Capture, box: tuple[Tensor, Tensor]) -> Floor | None:
    """The floor under the subject in a box (low [3], high [3]); None without plates, or where they show none.

    Cameras are taken to stand upright on the whole: the search begins level with the mean of their upward axes, at
    pictures so small that their pixels are as far apart as the points, and ends at the pictures themselves.
    """
    if capture.plates is None:
        return None
    low, high = box
    middle, unit = (low + high) / 2, float((high - low).norm()) / 2
    up = torch.nn.functional.normalize(-capture.cameras.world_to_camera[:, 1, :3].mean(0), dim=0)
    if float(up.norm()) < 0.5:  # cameras that look every way up
        return None
    spacing = SPACING * 2 * RADIUS * unit
    coarse = _agreement(capture, middle, up, RADIUS * unit, spacing, COARSE)
    depths = np.arange(DEPTHS[0], DEPTHS[1], spacing / unit)
    found = np.array([coarse(np.array([0.0, 0.0, depth])) for depth in depths])
    at = np.array([0.0, 0.0, depths[found.argmax()]])
    if found.max() < AGREE / 2 or np.quantile(found, 0.8) > NO_FLOOR * found.max():
        return None
    fine = _agreement(capture, middle, up, RADIUS * unit, 0.5 * spacing, FINE)
    for agreement, pixel in ((coarse, spacing), (fine, 0.5 * spacing)):
        corners = np.vstack([at, at + np.diag([pixel, pixel, 0.5 * pixel]) / unit])
        options = {"initial_simplex": corners, "xatol": 1e-4, "fatol": 1e-4, "maxfev": 100}
        at = minimize(lambda x, f=agreement: -f(x), at, method="Nelder-Mead", options=options).x
    agreement_there = fine(at)
    if agreement_there < AGREE:
        return None
    normal, point = _plane(at, middle, up, unit)
    return Floor(normal, float(point @ normal), agreement_there)


def _axes(up: Tensor) -> tuple[Tensor, Tensor]:
    """Two unit vectors across `up` and each other."""
    least = torch.nn.functional.one_hot(up.abs().argmin(), 3).double()
    first = torch.nn.functional.normalize(torch.linalg.cross(up, least), dim=0)
    return first, torch.linalg.cross(up, first)


def _plane(
    at: np.ndarray[tuple[int], np.dtype[np.float64]], middle: Tensor, up: Tensor, unit: float
) -> tuple[Tensor, Tensor]:
    """Normal and point of the plane with these tilts along two axes and this depth below the middle."""
    first, second = _axes(up)
    normal = torch.nn.functional.normalize(up + float(at[0]) * first + float(at[1]) * second, dim=0)
    return normal, middle - float(at[2]) * unit * up


def _agreement(
    capture: Capture, middle: Tensor, up: Tensor, radius: float, spacing: float, detail: float
) -> Callable[[np.ndarray[tuple[int], np.dtype[np.float64]]], float]:
    """How well the cameras agree on a plane, the mean correlation of what two of them see there, as a function of its
    tilts and depth. Pictures are made smaller until a pixel there is `spacing` wide; what is wider than `detail` pixels
    is taken out of them: it is alike on many planes, and tells most where the planes' edges run."""
    assert capture.plates is not None
    cameras, unit = capture.cameras, radius / RADIUS
    distance = (cameras.centers - middle).norm(dim=1)
    wide = spacing * torch.sqrt(cameras.K[:, 0, 0] * cameras.K[:, 1, 1]) / distance  # pixels
    pictures, projection = [], cameras.projection_matrices()
    for plate, pixels in zip(capture.plates, wide.tolist(), strict=True):
        small = plate.numpy().astype(np.float32).mean(axis=2)
        height, width = small.shape
        if pixels > 1:
            size = (max(2, round(width / pixels)), max(2, round(height / pixels)))
            small = cv2.resize(small, size, interpolation=cv2.INTER_AREA)
        small -= cv2.GaussianBlur(small, (0, 0), detail)
        pictures.append(torch.from_numpy(small)[None, None])
    line = torch.linspace(-1, 1, SIDE, dtype=torch.float64)
    disk = torch.stack(torch.meshgrid(line, line, indexing="ij"), -1).reshape(-1, 2)
    disk = radius * disk[disk.norm(dim=1) < 1]

    def agreement(at: np.ndarray[tuple[int], np.dtype[np.float64]]) -> float:
        normal, point = _plane(at, middle, up, unit)
        points = point + disk @ torch.stack(_axes(normal))
        seen = []
        homogeneous = points @ projection[:, :, :3].mT + projection[:, None, :, 3]
        places = 2 * homogeneous[..., :2] / homogeneous[..., 2:] / cameras.size[:, None] - 1
        inside = (homogeneous[..., 2] > 0) & (places.abs() < 1).all(2)
        above = (cameras.centers - point) @ normal > GRAZING * (cameras.centers - point).norm(dim=1)
        for i in (above & (inside.double().mean(1) >= SEEN)).nonzero()[:, 0].tolist():
            place, there = places[i].float(), inside[i]
            value = torch.nn.functional.grid_sample(pictures[i], place[None, None], align_corners=False)
            known = value[0, 0, 0][there]
            value = (value[0, 0, 0] - known.mean()) / known.std().clamp(min=1e-3)
            seen.append(torch.where(there, value, torch.nan))
        if len(seen) < FEWEST:
            return 0.0
        # Of n normalised signals with mean correlation r, the mean has the variance r + (1 - r)/n.
        values = torch.stack(seen)
        several = (~values.isnan()).sum(0) >= FEWEST
        share = float(values[:, several].nanmean(0).square().mean() / values[:, several].square().nanmean())
        return (share - 1 / len(seen)) / (1 - 1 / len(seen))

    return agreement
