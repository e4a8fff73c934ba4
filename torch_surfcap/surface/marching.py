"""Marching cubes over the tiles of a table in plain torch, on whatever device its tensors are on."""

from __future__ import annotations

import torch
from torch import Tensor

from torch_surfcap.ops import TILE
from torch_surfcap.surface.cases import EDGES, case_table

CHUNK = 1 << 14  # tiles at a time: bounds the temporaries
VOXELS = TILE**3
APRON = TILE + 1  # so many voxels along each axis are read by the cells of a tile


def march_cells(stored: Tensor, tiles: Tensor, crossing: Tensor) -> tuple[Tensor, Tensor]:
    """The surface on which the values change their sign, closed, with exactly two triangles at every edge.

    A voxel owns the edges to its three upper neighbours, and a vertex is the crossed edge that it lies on: there is
    nothing to weld. A cell belongs to the tile of its lowest voxel.

    Args:
        stored: [S, 4, 4, 4] float32 tiles of values, none 0; negative is matter.
        tiles: [X, Y, Z] int64, which tile of values stands where.
        crossing: [X, Y, Z] bool, tiles that have every cell with values of both signs; none at an upper end.

    Returns:
        vertices [V, 3] float64 in voxels of the table, whole numbers at voxel centres, and faces [F, 3], outwards.
    """
    device = stored.device
    place = crossing.nonzero()
    # The voxels that a tile's cells read: in which of 2^3 tiles each lies, and where in it.
    along = torch.arange(APRON, device=device)
    part, inner = _cube(along // TILE, 2), _cube(along % TILE, TILE)
    beside = torch.cartesian_prod(*[torch.arange(2, device=device)] * 3)
    chunks = [slice(s, s + CHUNK) for s in range(0, len(place), CHUNK)]

    case = torch.empty((len(place), VOXELS), dtype=torch.uint8, device=device)
    number = torch.full(
        (len(place), VOXELS, 3), -1, dtype=torch.int32, device=device
    )  # of the vertex on each edge
    vertices, count = [torch.zeros((0, 3), dtype=torch.float64, device=device)], 0
    for chunk in chunks:
        x, y, z = (place[chunk, None] + beside).unbind(-1)
        block = stored.view(-1)[tiles[x, y, z][:, part] * VOXELS + inner].unflatten(1, (APRON,) * 3)
        matter = (block < 0).to(torch.uint8)
        case[chunk] = sum((_corner(matter, corner) << corner for corner in range(1, 8)), _corner(matter, 0))
        low = _corner(block, 0)
        high = torch.stack([_corner(block, 1 << axis) for axis in range(3)], -1)
        crossed = (low[..., None] < 0) != (high < 0)
        tile, voxel, axis = crossed.nonzero().unbind(1)
        low, high = low[tile, voxel], high[tile, voxel, axis]
        at = (TILE * place[chunk][tile] + torch.stack(_split(voxel, TILE), 1)).double()
        new = torch.arange(len(at), device=device)
        at[new, axis] += (low / (low - high)).double()
        number[chunk][crossed] = (count + new).int()
        vertices.append(at)
        count += len(at)

    slot = torch.full_like(tiles, -1)
    slot[crossing] = torch.arange(len(place), device=device)
    first = _cube(
        along[:TILE], APRON
    )  # where a cell's lowest voxel is among those that the tile's cells read
    corners, axes = torch.tensor(EDGES, device=device).unbind(1)
    step = (
        (corners & 1) * APRON**2 + (corners >> 1 & 1) * APRON + (corners >> 2)
    )  # from there to an edge's owner
    table = case_table().to(device)
    faces = [torch.zeros((0, 3), dtype=torch.int64, device=device)]
    for chunk in chunks:
        x, y, z = (place[chunk, None] + beside).unbind(-1)
        home = slot[x, y, z]  # [C, 8]
        tile, cell = ((case[chunk] > 0) & (case[chunk] < 255)).nonzero().unbind(1)
        triangles = table[case[chunk][tile, cell].long()]
        row, which = (triangles[..., 0] >= 0).nonzero().unbind(1)
        edge = triangles[row, which]  # [F, 3]
        owner = first[cell[row], None] + step[edge]
        faces.append(number[home[tile[row, None], part[owner]], inner[owner], axes[edge]].long())
    return torch.cat(vertices), torch.cat(faces)


def _cube(along: Tensor, base: int) -> Tensor:
    """[n^3] numbers in ``base`` whose three digits run through ``along [n]``."""
    x, y, z = along.view(-1, 1, 1), along.view(-1, 1), along
    return ((x * base + y) * base + z).flatten()


def _split(number: Tensor, base: int) -> tuple[Tensor, Tensor, Tensor]:
    """The three digits of numbers in ``base``."""
    return number // base**2, number // base % base, number % base


def _corner(block: Tensor, corner: int) -> Tensor:
    """[C, 64]: of blocks [C, 5, 5, 5] the voxels at one corner of the cells, in the order of the cells."""
    x, y, z = (slice(corner >> axis & 1, (corner >> axis & 1) + TILE) for axis in range(3))
    return block[:, x, y, z].flatten(1)
