"""SurfaceField: the sparse field as an nn.Module that sits in anybody's optimiser and loss."""

from __future__ import annotations

import os
import zipfile
import zlib
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from torch_surfcap import ops
from torch_surfcap.autograd import March, MarchRays, SampleTiles, ShadePoints
from torch_surfcap.data.files import atomic_write
from torch_surfcap.errors import InputError
from torch_surfcap.field.tiles import TileGrid, with_skips

if TYPE_CHECKING:
    import trimesh

ETA = 0.01  # transparency of the solid
CLAMP = 4.0  # voxels; a signed distance is known in this band and constant beyond it
SLOPE = 4.0  # per voxel, of the signed distance's logistic
LEVEL = {"transparency": 0.81, "distance": 0.0}  # value on the surface, of a path of a voxel's diagonal
DIAGONAL = 3.0**0.5  # of a voxel, in voxels
MISSING = {"transparency": (1.0, ETA), "distance": (CLAMP, -CLAMP)}  # value outside, inside
FORMAT = 3  # of the .npz file
VIEW_PREFIX = "view_"


class RayOutput(NamedTuple):
    """What rays see: color [R, 3], transmittance [R], depth [R] (world units, NaN where a ray meets nothing)."""

    color: Tensor
    transmittance: Tensor
    depth: Tensor


