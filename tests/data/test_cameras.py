"""Cameras: conventions, projection against rays, resizing, faults."""

from __future__ import annotations

import pytest
import torch

from torch_surfcap.data.cameras import Cameras
from torch_surfcap.errors import InputError

from .rigs import rig_cameras


def test_hand_worked_projection() -> None:
    # f = 100, c = (32, 24), skew 10; the point (1, 2, 4) in front of a camera at the origin:
    # u = (100·1 + 10·2)/4 + 32 = 62,  v = 100·2/4 + 24 = 74
    K = torch.tensor([[[100.0, 10, 32], [0, 100, 24], [0, 0, 1]]])
    cameras = Cameras(K, torch.eye(4)[None], torch.tensor([[64, 48]]))
    uv, depth = cameras.project(0, torch.tensor([[1.0, 2.0, 4.0]]))
    assert uv[0].tolist() == pytest.approx([62.0, 74.0])
    assert depth.tolist() == [4.0]


def test_first_pixel_is_centred_at_one_half() -> None:
    cameras = rig_cameras(1)
    origins, directions = cameras.rays(0)
    uv, depth = cameras.project(0, origins + 3 * directions)
    assert uv[0].tolist() == pytest.approx([0.5, 0.5], abs=1e-9)
    assert uv[1].tolist() == pytest.approx([1.5, 0.5], abs=1e-9)  # row-major: u runs fastest
    assert uv[-1].tolist() == pytest.approx([39.5, 29.5], abs=1e-9)
    assert (depth > 0).all()
    torch.testing.assert_close(directions.norm(dim=1), torch.ones(len(directions), dtype=torch.float64))


def test_projection_matrices_agree_with_kornia() -> None:
    cameras = rig_cameras()
    points = torch.randn(50, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0)) * 0.3
    for i, P in enumerate(cameras.projection_matrices()):
        x = points @ P[:, :3].T + P[:, 3]
        uv, depth = cameras.project(i, points)
        torch.testing.assert_close(x[:, :2] / x[:, 2:], uv)
        torch.testing.assert_close(x[:, 2], depth)


def test_centers_project_nowhere() -> None:
    cameras = rig_cameras()
    for i, center in enumerate(cameras.centers):
        _, depth = cameras.project(i, center[None])
        assert abs(float(depth)) < 1e-12


def test_far_from_the_origin() -> None:
    """Cameras that stand 100 km away, with rotations as text files round them, are the same ones at the origin."""
    cameras, shift = rig_cameras(), torch.tensor([6e4, -6.4e4, 4.8e4], dtype=torch.float64)
    to_world = torch.linalg.inv(cameras.world_to_camera)
    to_world[:, :3, :3] = to_world[:, :3, :3].mul(1e5).round() / 1e5
    near = Cameras(cameras.K, torch.linalg.inv(to_world), cameras.size)
    to_world[:, :3, 3] += shift
    far = Cameras(cameras.K, torch.linalg.inv(to_world), cameras.size)
    for i in range(len(near)):
        (origins, directions), (start, towards) = far.rays(i), near.rays(i)
        torch.testing.assert_close(origins - shift, start, rtol=0, atol=1e-9)
        torch.testing.assert_close(directions, towards, rtol=0, atol=1e-12)
        uv, _ = far.project(i, origins + 3 * directions)
        torch.testing.assert_close(uv, near.pixels(i), rtol=0, atol=1e-6)
    torch.testing.assert_close(far.moved(-shift).world_to_camera, near.world_to_camera, rtol=0, atol=1e-9)


def test_half_of_a_camera_sees_the_mean_of_pixels() -> None:
    cameras = rig_cameras()
    half = cameras.scaled_half()
    assert half.size.tolist() == [[20, 15]] * len(cameras)
    point = torch.tensor([[0.1, -0.2, 1.0]], dtype=torch.float64)
    torch.testing.assert_close(2 * half.project(2, point)[0], cameras.project(2, point)[0])


def test_subset_keeps_the_order() -> None:
    cameras = rig_cameras()
    torch.testing.assert_close(cameras.subset([3, 1]).centers, cameras.centers[[3, 1]])
    assert len(cameras.subset([])) == 0


def test_joined_and_scaled() -> None:
    cameras = rig_cameras()
    both = Cameras.joined([cameras.subset([4]), cameras.subset([0, 1])])
    torch.testing.assert_close(both.centers, cameras.centers[[4, 0, 1]])
    # A picture of 300 x 200 at 60 x 40: a fifth, and so every pixel position.
    large = Cameras(cameras.K[:1], cameras.world_to_camera[:1], torch.tensor([[300, 200]]))
    small = large.scaled_to(60)
    assert small.size.tolist() == [[60, 40]]
    point = torch.tensor([[0.1, 0.2, 0.3]])
    torch.testing.assert_close(small.project(0, point)[0], large.project(0, point)[0] / 5)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda c: c.K[1, 0, 0].fill_(float("nan")), "camera 1: K holds NaN"),
        (lambda c: c.K[1, 1, 1].fill_(0.0), "camera 1: K is singular"),
        (lambda c: c.world_to_camera[2, 0].mul_(2.0), "camera 2: R is no rotation"),
        (lambda c: c.world_to_camera[2, 0, :3].neg_(), "camera 2: R mirrors"),
        (lambda c: c.world_to_camera[0, 3, 3].fill_(2.0), "camera 0: the last row of the pose"),
        (lambda c: c.K[0, 2, 0].fill_(1.0), "camera 0: the last row of K"),
    ],
)
def test_faults_are_named(change: object, message: str) -> None:
    cameras = rig_cameras()
    change(cameras)  # type: ignore[operator]
    with pytest.raises(InputError, match=message):
        Cameras(cameras.K, cameras.world_to_camera, cameras.size)


def test_shapes_are_named() -> None:
    cameras = rig_cameras()
    with pytest.raises(InputError, match=r"size has shape \[4, 2\], expected \[5, 2\]"):
        Cameras(cameras.K, cameras.world_to_camera, cameras.size[:4])
