"""Meshes and point clouds in files."""

from pathlib import Path

import numpy as np
import pytest
import trimesh

from torch_surfcap import InputError
from torch_surfcap.data.geometry import export_mesh, read_mesh, read_points


def test_mesh_and_points_of_one_file(tmp_path: Path) -> None:
    ball = trimesh.creation.icosphere(1)
    ball.export(tmp_path / "ball.ply")
    np.testing.assert_array_equal(read_mesh(tmp_path / "ball.ply").faces, ball.faces)
    np.testing.assert_allclose(read_points(tmp_path / "ball.ply"), ball.vertices, atol=1e-6)


@pytest.mark.parametrize("suffix", ["ply", "glb"])
@pytest.mark.parametrize("colored", [False, True])
def test_written_far_from_the_origin(tmp_path: Path, suffix: str, colored: bool) -> None:
    """At 100 km single precision has steps of 8 mm; edges are 3 mm long, and no vertex moves by a ten-thousandth of that."""
    ball = trimesh.creation.icosphere(3, radius=0.02)
    if colored:
        ball.visual.vertex_colors = np.arange(4 * len(ball.vertices), dtype=np.uint8).reshape(-1, 4)
    near, path = ball.copy(), tmp_path / f"ball.{suffix}"
    ball.apply_translation([6e4, -6.4e4, 4.8e4])
    export_mesh(path, ball)
    read = read_mesh(path)
    np.testing.assert_allclose(
        read.vertices, ball.vertices, rtol=0, atol=1e-4 * ball.edges_unique_length.min()
    )
    np.testing.assert_array_equal(read.faces, ball.faces)
    for visual in (read.visual, ball.visual):
        assert isinstance(visual, trimesh.visual.ColorVisuals)
        assert colored == (visual.kind == "vertex")
        np.testing.assert_array_equal(visual.vertex_colors, near.visual.vertex_colors)
    export_mesh(path, near)
    assert path.read_bytes() == trimesh.exchange.export.export_mesh(near, None, suffix)


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
