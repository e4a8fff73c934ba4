"""Exact distances from points to triangle meshes, and the triangles' normals."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial import cKDTree

Array = NDArray[np.float64]

PAIRS = 1 << 16  # point-triangle pairs tested at a time: the temporaries stay in the cache


def closest_on_triangles(points: Array, triangles: Array) -> Array:
    """Point of each triangle nearest to the point of the same row.

    The foot of the perpendicular where it falls inside, else the nearest of the three edges' nearest points:
    no case distinction to get wrong, and a triangle without area still has its edges.

    Args:
        points: [P, 3].
        triangles: [P, 3, 3] corner coordinates.

    Returns:
        [P, 3].
    """
    a = triangles[:, 0]
    ab, ac, ap = triangles[:, 1] - a, triangles[:, 2] - a, points - a
    d00, d01, d11 = row_dot(ab, ab), row_dot(ab, ac), row_dot(ac, ac)
    d20, d21 = row_dot(ap, ab), row_dot(ap, ac)
    area = d00 * d11 - d01 * d01
    safe = np.where(area > 0, area, 1.0)
    v, w = (d11 * d20 - d01 * d21) / safe, (d00 * d21 - d01 * d20) / safe
    inside = (area > 0) & (v >= 0) & (w >= 0) & (v + w <= 1)
    best = a + v[:, None] * ab + w[:, None] * ac
    rows = np.flatnonzero(~inside)
    if len(rows) == 0:
        return best
    nearest = np.full(len(rows), np.inf)
    for i in range(3):
        start, edge = triangles[rows, i], triangles[rows, (i + 1) % 3] - triangles[rows, i]
        length = row_dot(edge, edge)
        t = np.clip(row_dot(points[rows] - start, edge) / np.where(length > 0, length, 1.0), 0.0, 1.0)
        foot = start + t[:, None] * edge
        gap = row_dot(points[rows] - foot, points[rows] - foot)
        closer = gap < nearest
        nearest[closer] = gap[closer]
        best[rows[closer]] = foot[closer]
    return best


def row_dot(a: Array, b: Array) -> Array:
    """Dot product [P] of the rows of two arrays [P, 3]."""
    return np.asarray(np.einsum("ij,ij->i", a, b))


def face_normals(triangles: Array) -> Array:
    """Unit normals [F, 3] of triangles [F, 3, 3]; zero for a triangle without area."""
    cross = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    length = np.linalg.norm(cross, axis=1, keepdims=True)
    return np.asarray(cross / np.where(length > 0, length, 1.0))


@dataclass
class Closest:
    """Nearest points of a surface: distance [P], face [P] int, point [P, 3]. Beyond the limit of the search:
    distance inf, face -1, point NaN."""

    distance: Array
    face: NDArray[np.int64]
    point: Array


class SurfaceDistance:
    """Exact distances from points to a triangle mesh.

    Large triangles are cut into pieces, the pieces sorted by size into a few k-d trees of their centroids.
    A centroid lies on its triangle, so the nearest one bounds the distance from above; a piece of radius r
    whose centroid is farther than the bound plus r cannot be nearer. What remains is tested exactly.

    Args:
        mesh: anything with .triangles [F, 3, 3].

    Raises:
        ValueError: a mesh without triangles or with non-finite corners.
    """

    def __init__(self, mesh: trimesh.Trimesh) -> None:
        triangles = np.asarray(mesh.triangles, dtype=np.float64)
        if len(triangles) == 0 or not np.isfinite(triangles).all():
            raise ValueError(f"a mesh with finite triangles is needed, got {len(triangles)} triangles")
        self.triangles = triangles
        pieces, self._parent = _split(triangles)
        center = pieces.mean(axis=1)
        radius = np.linalg.norm(pieces - center[:, None], axis=2).max(axis=1)
        self._all = _tree(center)
        # Classes an octave apart, all of the small ones in one: the search radius of a class is its largest.
        octave = np.ceil(np.log2(np.maximum(radius / radius.max(), 1 / 16))).astype(int)
        self._classes = []
        for o in np.unique(octave):
            rows = np.flatnonzero(octave == o)
            self._classes.append((_tree(center[rows]), rows, float(radius[rows].max())))
        self._radius = radius
        self._leaf = np.argsort(self._all.indices)

    def __call__(self, points: Array, limit: float = math.inf) -> Closest:
        """Nearest surface points of points [P, 3]; those surely farther than limit are not searched for."""
        points = np.asarray(points, dtype=np.float64)
        bound, piece = self._all.query(points, workers=-1)
        best = bound**2
        face = self._parent[piece]
        foot = np.asarray(self._all.data)[piece].copy()
        # Neighbours one after the other, in the order of the tree's leaves: a third of a random order's time.
        near = np.flatnonzero(bound - self._radius.max() <= limit)
        near = near[np.argsort(self._leaf[piece[near]])]
        for tree, rows, reach in self._classes:
            self._search(points, near, tree, rows, reach, best, face, foot)
        distance = np.sqrt(best)
        far = distance > limit
        distance[far], face[far], foot[far] = np.inf, -1, np.nan
        return Closest(distance, face, foot)

    def _search(
        self,
        points: Array,
        active: NDArray[np.int64],
        tree: cKDTree,
        rows: NDArray[np.int64],
        reach: float,
        best: Array,
        face: NDArray[np.int64],
        foot: Array,
    ) -> None:
        """Improve best, face, foot at the active points by one class, doubling the candidates asked for until
        the farthest of them proves that none is missing."""
        done, k = 0, 4
        while len(active):
            k = min(k, len(rows))
            again = []
            for part in np.array_split(active, max(1, len(active) * k // (4 * PAIRS))):
                gap, near = tree.query(points[part], k=range(done + 1, k + 1), workers=-1)
                p, c = np.nonzero(gap - self._radius[rows[near]] < np.sqrt(best[part])[:, None])
                at, piece = part[p], rows[near[p, c]]
                for s in range(0, len(p), PAIRS):
                    self._test(points, at[s : s + PAIRS], piece[s : s + PAIRS], best, face, foot)
                again.append(part[gap[:, -1] - reach < np.sqrt(best[part])])
            active = np.concatenate(again) if k < len(rows) else active[:0]
            done, k = k, 4 * k

    def _test(
        self,
        points: Array,
        at: NDArray[np.int64],
        piece: NDArray[np.int64],
        best: Array,
        face: NDArray[np.int64],
        foot: Array,
    ) -> None:
        """Exact distances of the pairs (at, piece), taken over where they are smaller."""
        parent = self._parent[piece]
        near = closest_on_triangles(points[at], self.triangles[parent])
        gap = row_dot(points[at] - near, points[at] - near)
        closer = np.flatnonzero(gap < best[at])
        # Several candidates of one point: written from far to near, so that the nearest stays.
        closer = closer[np.argsort(-gap[closer], kind="stable")]
        best[at[closer]], face[at[closer]], foot[at[closer]] = gap[closer], parent[closer], near[closer]


def _tree(points: Array) -> cKDTree:
    """Built fast and asked far from its points: measured faster than the default, the balanced tree."""
    return cKDTree(points, leafsize=32, balanced_tree=False)


def _split(triangles: Array) -> tuple[Array, NDArray[np.int64]]:
    """Halve the longest edges of triangles until none is much larger than the average one.

    Returns:
        pieces [M, 3, 3] and the triangle [M] each is a part of.
    """
    parent = np.arange(len(triangles))
    cross = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    area = 0.5 * np.linalg.norm(cross, axis=1).sum()
    longest_allowed = 3.0 * math.sqrt(area / max(len(triangles), 20_000))
    done: list[tuple[Array, NDArray[np.int64]]] = []
    while len(triangles) and len(done) < 16:
        length = np.linalg.norm(np.roll(triangles, -1, axis=1) - triangles, axis=2)
        large = length.max(axis=1) > longest_allowed
        done.append((triangles[~large], parent[~large]))
        order = (length[large].argmax(axis=1)[:, None] + np.arange(3)) % 3
        turned = np.take_along_axis(triangles[large], order[:, :, None], axis=1)
        middle = turned[:, :2].mean(axis=1)
        first = np.stack([turned[:, 0], middle, turned[:, 2]], axis=1)
        second = np.stack([middle, turned[:, 1], turned[:, 2]], axis=1)
        triangles, parent = np.concatenate([first, second]), np.tile(parent[large], 2)
    done.append((triangles, parent))
    return np.concatenate([d[0] for d in done]), np.concatenate([d[1] for d in done])
