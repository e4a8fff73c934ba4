"""Whether a capture can be right, judged by its silhouettes: in a sound one every camera's silhouette is filled by
what the others allow. Used by train/check.py.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
import torch
import trimesh
from numpy.typing import NDArray
from skimage.measure import marching_cubes
from torch import Tensor

from torch_surfcap import ops
from torch_surfcap.data.cameras import Cameras
from torch_surfcap.data.capture import Capture
from torch_surfcap.data.images import as_float
from torch_surfcap.errors import InputError
from torch_surfcap.field.hull import Silhouettes, find_box, pixel_footprint

FINEST = 192  # samples on a ray at most
READS = 3e7  # mask look-ups for one measurement, a second or two
FIRST_READS = 1e7  # ... for a first look at a convention
FEWEST, MOST = 24, 1500  # pixels of each silhouette
BETTER = 0.03  # a convention that fills this much more of the silhouettes, absolutely, fits better
BORDER_SOUND = 0.1  # this much missing at the borders is the masks' own softness
HALF_PIXEL_BETTER = 0.4  # half a pixel must close this share of what is missing at the silhouettes' borders

BLAME_PIXELS, BLAME_SAMPLES, BLAME_RAYS = 40, 64, 400  # of each silhouette, on each ray, in all
BLAMED = 0.4  # share of the unfilled rays that one camera must answer for to be named


@dataclass
class Agreement:
    """How well each camera's silhouette is filled by the visual hull of all of them.

    filled [N]: share of the silhouette's pixels that the hull covers; the hull's silhouette never leaves the mask, so
    this is the intersection over union of the two. border [N]: mean hull value, against the mask's own, just inside
    the silhouette's border, where half a pixel shows.
    """

    filled: Tensor
    border: Tensor

    @property
    def mean(self) -> float:
        """Mean over the cameras of what is filled."""
        return float(self.filled.mean())


def agreement(capture: Capture, box: tuple[Tensor, Tensor] | None = None, reads: float = READS) -> Agreement:
    """Measure it on random pixels of each silhouette, with about `reads` mask look-ups in all. Seeded.

    box: (low [3], high [3]) around the subject, found where not given. Raises InputError if the silhouettes have no
    common volume.
    """
    assert capture.masks is not None
    low, high = find_box(capture) if box is None else box
    silhouettes = Silhouettes.of(capture)
    footprint = pixel_footprint(capture.cameras, (low + high) / 2)
    samples = int(min(FINEST, max(32.0, float((high - low).norm()) / footprint)))
    per_camera = int(np.clip(reads / (2 * samples * len(capture) ** 2), FEWEST, MOST))
    rng = np.random.default_rng(0)
    filled, border = [], []
    for i, mask in enumerate(capture.masks):
        inside = mask.numpy() > 0.5
        edge = inside & (cv2.erode(inside.astype(np.uint8), np.ones((3, 3), np.uint8)) == 0)
        anywhere, uv = _random_pixels(inside, per_camera, rng)
        there, uv_border = _random_pixels(edge, per_camera, rng)
        reached = _highest(silhouettes, capture.cameras, i, torch.cat([uv, uv_border]), (low, high), samples)
        border.append(float((reached[len(anywhere) :] / mask.flatten()[there]).mean()))
        reached = reached[: len(anywhere)]
        filled.append(float((reached > 0.5).double().mean()))
    return Agreement(torch.tensor(filled), torch.tensor(border))


def _highest(
    silhouettes: Silhouettes, cameras: Cameras, i: int, uv: Tensor, box: tuple[Tensor, Tensor], samples: int
) -> Tensor:
    """[M] greatest hull value on the rays through pixels `uv` [M,2] of camera i, sampled where they cross the box."""
    return silhouettes.hull(_on_rays(cameras, i, uv, box, samples)).double().amax(dim=1)


def _on_rays(cameras: Cameras, i: int, uv: Tensor, box: tuple[Tensor, Tensor], samples: int) -> Tensor:
    """[M,S,3] points spread evenly over the part of each ray that lies in the box."""
    origins, directions = cameras.rays(i, uv)
    a, b = ((corner - origins) / directions for corner in box)
    near = torch.minimum(a, b).nan_to_num(-torch.inf).amax(dim=1).clamp(min=0)
    far = torch.maximum(a, b).nan_to_num(torch.inf).amin(dim=1)
    t = near[:, None] + (far - near).clamp(min=0)[:, None] * (torch.arange(samples) + 0.5) / samples
    return origins[:, None] + t[:, :, None] * directions[:, None]


def _random_pixels(chosen: NDArray[np.bool_], count: int, rng: np.random.Generator) -> tuple[Tensor, Tensor]:
    """At most `count` pixels of those `chosen` [H,W]: row-major numbers [M] and centres [M,2]."""
    pixels = torch.from_numpy(rng.permutation(np.flatnonzero(chosen))[:count])
    width = chosen.shape[1]
    return pixels, torch.stack([pixels % width, pixels // width], dim=1) + 0.5


def culprit(capture: Capture, box: tuple[Tensor, Tensor]) -> tuple[int, float] | None:
    """The camera without which most of the unfilled pixels would be filled, and its share of them; None if none is.

    Unfilled are rays through random pixels of the silhouettes on which the hull is nowhere.
    """
    assert capture.masks is not None
    rng = np.random.default_rng(0)
    everyone, rays = Silhouettes.of(capture), []
    for i, mask in enumerate(capture.masks):
        _, uv = _random_pixels(mask.numpy() > 0.5, BLAME_PIXELS, rng)
        uv = uv[_highest(everyone, capture.cameras, i, uv, box, BLAME_SAMPLES) <= 0.5]
        rays.append(_on_rays(capture.cameras, i, uv, box, BLAME_SAMPLES))
    points = torch.cat(rays)
    points = points[torch.from_numpy(rng.permutation(len(points))[:BLAME_RAYS])]
    lowest = torch.full((2, *points.shape[:2]), torch.inf, dtype=torch.float64)
    who = torch.zeros(points.shape[:2], dtype=torch.int64)
    for j, mask in enumerate(capture.masks):
        one = Silhouettes.of_masks([mask], capture.cameras.subset([j]))
        value, sees = ops.soft_hull(points.reshape(-1, 3), one.projections, one.masks.double(), one.sizes)
        value = torch.where(sees > 0, value, 1.0).reshape(
            who.shape
        )  # who does not see a point has no vote on it
        who[value < lowest[0]] = j
        lowest = torch.cat([lowest, value[None]]).sort(dim=0).values[:2]
    freed = (lowest[1] > 0.5) & (lowest[0] <= 0.5)
    shares = [float(((who == j) & freed).any(dim=1).double().mean()) for j in range(len(capture))]
    worst = int(np.argmax(shares))
    return (worst, shares[worst]) if shares[worst] > BLAMED else None


def conventions(capture: Capture) -> Iterator[tuple[str, Cameras]]:
    """What the same calibration means under another convention: (what was the matter, cameras)."""
    cameras = capture.cameras
    flip = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64))
    inverse = torch.linalg.inv(cameras.world_to_camera)
    # a pose turned about its world, W·flip, is the same rig in another world: these three are all there are
    poses = {
        (False, True): flip @ cameras.world_to_camera,
        (True, False): inverse,
        (True, True): flip @ inverse,
    }
    for (inverted, flipped), pose in poses.items():
        yield _misread(capture.format, inverted, flipped), Cameras(cameras.K, pose, cameras.size)
    ratio = 0.5 * cameras.size.double() / cameras.K[:, :2, 2]
    factor = float(ratio.median())
    if factor > 0 and abs(np.log2(factor)) > 0.3:
        what = f"K belongs to pictures of another size: it fits when multiplied by about {factor:.2f}"
        yield what, cameras.resized(torch.full((len(cameras), 2), factor), cameras.size)


def _misread(format: str, inverted: bool, flipped: bool) -> str:
    """Which poses a file holds if those read from it must be inverted and their camera axes flipped (last)."""
    direction, axes = ("camera-to-world", "world-to-camera"), ("OpenGL", "OpenCV")
    expected = (0, 0) if format == "transforms" else (1, 1)
    # a reader of camera-to-world poses flips before it inverts, so that inverting again leaves its flip standing
    other_axes = flipped != (inverted and expected[0] == 0)
    found = (expected[0] ^ inverted, expected[1] ^ other_axes)
    names = [f"{direction[d]} with {axes[a]} axes" for d, a in (found, expected)]
    return f"the poses are {names[0]} where {names[1]} is expected"


def half_pixels(cameras: Cameras) -> Iterator[tuple[str, Cameras]]:
    """The same cameras with the principal points half a pixel further."""
    for shift, what in (
        (
            0.5,
            "the principal points count from the first pixel's centre (integer pixel centres): add 0.5 to them",
        ),
        (-0.5, "the principal points are half a pixel too large: 0.5 was added to them once too often"),
    ):
        K = cameras.K.clone()
        K[:, :2, 2] += shift
        yield what, Cameras(K, cameras.world_to_camera, cameras.size)


def under(capture: Capture, cameras: Cameras) -> Capture:
    """The capture as seen by other cameras."""
    other = capture.subset(range(len(capture)))
    other.cameras = cameras
    return other


def wrong_convention(capture: Capture, filled: float) -> tuple[str, float] | None:
    """The convention under which the silhouettes agree clearly better, and how much they then fill; None if none.

    filled: mean of what they fill as read, 0 where they have no common volume.
    """
    best, most = None, filled + BETTER
    for what, cameras in conventions(capture):
        try:
            score = agreement(under(capture, cameras), reads=FIRST_READS).mean
        except InputError:
            continue
        if score > most:
            best, most = what, score
    return None if best is None else (best, most)


def wrong_pixel_centre(capture: Capture, found: Agreement, box: tuple[Tensor, Tensor]) -> str | None:
    """Which half pixel in the principal points makes the silhouettes' borders agree clearly better; None if none."""
    missing = 1 - float(found.border.mean())
    for what, cameras in half_pixels(capture.cameras) if missing > BORDER_SOUND else ():
        other = agreement(under(capture, cameras), box)
        if 1 - float(other.border.mean()) < (1 - HALF_PIXEL_BETTER) * missing and other.mean >= found.mean:
            return what
    return None


