"""The floor that a subject stands on, found in the plates.

No camera sees a sole. What lies under it is bounded by what is seen beside it, and that is the contact shadow, too dark
to tell from a shoe: silhouettes leave a lump under the feet. But the pictures of the empty room show the floor from
everywhere: it is the plane on which all cameras agree about what is where.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates
from scipy.optimize import minimize
from torch import Tensor

from torch_surfcap.data.cameras import Cameras
from torch_surfcap.data.capture import Capture

Array = NDArray[np.floating]


class Look(NamedTuple):
    """How closely the piece of floor is looked at. pixel: its width, and points: so many along a line, both per diameter
    of the piece; detail: pixels, the scale of the texture that is compared; exact: tilts and depths closer than this are
    the same."""

    pixel: float
    points: int
    detail: float
    exact: float


COARSE, FINE = Look(1 / 80, 36, 6.0, 1e-3), Look(1 / 160, 71, 2.0, 1e-4)  # points are about two pixels apart
RADIUS = 0.5  # of the piece of floor that is looked at, in half diagonals of the subject's box
DEPTHS = (0.2, 1.3)  # below the box's middle, in the same unit, where a floor is looked for
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
    diameter = 2 * RADIUS * unit
    pictures: list[Array] = [plate.numpy() for plate in capture.plates]
    looks = {}
    for look in (FINE, COARSE):  # the coarse pictures are made of the fine ones
        pictures = _shrunk(pictures, capture.cameras, middle, look.pixel * diameter)
        looks[look] = _agreement(pictures, capture.cameras, middle, up, unit, look)
    depths = np.arange(*DEPTHS, COARSE.pixel * diameter / unit)
    found = np.array([looks[COARSE](np.array([0.0, 0.0, depth])) for depth in depths])
    at = np.array([0.0, 0.0, depths[found.argmax()]])
    if found.max() < AGREE / 2 or np.quantile(found, 0.8) > NO_FLOOR * found.max():
        return None
    for look, agreement in reversed(looks.items()):
        pixel = look.pixel * diameter / unit
        corners = np.vstack([at, at + np.diag([pixel, pixel, 0.5 * pixel])])
        options = {"initial_simplex": corners, "xatol": look.exact, "fatol": look.exact, "maxfev": 100}
        at = minimize(lambda x, f=agreement: -f(x), at, method="Nelder-Mead", options=options).x
    agreement_there = looks[FINE](at)
    if agreement_there < AGREE:
        return None
    normal, point = _plane(at, middle, up, unit)
    return Floor(normal, float(point @ normal), agreement_there)


def _axes(up: Tensor) -> tuple[Tensor, Tensor]:
    """Two unit vectors across `up` and each other."""
    least = torch.nn.functional.one_hot(up.abs().argmin(), 3).double()
    first = torch.nn.functional.normalize(torch.linalg.cross(up, least), dim=0)
    return first, torch.linalg.cross(up, first)


def _plane(at: Array, middle: Tensor, up: Tensor, unit: float) -> tuple[Tensor, Tensor]:
    """Normal and point of the plane with these tilts along two axes and this depth below the middle."""
    first, second = _axes(up)
    normal = torch.nn.functional.normalize(up + float(at[0]) * first + float(at[1]) * second, dim=0)
    return normal, middle - float(at[2]) * unit * up


def _shrunk(pictures: list[Array], cameras: Cameras, point: Tensor, pixel: float) -> list[Array]:
    """Pictures [H, W] or [H, W, 3] of cameras, made grey, float32, and so small that a pixel is ``pixel`` wide, world
    units, at a point; those with larger pixels stay as large as they are."""
    distance = (cameras.centers - point).norm(dim=1)
    factor = (pixel * torch.sqrt(cameras.K[:, 0, 0] * cameras.K[:, 1, 1]) / distance).clamp(min=1.0)
    sizes = (cameras.size / factor[:, None]).round().clamp(min=2).int().tolist()
    small: list[Array] = []
    for picture, size in zip(pictures, sizes, strict=True):
        resized = cv2.resize(picture.astype(np.float32), size, interpolation=cv2.INTER_AREA)
        grey = resized if picture.ndim == 2 else cv2.transform(resized, np.full((1, 3), 1 / 3))
        small.append(np.asarray(grey, np.float32))
    return small


def _agreement(
    pictures: list[Array], cameras: Cameras, middle: Tensor, up: Tensor, unit: float, look: Look
) -> Callable[[Array], float]:
    """How well the cameras agree on a plane, the mean correlation of what two of them see there, as a function of its
    tilts and depth. What is wider than the look's detail is taken out of the pictures [H, W]: it is alike on many planes,
    and tells most where the planes' edges run."""
    pictures = [picture - cv2.GaussianBlur(picture, (0, 0), look.detail) for picture in pictures]
    sizes = torch.tensor([picture.shape[::-1] for picture in pictures])
    small = cameras.resized(sizes / cameras.size, sizes)
    projections, centers = small.projection_matrices().numpy(), small.centers.numpy()
    projections[:, :2] -= 0.5 * projections[:, 2:]  # whole numbers are the middles of pixels
    line = np.linspace(-1, 1, look.points)
    x, y = (axis.ravel() for axis in np.meshgrid(line, line, indexing="ij"))
    disk = np.stack([x, y, np.ones_like(x)])[:, np.hypot(x, y) < 1]

    def agreement(at: Array) -> float:
        normal, point = _plane(at, middle, up, unit)
        first, second = _axes(normal)
        spanned = torch.stack([RADIUS * unit * first, RADIUS * unit * second, point], 1).numpy()
        homographies = projections[:, :, :3] @ spanned
        homographies[:, :, 2] += projections[:, :, 3]
        away = centers - point.numpy()
        above = away @ normal.numpy() > GRAZING * np.linalg.norm(away, axis=1)
        seen = []
        for i in above.nonzero()[0]:
            u, v, depth = homographies[i] @ disk
            depth = depth.clip(min=1e-12)  # what is behind a camera falls far outside its picture
            value = map_coordinates(pictures[i], (v / depth, u / depth), order=1, cval=np.nan)
            there = ~np.isnan(value)
            if there.mean() >= SEEN:
                known = value[there]
                seen.append((value - known.mean()) / max(known.std(), 1e-3))
        values = np.array(seen).reshape(len(seen), disk.shape[1])
        values = values[:, np.isfinite(values).sum(0) >= FEWEST]
        if not values.size:
            return 0.0
        # Of n normalised signals with mean correlation r, the mean has the variance r + (1 - r)/n.
        share = float(np.square(np.nanmean(values, 0)).mean() / np.nanmean(np.square(values)))
        return (share - 1 / len(seen)) / (1 - 1 / len(seen))

    return agreement