class SurfaceField(nn.Module):
    """A sparse voxel field of opacity and colour, rendered by marching rays and meshed by marching cubes.

    Attributes:
        voxels: the parameter, [T, 4, 4, 4, 1 + 3 (B + 1)^2]: the opacity value, then SH coefficients, RGB innermost.
        grid: which tiles there are. table: its table (a buffer). tile_coords: [T, 3] int32, relative to ``origin``.
        opacity: "transparency" (1 = empty) or "distance" (signed, in voxels, positive outside).
        sh_degree: 0, 1 or 2, of its own records.
        step: voxels between the samples of a ray: a transparency is that of a path of this length.
        view: another field, or None: its colour, read once per ray at the mean depth, is added to what the ray sees. A fit
            keeps view-dependent colours in one of larger voxels where ``view_spacing`` is more than 1.
        level: opacity value on the surface. A path of a voxel's diagonal has transparency 0.81 there, shorter ones more.

    >>> grid = torch.ones(8, 8, 8); grid[2:6, 2:6, 2:6] = 0.01
    >>> field = SurfaceField.from_dense(grid, torch.full((8, 8, 8, 1, 3), 0.5), [0.0, 0.0, 0.0], 1.0)
    >>> out = field(torch.tensor([[4.0, 4.0, -5.0]]), torch.tensor([[0.0, 0.0, 1.0]]))
    >>> round(out.color[0, 0].item(), 1)
    0.5
    """

    def __init__(
        self,
        voxels: Tensor,
        grid: TileGrid,
        opacity: str = "transparency",
        step: float = DIAGONAL,
        view: SurfaceField | None = None,
    ) -> None:
        super().__init__()
        if not 0 < step < float("inf"):
            raise ValueError(f"step: expected a positive number of voxels, got {step:g}")
        if opacity not in LEVEL:
            raise ValueError(f"opacity: expected transparency or distance, got {opacity!r}")
        if view is not None:
            found, like = [f"{x.dtype} on {x.device}" for x in (view.transparency, voxels)]
            if found != like:
                raise ValueError(f"view: expected {like} as the voxels, got {found}")
        expected = (len(grid.coords), ops.TILE, ops.TILE, ops.TILE)
        if voxels.dim() != 5 or tuple(voxels.shape[:4]) != expected:
            raise ValueError(f"voxels: expected {[*expected, '*']}, got {list(voxels.shape)}")
        grid.check()
        self.sh_degree = ops.degree_of(voxels.shape[-1])
        self.voxels = nn.Parameter(self._padded(voxels.detach()))
        self.opacity = opacity
        self.voxel_size = grid.voxel_size
        self.outside, self.inside = MISSING[opacity]
        self.step = step
        self.view = view
        self.level = LEVEL[opacity] ** (step / DIAGONAL)  # a path's transparency is a power of its length
        self.table: Tensor
        self.tile_coords: Tensor
        self.origin: Tensor
        self.register_buffer("table", grid.table.to(voxels.device), persistent=False)
        self.register_buffer("tile_coords", grid.coords.to(voxels.device), persistent=False)
        self._corner = grid.origin
        corner = torch.tensor(grid.origin, dtype=torch.float64, device=voxels.device)
        self.register_buffer("origin", corner, persistent=False)
        self._frame = grid.frame(self.outside, self.inside, about=grid.origin)  # see `_own`

    @classmethod
    def from_dense(
        cls,
        transparency: Tensor,
        sh: Tensor,
        origin: Tensor | list[float],
        voxel_size: float,
        opacity: str = "transparency",
    ) -> SurfaceField:
        """The field of a dense grid; tiles that are wholly outside or inside (whatever their colour) are not stored.

        Args:
            transparency: [X, Y, Z] opacity values (a signed distance in voxels where ``opacity="distance"``); value
                (i, j, k) sits at ``origin + (i + 1/2, j + 1/2, k + 1/2) * voxel_size``. Beyond the grid is outside.
            sh: [X, Y, Z, (B + 1)^2, 3] coefficients, or [X, Y, Z, 3] for degree 0.
            origin: world position of the grid's low corner. voxel_size: world units.
        """
        if opacity not in LEVEL:
            raise ValueError(f"opacity: expected transparency or distance, got {opacity!r}")
        if sh.shape[:3] != transparency.shape or transparency.dim() != 3 or sh.shape[-1] != 3:
            raise ValueError(f"sh: expected {[*transparency.shape, '(B + 1)^2', 3]}, got {list(sh.shape)}")
        outside, inside = MISSING[opacity]
        records = torch.cat([transparency[..., None], sh.flatten(3).to(transparency)], -1)
        pad = [(-n) % ops.TILE for n in transparency.shape]
        records = nn.functional.pad(records, (0, 0, 0, pad[2], 0, pad[1], 0, pad[0]))
        for axis in range(3):  # what was padded is outside
            records.narrow(axis, transparency.shape[axis], pad[axis])[..., 0] = outside
        x, y, z = (n // ops.TILE for n in records.shape[:3])
        tiles = records.reshape(x, 4, y, 4, z, 4, -1).permute(0, 2, 4, 1, 3, 5, 6)
        value = tiles[..., 0].flatten(3)
        solid = (value <= inside).all(-1)
        cx, cy, cz = (float(c) for c in origin)
        grid = TileGrid.build(~((value >= outside).all(-1) | solid), solid, (cx, cy, cz), voxel_size)
        i, j, k = grid.coords.long().unbind(1)
        return cls(tiles[i, j, k], grid, opacity)

    @property
    def grid(self) -> TileGrid:
        return TileGrid(self.table, self.tile_coords, self._corner, self.voxel_size)

    @property
    def frame(self) -> list[float]:
        """The ``frame`` argument of the ops, for positions in the world."""
        return self.grid.frame(self.outside, self.inside)

    @property
    def transparency(self) -> Tensor:
        """[T, 4, 4, 4] view of the opacity values."""
        return self.voxels[..., 0]

    @property
    def sh(self) -> Tensor:
        """[T, 4, 4, 4, (B + 1)^2, 3] view of the SH coefficients."""
        return self.voxels[..., 1:].unflatten(-1, ((self.sh_degree + 1) ** 2, 3))

    def march(self, step: float | None = None, stop: float | None = None) -> March:
        """How rays are sampled, ``step`` in world units; single precision stops at a transmittance of 1e-4."""
        if step is None:
            step = self.step * self.voxel_size
        if stop is None:
            stop = 0.0 if self.voxels.dtype == torch.float64 else 1e-4
        return March(ops.OPACITY[self.opacity], SLOPE, step, stop)

    def forward(
        self,
        origins: Tensor,
        directions: Tensor,
        background: Tensor | None = None,
        shift: Tensor | None = None,
        step: float | None = None,
    ) -> RayOutput:
        """The ray integral (paper eq. 6), and (1 - T) times the colour of ``view`` at the depth, which counts as a constant.

        Args:
            origins, directions: [R, 3], world; directions are unit vectors. background: [R, 3], black by default.
            shift: [R] displacement of a ray's samples in steps. step: between samples, world units; the field's own by
                default.

        Differentiability: voxels (and those of ``view``) and background.
        """
        origins, directions = self._own(origins), directions.to(self.voxels)
        if background is None:
            background = torch.zeros_like(origins)
        if shift is None:
            shift = origins.new_zeros(len(origins))
        store = self._store()
        rays = (origins, directions, shift.to(origins))
        color, transmittance, depth = MarchRays.apply(
            store, background.to(origins), self.table, self._frame, *rays, self.march(step)
        )
        if self.view is not None:
            points = self.origin + origins + depth.detach().nan_to_num(0.0)[:, None] * directions
            color = color + (1 - transmittance)[:, None] * self.view.sample(points, directions)[1]
        return RayOutput(color, transmittance, depth)

    def sample_opacity(self, points: Tensor) -> Tensor:
        """The raw opacity value at ``points [P, 3]``: [P], differentiable."""
        values: Tensor = SampleTiles.apply(self._store(), self.table, self._frame, self._own(points))
        return values[:, 0]

    def sample(self, points: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
        """Transparency [P] and colour [P, 3] at ``points [P, 3]`` seen along unit ``directions [P, 3]``.

        The transparency of a signed distance s is that of a long step that ends there, 1/(1 + exp(-slope s)): 1 outside,
        0 inside. Differentiability: voxels, and those of ``view``.
        """
        directions = directions.to(self.voxels)
        values = ShadePoints.apply(self._store(), self.table, self._frame, self._own(points), directions)
        opacity, color = values[:, 0], values[:, 1:]
        if self.opacity == "distance":
            opacity = torch.sigmoid(SLOPE * opacity)
        if self.view is not None:
            color = color + self.view.sample(points, directions)[1]
        return opacity, color

    def _own(self, points: Tensor) -> Tensor:
        """World positions relative to the field's own origin, so near that the voxels' precision resolves them."""
        return (points.to(self.origin) - self.origin).to(self.voxels.dtype)

    def _padded(self, voxels: Tensor) -> Tensor:
        """The coefficients in memory that is padded to a record's pitch, so that no op has to copy them."""
        return ops.padded(voxels).contiguous()[..., : ops.coefficients(self.sh_degree)]

    def _apply(self, fn: Callable[..., Any], recurse: bool = True) -> Any:
        """What ``to`` and its like do: their copies of the parameter are padded again, and the origin stays exact."""

        def moved(tensor: Tensor) -> Any:
            copy = fn(tensor)
            if tensor is self.origin:
                return tensor.to(copy.device)
            return self._padded(copy) if tensor is self.voxels and copy.stride() != self._strides() else copy

        return super()._apply(moved, recurse)

    def _strides(self) -> tuple[int, ...]:
        """Those of padded memory."""
        width = ops.pitch(self.sh_degree)
        return 64 * width, 16 * width, 4 * width, width, 1

    def _store(self) -> Tensor:
        """The parameter as the ops want it: padded records. The memory behind it, where that still is padded."""
        voxels, width, strides = self.voxels, ops.pitch(self.sh_degree), self._strides()
        differentiable = voxels.requires_grad and torch.is_grad_enabled()
        if voxels.shape[-1] < width and voxels.stride() == strides and not differentiable:
            return voxels.detach().as_strided((*voxels.shape[:4], width), strides)
        return ops.padded(voxels)

    def extract_mesh(
        self, threshold: float | None = None, smooth: int = 0, specks: float = 0.01
    ) -> trimesh.Trimesh:
        """The surface by marching cubes, with vertex colours, in world units, normals outward.

        Args:
            threshold: value on the surface; the field's level by default.
            smooth: rounds of Taubin smoothing. specks: pieces under this fraction of the largest one's area are removed.
        """
        from torch_surfcap.surface.extract import extract_mesh

        return extract_mesh(self, threshold, smooth=smooth, specks=specks)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write an .npz file (complete or absent, no pickle)."""
        with atomic_write(path) as partial, open(partial, "wb") as file:
            np.savez(file, format=np.int64(FORMAT), **self._arrays())

    def _arrays(self) -> dict[str, Any]:
        """What is saved, by name; what is the view's has a prefix."""
        data = {
            "voxels": self.voxels.detach().cpu().numpy(),
            "table": torch.clamp(self.table, min=ops.OUTSIDE).cpu().numpy(),
            "tile_coords": self.tile_coords.cpu().numpy(),
            "origin": np.array(self._corner),
            "voxel_size": np.float64(self.voxel_size),
            "opacity": np.str_(self.opacity),
            "step": np.float64(self.step),
        }
        view = self.view._arrays() if self.view else {}
        return data | {VIEW_PREFIX + name: value for name, value in view.items()}

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> SurfaceField:
        """The field of a file that :meth:`save` wrote. Raises InputError if it is none."""
        expected = "expected an .npz file of SurfaceField.save"
        try:
            with np.load(path, allow_pickle=False) as data:
                if int(data["format"]) != FORMAT:
                    raise InputError(f"{path}: field format {int(data['format'])}, expected {FORMAT}")
                return cls._of({name: data[name] for name in data.files})
        except InputError:
            raise
        except (OSError, EOFError, KeyError, TypeError, ValueError, AttributeError, RuntimeError) as error:
            raise InputError(f"{path}: not a saved field ({error}), {expected}") from error
        except (zipfile.BadZipFile, zlib.error) as error:
            raise InputError(f"{path}: a damaged file ({error}), {expected}") from error

    @classmethod
    def _of(cls, data: Mapping[str, Any]) -> SurfaceField:
        """The field of what :meth:`_arrays` gave."""
        view = {name.removeprefix(VIEW_PREFIX): data[name] for name in data if name.startswith(VIEW_PREFIX)}
        x, y, z = (float(c) for c in data["origin"])
        table, coords = torch.from_numpy(data["table"]), torch.from_numpy(data["tile_coords"])
        grid = TileGrid(with_skips(table), coords, (x, y, z), float(data["voxel_size"]))
        kind, step = str(data["opacity"]), float(data["step"])
        return cls(torch.from_numpy(data["voxels"]), grid, kind, step, cls._of(view) if view else None)
