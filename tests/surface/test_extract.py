"""Extraction: closed, outward, in the right place, whatever the blocks."""

import numpy as np
import pytest
import torch
import trimesh

from tests.surface.shapes import (
    CENTER,
    RADIUS,
    VOXEL,
    assert_closed,
    ball,
    ball_distance,
    colors_of,
    field_of,
    signed,
    soft,
    tiled,
)
from torch_surfcap.field.field import SurfaceField
from torch_surfcap.surface import extract
from torch_surfcap.surface.extract import (
    drop_pieces,
    extract_mesh,
    isosurface,
    march_blocks,
    vertex_normals,
)
from torch_surfcap.surface.marching import march_cells

NOTHING = torch.zeros(0, 4, 4, 4)


@pytest.fixture(params=[march_blocks, march_cells])
def march(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Marching cubes of either kind."""
    monkeypatch.setattr(extract, "march_blocks", request.param)


@pytest.mark.usefixtures("march")
@pytest.mark.parametrize("opacity", ["transparency", "distance"])
def test_ball(opacity: str) -> None:
    origin, _, distance = ball_distance()
    values = soft(distance) if opacity == "transparency" else signed(distance)
    mesh = extract_mesh(field_of(values, origin, opacity=opacity))
    assert mesh.is_watertight
    radius = np.linalg.norm(mesh.vertices - CENTER, axis=1)
    # Linear in the distance, so only the chord within a voxel is missed: VOXEL^2 / (8 RADIUS) = 0.0002.
    assert np.abs(radius - RADIUS).max() < 4e-4
    assert mesh.volume == pytest.approx(4 / 3 * np.pi * RADIUS**3, rel=5e-3)
    normals = vertex_normals(np.asarray(mesh.vertices), np.asarray(mesh.faces))
    outward = (mesh.vertices - CENTER) / radius[:, None]
    assert (normals * outward).sum(axis=1).min() > 0.97


def test_threshold_moves_the_surface() -> None:
    # 0.25 per voxel: 0.56 lies one voxel below 0.81.
    radius = np.linalg.norm(extract_mesh(ball(), threshold=0.56).vertices - CENTER, axis=1)
    assert radius.mean() == pytest.approx(RADIUS - VOXEL, abs=4e-4)


@pytest.mark.parametrize("kind", ["noise", "ties"])
@pytest.mark.parametrize("block", [1, 3, 64])
def test_noise_is_watertight_across_blocks(kind: str, block: int, monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(0)
    size = (28, 24, 20)
    # Values of equal size on both sides of the level are ties for the cells on the two sides of a voxel face.
    dense = rng.normal(size=size) if kind == "noise" else rng.choice([-1.0, 1.0, 0.5, -0.5, 0.0], size=size)
    voxels, table = tiled(dense)
    whole_vertices, whole_faces = isosurface(voxels, table, 1.0, -1.0, 0.0)
    monkeypatch.setattr(extract, "BLOCK", block)
    vertices, faces = isosurface(voxels, table, 1.0, -1.0, 0.0)
    assert len(vertices) == len(whole_vertices)
    assert len(faces) == len(whole_faces)
    assert_closed(faces)
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    assert mesh.volume > 0
    assert mesh.area_faces.min() > 0
    np.testing.assert_allclose(vertices, whole_vertices, atol=1e-4)


@pytest.mark.usefixtures("march")
def test_vertices_lie_where_the_trilinear_field_crosses() -> None:
    # One voxel of -1 in a room of +3: the six crossings are a quarter of the way to its neighbours.
    dense = np.full((4, 4, 4), 3.0)
    dense[1, 2, 1] = -1.0
    vertices, faces = isosurface(*tiled(dense), 3.0, -3.0, 0.0)
    middle = np.array([5.0, 6, 5])  # the rim adds four voxels
    expected = np.concatenate([middle + 0.25 * np.eye(3), middle - 0.25 * np.eye(3)])
    assert len(faces) == 8
    np.testing.assert_allclose(sorted(vertices.tolist()), sorted(expected.tolist()), atol=1e-4)


@pytest.mark.usefixtures("march")
def test_missing_inside_beside_missing_outside_is_closed() -> None:
    # No stored tile at all: two inside tiles alone make a box of 8 x 4 x 4 voxels, half a voxel larger each side.
    table = torch.full((5, 4, 4), -2)
    table[1:3, 1, 1] = -1
    table[0, 0, 0] = -9  # a skip distance is outside as well
    vertices, faces = isosurface(NOTHING, table, 1.0, -1.0, 0.0)
    assert_closed(faces)
    np.testing.assert_allclose(vertices.amin(0), 3.5, atol=1e-3)
    np.testing.assert_allclose(vertices.amax(0), [11.5, 7.5, 7.5], atol=1e-3)


@pytest.mark.usefixtures("march")
def test_nothing_crosses() -> None:
    table = torch.full((3, 3, 3), -2)
    vertices, faces = isosurface(NOTHING, table, 1.0, 0.01, 0.81)
    assert vertices.shape == faces.shape == (0, 3)
    origin, _, distance = ball_distance((8, 8, 8))
    assert len(extract_mesh(field_of(np.ones_like(distance), origin)).faces) == 0


def test_impossible_values_are_refused() -> None:
    table = torch.full((3, 3, 3), -2)
    with pytest.raises(ValueError, match=r"threshold 1: expected less than the value outside, 1"):
        isosurface(NOTHING, table, 1.0, 0.01, 1.0)
    table[1, 1, 1] = 0
    with pytest.raises(ValueError, match="64 voxels are not finite"):
        isosurface(torch.full((1, 4, 4, 4), torch.nan), table, 1.0, 0.01, 0.81)


def _pieces() -> tuple[np.ndarray, np.ndarray]:
    """A large ball, an inner sheet of a ninth of its area in it, a speck of a hundredth beside it."""
    large, inner, speck = (trimesh.creation.icosphere(3, radius) for radius in (0.9, 0.3, 0.09))
    corners = [large.vertices, inner.vertices, speck.vertices + np.array([2.0, 0.0, 0.0])]
    n = len(large.vertices)
    return np.concatenate(corners), np.concatenate(
        [large.faces, inner.faces[:, ::-1] + n, speck.faces + 2 * n]
    )


@pytest.mark.parametrize(
    ("specks", "cavities", "left"),
    [(0.0, True, 3), (0.009, True, 3), (0.011, True, 2), (0.12, True, 1), (0.0, False, 2), (0.011, False, 1)],
)
def test_pieces(specks: float, cavities: bool, left: int) -> None:
    corners, faces = _pieces()
    vertices, faces = drop_pieces(corners, faces, specks, cavities)
    each = len(corners) // 3
    assert len(vertices) == left * each
    assert set(np.unique(faces)) == set(range(len(vertices)))
    np.testing.assert_allclose(np.linalg.norm(vertices[:each], axis=1), 0.9, atol=1e-9)


def test_speck_goes_from_a_field() -> None:
    origin, centers, distance = ball_distance()
    speck = np.linalg.norm(centers - (CENTER + 0.21), axis=-1) - 0.015
    field = field_of(soft(np.minimum(distance, speck)), origin)
    parts = [len(extract_mesh(field, specks=s).split(only_watertight=False)) for s in (0.0, 0.01)]
    assert parts == [2, 1]


def test_smoothing_equals_trimesh_and_helps() -> None:
    origin, _, distance = ball_distance()
    stairs = field_of(np.where(distance < 0, 0.01, 1.0), origin)
    rough, mesh = extract_mesh(stairs), extract_mesh(stairs, smooth=15)
    expected = trimesh.smoothing.filter_taubin(rough.copy(), iterations=15)
    np.testing.assert_allclose(mesh.vertices, expected.vertices, atol=1e-12)
    spread = [np.linalg.norm(m.vertices - CENTER, axis=1).std() for m in (rough, mesh)]
    assert spread[1] < 0.8 * spread[0]


def test_colors_are_the_fields() -> None:
    # A distance keeps four voxels of margin, so no missing (black) tile is read at the surface.
    origin, centers, distance = ball_distance()
    ramp = (centers - centers[0, 0, 0]) / (centers[-1, -1, -1] - centers[0, 0, 0])
    mesh = extract_mesh(field_of(signed(distance), origin, ramp, opacity="distance"))
    index = (mesh.vertices - centers[0, 0, 0]) / (centers[-1, -1, -1] - centers[0, 0, 0])
    assert np.abs(colors_of(mesh) - index).max() < 1 / 255
    assert isinstance(mesh.visual, trimesh.visual.ColorVisuals)
    assert (np.asarray(mesh.visual.vertex_colors)[:, 3] == 255).all()


def test_colors_are_seen_from_outside() -> None:
    # Degree 1, of which the last function is x: red 0.5 + 0.4 x of the view's direction, which is minus the normal.
    origin, _, distance = ball_distance()
    values = torch.from_numpy(signed(distance)).float()
    sh = torch.zeros(*distance.shape, 4, 3)
    sh[..., 0, :], sh[..., 3, 0] = 0.5, 0.4
    mesh = extract_mesh(
        SurfaceField.from_dense(values, sh, torch.from_numpy(origin), VOXEL, opacity="distance")
    )
    outward = (mesh.vertices - CENTER) / np.linalg.norm(mesh.vertices - CENTER, axis=1, keepdims=True)
    assert np.abs(colors_of(mesh)[:, 0] - (0.5 - 0.4 * outward[:, 0])).max() < 0.06
