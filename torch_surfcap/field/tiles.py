"""Which tiles a sparse field has: the table that maps a place to a tile, to inside, or to outside."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.ndimage import distance_transform_cdt
from torch import Tensor

from torch_surfcap.ops import INSIDE, OUTSIDE, TILE

MAX_SKIP = 120  # cells; farther empty space is crossed in several strides


@dataclass(frozen=True)
class TileGrid:
    """Tiles of 4x4x4 voxels in a box.

    table:      [X+2, Y+2, Z+2] int32, tile index, ``INSIDE`` or ``OUTSIDE - d`` (see :mod:`torch_surfcap.ops`); the
                outermost layer is a border of outside tiles
    coords:     [T, 3] int32, place of each stored tile relative to ``origin`` (border not counted), in Morton order
    origin:     world position of the low corner of tile (0, 0, 0)
    voxel_size: world units
    """

    table: Tensor
    coords: Tensor
    origin: tuple[float, float, float]
    voxel_size: float

    @staticmethod
    def build(
        stored: Tensor, inside: Tensor, origin: tuple[float, float, float], voxel_size: float
    ) -> TileGrid:
        """The grid of the tiles marked in ``stored [X, Y, Z]`` bool; of the others those in ``inside`` are inside."""
        coords = morton_sorted(stored.nonzero().to(torch.int32))
        table = torch.full([n + 2 for n in stored.shape], OUTSIDE, dtype=torch.int32, device=stored.device)
        table[1:-1, 1:-1, 1:-1][inside & ~stored] = INSIDE
        x, y, z = (coords.long() + 1).unbind(1)
        table[x, y, z] = torch.arange(len(coords), dtype=torch.int32, device=stored.device)
        return TileGrid(with_skips(table), coords, origin, float(voxel_size))

    def check(self) -> None:
        """Raises ValueError where the table and the tiles contradict each other: the ops read what the table says."""
        table, coords, tiles = self.table, self.coords, len(self.coords)
        if table.dim() != 3 or min(table.shape) < 3 or table.dtype != torch.int32:
            raise ValueError(f"table: expected int32 [X+2, Y+2, Z+2], got {table.dtype} {list(table.shape)}")
        if coords.shape != (tiles, 3) or coords.dtype != torch.int32:
            raise ValueError(f"tile_coords: expected int32 [T, 3], got {coords.dtype} {list(coords.shape)}")
        if not (self.voxel_size > 0 and all(math.isfinite(c) for c in (*self.origin, self.voxel_size))):
            raise ValueError(
                f"origin, voxel_size: expected finite numbers, got {self.origin}, {self.voxel_size}"
            )
        if tiles and not (coords.amin() >= 0 and (coords < coords.new_tensor(self.size)).all()):
            raise ValueError(f"tile_coords: expected places within {list(self.size)} tiles")
        x, y, z = self.places.long().unbind(1)
        index = torch.arange(tiles, dtype=torch.int32, device=table.device)
        if int((table >= 0).sum()) != tiles or not torch.equal(table[x, y, z], index):
            raise ValueError(f"table: expected the {tiles} tiles at their tile_coords and nowhere else")
        if int(table.min()) < OUTSIDE - MAX_SKIP:
            raise ValueError(
                f"table: expected entries of at least {OUTSIDE - MAX_SKIP}, got {int(table.min())}"
            )

    @property
    def size(self) -> tuple[int, int, int]:
        """Extent in tiles, border not counted."""
        x, y, z = self.table.shape
        return x - 2, y - 2, z - 2

    @property
    def places(self) -> Tensor:
        """[T, 3] int32, where each tile stands in the table."""
        return self.coords + 1

    @property
    def inside(self) -> Tensor:
        """[X, Y, Z] bool: missing tiles that are inside."""
        return self.table[1:-1, 1:-1, 1:-1] == INSIDE

    def frame(
        self, outside: float, inside: float, about: tuple[float, float, float] = (0.0, 0.0, 0.0)
    ) -> list[float]:
        """The ``frame`` argument of the ops, for positions relative to ``about``."""
        edge = TILE * self.voxel_size
        corner = (o - a - edge for o, a in zip(self.origin, about, strict=True))
        return [*corner, self.voxel_size, outside, inside]

    def moved(self, shift: Tensor) -> TileGrid:
        """The same tiles in a world whose points have all moved by ``shift`` [3]."""
        x, y, z = (o + s for o, s in zip(self.origin, shift.tolist(), strict=True))
        return replace(self, origin=(x, y, z))

    def to(self, device: torch.device | str) -> TileGrid:
        return TileGrid(self.table.to(device), self.coords.to(device), self.origin, self.voxel_size)

    def without(self, tiles: Tensor) -> Tensor:
        """The table with some stored tiles, [T] bool, as outside: what a march that shall not see them reads."""
        x, y, z = self.places.long().unbind(1)
        table = self.table.clone()
        table[x, y, z] = torch.where(tiles, OUTSIDE, table[x, y, z])
        return with_skips(table)

    def borders(self, within: Tensor) -> Tensor:
        """Which stored voxels have one of their 6 neighbours on the other side: bool [T, 4, 4, 4].

        Args:
            within: [T, 4, 4, 4] bool, the side of each stored voxel; missing tiles are on the side that they stand for.
        """
        crossed = torch.zeros_like(within)
        for axis in range(3):
            for side in (-1, 1):
                places = self.places.long()
                places[:, axis] += side
                x, y, z = places.unbind(1)
                entry = self.table[x, y, z].long()
                facing = within.select(axis + 1, 0 if side > 0 else TILE - 1)[entry.clamp(min=0)]
                facing = torch.where(entry.view(-1, 1, 1) >= 0, facing, (entry == INSIDE).view(-1, 1, 1))
                beside = within.roll(-side, axis + 1)
                beside.select(axis + 1, TILE - 1 if side > 0 else 0).copy_(facing)
                crossed |= within != beside
        return crossed

    def refined(self, surface: Tensor, solid: Tensor) -> TileGrid:
        """The grid of half the voxel size that follows a surface.

        A fine tile is stored if a surface voxel lies in it or, with a margin of one coarse voxel (26 neighbours), beside
        it; else it is inside if more than half of the 8 coarse voxels under it are solid, or if it lies in a missing tile
        that is inside.

        Args:
            surface, solid: [T, 4, 4, 4] bool, per stored voxel of this grid.
        """
        fine_size = torch.tensor([2 * n for n in self.size], device=surface.device)
        stored = torch.zeros([2 * n for n in self.size], dtype=torch.bool, device=surface.device)
        tile, x, y, z = surface.nonzero().unbind(1)
        voxel = self.coords.long()[tile] * TILE + torch.stack([x, y, z], 1)
        for corner in range(27):
            offset = torch.tensor(
                [corner // 9 - 1, corner // 3 % 3 - 1, corner % 3 - 1], device=surface.device
            )
            fine = torch.div(voxel + offset, 2, rounding_mode="floor")
            fine = fine[((fine >= 0) & (fine < fine_size)).all(1)]
            stored[fine[:, 0], fine[:, 1], fine[:, 2]] = True
        inside = self.inside.repeat_interleave(2, 0).repeat_interleave(2, 1).repeat_interleave(2, 2)
        halves = solid.reshape(-1, 2, 2, 2, 2, 2, 2).float().mean((2, 4, 6)) > 0.5  # [T, 2, 2, 2] fine tiles
        half = torch.tensor([[i // 4, i // 2 % 2, i % 2] for i in range(8)], device=surface.device)
        place = (self.coords.long()[:, None] * 2 + half).reshape(-1, 3)
        inside[place[:, 0], place[:, 1], place[:, 2]] = halves.reshape(-1)
        return TileGrid.build(stored, inside, self.origin, self.voxel_size / 2)


def voxel_centers(grid: TileGrid, tiles: slice | Tensor = slice(None)) -> Tensor:
    """[T, 4, 4, 4, 3] float64 world positions of the voxels of the stored tiles."""
    steps = torch.arange(TILE, dtype=torch.float64, device=grid.coords.device) + 0.5
    inner = torch.stack(torch.meshgrid(steps, steps, steps, indexing="ij"), -1)
    low = grid.coords[tiles].double()[:, None, None, None] * TILE
    return torch.tensor(grid.origin, dtype=torch.float64, device=low.device) + (low + inner) * grid.voxel_size


def with_skips(table: Tensor) -> Tensor:
    """``table`` with every outside entry turned into OUTSIDE - d, d the distance in cells (Chebyshev) to the nearest
    cell that is not empty, so that the march can leave empty space in long strides. Values mean the same."""
    if table.dim() != 3:
        raise ValueError(f"table: expected int32 [X+2, Y+2, Z+2], got {table.dtype} {list(table.shape)}")
    cell = table > OUTSIDE  # a cell is empty if the tiles t .. t + 1 are outside
    for axis in range(3):
        upper = cell.narrow(axis, 1, cell.shape[axis] - 1).clone()
        cell.narrow(axis, 0, cell.shape[axis] - 1).logical_or_(upper)
    skips = skips_on_host(cell) if table.device.type == "cpu" else skips_by_doubling(cell)
    return torch.where(table > OUTSIDE, table, OUTSIDE - skips.int())


def skips_on_host(cell: Tensor) -> Tensor:
    """What :func:`skips_by_doubling` gives, by scipy: on the CPU that takes a tenth of the time."""
    distance = np.full(cell.shape, MAX_SKIP, dtype=np.int32)
    if cell.any():
        distance = np.minimum(distance_transform_cdt(~cell.numpy(), metric="chessboard"), MAX_SKIP)
    return torch.from_numpy(distance)


def skips_by_doubling(cell: Tensor) -> Tensor:
    """[X, Y, Z] uint8, each cell's Chebyshev distance d to the nearest marked one, at most MAX_SKIP.

    Of min(d, 2 R), what is less than R is min(d, R); where that is R, walking R cells towards the nearest marked one leaves
    d - R, and no walk leaves less: the rest is the least min(d, R) within R cells.
    """
    distance = cell.logical_not().to(torch.uint8)
    reach = 1
    while reach < MAX_SKIP:
        rest = distance
        for axis in range(3):
            rest = _least(rest, reach, axis)
        distance = torch.where(distance < reach, distance, rest + reach)
        reach *= 2
    return distance.clamp(max=MAX_SKIP)


def _least(values: Tensor, reach: int, axis: int) -> Tensor:
    """The least of the values (uint8) that lie up to ``reach`` cells away along an axis, out of windows that double."""
    count, width, span = values.shape[axis], 2 * reach + 1, 1
    ends = [0] * 4 + [reach] * 2
    values = torch.nn.functional.pad(values.movedim(axis, 0), ends, value=255)
    while 2 * span <= width:
        values, span = torch.minimum(values[:-span], values[span:]), 2 * span
    return torch.minimum(values[:count], values[width - span :]).movedim(0, axis)


def morton_sorted(coords: Tensor) -> Tensor:
    """Places [T, 3] in Morton order (bits of x, y and z interleaved), so that neighbours lie close in memory."""
    key = torch.zeros(len(coords), dtype=torch.int64, device=coords.device)
    for bit in range(20):
        for axis in range(3):
            key |= ((coords[:, axis].long() >> bit) & 1) << (3 * bit + 2 - axis)
    return coords[key.argsort()]
