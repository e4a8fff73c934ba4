"""Small random fields and rays for the tests of the ops, and what their results are compared with."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from torch_surfcap import reference
from torch_surfcap.reference import DISTANCE, INSIDE, OUTSIDE, TILE, TRANSPARENCY

PITCH = {0: 4, 1: 16, 2: 32}  # numbers of a voxel by SH degree
TOLERANCE = {torch.float64: 1e-10, torch.float32: 2e-5}  # relative to the largest number compared
# On a GPU the order of sums, and with it the last bits of a gradient, is left to chance.
GRADCHECK: dict[str, Any] = {"fast_mode": True, "nondet_tol": 1e-12}


@dataclass
class Scene:
    """A field of some stored, some inside and many missing tiles, and rays that cross it, graze it and miss it."""

    voxels: Tensor  # [T,4,4,4,P]
    table: Tensor  # [X,Y,Z] int32
    frame: list[float]
    coordinates: Tensor  # [T,3] int32
    origins: Tensor  # [R,3]
    directions: Tensor
    shift: Tensor
    background: Tensor
    target: Tensor
    mask: Tensor
    weight: Tensor
    opacity: int
    slope: float
    step: float

    @property
    def field(self) -> tuple[Tensor, Tensor, list[float]]:
        return self.voxels, self.table, self.frame

    @property
    def rays(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        return self.origins, self.directions, self.shift, self.background

    def march(self, stop: float = 0.0) -> tuple[int, float, float, float]:
        return self.opacity, self.slope, self.step, stop

    def marched(self, stop: float = 0.0) -> list[Any]:
        """All arguments of march_forward."""
        return [*self.field, *self.rays, *self.march(stop)]

    def select(self, rays: slice | Tensor) -> Scene:
        """The scene with some of its rays."""
        names = ("origins", "directions", "shift", "background", "target", "mask", "weight")
        chosen: dict[str, Any] = {name: getattr(self, name)[rays] for name in names}
        return replace(self, **chosen)

    def non_contiguous(self) -> Scene:
        """The same numbers, each tensor a view of every second element of a larger one."""
        changed: dict[str, Any] = {
            name: torch.stack([value, value], -1)[..., 0]
            for name, value in vars(self).items()
            if isinstance(value, Tensor)
        }
        assert not changed["voxels"].is_contiguous()
        return replace(self, **changed)


def promises(table: Tensor) -> Tensor:
    """The table with every missing outside tile's entry lowered by its cell's distance to a non-empty cell."""
    near = reference.nonempty_cells(table)
    distance = torch.zeros_like(table)
    for _ in range(max(table.shape)):
        distance += (~near).int()
        grown = torch.nn.functional.max_pool3d(near[None, None].double(), 3, stride=1, padding=1)
        near = grown[0, 0] > 0
    return torch.where(table <= OUTSIDE, OUTSIDE - distance, table).int()


def make_scene(
    degree: int = 1,
    opacity: int = TRANSPARENCY,
    dtype: torch.dtype = torch.float64,
    device: str = "cpu",
    rays: int = 24,
    seed: int = 0,
    side: int = 3,
) -> Scene:
    """A Scene with side³ tiles inside the table's border. The same numbers for every dtype and device."""
    g = torch.Generator().manual_seed(seed)

    def uniform(*shape: int, low: float = 0.0, high: float = 1.0) -> Tensor:
        return low + (high - low) * torch.rand(*shape, generator=g, dtype=torch.float64)

    kind = uniform(side, side, side)
    stored = kind < 0.4
    coordinates = stored.nonzero() + 1
    table = torch.full((side + 2,) * 3, OUTSIDE, dtype=torch.int32)
    table[1:-1, 1:-1, 1:-1][kind > 0.85] = INSIDE
    table[coordinates.unbind(-1)] = torch.arange(len(coordinates), dtype=torch.int32)

    basis = (degree + 1) ** 2
    voxels = torch.zeros(len(coordinates), TILE, TILE, TILE, PITCH[degree], dtype=torch.float64)
    low, high = (0.2, 0.95) if opacity == TRANSPARENCY else (-2.0, 2.0)
    voxels[..., 0] = uniform(*voxels.shape[:4], low=low, high=high)
    voxels[..., 1:4] = uniform(*voxels.shape[:4], 3)
    voxels[..., 4 : 1 + 3 * basis] = uniform(*voxels.shape[:4], 3 * basis - 3, low=-0.5, high=0.5)
    size, outside, inside = (0.1, 1.0, 0.02) if opacity == TRANSPARENCY else (0.1, 4.0, -4.0)
    frame = [-0.93, 0.21, 1.57, size, outside, inside]

    low_corner = torch.tensor(frame[:3], dtype=torch.float64)
    extent = TILE * size * (side + 2)
    through = low_corner + uniform(rays, 3) * extent
    away = torch.nn.functional.normalize(uniform(rays, 3, low=-1, high=1), dim=-1)
    origins = through - away * uniform(rays, 1, low=0.0, high=1.5) * extent
    numbers = {
        "voxels": voxels,
        "origins": origins,
        "directions": away,
        "shift": uniform(rays, low=-0.5, high=0.5),
        "background": uniform(rays, 3),
        "target": uniform(rays, 3),
        "mask": uniform(rays),
        "weight": uniform(rays, low=0.5, high=2.0),
    }
    return Scene(
        table=promises(table).to(device),
        frame=frame,
        coordinates=coordinates.int().to(device),
        opacity=opacity,
        slope=2.0 if opacity == DISTANCE else 0.0,
        step=0.13,
        **{name: value.to(device, dtype) for name, value in numbers.items()},
    )


def doubled(arguments: Sequence[Any]) -> list[Any]:
    """The arguments for the reference: floating tensors in double on the CPU."""
    return [
        (a.cpu().double() if a.is_floating_point() else a.cpu()) if isinstance(a, Tensor) else a
        for a in arguments
    ]


def assert_close(actual: Tensor, expected: Tensor, tolerance: float = TOLERANCE[torch.float64]) -> None:
    """Equal up to `tolerance` times the largest expected number; NaN alike."""
    assert actual.shape == expected.shape
    scale = float(expected.detach().nan_to_num().abs().max()) if expected.numel() else 1.0
    torch.testing.assert_close(
        actual.detach().cpu().double(),
        expected.detach().double(),
        rtol=0,
        atol=tolerance * scale,
        equal_nan=True,
    )


def one_tile(
    degree: int = 0, outside: float = 1.0, device: str = "cpu"
) -> tuple[Tensor, Tensor, list[float]]:
    """A field of one tile of zeros; its voxel (x, y, z) is the unit cube whose low corner is (x, y, z)."""
    voxels = torch.zeros(1, TILE, TILE, TILE, PITCH[degree], dtype=torch.float64, device=device)
    table = torch.full((3, 3, 3), OUTSIDE, dtype=torch.int32)
    table[1, 1, 1] = 0
    return voxels, promises(table).to(device), [-4.0, -4.0, -4.0, 1.0, outside, 0.0]
