"""The mesh of a field: marching cubes over its tiles, cleaned, smoothed and coloured."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
import torch
import trimesh
from numpy.typing import NDArray
from skimage.measure import marching_cubes
from torch import Tensor

from torch_surfcap.distance import Array
from torch_surfcap.ops import INSIDE, TILE
from torch_surfcap.surface.marching import march_cells
from torch_surfcap.surface.smoothing import taubin

if TYPE_CHECKING:
    from torch_surfcap.field.field import SurfaceField

Ints = NDArray[np.int64]

BLOCK = 16  # tiles along the side of the dense blocks that marching cubes reads
NEAREST = 1e-4  # of the largest value: values nearer to the threshold are moved away from it
CHUNK = 1 << 18  # surface points coloured at a time


def extract_mesh(
    field: SurfaceField,
    threshold: float | None = None,
    smooth: int = 0,
    specks: float = 0.01,
    cavities: bool = True,
) -> trimesh.Trimesh:
    """The surface where the field's opacity value crosses a threshold, closed and with colours.

    Pieces: the parts of the surface that do not hang together are scattered specks (outward, enclosing matter) and
    inner sheets (inward, enclosing emptiness within matter). Both count as pieces alike: what has less than `specks`
    of the largest piece's area goes. Inner sheets can be dropped whatever their size, since no camera sees them.

    Args:
        field: the field.
        threshold: value of the surface; matter is where the value is smaller. None: the field's own level.
        smooth: rounds of Taubin smoothing (every other round shrinks, the rounds between swell).
        specks: least area of a piece, as a share of the largest one's; 0 keeps everything.
        cavities: keep large inner sheets.

    Returns:
        Watertight mesh in world units, normals outwards, with a colour per vertex: the field's, seen from straight
        above. Without faces if nothing crosses the threshold.

    Raises:
        ValueError: the values are not finite, or space outside lies on the matter's side of the threshold, where
            the surface would have no end.
    """
    level = field.level if threshold is None else float(threshold)
    found = isosurface(field.transparency.detach(), field.table, field.outside, field.inside, level)
    vertices, faces = (x.cpu().numpy() for x in found)
    vertices, faces = drop_pieces(vertices, faces, specks, cavities)
    if smooth and len(faces):
        at, around = (torch.from_numpy(x).to(field.table.device) for x in (vertices, faces))
        vertices = taubin(at, around, smooth).cpu().numpy()
    corner = np.asarray(field.frame[:3], dtype=np.float64)
    mesh = trimesh.Trimesh(corner + (vertices + 0.5) * field.voxel_size, faces, process=False)
    if len(faces) == 0:
        return mesh
    mesh.visual = trimesh.visual.ColorVisuals(mesh, vertex_colors=vertex_colors(field, mesh))
    return mesh


def isosurface(
    values: Tensor, table: Tensor, outside: float, inside: float, level: float
) -> tuple[Tensor, Tensor]:
    """Marching cubes over the tiles of a table, closed also where a missing inside tile meets a missing outside one.

    Args:
        values: [T, 4, 4, 4] voxels of the stored tiles.
        table: [X, Y, Z] index of the stored tile, -1 inside, less: outside; its rim is outside.
        outside, inside: value of the missing tiles.
        level: of the surface; smaller values are matter.

    Returns:
        vertices [V, 3] float64 in voxels of the table, whole numbers at voxel centres, and faces [F, 3], outwards; on
        the device of the values. On the CPU scikit-image finds them, which decides ambiguous cells by their values.
    """
    march = march_blocks if values.device.type == "cpu" else march_cells
    return march(*signed_tiles(values, table, outside, inside, level))


def signed_tiles(
    values: Tensor, table: Tensor, outside: float, inside: float, level: float
) -> tuple[Tensor, Tensor, Tensor]:
    """What marching cubes reads, of the arguments of :func:`isosurface`: tiles [S, 4, 4, 4] float32 of values relative to
    the level, none of them near 0, which of them stands where [X, Y, Z] int64, and the places [X, Y, Z] bool of those
    with cells that cross the level."""
    if not outside > level:
        raise ValueError(f"threshold {level:g}: expected less than the value outside, {outside:g}")
    missing = torch.tensor([inside, outside], dtype=torch.float32, device=values.device)
    stored = torch.cat([values.float(), missing.view(2, 1, 1, 1).expand(2, TILE, TILE, TILE)]) - level
    finite = stored.isfinite()
    if not finite.all():
        raise ValueError(f"{int((~finite).sum())} voxels are not finite, expected numbers")
    tiles = torch.where(table >= 0, table, len(values) + (table != INSIDE).int()).long()
    # A vertex must lie clearly between its edge's ends for the edge to be told from the coordinates, which come as
    # float32; so values keep a distance from the level. The factor on one side breaks ties A C = B D on a voxel
    # face, where the two cells that share the face may decide differently and leave a hole.
    stored /= NEAREST * stored.abs().max()
    stored = torch.where(stored < 0, stored.clamp(max=-1.0), stored.clamp(min=1.0) * (1 + 1e-5))
    crossing = _reach(stored.amin((1, 2, 3))[tiles], torch.minimum) < 0
    crossing &= _reach(stored.amax((1, 2, 3))[tiles], torch.maximum) > 0
    return stored, tiles, crossing


def _reach(tiles: Tensor, fold: Callable[[Tensor, Tensor], Tensor]) -> Tensor:
    """Minimum or maximum over what the cells of each tile read: the tile and its seven upper neighbours."""
    for axis in range(3):
        size = tiles.shape[axis]
        ahead = torch.cat([tiles.narrow(axis, 1, size - 1), tiles.narrow(axis, size - 1, 1)], axis)
        tiles = fold(tiles, ahead)
    return tiles


def march_blocks(stored: Tensor, tiles: Tensor, crossing: Tensor) -> tuple[Tensor, Tensor]:
    """:func:`march_cells` by scikit-image, with ambiguous cells decided by their values, on the host.

    Dense blocks with an apron of one voxel are cut out where something crosses the level; a vertex that two blocks
    share lies on one edge of the voxel grid, and that edge is its identity.
    """
    vertices, faces = _weld(_blocks(*(x.cpu().numpy() for x in (stored, tiles, crossing))))
    return torch.from_numpy(vertices), torch.from_numpy(faces)


def _blocks(
    stored: NDArray[np.float32], tiles: Ints, crossing: NDArray[np.bool_]
) -> list[tuple[Array, Ints, Ints]]:
    """Vertices, faces and edge numbers of the vertices, block by block."""
    shape = TILE * np.array(tiles.shape, dtype=np.int64)
    found: list[tuple[Array, Ints, Ints]] = []
    for start in np.unique(np.argwhere(crossing) // BLOCK, axis=0) * BLOCK:
        part = np.argwhere(crossing[tuple(slice(s, s + BLOCK) for s in start)])
        first, last = start + part.min(axis=0), start + part.max(axis=0)
        cut = tiles[tuple(slice(a, b + 2) for a, b in zip(first, last, strict=True))]
        block = stored[cut].transpose(0, 3, 1, 4, 2, 5).reshape([TILE * n for n in cut.shape])
        block = block[tuple(slice(TILE * n + 1) for n in last - first + 1)]
        if block.min() > 0 or block.max() < 0:
            continue  # the neighbours cross the level beyond their first layer only
        # "descent" is meant for left-handed axes: here it turns the faces towards the larger values.
        corners, faces, _, _ = marching_cubes(block, 0.0, gradient_direction="descent")
        found.append((corners + float(TILE) * first, faces, _edge(corners, TILE * first, shape)))
    return found


def _edge(corners: NDArray[np.float32], first: Ints, shape: Ints) -> Ints:
    """Number [V] of the grid edge that each vertex of a block lies on: low voxel of the edge and axis. Marching cubes
    also sets a vertex within a cell here and there; it gets the cell's low voxel and no axis."""
    base = np.rint(corners)
    off = np.abs(corners - base) > 0.1 * NEAREST
    base = (np.where(off, np.floor(corners), base)).astype(np.int64) + first
    axis = np.where(off.sum(axis=1) == 1, off.argmax(axis=1), 3)
    return np.asarray(4 * ((base[:, 0] * shape[1] + base[:, 1]) * shape[2] + base[:, 2]) + axis)


