"""Marching cubes in plain torch: every case, closed whatever the signs, in the same place as scikit-image's."""

from collections.abc import Callable

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial import KDTree
from torch import Tensor

from tests.surface.shapes import (
    CENTER,
    VOXEL,
    assert_closed,
    ball_distance,
    colors_of,
    field_of,
    signed,
    tiled,
)
from torch_surfcap.surface import extract, marching
from torch_surfcap.surface.cases import EDGES, SIDES, loops, triangulated
from torch_surfcap.surface.extract import extract_mesh, march_blocks, signed_tiles
from torch_surfcap.surface.marching import march_cells


def surface(
    voxels: Tensor, table: Tensor, outside: float = 1.0, device: str = "cpu"
) -> tuple[Tensor, Tensor]:
    """Vertices and faces where the values change their sign, found in torch on the device, as tensors on the host."""
    found = march_cells(*signed_tiles(voxels.to(device), table.to(device), outside, -outside, 0.0))
    assert all(x.device.type == device for x in found)
    return found[0].cpu(), found[1].cpu()


def volumes(vertices: Tensor, faces: Tensor) -> Tensor:
    """Signed volumes [F] between faces and origin."""
    a, b, c = vertices[faces].unbind(1)
    return (a * torch.linalg.cross(b, c)).sum(1) / 6


def patchwork(seed: int) -> tuple[Tensor, Tensor]:
    """Random values in random tiles, a third of which are missing inside and a third missing outside."""
    rng = torch.Generator().manual_seed(seed)
    kind = torch.randint(-2, 1, (6, 5, 4), generator=rng)
    kind[kind == 0] = torch.arange(int((kind == 0).sum()))
    table = torch.nn.functional.pad(kind, (1,) * 6, value=-2).int()
    return torch.randn(int((kind >= 0).sum()), 4, 4, 4, generator=rng), table


def dense_of(voxels: Tensor, table: Tensor) -> Tensor:
    """The values [4 X, 4 Y, 4 Z] that the tiles of a table stand for, -1 inside and 1 outside."""
    missing = torch.tensor([-1.0, 1.0]).view(2, 1, 1, 1).expand(2, 4, 4, 4)
    tiles = torch.cat([voxels, missing])[
        torch.where(table < 0, len(voxels) - 1 - table.clamp(min=-2), table).long()
    ]
    return tiles.permute(0, 3, 1, 4, 2, 5).reshape([4 * n for n in table.shape])


def test_no_diagonal_lies_in_a_face_of_the_cell() -> None:
    for case in range(256):
        crossed = [k for k, (low, axis) in enumerate(EDGES) if (case >> low ^ case >> (low | 1 << axis)) & 1]
        rings = loops(case)
        assert sorted(edge for ring in rings for edge in ring) == crossed
        for ring in rings:
            lines = set(zip(ring, ring[1:] + ring[:1], strict=True))
            triangles = triangulated(ring)
            assert len(triangles) == len(ring) - 2
            sides = {side for t in triangles for side in zip(t, (*t[1:], t[0]), strict=True)}
            assert lines <= sides
            assert all((b, a) in sides for a, b in sides - lines)
            assert not any(a in face and b in face for a, b in sides - lines for face in SIDES)


