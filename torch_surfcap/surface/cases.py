"""The triangles of marching cubes for each of a cell's 256 sets of corners in matter, derived face by face."""

from __future__ import annotations

import math
from functools import cache

import torch
from torch import Tensor

Triangles = tuple[tuple[int, int, int], ...]

# Corner x + 2 y + 4 z of a cell stands at (x, y, z). An edge is its lower corner and its axis.
EDGES = [(low, axis) for axis in range(3) for low in range(8) if not low >> axis & 1]
MIDDLE = [[0.5 * (i == axis) + (low >> i & 1) for i in range(3)] for low, axis in EDGES]


def _faces() -> list[list[int]]:
    """Corners of the cell's 6 faces, counter-clockwise seen from outside."""
    rings = []
    for axis in range(3):
        up, u, v = (1 << (axis + i) % 3 for i in range(3))
        rings += [[0, v, u | v, u], [up, up | u, up | u | v, up | v]]
    return rings


FACES = _faces()
# Edges of the faces, the k-th from corner k to the next.
SIDES = [
    [EDGES.index((p & q, (p ^ q).bit_length() - 1)) for p, q in zip(f, f[1:] + f[:1], strict=True)]
    for f in FACES
]


@cache
def case_table() -> Tensor:
    """[256, 5, 3] int64, triangles as numbers of edges, outwards; -1 where a case has fewer. Bit k is corner k's."""
    table = torch.full((256, 5, 3), -1)
    for case in range(1, 255):
        triangles = [t for ring in loops(case) for t in triangulated(ring)]
        table[case, : len(triangles)] = torch.tensor(triangles)
    return table


def loops(case: int) -> list[list[int]]:
    """The closed lines, as edges, that the surface draws on a cell's faces, with matter to the left seen from outside.

    Around a face, matter begins at some edges and ends at others. A line leads from each edge where it begins to the
    nearest one behind where it ended: two corners of matter that are opposite on a face hang together. The face's four
    signs alone decide, so both cells at a face draw the same lines, in opposite directions; and on every crossed edge
    one line of a cell begins and one ends.
    """
    follower: dict[int, int] = {}
    for corners, sides in zip(FACES, SIDES, strict=True):
        matter = [case >> corner & 1 for corner in corners]
        turn = [matter[(k + 1) % 4] - matter[k] for k in range(4)]
        for k in range(4):
            if turn[k] > 0:
                follower[sides[k]] = next(sides[k - back] for back in (1, 2, 3) if turn[k - back] < 0)
    rings = []
    while follower:
        ring = [next(iter(follower))]
        while (ahead := follower.pop(ring[-1])) != ring[0]:
            ring.append(ahead)
        rings.append(ring)
    return rings


def triangulated(ring: list[int]) -> Triangles:
    """The triangulation of a loop of edges of least area, with vertices amid the edges, that keeps a manifold.

    No diagonal joins two edges of one face of the cell, for the neighbour could have the same diagonal, which would be
    an edge of four triangles. Every loop that `loops` finds has such a triangulation: none needs a vertex amid the cell.
    """
    last = len(ring) - 1

    def allowed(i: int, j: int) -> bool:
        return j - i in (1, last) or not any(ring[i] in side and ring[j] in side for side in SIDES)

    def area(i: int, k: int, j: int) -> float:
        p, q = ([b - a for a, b in zip(MIDDLE[ring[i]], MIDDLE[ring[m]], strict=True)] for m in (k, j))
        return math.hypot(*(p[m - 2] * q[m - 1] - p[m - 1] * q[m - 2] for m in range(3)))

    @cache
    def best(i: int, j: int) -> tuple[float, Triangles]:
        """Area and triangles of the part from vertex i to vertex j."""
        if j - i == 1:
            return 0.0, ()
        found: tuple[float, Triangles] = (math.inf, ())
        for k in range(i + 1, j):
            if allowed(i, k) and allowed(k, j):
                (a, left), (b, right) = best(i, k), best(k, j)
                cut = (a + b + area(i, k, j), (*left, (ring[i], ring[k], ring[j]), *right))
                found = min(found, cut)
        return found

    return best(0, last)[1]
