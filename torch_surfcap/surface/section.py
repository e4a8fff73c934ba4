"""A plane cut through a field: its transparency, and which tiles are stored, missing inside and missing outside."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
import trimesh
from numpy.typing import NDArray
from torch import Tensor

from torch_surfcap.errors import InputError
from torch_surfcap.ops import INSIDE, OUTSIDE, TILE

if TYPE_CHECKING:
    from torch_surfcap.field.field import SurfaceField

INSIDE_COLOR = (0.45, 0.75, 0.42)  # missing tiles that are inside
OUTSIDE_COLOR = (0.87, 0.92, 0.98)  # missing tiles that are outside
CHUNK = 1 << 18  # points read at a time


@dataclass
class Section:
    """A picture's worth of a plane, rows downwards, pixels square.

    axis, position: the plane is x, y or z (0, 1, 2) = position, world units. across, upward: the world axes that the
    picture shows; corner: world coordinates of the picture's top left corner along them; pixel: its pixels' size, world
    units, where a negative second entry means that `upward` grows against the rows, as it does unless turned over.
    value, transparency [H, W]: at the pixels' centres. tile [H, W]: entries of the field's table there. stored [M, 2]: low
    corners of the stored tiles that the plane cuts, along across and upward, and edge, their width, world units. level:
    value on the surface.
    """

    axis: int
    position: float
    across: int
    upward: int
    corner: tuple[float, float]
    pixel: tuple[float, float]
    value: Tensor
    transparency: Tensor
    tile: Tensor
    stored: Tensor
    edge: float
    level: float

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """World coordinates of the picture's left, right, bottom and top border."""
        height, width = self.value.shape
        (left, top), (dx, dy) = self.corner, self.pixel
        return left, left + width * dx, top + height * dy, top

    def picture(self) -> Tensor:
        """[H, W, 3]: in stored tiles the transparency, white 1 to black 0; missing tiles in their colours."""
        grey = self.transparency.clamp(0, 1)[:, :, None].expand(-1, -1, 3)
        missing = torch.where(
            (self.tile == INSIDE)[:, :, None], torch.tensor(INSIDE_COLOR), torch.tensor(OUTSIDE_COLOR)
        )
        return torch.where((self.tile >= 0)[:, :, None], grey, missing)

    def surface(self) -> NDArray[np.bool_]:
        """[H, W]: pixels between which and the next to the right or below the value crosses the level."""
        within = (self.value < self.level).numpy()
        crossed = np.zeros(within.shape, dtype=bool)
        crossed[:, :-1] |= within[:, :-1] != within[:, 1:]
        crossed[:-1] |= within[:-1] != within[1:]
        return crossed


def middle_plane(mesh: trimesh.Trimesh) -> tuple[int, float]:
    """The axis along which a mesh is thinnest, so that the plane across it shows most, and the place on it that has half
    of the vertices on either side: an outstretched arm moves it little."""
    vertices = np.asarray(mesh.vertices)
    axis = int(np.ptp(vertices, axis=0).argmin())
    return axis, float(np.median(vertices[:, axis]))


def in_words(position: float, length: float) -> str:
    """A coordinate, to a tenth of a length or finer, however far from the origin."""
    return np.format_float_positional(position, max(0, 1 - math.floor(math.log10(length))), trim="-")


