"""Scores of pictures (PSNR, SSIM) and of surfaces (exact distances, normals, the concave part)."""

from __future__ import annotations

import math

import kornia
import numpy as np
import trimesh
from numpy.typing import NDArray
from skimage.metrics import structural_similarity
from torch import Tensor

from torch_surfcap.distance import Array, SurfaceDistance, face_normals, row_dot


def psnr(image: Tensor, truth: Tensor, mask: Tensor | None = None) -> float:
    """Peak signal-to-noise ratio in dB of values clipped to [0, 1].

    Args:
        image, truth: [H, W, 3].
        mask: [H, W]; if given, only pixels with mask > 0.5 count.

    Returns:
        dB; inf for equal pictures, NaN where the mask is empty.
    """
    image, truth = (x.detach().cpu().float().clamp(0, 1) for x in (image, truth))
    if mask is not None:
        inside = mask.cpu() > 0.5
        image, truth = image[inside], truth[inside]
    if image.numel() == 0:
        return math.nan
    return float(kornia.metrics.psnr(image, truth, 1.0))


def ssim(image: Tensor, truth: Tensor) -> float:
    """Structural similarity of two pictures [H, W, 3] clipped to [0, 1], with the 11x11 Gaussian window
    (sigma 1.5) of Wang et al. 2004 that radiance field papers use."""
    a, b = (x.detach().cpu().float().clamp(0, 1).numpy() for x in (image, truth))
    return float(
        structural_similarity(
            a,
            b,
            channel_axis=2,
            data_range=1.0,
            gaussian_weights=True,
            sigma=1.5,
            use_sample_covariance=False,
        )
    )


def surface_scores(
    mesh: trimesh.Trimesh,
    truth: trimesh.Trimesh | None = None,
    visible_points: Array | None = None,
    concave_points: Array | None = None,
    cut: float = 0.05,
    normals_within: float = 0.01,
    samples: int = 200_000,
    seed: int = 0,
) -> dict[str, float]:
    """Distances between a mesh and the true surface, exact from point to triangle, on uniform area samples.

    Args:
        mesh: the surface to score.
        truth: true surface. Layers hidden under others may be part of it; they count as surface.
        visible_points: [P, 3] points of the true surface that the cameras see; None: area samples of it.
        concave_points: [Q, 3] those of them that no silhouette shows.
        cut: longest distance that counts, world units (5 cm in metres). A farther sample counts as `cut`; in
            the scores named `_ignored` it does not count at all.
        normals_within: a sample's normal is compared where the truth is nearer than this, world units.
        samples: most samples taken of a surface, and most of the given points used.
        seed: of the samples; the same seed gives the same scores.

    Returns:
        In world units, those that the arguments allow: accuracy, accuracy_ignored (mesh to truth),
        accuracy_beyond (share of the samples beyond the cut), completeness, completeness_ignored,
        completeness_beyond (truth to mesh), chamfer, chamfer_ignored (means of the two), normal_error_deg
        (mean angle, 0 to 90, between the lines along the mesh's face normals and along those of the nearest
        true triangles), normals_turned (share of these that point to the other side: near 1 for a mesh inside
        out), concave (mean distance of the concave points to the mesh, cut), concave_beyond, pieces (connected
        components of the mesh).
    """
    scores: dict[str, float] = {}
    to_mesh = SurfaceDistance(mesh)
    if truth is not None:
        points, faces = _area_samples(mesh, samples, seed)
        near = SurfaceDistance(truth)(points, cut)
        _means(scores, "accuracy", near.distance, cut)
        close = near.distance < normals_within
        ours = face_normals(to_mesh.triangles[faces[close]])
        theirs = face_normals(np.asarray(truth.triangles, dtype=np.float64)[near.face[close]])
        cosine = row_dot(ours, theirs)
        # Of the lines, not of the arrows: scans and dressed figures hold sheets turned inside out.
        angle = np.degrees(np.arccos(np.clip(np.abs(cosine), 0.0, 1.0)))
        scores["normal_error_deg"] = float(angle.mean()) if len(angle) else math.nan
        scores["normals_turned"] = float((cosine < 0).mean()) if len(angle) else math.nan
        if visible_points is None:
            visible_points, _ = _area_samples(truth, samples, seed + 1)
    if visible_points is not None:
        _means(scores, "completeness", to_mesh(_subset(visible_points, samples, seed), cut).distance, cut)
    if truth is not None:
        for kind in ("", "_ignored"):
            scores["chamfer" + kind] = 0.5 * (scores["accuracy" + kind] + scores["completeness" + kind])
    if concave_points is not None:
        _means(scores, "concave", to_mesh(_subset(concave_points, samples, seed), cut).distance, cut)
        del scores["concave_ignored"]
    labels = trimesh.graph.connected_component_labels(mesh.edges, len(mesh.vertices))
    scores["pieces"] = len(np.unique(labels[mesh.faces]))
    return scores


def _means(scores: dict[str, float], name: str, distance: Array, cut: float) -> None:
    within = distance <= cut
    scores[name] = float(np.where(within, distance, cut).mean())
    scores[name + "_ignored"] = float(distance[within].mean()) if within.any() else math.nan
    scores[name + "_beyond"] = float(1.0 - within.mean())


def _area_samples(mesh: trimesh.Trimesh, count: int, seed: int) -> tuple[Array, NDArray[np.int64]]:
    # trimesh ignores numpy's global seed.
    points, faces = trimesh.sample.sample_surface(mesh, count, seed=seed)[:2]
    return np.asarray(points, dtype=np.float64), np.asarray(faces, dtype=np.int64)


def _subset(points: Array, count: int, seed: int) -> Array:
    points = np.asarray(points, dtype=np.float64)
    if len(points) <= count:
        return points
    return points[np.random.default_rng(seed).choice(len(points), count, replace=False)]
