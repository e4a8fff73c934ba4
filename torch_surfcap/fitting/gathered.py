"""The gathered gradient in a fit (paper, eq. 19): the slots in which the rays of a level leave their samples' gradients,
and the cameras that the voxels read them by."""

from __future__ import annotations

import itertools
import math
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from torch_surfcap import ops
from torch_surfcap.autograd import March
from torch_surfcap.field.field import MISSING
from torch_surfcap.field.tiles import TileGrid
from torch_surfcap.fitting.rays import RayBatch
from torch_surfcap.fitting.settings import FitSettings

if TYPE_CHECKING:
    from torch_surfcap.fitting.late import Stopwatch

COSINES = ("cosine_opacity", "cosine_color")
LARGEST = torch.finfo(torch.float8_e5m2).max


class GatheredGradient:
    """Slots and gradient of one level; the rows follow the rays' ranges as they are when :meth:`lay_out` is called.

    A slot's number is dL/d(opacity value) or dL/d(colour) of one sample. With rays of weight w, colours between 0 and 1
    and Huber's slope eps, the latter is at most w eps (photo + sample) and the former at most
    w (3 eps (photo + sample) + 2 mask) da/d(value), where da/d(value) is 1 for a transparency and, of the two intervals
    beside a sample, at most 2 slope for a distance. 8-bit slots are scaled so that this bound is their largest number,
    which leaves 31 octaves below it.
    """

    def __init__(self, rays: RayBatch, grid: TileGrid, settings: FitSettings, march: March) -> None:
        self.rays, self.grid, self.march = rays, grid, march
        self.frame = grid.frame(*MISSING[settings.opacity])
        self.narrow = settings.lattice == 8
        loss = settings.losses
        change = 1.0 if settings.opacity == "transparency" else 2.0 * march.slope
        bound = change * (3 * loss.huber * (loss.photo + loss.sample) + 2 * (loss.mask or 0.0))
        bound *= float(rays.weight.max()) if len(rays) else 0.0
        self.exponent = math.floor(math.log2(LARGEST / bound)) if self.narrow and bound > 0 else 0
        cameras = rays.cameras
        device = rays.origins.device
        self.look((cameras.K @ cameras.world_to_camera[:, :3, :3]).to(device))
        self.centers = cameras.centers.float().to(device)
        self.rays_per_camera = torch.tensor(rays.camera_starts, device=device).diff()
        self.windows, self.window_rays = camera_windows(rays.pixels, rays.camera_starts, cameras.size[:, 0])
        self.gradient = rays.origins.new_empty(0)
        self.lay_out()

    def look(self, matrices: Tensor) -> None:
        """Takes [N, 3, 3] from directions in the world to pixels for the cameras'."""
        self.matrices = matrices.float()

    def lay_out(self) -> None:
        """Rows of slots for all samples within the ranges, whatever the shift."""
        assert self.rays.ranges is not None  # the settings see to it
        self.starts, self.first = slot_rows(
            self.rays.ranges, self.march.step, self.rays.bundle, len(self.rays)
        )
        dtype = torch.uint8 if self.narrow else self.rays.origins.dtype
        self.slots = torch.empty(int(self.starts[-1]), 4, dtype=dtype, device=self.starts.device)

    def per_ray(self, shift: Tensor) -> Tensor:
        """The cameras' shifts [N] for every ray [R]."""
        return shift.repeat_interleave(self.rays_per_camera, output_size=len(self.rays))

    def step(self, arguments: dict[str, Any], shift: Tensor, watch: Stopwatch) -> tuple[Tensor, ...]:
        """What ``ops.photometric_step`` returns, with the gathered gradient [T, 4, 4, 4, P].

        Args:
            arguments: of ``ops.photometric_step``, without ranges and memory. shift: [N], the cameras' in them.
        """
        store = arguments["voxels"]
        if self.gradient.shape != store.shape:
            self.gradient = self.gradient.new_empty(store.shape)
        rows: dict[str, Any] = {
            "starts": self.starts,
            "first": self.first,
            "exponent": self.exponent,
            "slots": self.slots,
        }
        losses, *rendering = ops.photometric_lattice(**arguments, **rows, ranges=self.rays.ranges)
        watch.lap("march")
        ops.gather_gradient(
            store,
            self.grid.table,
            self.frame,
            self.grid.places,
            self.matrices,
            self.centers,
            self.windows,
            self.window_rays,
            shift,
            self.march.step,
            **rows,
            gradient=self.gradient,
        )
        watch.lap("gather")
        return losses, self.gradient, *rendering

    def cosines(self, arguments: dict[str, Any]) -> Tensor:
        """[2] float64, of the angles between the last step's gradient and the exact one, for the opacity value and for
        colour."""
        exact = ops.photometric_step(**arguments, ranges=self.rays.ranges)[1]
        between = [
            torch.cosine_similarity(
                self.gradient[..., part].double().flatten(), exact[..., part].double().flatten(), dim=0
            )
            for part in (slice(0, 1), slice(1, None))
        ]
        return torch.stack(between)


def slot_rows(ranges: tuple[Tensor, Tensor], step: float, bundle: int, rays: int) -> tuple[Tensor, Tensor]:
    """``starts [R + 1]`` and ``first [R]`` of rows that hold every sample from a ray's first range to its last one,
    t_k = (k + 1/2 + shift) step with any shift between -1/2 and 1/2."""
    offsets, stretches = ranges
    counts = torch.zeros_like(offsets[1:])
    first = torch.zeros_like(counts)
    some = offsets.diff() > 0
    begin, end = stretches[offsets[:-1][some], 0].double(), stretches[offsets[1:][some] - 1, 1].double()
    first[some] = (torch.ceil(begin / step).long() - 1).clamp(min=0)
    counts[some] = (torch.ceil(end / step).long() - first[some]).clamp(min=0)
    counts, first = (x.repeat_interleave(bundle)[:rays] for x in (counts, first))
    return torch.cat([counts.new_zeros(1), counts.cumsum(0)]), first.to(torch.int32)


def camera_windows(pixels: Tensor, camera_starts: list[int], widths: Tensor) -> tuple[Tensor, Tensor]:
    """``windows [N, 4]`` and ``window_rays`` of ``ops.gather_gradient`` for rays through these pixels [R], numbered row by
    row in pictures of these widths [N]."""
    windows, maps = [], [torch.zeros(0, dtype=torch.int32, device=pixels.device)]
    for (begin, end), across in zip(itertools.pairwise(camera_starts), widths.tolist(), strict=True):
        if begin == end:
            windows.append([0, 0, 0, 0])
            continue
        column, row = pixels[begin:end].long() % across, pixels[begin:end].long() // across
        left, top = int(column.min()) - 1, int(row.min()) - 1
        width, height = int(column.max()) + 2 - left, int(row.max()) + 2 - top
        window = torch.full((height, width), -1, dtype=torch.int32, device=pixels.device)
        numbers = torch.arange(begin, end, dtype=torch.int32, device=pixels.device)
        window[row - top, column - left] = numbers
        windows.append([left, top, width, height])
        maps.append(window.flatten())
    return torch.tensor(windows, device=pixels.device).view(-1, 4), torch.cat(maps)
