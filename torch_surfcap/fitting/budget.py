"""What a fit will need: memory per level, and a rough guess of the time."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torch_surfcap import codes, devices, ops
from torch_surfcap.data.capture import Capture
from torch_surfcap.devices import CPU
from torch_surfcap.field.field import DIAGONAL
from torch_surfcap.field.tiles import TileGrid
from torch_surfcap.fitting.settings import FitSettings

if TYPE_CHECKING:
    from torch_surfcap.fitting.levels import Level

GROUP_BYTES = 256 << 20  # for partial gradients; their number follows from the size of the problem alone
GROUPS = (4, 32)  # fewest, most
TRACE_BYTES = 1 << 30  # at most, on a GPU: samples of the rays in flight, csrc/cuda/walk.cuh
CODE_GROUPS = 2  # the same beside codes, whose reason is to save memory
BYTES_PER_RAY = 200  # rays, observations, ranges and results, and the copies while they are collected
VIEW_BYTES_PER_RAY = 100  # what a ray reads there, where, and the photograph without it
SURFACE = {"transparency": 0.99, "distance": 0.0}  # opacity value on the hull's surface, where a fit starts
AREA_PER_BORDER = 0.6  # voxel faces of area per voxel at the border of a ball, counted
TILES_PER_AREA = 2.5  # stored tiles per tile face of surface, measured
SAMPLES_PER_RAY = 8  # within the integration ranges, a voxel's diagonal apart, measured
OVERHEAD = 2.0  # levels run longer than planned, and there are ranges, voxel terms and the mesh, measured
SAMPLE_SECONDS = {4: 60e-9, 16: 90e-9, 32: 130e-9}  # forward and backward on one core, by pitch, measured
RAY_MARGIN = 1.3  # rays per pixel of the silhouettes


@dataclass(frozen=True)
class Budget:
    """level_bytes: of each level's field, moments, gradients and rays. seconds: of the whole fit on the CPU, within a factor
    of two; None on another device."""

    level_bytes: list[int]
    seconds: float | None


def estimate(
    capture: Capture, plan: list[Level], grid: TileGrid, store: Tensor, settings: FitSettings
) -> Budget:
    """The budget of a fit whose first level has this grid: surfaces grow by 4 per level, and so do pictures."""
    assert capture.masks is not None
    pixels = sum(float(mask.sum()) for mask in capture.masks)
    pitch, device = store.shape[-1], store.device
    area = _surface_tiles(grid, store[..., 0] < SURFACE[settings.opacity])
    level_bytes, samples = [], 0.0
    for number, level in enumerate(plan):
        tiles = len(store) if number == 0 else TILES_PER_AREA * area * 4**number
        numbers = int(tiles * ops.TILE**3 * pitch)
        rays = RAY_MARGIN * pixels / 4**level.halvings
        needed = bytes_per_number(numbers, settings, device) * numbers + BYTES_PER_RAY * rays
        if settings.degree != settings.voxel_degree:  # coarse tiles are as many as they are larger
            coarse = int(tiles / settings.view_spacing**2 * ops.TILE**3 * ops.pitch(settings.degree))
            needed += 4 * (3 + gradient_groups(coarse, device)) * coarse + VIEW_BYTES_PER_RAY * rays
        level_bytes.append(int(needed) + (0 if device == CPU else TRACE_BYTES))
        step = settings.descent.step_of(level.last)
        samples += rays * level.iterations * SAMPLES_PER_RAY * DIAGONAL / step
    seconds = OVERHEAD * samples * SAMPLE_SECONDS[pitch] / torch.get_num_threads()
    return Budget(level_bytes, seconds if device == CPU else None)


def gradient_groups(numbers: int, device: torch.device = CPU, coded: bool = False) -> int:
    """How many partial gradients a field of so many numbers, or codes, gets: as many as fit a fixed memory, whatever the
    threads; one on a GPU, whose threads add atomically."""
    if device != CPU:
        return 1
    return CODE_GROUPS if coded else max(GROUPS[0], min(GROUPS[1], GROUP_BYTES // (4 * max(numbers, 1))))


def partial_gradients(store: Tensor, accumulator: int) -> Tensor:
    """Memory for the partial gradients [groups, T, 4, 4, 4, P] of a field of floats or codes, in so many bits."""
    groups = gradient_groups(store.numel(), store.device, not store.is_floating_point())
    dtype = torch.float16 if accumulator == 16 else codes.real(store.dtype)
    return torch.empty(groups, *store.shape, dtype=dtype, device=store.device)


LESS = "sh_degree=0, voxels 1.4 times as large or data.scale=0.5 halve it"


def bytes_per_number(numbers: int, settings: FitSettings, device: torch.device = CPU) -> float:
    """What each of so many numbers of a field takes in training: value, two moments, partial gradients."""
    groups = gradient_groups(numbers, device, settings.storage < 32)
    if settings.gradient == "gather":
        groups = 1  # beside the slots, which are counted by samples
    sums = 64 if settings.storage == 64 else 0
    return (3 * settings.storage + groups * max(settings.accumulator, sums)) / 8


def shortage(needed: int, remedy: str = LESS, device: torch.device = CPU) -> str | None:
    """What is missing on a device for so many bytes, and the remedy; None where they are free."""
    free = devices.free_bytes(device)
    return lack(needed, free, remedy) if needed > free else None


def lack(needed: int, free: int, remedy: str = LESS) -> str:
    """How so many bytes were not enough, where so many were guessed to be needed, and the remedy."""
    there = f"{free / 2**30:.1f} GiB"
    if needed > free:
        return f"needs {needed / 2**30:.1f} GiB and {there} are free: {remedy}"
    return f"needs more than the {there} that are free: {remedy}"


def _surface_tiles(grid: TileGrid, within: Tensor) -> float:
    """Area of the border of the stored voxels [T, 4, 4, 4] that are within, in tile faces."""
    return float(grid.borders(within).sum()) * AREA_PER_BORDER / ops.TILE**2
