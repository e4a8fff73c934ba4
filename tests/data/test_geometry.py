"""Meshes and point clouds read from files."""

from pathlib import Path

import numpy as np
import pytest
import trimesh

from torch_surfcap import InputError
from torch_surfcap.data.geometry import read_mesh, read_points


def test_mesh_and_points_of_one_file(tmp_path: Path) -> None:
    ball = trimesh.creation.icosphere(1)
    ball.export(tmp_path / "ball.ply")
    np.testing.assert_array_equal(read_mesh(tmp_path / "ball.ply").faces, ball.faces)
    np.testing.assert_allclose(read_points(tmp_path / "ball.ply"), ball.vertices, atol=1e-6)


@pytest.mark.parametrize("names", [("xyz",), ("normals", "points")])
def test_points_of_archives(tmp_path: Path, names: tuple[str, ...]) -> None:
    arrays = {name: np.full((4, 3), float(i)) for i, name in enumerate(names)}
    np.savez(tmp_path / "points.npz", **arrays, seen=0.5)  # type: ignore[arg-type]
    np.testing.assert_array_equal(read_points(tmp_path / "points.npz"), arrays[names[-1]])


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_what_is_not_finite_is_named(tmp_path: Path, value: float) -> None:
    ball = trimesh.creation.icosphere(1)
    ball.vertices[3, 1] = value
    ball.export(tmp_path / "ball.ply")
    with pytest.raises(InputError, match=r"ball\.ply: vertices with NaN or infinite"):
        read_mesh(tmp_path / "ball.ply")
    with pytest.raises(InputError, match=r"ball\.ply: .*finite points"):
        read_points(tmp_path / "ball.ply")