def cut(
    field: SurfaceField,
    axis: int,
    position: float,
    size: int = 1000,
    up: Tensor | None = None,
    level: float | None = None,
    around: tuple[float, float] | None = None,
    width: float = 0.0,
) -> Section:
    """The section of a field by the plane `axis` = position (world units).

    size: about so many pixels on the longer side; a voxel gets a whole number of them. up: world direction [3] that is to
    be up in the picture, as far as the plane allows; by default z, and y where the plane is across z. level: value on the
    surface, the field's own by default. around, width: show the square of this width about a point of the plane, both in
    world units, instead of all stored tiles.

    Raises:
        InputError: no tile of the field is on the plane.
    """
    table, edge = field.table.cpu(), TILE * field.voxel_size
    frame = np.array(field.frame[:3])
    across, upward, sign = _orientation(axis, up)
    place = int(np.floor((position - frame[axis]) / edge))
    layer = table.select(axis, place) if 0 <= place < table.shape[axis] else torch.full((1, 1), OUTSIDE)
    if across > upward:
        layer = layer.T
    occupied = (layer > OUTSIDE).nonzero()
    if len(occupied) == 0:
        reach = frame[axis] + edge * np.flatnonzero((table > OUTSIDE).transpose(0, axis).flatten(1).any(1))
        ends = [in_words(end, field.voxel_size) for end in (position, *reach[:1], *(reach[-1:] + edge))]
        there = " to ".join(ends[1:]) or "a field that is not empty"
        raise InputError(f"section: no tile of the field at {'xyz'[axis]}={ends[0]}, expected {there}")
    if around is None:
        first, last = (x.double().numpy() for x in (occupied.amin(0) - 1, occupied.amax(0) + 2))
        low, span = frame[[across, upward]] + edge * first, edge * (last - first)
    else:
        low, span = np.array(around) - width / 2, np.array([width, width])
    per_voxel = max(1, int(size * field.voxel_size / span.max()))
    step = field.voxel_size / per_voxel
    columns, rows = (int(n) for n in np.maximum(1, np.rint(span / step)))
    u = low[0] + (torch.arange(columns, dtype=torch.float64) + 0.5) * step
    v = low[1] + (torch.arange(rows, dtype=torch.float64) + 0.5) * step
    v = v.flip(0) if sign > 0 else v
    points = torch.empty(rows, columns, 3, dtype=torch.float64)
    points[..., axis], points[..., across], points[..., upward] = position, u[None, :], v[:, None]
    value, transparency = (x.reshape(rows, columns) for x in _read(field, points.reshape(-1, 3)))
    return Section(
        axis,
        position,
        across,
        upward,
        (float(low[0]), float(low[1]) + (rows * step if sign > 0 else 0.0)),
        (step, -sign * step),
        value,
        transparency,
        _entries(layer, (u - frame[across]) / edge, (v - frame[upward]) / edge),
        torch.from_numpy(frame[[across, upward]]) + edge * (layer >= 0).nonzero(),
        edge,
        field.level if level is None else level,
    )


def _orientation(axis: int, up: Tensor | None) -> tuple[int, int, int]:
    """The world axes to the right and up in the picture of a plane, and 1, or -1 where the latter points down."""
    one, other = (a for a in range(3) if a != axis)
    if up is None or float(up[[one, other]].abs().max()) < 0.1:
        return one, other, 1
    upward = max(one, other, key=lambda a: float(up[a].abs()))
    return one + other - upward, upward, 1 if up[upward] > 0 else -1


def _entries(layer: Tensor, u: Tensor, v: Tensor) -> Tensor:
    """[H, W] entries of a layer of the table at tile coordinates u [W] along its first axis, v [H] along its second."""
    u, v = u.floor().long(), v.floor().long()
    found = layer[u.clamp(0, layer.shape[0] - 1)[None, :], v.clamp(0, layer.shape[1] - 1)[:, None]]
    beyond = ((u < 0) | (u >= layer.shape[0]))[None, :] | ((v < 0) | (v >= layer.shape[1]))[:, None]
    return found.masked_fill(beyond, OUTSIDE)


def _read(field: SurfaceField, points: Tensor) -> tuple[Tensor, Tensor]:
    """Opacity value and transparency [P] at points [P, 3]."""
    ahead = torch.tensor([0.0, 0.0, 1.0]).expand(CHUNK, 3)
    values, transparencies = [], []
    with torch.no_grad():
        for part in points.split(CHUNK):
            values.append(field.sample_opacity(part).cpu().float())
            transparencies.append(field.sample(part, ahead[: len(part)])[0].cpu().float())
    return torch.cat(values), torch.cat(transparencies)