def _weld(blocks: list[tuple[Array, Ints, Ints]]) -> tuple[Array, Ints]:
    """One mesh of blocks (vertices, faces, edge numbers), vertices in the order of their edges."""
    if not blocks:
        return np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64)
    starts = np.cumsum([0] + [len(corners) for corners, _, _ in blocks])
    _, first, number = np.unique(
        np.concatenate([b[2] for b in blocks]), return_index=True, return_inverse=True
    )
    faces = np.concatenate([b[1] + start for b, start in zip(blocks, starts[:-1], strict=True)])
    return np.concatenate([b[0] for b in blocks])[first], number[faces]


def drop_pieces(vertices: Array, faces: Ints, specks: float, cavities: bool = True) -> tuple[Array, Ints]:
    """Remove the pieces with less than `specks` of the largest one's area and, unless `cavities`, the pieces that
    enclose a negative volume; and the vertices that no face needs any more."""
    if len(faces) == 0:
        return vertices, faces
    sides = np.concatenate([faces[:, :2], faces[:, 1:]])
    label = trimesh.graph.connected_component_labels(sides, len(vertices))[faces[:, 0]]
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    cross = np.cross(b - a, c - a)
    area = np.bincount(label, np.linalg.norm(cross, axis=1))
    keep = area >= specks * area.max()
    if not cavities:
        keep &= np.bincount(label, np.einsum("ij,ij->i", a, cross)) > 0
    faces = faces[keep[label]]
    used = np.zeros(len(vertices), dtype=bool)
    used[faces] = True
    return vertices[used], (np.cumsum(used) - 1)[faces]


def vertex_normals(vertices: Array, faces: Ints) -> Array:
    """Unit normals [V, 3], the mean of the faces around weighted by their areas; zero where they cancel."""
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    cross = np.cross(b - a, c - a)
    weight = np.tile(cross, (3, 1))
    total = np.stack([np.bincount(faces.T.ravel(), weight[:, i], len(vertices)) for i in range(3)], axis=1)
    length = np.linalg.norm(total, axis=1, keepdims=True)
    return np.asarray(total / np.where(length > 0, length, 1.0))


def vertex_colors(field: SurfaceField, mesh: trimesh.Trimesh) -> NDArray[np.uint8]:
    """Colours [V, 4] (RGBA, 8 bit) of the field at a mesh's vertices, seen along the normal from outside."""
    vertices = np.asarray(mesh.vertices, dtype=np.float64)
    inward = -vertex_normals(vertices, np.asarray(mesh.faces, dtype=np.int64))
    colors = np.full((len(vertices), 4), 255, dtype=np.uint8)
    with torch.no_grad():
        for s in range(0, len(vertices), CHUNK):
            at, towards = (torch.from_numpy(x[s : s + CHUNK]) for x in (vertices, inward))
            rgb = field.sample(at, towards)[1].clamp(0, 1).cpu().numpy()
            colors[s : s + CHUNK, :3] = np.rint(255 * rgb)
    return colors
