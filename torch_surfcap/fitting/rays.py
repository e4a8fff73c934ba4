"""The rays of one level: every pixel whose ray meets the field, with what its photograph says."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torch_surfcap import codes, ops
from torch_surfcap.autograd import March
from torch_surfcap.data.arrays import float_tensor
from torch_surfcap.data.cameras import Cameras
from torch_surfcap.data.capture import Capture
from torch_surfcap.field.field import MISSING
from torch_surfcap.field.hull import grown
from torch_surfcap.field.tiles import TileGrid
from torch_surfcap.fitting.color_gain import Equations, Exposure

BLOCK = 8  # rays are ordered in blocks of so many pixels a side, so that neighbours read the same tiles
QUIET = {"transparency": 0.999, "distance": 1.5}  # opacity value above which space is as good as empty
WITHIN = 0.99  # a mask above which a pixel shows the subject alone
MARGIN = 4  # voxels beyond the silhouette that rays are followed


@dataclass
class RayBatch:
    """R rays and their observations, in the order of cameras and pixel blocks; of the type that the field is computed with.

    origins, directions, target, background: [R, 3]; mask, weight: [R]; ranges: as ``ops.integration_ranges`` gives them,
    or None, where rays search for the cells that are not empty;
    camera_starts: [N + 1], where each camera's rays begin; pixels: [R] int32, row-major number in the camera's picture;
    cameras: of the pictures; bundle: consecutive rays that share a list of ranges.
    """

    origins: Tensor
    directions: Tensor
    target: Tensor
    background: Tensor
    mask: Tensor
    weight: Tensor
    ranges: tuple[Tensor, Tensor] | None
    camera_starts: list[int]
    pixels: Tensor
    cameras: Cameras
    bundle: int = 1

    def __len__(self) -> int:
        return len(self.mask)

    def of_camera(self, i: int) -> slice:
        """Which rays are camera i's."""
        return slice(self.camera_starts[i], self.camera_starts[i + 1])

    def samples(self, step: float) -> float:
        """How many samples, `step` apart, the integration ranges hold: what one iteration visits, but for what lies behind
        an opaque surface. NaN without ranges."""
        if self.ranges is None:
            return math.nan
        offsets, ranges = self.ranges
        rays = torch.full_like(offsets[1:], self.bundle)
        rays[-1:] = len(self) - self.bundle * (len(rays) - 1)
        length = (ranges[:, 1] - ranges[:, 0]).double()
        return float((length * rays.repeat_interleave(offsets.diff())).sum()) / step

    def find_ranges(self, store: Tensor, grid: TileGrid, opacity: str, march: March) -> None:
        """Sets the ranges, where there are any, to those of the field as it now is."""
        if self.ranges is None:
            return
        found = RangeFinder(store, grid, opacity, march).ranges(self.origins, self.directions)
        self.ranges = shared_ranges(found, self.bundle)

    def expose(self, capture: Capture, backdrop: Tensor | None, exposure: Exposure) -> None:
        """Sets target and background in the common exposure.

        Args:
            backdrop: [3], the colour over which the photographs are composited with their masks; None: the plates are
                the background and the photographs stay as they are.
        """
        for i in range(len(capture)):
            part = self.of_camera(i)
            photograph = exposure.common(i, picture_at(capture.images[i], self.pixels[part]))
            if backdrop is None:
                assert capture.plates is not None
                self.background[part] = exposure.common(i, picture_at(capture.plates[i], self.pixels[part]))
                self.target[part] = photograph
            else:
                soft = self.mask[part, None]
                self.background[part] = backdrop
                self.target[part] = soft * photograph + (1 - soft) * backdrop

    def equations(
        self, capture: Capture, backdrop: Tensor | None, color: Tensor, transmittance: Tensor
    ) -> Equations:
        """What renderings of these rays, [R, 3] and [R], say about the cameras' gains."""
        cameras = []
        for i in range(len(capture)):
            part = self.of_camera(i)
            photograph = picture_at(capture.images[i], self.pixels[part])
            through = transmittance[part]
            if backdrop is None:
                assert capture.plates is not None
                field = color[part] - through[:, None] * self.background[part]
                plate = picture_at(capture.plates[i], self.pixels[part])
                cameras.append(Equations.of(photograph, field, through, plate))
            else:
                within = self.mask[part] > WITHIN
                cameras.append(Equations.of(photograph, color[part], counted=within))
        return Equations.joined(cameras)