def test_every_case_alone_is_closed_and_outward(device: str) -> None:
    dense = np.ones((64, 64, 4))
    for case in range(256):
        x, y = 4 * (case // 16), 4 * (case % 16)
        for corner in range(8):
            if case >> corner & 1:
                dense[x + 1 + (corner & 1), y + 1 + (corner >> 1 & 1), 1 + (corner >> 2)] = -1.0
    for matter in (dense, -dense):  # and every case as a hole
        vertices, faces = surface(*tiled(matter), device=device)
        assert_closed(faces)
        tile = vertices[faces[:, 0]].add(0.5).div(4, rounding_mode="floor").long() - 1
        own = (tile[:, :2] >= 0).all(1) & (tile[:, :2] < 16).all(1)
        if matter is not dense:  # the outer skin, half a voxel beyond the plate
            middle = vertices[faces].mean(1)
            own &= ((middle > 4) & (middle < torch.tensor([67.0, 67, 7]))).all(1)
        volume = torch.zeros(256, dtype=torch.float64)
        volume.index_add_(0, 16 * tile[own, 0] + tile[own, 1], volumes(vertices, faces)[own])
        sign = 1 if matter is dense else -1
        assert volume[0] == 0
        assert ((sign * volume)[1:] > 0.1).all()
        assert (volume.abs() < 8.0).all()


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("chunk", [7, 1 << 14])
def test_random_tiles_are_closed(seed: int, chunk: int, device: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(marching, "CHUNK", chunk)
    voxels, table = patchwork(seed)
    vertices, faces = surface(voxels, table, device=device)
    assert_closed(faces)
    assert torch.equal(faces.unique(), torch.arange(len(vertices)))
    assert volumes(vertices, faces).sum() > 0
    a, b, c = vertices[faces].unbind(1)
    assert torch.linalg.cross(b - a, c - a).norm(dim=1).min() > 0


def test_vertices_are_the_crossed_edges(device: str) -> None:
    voxels, table = patchwork(9)
    voxels += 0.1 * voxels.sign()  # so that none is so near to the level that it is moved away
    dense = dense_of(voxels, table).double()
    vertices, _ = surface(voxels, table, device=device)
    low = vertices.floor()
    along = vertices != low
    assert (along.sum(1) == 1).all()
    a, b = (dense[tuple(at.long().unbind(1))] for at in (low, low + along))
    assert (a * b < 0).all()
    torch.testing.assert_close((vertices - low).sum(1), a / (a - b), rtol=0, atol=1e-5)
    crossed = sum(
        int((dense.narrow(i, 0, n - 1) * dense.narrow(i, 1, n - 1) < 0).sum())
        for i, n in enumerate(dense.shape)
    )
    assert len(vertices.unique(dim=0)) == len(vertices) == crossed


def ball_of(at: np.ndarray) -> np.ndarray:
    return np.linalg.norm(at, axis=-1) - 15.2


def torus_of(at: np.ndarray) -> np.ndarray:
    return np.hypot(np.hypot(at[..., 0], at[..., 1]) - 12.3, at[..., 2]) - 5.1


@pytest.mark.parametrize(("shape", "euler"), [(ball_of, 2), (torus_of, 0)])
def test_smooth_shapes_equal_skimages(
    shape: Callable[[np.ndarray], np.ndarray], euler: int, device: str
) -> None:
    size = np.array([48, 44, 40])
    middle = size / 2 - 0.53
    at = np.stack(np.meshgrid(*[np.arange(n) for n in size], indexing="ij"), axis=-1) - middle
    voxels, table = tiled(np.clip(shape(at), -4, 4))
    found = [surface(voxels, table, 4.0, device), march_blocks(*signed_tiles(voxels, table, 4.0, -4.0, 0.0))]
    meshes = [trimesh.Trimesh(at.numpy(), faces.numpy(), process=False) for at, faces in found]
    for one, other in (meshes, meshes[::-1]):
        assert one.euler_number == euler
        assert KDTree(one.vertices).query(other.vertices)[0].max() < 1e-4
        # Only diagonals differ, which are chords of up to sqrt(3) voxels: 3 / (8 * 5.1) at the most.
        assert np.abs(shape(one.triangles_center - 4 - middle)).max() < 0.075
        assert one.volume == pytest.approx(other.volume, rel=1e-3)


def test_a_fields_mesh_is_found_in_torch_elsewhere(device: str, monkeypatch: pytest.MonkeyPatch) -> None:
    origin, centers, distance = ball_distance()
    ramp = (centers - centers[0, 0, 0]) / (centers[-1, -1, -1] - centers[0, 0, 0])
    field = field_of(signed(distance), origin, ramp, opacity="distance")
    expected, skimages = extract_mesh(field), extract_mesh(field, smooth=6)
    monkeypatch.setattr(extract, "march_blocks", march_cells)  # so that the CPU goes the same way
    mesh, smooth = extract_mesh(field.to(device)), extract_mesh(field.to(device), smooth=6)
    away, nearest = KDTree(expected.vertices).query(mesh.vertices)
    assert len(mesh.vertices) == len(expected.vertices)
    assert away.max() < 1e-4 * VOXEL
    assert np.abs(colors_of(mesh) - colors_of(expected)[nearest]).max() < 1.5 / 255
    assert mesh.volume == pytest.approx(expected.volume, rel=1e-3)
    # Where the vertices slide to depends on the diagonals; the shape does not.
    assert smooth.is_watertight
    assert smooth.volume == pytest.approx(skimages.volume, rel=2e-3)
    radius = np.linalg.norm(smooth.vertices - CENTER, axis=1)
    assert np.abs(radius - radius.mean()).max() < 0.05 * VOXEL
