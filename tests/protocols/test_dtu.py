"""DTU's surface protocol on shapes whose scores follow by hand."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
from scipy.io import savemat
from scipy.spatial import cKDTree

from tests.protocols.layouts import CENTER, cameras, sphere_points, write_dtu_truth
from torch_surfcap import Capture, InputError
from torch_surfcap.protocols import dtu
from torch_surfcap.protocols.dtu import Scan, culled, mesh_points, read_scan, scan_scores, thinned

EVERYWHERE = np.array([0.0, 0.0, 0.0, 1.0])  # a plane that everything lies above
BOX = np.array([[-20.0, -20.0, -20.0], [20.0, 20.0, 40.0]])
OBSERVED = np.ones((41, 41, 61), dtype=bool)  # 1 mm apart, entry (0, 0, 0) at the box's lower corner


def square(*heights: float, side: float = 10.0) -> trimesh.Trimesh:
    """Squares of two triangles parallel to the ground, their corners at 0 and `side`."""
    corners = np.array([[0.0, 0, 0], [side, 0, 0], [side, side, 0], [0, side, 0]])
    vertices = np.concatenate([corners + np.array([0, 0, h]) for h in heights])
    faces = np.concatenate([4 * i + np.array([[0, 1, 2], [0, 2, 3]]) for i in range(len(heights))])
    return trimesh.Trimesh(vertices, faces, process=False)


def ground(step: float = 0.1) -> np.ndarray:
    """Scanned points of the square at height 0."""
    x, y = np.meshgrid(np.arange(0, 10 + step / 2, step), np.arange(0, 10 + step / 2, step))
    return np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)


def scan_of(points: np.ndarray, observed: np.ndarray = OBSERVED, plane: np.ndarray = EVERYWHERE) -> Scan:
    return Scan(1, points, observed, BOX, 1.0, plane)


def test_ball_that_is_a_millimetre_too_large() -> None:
    mesh = trimesh.creation.icosphere(5, 11.0)
    scores = scan_scores(mesh, scan_of(sphere_points(10.0) - CENTER))
    assert scores["accuracy"] == pytest.approx(1.0, abs=0.01)
    assert scores["completeness"] == pytest.approx(
        1.0, abs=0.02
    )  # to points 0.2 mm apart, not to the surface
    assert scores["overall"] == 0.5 * (scores["accuracy"] + scores["completeness"])
    assert scores["accuracy_beyond"] == scores["completeness_beyond"] == 0


def test_only_the_observed_counts_for_accuracy() -> None:
    upper = OBSERVED.copy()
    upper[:, :, :20] = False  # entry k is centred at -20 + k: all below -0.5 goes
    both = square(1.0, -3.0)
    assert scan_scores(both, scan_of(ground()))["accuracy"] == pytest.approx(2.0, rel=0.01)
    hidden = scan_scores(both, scan_of(ground(), upper))
    assert hidden["accuracy"] == pytest.approx(1.0, rel=0.01)
    # The scan is still held against what the mask hides: the square at -0.6, nearer than the one at 1.
    near = scan_scores(square(1.0, -0.6), scan_of(ground(), upper))
    assert near["accuracy"] == pytest.approx(1.0, rel=0.01)
    assert near["completeness"] == pytest.approx(0.6, rel=0.03)


def test_only_scanned_points_above_the_plane_count_for_completeness() -> None:
    points = np.concatenate([ground(), ground() - [0, 0, 5]])
    above = np.array([0.0, 0.0, 2.0, 6.0])  # 2 z + 6 > 0: higher than -3
    assert scan_scores(square(1.0), scan_of(points))["completeness"] == pytest.approx(3.5, rel=0.01)
    scores = scan_scores(square(1.0), scan_of(points, plane=above))
    assert scores["completeness"] == pytest.approx(1.0, rel=0.01)
    assert scores["scan_points"] == len(ground())


@pytest.mark.parametrize(("height", "accuracy", "beyond"), [(15.0, 8.0, 0.0), (25.0, 1.0, 0.5)])
def test_what_is_far_does_not_count(height: float, accuracy: float, beyond: float) -> None:
    scores = scan_scores(square(1.0, height), scan_of(ground()))
    assert scores["accuracy"] == pytest.approx(accuracy, rel=0.01)
    assert scores["accuracy_beyond"] == pytest.approx(beyond, abs=0.01)
    assert scores["completeness"] == pytest.approx(1.0, rel=0.01)


def test_exactly_the_farthest_does_not_count() -> None:
    """Only the four corners: the spacing leaves no room for more. They are 20 mm away, and 19 mm."""
    cuts = dtu.Cuts(spacing=9.0)
    far = scan_scores(square(20.0), scan_of(ground()), cuts)
    assert np.isnan(far["accuracy"])
    assert far["accuracy_beyond"] == 1.0
    near = scan_scores(square(19.0), scan_of(ground()), cuts)
    assert (near["accuracy"], near["mesh_points"]) == (19.0, 4)


def test_points_of_a_triangle() -> None:
    """Legs of 1 at a spacing of 1/4: 4 x 4 cells, of which 6 have their centre below the diagonal."""
    mesh = trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]], process=False)
    found = mesh_points(mesh, 0.25, BOX)
    centres = np.array([[i / 8, j / 8, 0] for j in (1, 3, 5) for i in (1, 3, 5) if i + j < 8])
    np.testing.assert_allclose(found, np.concatenate([mesh.vertices, centres]))
    inside = mesh_points(mesh, 0.25, np.array([[-1.0, -1, -1], [0.3, 0.3, 1]]))
    np.testing.assert_allclose(inside, [[0.0, 0.0, 0.0], [0.125, 0.125, 0.0]])


def test_points_of_triangles_without_area_are_their_vertices() -> None:
    mesh = trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [2, 0, 0]], [[0, 1, 2], [1, 1, 1]], process=False)
    np.testing.assert_array_equal(mesh_points(mesh, 0.25, BOX), mesh.vertices)


@pytest.mark.parametrize("block", [1, 100, 1 << 20])
def test_thinning_is_the_one_by_one_rule(block: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dtu, "BLOCK", block)
    points, spacing = np.random.default_rng(1).random((1000, 3)), 0.12
    expected: list[np.ndarray] = []
    for point in points[np.random.default_rng(0).permutation(len(points))]:
        if all(np.linalg.norm(point - other) > spacing for other in expected):
            expected.append(point)
    np.testing.assert_array_equal(thinned(points, spacing), expected)
    assert cKDTree(points).query(points, k=2)[0][:, 1].min() < spacing  # there was something to thin


def test_thinning_nothing_and_the_same() -> None:
    assert thinned(np.empty((0, 3)), 0.2).shape == (0, 3)
    assert thinned(np.ones((5, 3)), 0.2).shape == (1, 3)


def test_mesh_elsewhere_is_an_error() -> None:
    with pytest.raises(InputError, match=r"observation mask of scan 1.*millimetres"):
        scan_scores(square(1000.0), scan_of(ground()))


def test_scan_is_read(tmp_path: Path) -> None:
    observed = np.random.default_rng(0).random((3, 4, 5)) > 0.5
    box, plane = np.array([[0.0, 0, 0], [4, 6, 8]]), np.array([0.0, 0.0, 1.0, -0.5])
    points = np.array([[0.0, 0, 0], [1, 2, 3]])
    write_dtu_truth(tmp_path, 7, points, observed, box, 2.0, plane)
    scan = read_scan(tmp_path, 7)
    assert (scan.number, scan.resolution) == (7, 2.0)
    np.testing.assert_array_equal(scan.points, points)
    np.testing.assert_array_equal(scan.box, box)
    np.testing.assert_array_equal(scan.above_ground(), points[1:])
    centres = 2 * np.argwhere(np.ones_like(observed)).astype(np.float64)
    np.testing.assert_array_equal(scan.observes(centres + 0.9), observed.ravel())
    outside = np.array([[-1.1, 0, 0], [5.1, 0, 0], [0, 0, 9.1], [1e9, 0, 0]])
    assert not scan.observes(outside).any()


MASK, PLANE, STL = "ObsMask/ObsMask7_10.mat", "ObsMask/Plane7.mat", "Points/stl/stl007_total.ply"
HDF5 = b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM" + bytes(512)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        (MASK, None, "No such file"),
        (PLANE, None, "No such file"),
        (STL, None, "expected points"),
        (MASK, b"", "expected a .mat file"),
        (MASK, b"no mask " * 50, "expected a .mat file"),
        (MASK, HDF5, "v7.3 files"),
        (PLANE, 150, "expected a .mat file"),
        (MASK, 200, "expected a .mat file"),
        (STL, b"ply\nformat ascii 1.0\nend_header\n", "expected finite points"),
        (PLANE, {"Q": np.ones(4)}, "no P"),
        (PLANE, {"P": np.ones(3)}, "P is 3, expected 4"),
        (PLANE, {"P": np.array([0, 0, 0, -1.0])}, "above the plane"),
        (MASK, {"ObsMask": np.ones((2, 2, 2))}, "no BB and no Res"),
        (MASK, {"ObsMask": np.ones((2, 2)), "BB": BOX, "Res": 1.0}, "2 x 2"),
        (MASK, {"ObsMask": np.ones((2, 2, 2)), "BB": BOX[0], "Res": 1.0}, "BB is 1x3"),
        (MASK, {"ObsMask": np.ones((2, 2, 2)), "BB": BOX * np.nan, "Res": 1.0}, "a box and a length"),
        (MASK, {"ObsMask": np.ones((2, 2, 2)), "BB": BOX, "Res": 0.0}, "a box and a length"),
        (MASK, {"ObsMask": np.ones((2, 2, 2)), "BB": BOX, "Res": "one"}, "Res is not numeric"),
    ],
)
def test_bad_truth_is_named(
    tmp_path: Path, name: str, content: bytes | int | dict[str, Any] | None, message: str
) -> None:
    write_dtu_truth(tmp_path, 7, ground(), OBSERVED, BOX, 1.0, EVERYWHERE)
    path = tmp_path / name
    if isinstance(content, dict):
        savemat(path, content)
    elif content is None:
        path.unlink()
    else:
        path.write_bytes(content if isinstance(content, bytes) else path.read_bytes()[:content])
    with pytest.raises(InputError) as error:
        read_scan(tmp_path, 7)
    assert str(error.value).startswith(str(path))
    assert message in str(error.value)
    assert "\n" not in str(error.value)


def test_faces_outside_a_mask_are_culled() -> None:
    """A small ball a pixel's footprint of 1.14 mm (80 mm / 70) times 10 above the other; masks hold the other only."""
    views = cameras(4)
    main, spur = (trimesh.creation.icosphere(2, 2.0) for _ in range(2))
    main.apply_translation(CENTER)
    spur.apply_translation(CENTER + np.array([0, 0, 11.4]))
    disc = ((torch.stack(torch.meshgrid(*[torch.arange(48) + 0.5] * 2, indexing="ij")) - 24) ** 2).sum(0) < 9
    capture = Capture([torch.zeros(48, 48, 3)] * 4, views.K, views.world_to_camera, [disc.float()] * 4)
    both = main + spur
    kept = culled(both, [capture], 0.0)
    assert (len(kept.faces), len(kept.vertices)) == (len(main.faces), len(main.vertices))
    assert len(culled(both, [capture], 5.0).faces) == len(main.faces)
    assert len(culled(both, [capture], 12.0).faces) == len(both.faces)
    with pytest.raises(InputError, match="no face lies within all masks dilated by 0 pixels"):
        culled(spur, [capture], 0.0)
    # Far above it is in no picture: no camera has a vote on it.
    spur.apply_translation([0, 0, 500.0])
    assert len(culled(main + spur, [capture], 0.0).faces) == len(both.faces)