def shared_ranges(ranges: tuple[Tensor, Tensor], bundle: int) -> tuple[Tensor, Tensor]:
    """Ranges (offsets, stretches) of single rays, united over bundles of consecutive ones."""
    if bundle == 1:
        return ranges
    offsets, stretches = ranges
    lists = -(-(len(offsets) - 1) // bundle)
    ray = torch.arange(len(offsets) - 1, device=offsets.device).repeat_interleave(offsets.diff())
    # Bundle by bundle along one line, far enough apart that a range of one never meets one of the next.
    apart = float(stretches.max()) + 1.0 if len(stretches) else 1.0
    moved = stretches.double() + (ray // bundle)[:, None] * apart
    begin, order = moved[:, 0].sort(stable=True)
    reached = moved[order, 1].cummax(0).values
    one = torch.ones_like(begin[:1], dtype=torch.bool)
    starts = torch.cat([one, begin[1:] > reached[:-1]])
    ends = torch.cat([starts[1:], one])
    of_bundle = (ray // bundle)[order][starts]
    united = torch.stack([begin[starts], reached[ends]], 1) - of_bundle[:, None] * apart
    counts = torch.bincount(of_bundle, minlength=lists)
    return torch.cat([counts.new_zeros(1), counts.cumsum(0)]), united.to(stretches.dtype)


def picture_at(picture: Tensor, pixels: Tensor) -> Tensor:
    """Colours [M, 3], float32 in [0, 1], of a picture [H, W, 3] at the row-major numbers [M] of pixels, on their device."""
    return float_tensor(picture.to(pixels.device).reshape(-1, 3)[pixels.long()])


def gather_rays(
    capture: Capture,
    store: Tensor,
    grid: TileGrid,
    opacity: str,
    march: March,
    bundle: int = 1,
    visit: str = "ranges",
) -> RayBatch:
    """The rays of all cameras that meet anything in the field (the others are culled), still without colours; all rays
    where ``visit`` is "box". A camera whose silhouette is empty has none.

    The weight of a ray is 1/(number of views * rho), rho = (voxel * focal / distance)^2 being the pixels that a voxel's
    face covers: the gradient on a voxel then depends neither on the number of cameras nor on the image size nor on the
    level.
    """
    assert capture.masks is not None
    dtype = codes.real(store.dtype)
    if visit == "box":
        everywhere = [
            _blocked((mask.amax() > 0).expand_as(mask).nonzero()).to(store.device) for mask in capture.masks
        ]
        widths = capture.cameras.size[:, 0].tolist()
        pixels = [(i[:, 0] * w + i[:, 1]).int() for i, w in zip(everywhere, widths, strict=True)]
        return rays_of(capture, grid, pixels, None, dtype=dtype)
    per_voxel = pixels_per_voxel(capture, grid)
    finder = RangeFinder(store, grid, opacity, march)
    chosen, counts, ranges = [], [], []
    for i, mask in enumerate(capture.masks):
        reach = int(torch.ceil(MARGIN * per_voxel[i])) + 1
        index = _blocked((grown(mask, reach) > 0).nonzero()).to(store.device)
        origins, directions = _rays(capture, i, index, dtype)
        offsets, stretches = finder.ranges(origins, directions)
        passes = offsets.diff()
        hit = passes > 0
        # Rays through tiles that are empty as yet stay too: they would object if the surface grew there.
        rest = (~hit).nonzero()[:, 0]
        hit[rest] = finder.meets_tiles(origins[rest], directions[rest])
        chosen.append((index[hit, 0] * mask.shape[1] + index[hit, 1]).int())
        counts.append(passes[hit])
        ranges.append(stretches)
    passing = torch.cat(counts)
    offsets = torch.cat([passing.new_zeros(1), passing.cumsum(0)])
    found = shared_ranges((offsets, torch.cat(ranges)), bundle) if visit == "ranges" else None
    return rays_of(capture, grid, chosen, found, bundle, dtype)


def rays_of(
    capture: Capture,
    grid: TileGrid,
    pixels: list[Tensor],
    ranges: tuple[Tensor, Tensor] | None,
    bundle: int = 1,
    dtype: torch.dtype = torch.float32,
) -> RayBatch:
    """The rays through pixels, given per camera by their row-major numbers, on their device, still without colours."""
    assert capture.masks is not None
    per_voxel = pixels_per_voxel(capture, grid)
    parts, starts = [], [0]
    for i, (mask, chosen) in enumerate(zip(capture.masks, pixels, strict=True)):
        width = mask.shape[1]
        index = torch.stack([chosen.long() // width, chosen.long() % width], 1)
        known = mask.to(chosen.device).flatten()[chosen.long()].to(dtype)
        weight = torch.full_like(known, 1.0 / (len(capture) * float(per_voxel[i]) ** 2))
        parts.append((*_rays(capture, i, index, dtype), known, weight))
        starts.append(starts[-1] + len(index))
    origins, directions, mask, weight = (torch.cat(c).contiguous() for c in zip(*parts, strict=True))
    target, background = torch.empty_like(origins), torch.empty_like(origins)
    observed = (origins, directions, target, background, mask, weight)
    return RayBatch(*observed, ranges, starts, torch.cat(pixels), capture.cameras, bundle)


def pixels_per_voxel(capture: Capture, grid: TileGrid) -> Tensor:
    """[N] pixels that a voxel's edge covers in each camera's picture, at the middle of the grid."""
    cameras = capture.cameras
    low = torch.tensor(grid.origin, dtype=torch.float64)
    center = low + torch.tensor(grid.size, dtype=torch.float64) * ops.TILE * grid.voxel_size / 2
    distance = (cameras.centers - center).norm(dim=1)
    focal = torch.sqrt(cameras.K[:, 0, 0] * cameras.K[:, 1, 1])
    return grid.voxel_size * focal / distance


def _rays(capture: Capture, i: int, index: Tensor, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    """Origins and directions [M, 3] through the centres of pixels [M, 2] (row, column)."""
    origins, directions = capture.cameras.rays(i, index.flip(1).double() + 0.5)
    return origins.to(dtype).contiguous(), directions.to(dtype).contiguous()


class RangeFinder:
    """Finds the integration ranges of rays, see ``ops.integration_ranges``, in a field as it now is."""

    def __init__(self, store: Tensor, grid: TileGrid, opacity: str, march: March) -> None:
        missing = MISSING[opacity]
        # With as little colour as a record can have, the search walks through less memory.
        self.store = codes.decode(store[..., : ops.pitch(0)].contiguous(), *missing)
        self.frame, self.march, self.quiet, self.table = (
            grid.frame(*missing),
            march,
            QUIET[opacity],
            grid.table,
        )
        # Tiles without a value under `quiet` are crossed as if they were missing.
        self.busy_table = grid.without((self.store[..., 0] >= self.quiet).flatten(1).all(1))

    def ranges(self, origins: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
        """What is not as good as empty along rays [R, 3]."""
        return self._search(self.busy_table, self.quiet, origins, directions)

    def meets_tiles(self, origins: Tensor, directions: Tensor) -> Tensor:
        """[R] bool: which rays come by any tile, were it empty."""
        return self._search(self.table, math.inf, origins, directions)[0].diff() > 0

    def _search(
        self, table: Tensor, quiet: float, origins: Tensor, directions: Tensor
    ) -> tuple[Tensor, Tensor]:
        shift = origins.new_zeros(len(origins))
        return ops.integration_ranges(
            self.store, table, self.frame, origins, directions, shift, *self.march, quiet
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
