"""torch_surfcap.metrics against brute force and hand-worked figures."""

import math

import numpy as np
import pytest
import torch
import trimesh

from torch_surfcap.distance import SurfaceDistance, closest_on_triangles
from torch_surfcap.metrics import psnr, ssim, surface_scores


def test_psnr_by_hand() -> None:
    # A difference of 0.1 everywhere: 20 log10(1 / 0.1) = 20 dB.
    truth = torch.full((4, 5, 3), 0.5)
    assert psnr(truth + 0.1, truth) == pytest.approx(20.0, abs=1e-4)
    # Clipped to [0, 1]: 1.7 counts as 1, so the difference is 0.5 and 20 log10(2) = 6.0206 dB.
    assert psnr(truth + 1.2, truth) == pytest.approx(6.0206, abs=1e-3)
    assert psnr(truth, truth) == math.inf


def test_psnr_mask_counts_its_pixels_only() -> None:
    truth, mask = torch.full((2, 2, 3), 0.5), torch.tensor([[1.0, 0.6], [0.4, 0.0]])
    image = truth.clone()
    image[0] += 0.1
    image[1] += 0.4
    assert psnr(image, truth, mask) == pytest.approx(20.0, abs=1e-4)
    assert math.isnan(psnr(image, truth, torch.zeros(2, 2)))


def test_ssim_orders_pictures() -> None:
    generator = torch.Generator().manual_seed(0)
    truth = torch.rand(32, 40, 3, generator=generator)
    noise = torch.randn(32, 40, 3, generator=generator)
    assert ssim(truth, truth) == pytest.approx(1.0)
    assert 1.0 > ssim(truth + 0.05 * noise, truth) > ssim(truth + 0.3 * noise, truth)


def test_closest_on_triangle_by_hand() -> None:
    # The triangle (0,0,0) (1,0,0) (0,1,0): over its face, past an edge, past the slanted edge, past a corner.
    triangle = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    points = np.array([[0.25, 0.25, 2], [0.5, -1, 1], [1, 1, 0], [3, -1, 0]])
    expected = np.array([[0.25, 0.25, 0], [0.5, 0, 0], [0.5, 0.5, 0], [1, 0, 0]])
    found = closest_on_triangles(points, np.tile(triangle, (4, 1, 1)))
    np.testing.assert_allclose(found, expected, atol=1e-15)


def test_closest_on_triangle_without_area() -> None:
    needle = np.array([[[0.0, 0, 0], [1, 0, 0], [2, 0, 0]]])
    point = np.array([[[0.0, 0, 0]] * 3])
    at = np.array([[1.5, 1.0, 0]])
    np.testing.assert_allclose(closest_on_triangles(at, needle), [[1.5, 0, 0]])
    np.testing.assert_allclose(closest_on_triangles(at, point), [[0, 0, 0]])


def _soup(rng: np.random.Generator) -> trimesh.Trimesh:
    """Triangles of sizes from 1e-3 to 1, a needle and a point among them."""
    size = 10.0 ** rng.uniform(-3, 0, (400, 1, 1))
    corners = rng.normal(size=(400, 1, 3)) + size * rng.normal(size=(400, 3, 3))
    corners[0, 2], corners[1] = corners[0, 1], corners[1, 0]
    return trimesh.Trimesh(corners.reshape(-1, 3), np.arange(1200).reshape(-1, 3), process=False)


@pytest.mark.parametrize("spread", [0.01, 1.0, 30.0])
def test_distance_equals_brute_force(spread: float) -> None:
    rng = np.random.default_rng(3)
    mesh = _soup(rng)
    points = spread * rng.normal(size=(300, 3))
    found = SurfaceDistance(mesh)(points)
    triangles = np.asarray(mesh.triangles)
    for p, point in enumerate(points):
        nearest = closest_on_triangles(np.tile(point, (len(triangles), 1)), triangles)
        gap = np.linalg.norm(nearest - point, axis=1)
        assert found.distance[p] == pytest.approx(gap.min(), abs=1e-12)
        assert gap[found.face[p]] == pytest.approx(gap.min(), abs=1e-12)
        assert np.linalg.norm(found.point[p] - point) == pytest.approx(gap.min(), abs=1e-12)


