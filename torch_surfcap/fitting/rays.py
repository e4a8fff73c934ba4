"""The rays of one level: every pixel whose ray meets the field, with what its photograph says."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torch_surfcap import ops
from torch_surfcap.autograd import March
from torch_surfcap.data.cameras import Cameras
from torch_surfcap.data.capture import Capture
from torch_surfcap.field.field import MISSING
from torch_surfcap.field.hull import grown
from torch_surfcap.field.tiles import TileGrid

BLOCK = 8  # rays are ordered in blocks of so many pixels a side, so that neighbours read the same tiles
QUIET = {"transparency": 0.999, "distance": 1.5}  # opacity value above which space is as good as empty
MARGIN = 4  # voxels beyond the silhouette that rays are followed


@dataclass
class RayBatch:
    """R rays and their observations, float32, in the order of cameras and pixel blocks.

    origins, directions, target, background: [R, 3]; mask, weight: [R]; ranges: as ``ops.integration_ranges`` gives them;
    camera_starts: [N + 1], where each camera's rays begin; pixels: [R, 2] int32, column and row; cameras: of the pictures.
    """

    origins: Tensor
    directions: Tensor
    target: Tensor
    background: Tensor
    mask: Tensor
    weight: Tensor
    ranges: tuple[Tensor, Tensor]
    camera_starts: list[int]
    pixels: Tensor
    cameras: Cameras

    def __len__(self) -> int:
        return len(self.mask)


def gather_rays(
    capture: Capture, store: Tensor, grid: TileGrid, opacity: str, march: March, backdrop: Tensor | None
) -> RayBatch:
    """The rays of all cameras that meet anything in the field (the others are culled).

    The weight of a ray is 1/(number of views * rho), rho = (voxel * focal / distance)^2 being the pixels that a voxel's
    face covers: the gradient on a voxel then depends neither on the number of cameras nor on the image size nor on the
    level.

    Args:
        backdrop: [3], the colour over which the photographs are composited with their masks; None: the plates are the
            background and the photographs stay as they are.
    """
    assert capture.masks is not None
    cameras = capture.cameras
    low = torch.tensor(grid.origin, dtype=torch.float64)
    center = low + torch.tensor(grid.size, dtype=torch.float64) * ops.TILE * grid.voxel_size / 2
    distance = (cameras.centers - center).norm(dim=1)
    focal = torch.sqrt(cameras.K[:, 0, 0] * cameras.K[:, 1, 1])
    pixels_per_voxel = grid.voxel_size * focal / distance
    store = colorless(store)  # once, not anew for every camera
    parts: list[tuple[Tensor, ...]] = []
    starts, counts, ranges = [0], [], []
    for i, mask in enumerate(capture.masks):
        reach = int(torch.ceil(MARGIN * pixels_per_voxel[i])) + 1
        index = _blocked((grown(mask, reach) > 0).nonzero())
        origins, directions = (r.float().contiguous() for r in cameras.rays(i, index.flip(1).double() + 0.5))
        offsets, stretches = find_ranges(store, grid, opacity, march, origins, directions)
        passes = offsets.diff()
        hit = passes > 0
        # Rays through tiles that are empty as yet stay too: they would object if the surface grew there.
        rest = (~hit).nonzero()[:, 0]
        all_of_them, _ = find_ranges(store, grid, opacity, march, origins[rest], directions[rest], math.inf)
        hit[rest] = all_of_them.diff() > 0
        index, origins, directions = index[hit], origins[hit], directions[hit]
        v, u = index.unbind(1)
        photograph, soft = capture.photograph(i)[v, u], mask[v, u]
        if backdrop is None:
            background = capture.plate(i)[v, u]
        else:
            background = backdrop.expand_as(photograph)
            photograph = soft[:, None] * photograph + (1 - soft[:, None]) * background
        weight = torch.full_like(soft, 1.0 / (len(cameras) * float(pixels_per_voxel[i]) ** 2))
        pixels = index.flip(1).to(torch.int32)
        parts.append((origins, directions, photograph, background, soft, weight, pixels))
        counts.append(passes[hit])
        ranges.append(stretches)
        starts.append(starts[-1] + len(index))
    joined = [torch.cat(column).contiguous() for column in zip(*parts, strict=True)]
    offsets = torch.cat([torch.zeros(1, dtype=torch.int64), torch.cat(counts).cumsum(0)])
    origins, directions, target, background, soft, weight, pixels = joined
    found = (offsets, torch.cat(ranges))
    return RayBatch(origins, directions, target, background, soft, weight, found, starts, pixels, cameras)


def colorless(store: Tensor) -> Tensor:
    """The field with as little colour as a record can have: a search for its surface walks through less memory."""
    return store[..., : ops.pitch(0)].contiguous()


def find_ranges(
    store: Tensor,
    grid: TileGrid,
    opacity: str,
    march: March,
    origins: Tensor,
    directions: Tensor,
    quiet: float | None = None,
) -> tuple[Tensor, Tensor]:
    """The integration ranges of rays in the field as it now is, see ``ops.integration_ranges``; ``quiet`` is by default what
    suits the opacity."""
    frame, shift = grid.frame(*MISSING[opacity]), origins.new_zeros(len(origins))
    level = QUIET[opacity] if quiet is None else quiet
    return ops.integration_ranges(
        colorless(store), grid.table, frame, origins, directions, shift, *march, level
    )


def _blocked(index: Tensor) -> Tensor:
    """Pixels [M, 2] (row, column) in blocks of BLOCK x BLOCK."""
    row, column = index.unbind(1)
    width = int(column.max()) // BLOCK + 1 if len(index) else 1
    block = (row // BLOCK) * width + column // BLOCK
    return index[(block * BLOCK * BLOCK + (row % BLOCK) * BLOCK + column % BLOCK).argsort()]


def choose_backdrop(capture: Capture) -> Tensor | None:
    """[3], the colour before which the subject is set, None where plates explain the whole picture.

    Silhouettes that were found on a black background take shadows on the subject for background now and then: black, such
    a mistake does little harm. Else it is the corner of the colour cube farthest from the subject's colours, namely the
    one whose nearest tenth of the subject's pixels is farthest away.
    """
    assert capture.masks is not None
    if capture.mask_source == "plate":
        return None
    if capture.mask_source == "threshold":
        return torch.zeros(3)
    colors = []
    for i, mask in enumerate(capture.masks):
        subject = capture.photograph(i)[mask > 0.5]
        colors.append(subject[:: max(1, len(subject) // 1000)])
    corners = torch.tensor([[i // 4, i // 2 % 2, i % 2] for i in range(8)], dtype=torch.float32)
    distance = torch.cdist(corners, torch.cat(colors)).sort(dim=1).values
    return corners[distance[:, distance.shape[1] // 10].argmax()]
