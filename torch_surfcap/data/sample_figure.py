"""The subject and the room of the sample scene: an implicit figure, meshed once, and colours by position.

Metres, z up, the figure faces -y and stands on z = 0.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates
from skimage.measure import marching_cubes

Array = NDArray[np.float32]

SPACING = 0.006  # of the marching cubes
BLEND = 0.03  # length over which parts melt into each other
LOW, HIGH = (-0.56, -0.36, -0.03), (0.56, 0.24, 1.86)
ROOM = (3.8, 3.8, 3.4)  # half width, half depth, height

# capsules: two ends and the radius at each
CAPSULES = (
    ((0.11, 0.00, 0.08), (0.10, 0.00, 0.86), 0.062, 0.095),  # legs
    ((-0.13, 0.00, 0.08), (-0.10, 0.00, 0.86), 0.062, 0.095),
    ((0.12, -0.13, 0.047), (0.11, 0.04, 0.055), 0.045, 0.055),  # feet
    ((-0.16, -0.12, 0.047), (-0.13, 0.04, 0.055), 0.045, 0.055),
    ((-0.06, 0.00, 0.93), (-0.07, 0.00, 1.32), 0.120, 0.125),  # trunk
    ((0.06, 0.00, 0.93), (0.07, 0.00, 1.32), 0.120, 0.125),
    ((-0.17, 0.00, 1.39), (0.17, 0.00, 1.39), 0.070, 0.070),  # shoulders
    ((0.00, 0.00, 1.40), (0.00, -0.01, 1.56), 0.060, 0.055),  # neck
    ((0.19, 0.00, 1.39), (0.42, 0.08, 1.17), 0.062, 0.050),  # an arm akimbo
    ((0.42, 0.08, 1.17), (0.17, -0.06, 1.00), 0.050, 0.042),
    ((-0.19, 0.00, 1.39), (-0.38, -0.02, 1.16), 0.062, 0.050),  # an arm raised
    ((-0.38, -0.02, 1.16), (-0.43, -0.22, 1.36), 0.050, 0.040),
    ((-0.43, -0.22, 1.36), (-0.44, -0.26, 1.42), 0.045, 0.050),
    ((0.00, -0.10, 1.63), (0.00, -0.125, 1.615), 0.020, 0.018),  # nose
)
HEAD = ((0.0, -0.01, 1.66), (0.088, 0.102, 0.122))  # centre and half axes
BRIM = ((0.0, 0.0, 1.735), 0.095, 0.026)  # of the hat: centre, radius of the ring and of its tube
HOLLOW = ((0.0, 0.20, 1.20), 0.140)  # taken out of the back: no silhouette shows it


def figure_mesh() -> trimesh.Trimesh:
    """The closed true surface of the figure, about 1.8 m tall, one piece."""
    counts = [round((high - low) / SPACING) + 1 for low, high in zip(LOW, HIGH, strict=True)]
    axes = [low + SPACING * np.arange(n, dtype=np.float32) for low, n in zip(LOW, counts, strict=True)]
    x, y, z = np.meshgrid(*axes, indexing="ij", sparse=True)
    vertices, faces, _, _ = marching_cubes(_distance(x, y, z), 0.0, spacing=(SPACING,) * 3)
    mesh = trimesh.Trimesh(vertices + np.array(LOW), faces, process=True)
    mesh = max(mesh.split(only_watertight=False), key=lambda piece: len(piece.faces))
    if mesh.volume < 0:
        mesh.invert()
    return mesh


def figure_colors(points: NDArray[np.float64], seed: int) -> Array:
    """[P,3] albedo in [0, 1] at points of the figure: skin, a striped shirt, trousers, shoes and a hat, all mottled."""
    x, _, z = points.T.astype(np.float32)
    cloth = np.where(
        (np.sin(130 * z + 4 * np.sin(12 * x)) > 0)[:, None], (0.75, 0.22, 0.18), (0.85, 0.80, 0.68)
    )
    regions = (
        (z < 0.10, (0.16, 0.12, 0.10)),
        (z < 0.93, (0.20, 0.30, 0.55)),
        ((z < 1.47) & (points[:, 1] > -0.14), cloth),
        (z < 1.715, (0.82, 0.60, 0.48)),
    )
    albedo = np.full((len(points), 3), (0.25, 0.45, 0.25))
    for inside, color in reversed(regions):
        albedo = np.where(inside[:, None], color, albedo)
    mottle = _noise(points, seed, scale=0.05, octaves=4)
    return np.clip(albedo * (0.55 + 0.9 * mottle[:, None]), 0.02, 0.98).astype(np.float32)


def plain_colors(points: NDArray[np.float64], seed: int) -> Array:
    """[P,3] one grey, without any texture."""
    return np.full((len(points), 3), 0.55, np.float32)


def repeated_colors(points: NDArray[np.float64], seed: int) -> Array:
    """[P,3] a chequer of 6 cm that looks the same wherever it is seen."""
    chequer = np.sin(np.pi * (points + 0.011) / 0.06).prod(axis=1) > 0
    return np.where(chequer[:, None], (0.75, 0.70, 0.55), (0.25, 0.30, 0.45)).astype(np.float32)


PAINTS = {"cloth": figure_colors, "plain": plain_colors, "repeated": repeated_colors}


def room_colors(origins: NDArray[np.float64], directions: NDArray[np.float64], seed: int) -> Array:
    """[P,3] colours in [0, 1] of the empty room along rays from inside of it."""
    low, high = np.array([-ROOM[0], -ROOM[1], 0.0]), np.array(ROOM)
    with np.errstate(divide="ignore"):
        distance = np.maximum((low - origins) / directions, (high - origins) / directions)
    wall = np.argmin(distance, axis=1)
    points = origins + distance[np.arange(len(wall)), wall][:, None] * directions
    tint = np.array([(0.80, 0.75, 0.62), (0.62, 0.74, 0.80), (0.55, 0.52, 0.50)])[wall]
    # three independent mottles, so that the room's hue varies as well and a shadow cannot be taken for another wall
    mottle = np.stack(
        [_noise(points, seed + 1 + channel, scale=0.25, octaves=4) for channel in range(3)], axis=1
    )
    return np.clip(tint * (0.55 + 0.75 * mottle), 0.02, 0.98).astype(np.float32)


def _distance(x: Array, y: Array, z: Array) -> Array:
    """About the signed distance to the figure, negative inside, on a grid given by its sparse axes."""
    total = _ellipsoid(x, y, z, *HEAD)
    for start, end, r0, r1 in CAPSULES:
        total = _melt(total, _capsule(x, y, z, start, end, r0, r1))
    (cx, cy, cz), ring, tube = BRIM
    brim = np.sqrt((np.sqrt((x - cx) ** 2 + (y - cy) ** 2) - ring) ** 2 + (z - cz) ** 2) - tube
    total = _melt(total, brim.astype(np.float32))
    (hx, hy, hz), radius = HOLLOW
    hollow = np.sqrt((x - hx) ** 2 + (y - hy) ** 2 + (z - hz) ** 2) - radius
    total = -_melt(-total, hollow)
    folds = np.sin(38 * x + 9 * np.sin(7 * z)) * np.sin(31 * z + 5 * y) * np.sin(35 * y)
    return (total + 0.004 * folds).astype(np.float32)


def _capsule(
    x: Array, y: Array, z: Array, start: tuple[float, ...], end: tuple[float, ...], r0: float, r1: float
) -> Array:
    a, axis = np.array(start, np.float32), np.subtract(end, start).astype(np.float32)
    along = (x - a[0]) * axis[0] + (y - a[1]) * axis[1] + (z - a[2]) * axis[2]
    t = np.clip(along / (axis @ axis), 0, 1)
    squares = [(p - a[i] - t * axis[i]) ** 2 for i, p in enumerate((x, y, z))]
    return np.sqrt(squares[0] + squares[1] + squares[2]) - (r0 + (r1 - r0) * t)


def _ellipsoid(x: Array, y: Array, z: Array, center: tuple[float, ...], axes: tuple[float, ...]) -> Array:
    squares = [((p - c) / r) ** 2 for p, c, r in zip((x, y, z), center, axes, strict=True)]
    return (np.sqrt(squares[0] + squares[1] + squares[2]) - 1) * np.float32(min(axes))


def _melt(a: Array, b: Array) -> Array:
    """Smooth minimum: the union of two parts with a rounded seam."""
    h = np.maximum(np.float32(BLEND) - np.abs(a - b), 0) / np.float32(BLEND)
    return np.minimum(a, b) - np.float32(0.25 * BLEND) * h * h


def _noise(points: NDArray[np.float64], seed: int, scale: float, octaves: int) -> Array:
    """[P] smooth random values, mean 1/2, with details from `scale` metres downwards by halves."""
    lattice = _lattice(seed)
    total = np.zeros(len(points), np.float32)
    for octave in range(octaves):
        position = (points.T * (2.0**octave / scale) + 7.3 * octave) % lattice.shape[0]
        total += 0.5**octave * map_coordinates(lattice, position, order=1, mode="grid-wrap", prefilter=False)
    return total / (2.0 - 0.5 ** (octaves - 1))


@lru_cache(maxsize=8)
def _lattice(seed: int) -> Array:
    return np.random.default_rng(seed).random((48, 48, 48), dtype=np.float32)