def test_distance_limit_and_large_triangles() -> None:
    box = trimesh.creation.box((2, 2, 2))
    points = np.array([[0.0, 0, 0], [0, 0, 3], [0.9, 0.1, 0.3], [1.5, 0, 0]])
    found = SurfaceDistance(box)(points, limit=0.6)
    np.testing.assert_allclose(found.distance, [np.inf, np.inf, 0.1, 0.5], atol=1e-12)
    assert (found.face[:2] == -1).all()
    assert np.isnan(found.point[:2]).all()
    assert len(SurfaceDistance(box)(np.zeros((0, 3))).distance) == 0


def test_distance_refuses_an_empty_mesh() -> None:
    with pytest.raises(ValueError, match="0 triangles"):
        SurfaceDistance(trimesh.Trimesh())


def test_scores_of_a_larger_sphere() -> None:
    truth, mesh = trimesh.creation.icosphere(5, 0.500), trimesh.creation.icosphere(5, 0.504)
    scores = surface_scores(mesh, truth, samples=20_000)
    assert scores["accuracy"] == pytest.approx(0.004, abs=1e-4)
    assert scores["completeness"] == pytest.approx(0.004, abs=1e-4)
    assert scores["chamfer"] == pytest.approx((scores["accuracy"] + scores["completeness"]) / 2)
    assert scores["normal_error_deg"] < 1.0
    assert scores["normals_turned"] == 0.0
    assert scores["pieces"] == 1
    assert scores == surface_scores(mesh, truth, samples=20_000)


def test_scores_cut_and_ignored() -> None:
    # A second sphere of the same size a metre away: half of the samples are beyond the cut.
    truth = trimesh.creation.icosphere(4, 0.1)
    corners = np.concatenate([truth.vertices, truth.vertices + np.array([1.0, 0.0, 0.0])])
    mesh = trimesh.Trimesh(corners, np.concatenate([truth.faces, truth.faces + len(truth.vertices)]))
    scores = surface_scores(mesh, truth, samples=20_000)
    assert scores["pieces"] == 2
    assert scores["accuracy_beyond"] == pytest.approx(0.5, abs=0.02)
    assert scores["accuracy"] == pytest.approx(0.05 * scores["accuracy_beyond"], abs=1e-6)
    assert scores["accuracy_ignored"] == pytest.approx(0.0, abs=1e-6)
    assert scores["completeness"] == pytest.approx(0.0, abs=1e-6)


def test_scores_turned_and_tilted_normals() -> None:
    def plane(angle: float) -> trimesh.Trimesh:
        corners = np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * 0.01
        mesh = trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]], process=False)
        return mesh.apply_transform(trimesh.transformations.rotation_matrix(math.radians(angle), [1, 0, 0]))

    scores = surface_scores(plane(20), plane(0), samples=1000)
    assert scores["normal_error_deg"] == pytest.approx(20.0, abs=1e-6)
    assert scores["normals_turned"] == 0.0
    scores = surface_scores(plane(160), plane(0), samples=1000)
    assert scores["normal_error_deg"] == pytest.approx(20.0, abs=1e-6)
    assert scores["normals_turned"] == 1.0


def test_scores_of_points_alone() -> None:
    mesh = trimesh.creation.box((0.2, 0.2, 0.2))
    points = np.array([[0.0, 0, 0.11], [0, 0, 0.13]])
    scores = surface_scores(mesh, visible_points=points, concave_points=points[:1])
    assert scores["completeness"] == pytest.approx(0.02)
    assert scores["concave"] == pytest.approx(0.01)
    assert "accuracy" not in scores
    assert "chamfer" not in scores
