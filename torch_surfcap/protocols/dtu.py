"""The surface protocol of the DTU data set: a mesh against the points of a structured-light scanner.

The rules are those of Jensen et al., "Large Scale Multi-view Stereopsis Evaluation", CVPR 2014, as papers on surfaces from
pictures apply them to meshes (DTUeval-python, on average within 0.02 % of the official program). Lengths are in mm.

1. The mesh becomes points, its vertices and a lattice with cells of spacing² on every triangle that is large enough.
   Those beyond a margin around the scan's box go; the rest is thinned in a random order until no two are closer than
   the spacing.
2. Accuracy is the mean distance of those inside the observation mask, the space the scanner saw, to the scan.
3. Completeness is the mean distance of the scanned points above the ground plane to the mesh's points, whether these
   are inside the mask or not.
4. A distance of `farthest` or more counts in neither mean. Overall is the mean of the two.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
import trimesh
from numpy.typing import NDArray
from scipy.io import loadmat
from scipy.spatial import cKDTree

from torch_surfcap.data.capture import Capture
from torch_surfcap.data.geometry import Points, read_points
from torch_surfcap.data.parse import matrix
from torch_surfcap.errors import InputError

Flags = NDArray[np.bool_]

BLOCK = 1 << 20  # points sampled or thinned at first at a time: bounds the temporaries


@dataclass(frozen=True)
class Cuts:
    """The lengths of the rules, mm."""

    spacing: float = 0.2  # between points of the mesh
    margin: float = 60.0  # around the scan's box, twice that at its upper end: mesh points beyond are dropped
    farthest: float = 20.0  # distances from here on do not count


@dataclass(frozen=True)
class Scan:
    """What is known of one DTU object.

    points:     [P, 3] scanned surface
    observed:   [X, Y, Z] the observation mask; entry (0, 0, 0) is centred at the box's lower corner
    box:        [2, 3] lower and upper corner of the mask
    resolution: distance between entries of the mask
    plane:      [4] the ground; above it is plane · (x, y, z, 1) > 0
    """

    number: int
    points: Points
    observed: Flags
    box: Points
    resolution: float
    plane: Points

    def observes(self, points: Points) -> Flags:
        """[P] whether points [P, 3] lie where the scanner saw."""
        index = np.rint((points - self.box[0]) / self.resolution).astype(np.int64)
        inside = ((index >= 0) & (index < self.observed.shape)).all(axis=1)
        inside[inside] = self.observed[tuple(index[inside].T)]
        return inside

    def above_ground(self) -> Points:
        """The scanned points that count."""
        return self.points[self.points @ self.plane[:3] + self.plane[3] > 0]


def read_scan(folder: Path, number: int) -> Scan:
    """The truth of an object from DTU's folder: Points/stl/stl065_total.ply, ObsMask/ObsMask65_10.mat (ObsMask, BB, Res)
    and ObsMask/Plane65.mat (P) for number 65.

    Raises InputError naming the file that is missing or does not hold what it should.
    """
    mask_file = folder / "ObsMask" / f"ObsMask{number}_10.mat"
    content = _read_mat(mask_file, "ObsMask", "BB", "Res")
    observed = np.asarray(content["ObsMask"])
    if observed.ndim != 3 or observed.dtype.kind not in "biuf":
        raise InputError(f"{mask_file}: ObsMask is {_size(observed)}, expected a mask of three dimensions")
    box = matrix(content["BB"], (2, 3), "BB", str(mask_file))
    resolution = float(matrix(np.squeeze(content["Res"]), (), "Res", str(mask_file)))
    if not (resolution > 0 and math.isfinite(resolution) and np.isfinite(box).all()):
        raise InputError(
            f"{mask_file}: BB {box.tolist()} and Res {resolution:g}, expected a box and a length"
        )
    plane_file = folder / "ObsMask" / f"Plane{number}.mat"
    plane = matrix(np.squeeze(_read_mat(plane_file, "P")["P"]), (4,), "P", str(plane_file))
    points = read_points(folder / "Points" / "stl" / f"stl{number:03d}_total.ply")
    scan = Scan(number, points, observed.astype(bool), box, resolution, plane)
    if len(scan.above_ground()) == 0:
        raise InputError(
            f"{plane_file}: no scanned point lies above the plane P {plane.tolist()}, expected some"
        )
    return scan


def _read_mat(path: Path, *names: str) -> dict[str, Any]:
    """Variables of a .mat file. The format holds data only: nothing in it is run or unpickled."""
    try:
        with path.open("rb") as file:
            content = loadmat(file, variable_names=names)
    except Exception as error:  # scipy's reader raises whatever its parsing trips over
        expected = f"a .mat file of version 7.2 or older with {', '.join(names)}"
        raise InputError(f"{path}: {error}, expected {expected}") from error
    missing = [name for name in names if name not in content]
    if missing:
        raise InputError(f"{path}: no {' and no '.join(missing)}, expected {', '.join(names)}")
    return content


def _size(values: NDArray[Any]) -> str:
    return " x ".join(map(str, values.shape)) + f" of type {values.dtype}"


def scan_scores(
    mesh: trimesh.Trimesh, scan: Scan, cuts: Cuts | None = None, seed: int = 0
) -> dict[str, float]:
    """Score a mesh in DTU's world, mm, by the rules above.

    Args:
        mesh: the surface to score.
        scan: its truth.
        cuts: the protocol's own by default.
        seed: of the order in which points are thinned; it moves the scores by about 0.01 %.

    Returns:
        accuracy, completeness, overall, mm, NaN where no distance counts; accuracy_beyond, completeness_beyond (share
        of the points that are too far to count); mesh_points, scan_points (their numbers).

    Raises:
        InputError: no part of the mesh lies where the scanner saw.
    """
    cuts = Cuts() if cuts is None else cuts
    box = scan.box + np.array([[-1.0], [2.0]]) * cuts.margin
    points = thinned(mesh_points(mesh, cuts.spacing, box), cuts.spacing, seed)
    seen, counted = points[scan.observes(points)], scan.above_ground()
    if len(seen) == 0:
        low, high = (np.round(corner, 1).tolist() for corner in mesh.bounds)
        raise InputError(
            f"mesh: from {low} to {high} nothing lies in the observation mask of scan {scan.number}, "
            "expected a mesh in the millimetres of DTU's cameras"
        )
    scores: dict[str, float] = {}
    for name, of, to in (("accuracy", seen, scan.points), ("completeness", counted, points)):
        distance = cKDTree(to).query(of, workers=-1)[0]
        near = distance[distance < cuts.farthest]
        scores[name] = float(near.mean()) if len(near) else math.nan
        scores[f"{name}_beyond"] = 1 - len(near) / len(distance)
    scores["overall"] = 0.5 * (scores["accuracy"] + scores["completeness"])
    return {**scores, "mesh_points": len(seen), "scan_points": len(counted)}


def mesh_points(mesh: trimesh.Trimesh, spacing: float, box: Points) -> Points:
    """Points [P, 3] of a mesh inside a box [2, 3]: its vertices, and a lattice with cells of spacing² on its triangles."""
    triangles = np.asarray(mesh.triangles, dtype=np.float64)

    def pieces() -> Iterator[Points]:
        yield np.asarray(mesh.vertices, dtype=np.float64)
        for part in np.array_split(triangles, 1 + int(mesh.area / spacing**2) // BLOCK):
            yield _lattice(part, spacing)

    return np.concatenate([p[((p >= box[0]) & (p < box[1])).all(axis=1)] for p in pieces()])


def _lattice(triangles: Points, spacing: float) -> Points:
    """Points [P, 3] of triangles [F, 3, 3]: the centres of the m×n cells of the parallelogram on two edges e and f that
    fall inside, m = ⌊|e|/s⌋, n = ⌊|f|/s⌋, s = spacing √(|e||f| / |e×f|), so that a cell has the area spacing²."""
    corner, e, f = triangles[:, 0], triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    length_e, length_f = np.linalg.norm(e, axis=1), np.linalg.norm(f, axis=1)
    area = np.linalg.norm(np.cross(e, f), axis=1)
    aspect = np.sqrt(length_e * length_f / np.where(area > 0, area, np.inf))
    step = spacing * np.where(area > 0, aspect, np.inf)
    m, n = (np.floor(length / step).astype(np.int64) for length in (length_e, length_f))
    of = np.repeat(np.arange(len(triangles)), m * n)
    cell = np.arange(len(of)) - np.repeat(np.cumsum(m * n) - m * n, m * n)
    u, v = (cell % m[of] + 0.5) / m[of], (cell // m[of] + 0.5) / n[of]
    inside = u + v < 1
    of, u, v = of[inside], u[inside, None], v[inside, None]
    return np.asarray(corner[of] + u * e[of] + v * f[of])


def thinned(points: Points, spacing: float, seed: int = 0) -> Points:
    """Points [P, 3] visited in a random order, without those within the spacing of one that stayed before them.

    Taken in blocks that double: most points of a block are near one that stays from the blocks before, which a search
    for the nearest tells; the pairs among the rest are few enough to be listed.
    """
    shuffled = points[np.random.default_rng(seed).permutation(len(points))]
    kept = _first_come(shuffled[:BLOCK], spacing)
    start = BLOCK
    while start < len(shuffled):
        block = shuffled[start : 2 * start]
        block = block[cKDTree(kept).query(block, workers=-1)[0] > spacing]
        kept = np.concatenate([kept, _first_come(block, spacing)])
        start *= 2
    return kept


def _first_come(points: Points, spacing: float) -> Points:
    """The same for points in the order in which they are visited, by rounds over all pairs instead of one by one."""
    pairs = cKDTree(points).query_pairs(spacing, output_type="ndarray")  # the earlier point first
    stays = np.ones(len(points), dtype=bool)
    while len(pairs):
        safe = np.ones(len(points), dtype=bool)
        safe[pairs[:, 1]] = False  # a point with an earlier one nearby waits for that one's fate
        stays[pairs[safe[pairs[:, 0]], 1]] = False
        pairs = pairs[stays[pairs].all(axis=1)]
    return points[stays]


def culled(mesh: trimesh.Trimesh, captures: Iterable[Capture], dilation: float) -> trimesh.Trimesh:
    """The mesh without the faces that have a vertex outside a mask dilated by a disc.

    Args:
        captures: views with masks; one that does not see a vertex has no vote on it.
        dilation: radius of the disc, pixels.

    Raises:
        InputError: nothing is left.
    """
    vertices = torch.as_tensor(np.asarray(mesh.vertices), dtype=torch.float64)
    inside = np.ones(len(vertices), dtype=bool)
    for capture in captures:
        for i, mask in enumerate(capture.masks or ()):
            uv, depth = capture.cameras.project(i, vertices)
            seen = (depth > 0) & (uv >= 0).all(dim=1) & (uv < capture.cameras.size[i]).all(dim=1)
            u, v = uv[seen].long().numpy().T
            outside = (mask <= 0.5).byte().numpy()
            away = cv2.distanceTransform(outside, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
            inside[seen.numpy()] &= away[v, u] <= dilation
    faces = inside[mesh.faces].all(axis=1)
    if not faces.any():
        raise InputError(f"mesh: no face lies within all masks dilated by {dilation:g} pixels, expected some")
    kept = mesh.copy()
    kept.update_faces(faces)
    kept.remove_unreferenced_vertices()
    return kept
