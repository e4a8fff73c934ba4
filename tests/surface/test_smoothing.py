"""Taubin smoothing: trimesh's."""

import numpy as np
import pytest
import torch
import trimesh

from torch_surfcap.surface.smoothing import taubin


@pytest.mark.parametrize("rounds", [0, 1, 2, 15])
def test_equals_trimesh(rounds: int, device: str) -> None:
    mesh = trimesh.creation.icosphere(4, 30.0)
    mesh.vertices += np.random.default_rng(0).normal(size=mesh.vertices.shape)
    before, faces = (torch.tensor(np.asarray(x), device=device) for x in (mesh.vertices, mesh.faces))
    vertices = taubin(before, faces, rounds)
    assert vertices.device.type == device
    expected = trimesh.smoothing.filter_taubin(mesh, iterations=rounds)
    np.testing.assert_allclose(vertices.cpu(), expected.vertices, rtol=1e-9, atol=1e-9)