def brightness(capture: Capture) -> Tensor:
    """[N] median brightness (0 to 1) of the subject in each photograph."""
    assert capture.masks is not None
    values = []
    for image, mask in zip(capture.images, capture.masks, strict=True):
        subject = mask.numpy() >= min(0.9, float(mask.max()))
        values.append(float(np.median(as_float(image.numpy()[subject]).mean(axis=1))))
    return torch.tensor(values, dtype=torch.float64)


def hull_mesh(capture: Capture, box: tuple[Tensor, Tensor], cells: int = 96) -> trimesh.Trimesh:
    """The visual hull at level 1/2, on a lattice with `cells` along the box's longest side; closed, world units."""
    low, high = box
    spacing = float((high - low).max()) / cells
    axes = [
        torch.arange(float(a), float(b) + spacing, spacing, dtype=torch.float64)
        for a, b in zip(low, high, strict=True)
    ]
    values = Silhouettes.of(capture).hull(torch.stack(torch.meshgrid(*axes, indexing="ij"), dim=-1)).numpy()
    padded = np.pad(values, 1)
    if padded.max() <= 0.5:
        return trimesh.Trimesh()
    vertices, faces, _, _ = marching_cubes(padded, 0.5, spacing=(spacing,) * 3, gradient_direction="ascent")
    return trimesh.Trimesh(vertices - spacing + low.numpy(), faces)
