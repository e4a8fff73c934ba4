"""Pinhole cameras in the one convention of this package; kornia does the projecting.

OpenCV axes (x right, y down, z forward), world-to-camera [R|t], full 3x3 K (skew allowed), and pixel (0, 0) is centred
at (0.5, 0.5): an image of width W spans u in [0, W]. Halving an image is a 2x2 mean and exactly K/2.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from kornia.geometry.camera import PinholeCamera
from torch import Tensor

from torch_surfcap.errors import InputError

ROTATION_TOLERANCE = (
    1e-3  # largest accepted entry of |R R^T - I|: text files round, wrong matrices miss by far more
)


def calibration_fault(K: Tensor, world_to_camera: Tensor) -> str | None:
    """What is wrong with one camera's K [3,3] and world_to_camera [4,4], as "found, expected"; None when sound."""
    if not torch.isfinite(K).all():
        return "K holds NaN or infinite values, expected finite numbers"
    if not torch.isfinite(world_to_camera).all():
        return "the pose holds NaN or infinite values, expected finite numbers"
    if not torch.allclose(K[2], K.new_tensor([0.0, 0.0, 1.0]), atol=1e-9):
        return f"the last row of K is {_row(K[2])}, expected 0 0 1"
    if K[0, 0] <= 0 or K[1, 1] <= 0:
        return f"K is singular or mirrored (focal lengths {K[0, 0]:g}, {K[1, 1]:g}), expected positive focal lengths"
    if abs(float(torch.linalg.det(K))) < 1e-9 * float(K[0, 0] * K[1, 1]):
        return "K is singular, expected an invertible matrix"
    if not torch.allclose(world_to_camera[3], K.new_tensor([0.0, 0.0, 0.0, 1.0]), atol=1e-9):
        return f"the last row of the pose is {_row(world_to_camera[3])}, expected 0 0 0 1"
    R = world_to_camera[:3, :3]
    error = float((R @ R.T - torch.eye(3, dtype=R.dtype)).abs().max())
    if error > ROTATION_TOLERANCE:
        return f"R is no rotation (R R^T differs from the identity by {error:.2g}), expected at most {ROTATION_TOLERANCE:g}"
    if torch.linalg.det(R) < 0:
        return "R mirrors (determinant -1), expected a rotation (determinant +1)"
    return None


def _row(values: Tensor) -> str:
    return " ".join(f"{float(v):g}" for v in values)


@dataclass
class Cameras:
    """N calibrated cameras. Everything is float64 (sizes int64) and lives on the CPU.

    K:               [N,3,3] in pixels
    world_to_camera: [N,4,4], translations in the capture's own unit
    size:            [N,2] width and height in pixels, one per camera

    Raises InputError where shapes disagree or a calibration is not finite, singular or not a rotation.
    """

    K: Tensor
    world_to_camera: Tensor
    size: Tensor

    def __post_init__(self) -> None:
        self.K = torch.as_tensor(self.K, dtype=torch.float64, device="cpu")
        self.world_to_camera = torch.as_tensor(self.world_to_camera, dtype=torch.float64, device="cpu")
        self.size = torch.as_tensor(self.size, dtype=torch.int64, device="cpu")
        n = len(self.K)
        expected = {"K": (n, 3, 3), "world_to_camera": (n, 4, 4), "size": (n, 2)}
        for name, shape in expected.items():
            found = tuple(getattr(self, name).shape)
            if found != shape:
                raise InputError(f"cameras: {name} has shape {list(found)}, expected {list(shape)}")
        for i in range(n):
            fault = calibration_fault(self.K[i], self.world_to_camera[i])
            if fault:
                raise InputError(f"camera {i}: {fault}")

    def __len__(self) -> int:
        return len(self.K)

    @property
    def centers(self) -> Tensor:
        """[N,3] camera centres in world units."""
        R, t = self.world_to_camera[:, :3, :3], self.world_to_camera[:, :3, 3]
        # Not -R^T t: text files round R, and far from the world's origin that would move the centre.
        return -torch.linalg.solve(R, t)

    def pinhole(self, i: int, device: torch.device | str = "cpu", at_origin: bool = False) -> PinholeCamera:
        """Camera i, or one that stands at the origin and looks the same way, as kornia's PinholeCamera (batch of one), for
        points on a device."""
        intrinsics, pose = torch.eye(4, dtype=torch.float64), self.world_to_camera[i].clone()
        intrinsics[:3, :3] = self.K[i]
        if at_origin:
            pose[:3, 3] = 0.0
        width, height = self.size[i, 0:1], self.size[i, 1:2]
        camera = (intrinsics[None], pose[None], height, width)
        return PinholeCamera(*(part.to(device) for part in camera))

    def projection_matrices(self) -> Tensor:
        """[N,3,4] K [R|t]: world points to homogeneous pixels, the third component being the depth."""
        return self.K @ self.world_to_camera[:, :3]

    def project(self, i: int, points: Tensor) -> tuple[Tensor, Tensor]:
        """World points [P,3] -> pixels [P,2] and depths [P] (world units along the optical axis) in camera i.

        Where the depth is not positive the point lies behind the camera and its pixel means nothing.
        """
        points = points.to(torch.float64).reshape(-1, 3)
        uv = self.pinhole(i).project(points[None])[0]
        return uv, points @ self.world_to_camera[i, 2, :3] + self.world_to_camera[i, 2, 3]

    def pixels(self, i: int) -> Tensor:
        """[H*W,2] centres of all pixels of camera i in row-major order, as (u, v)."""
        width, height = (int(s) for s in self.size[i])
        v, u = torch.meshgrid(
            torch.arange(height, dtype=torch.float64) + 0.5,
            torch.arange(width, dtype=torch.float64) + 0.5,
            indexing="ij",
        )
        return torch.stack([u, v], dim=-1).reshape(-1, 2)

    def rays(self, i: int, pixels: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Origins [M,3] and unit directions [M,3] of the rays through `pixels` [M,2] of camera i.

        `pixels` are (u, v) positions, (0.5, 0.5) being the first pixel's centre; all pixels in row-major order by default.
        The rays are made on the pixels' device.
        """
        uv = self.pixels(i) if pixels is None else pixels.to(torch.float64).reshape(-1, 2)
        # The difference of two points far from the origin would have few digits left.
        towards = self.pinhole(i, uv.device, at_origin=True).unproject(uv[None], uv.new_ones(1, len(uv), 1))[
            0
        ]
        origins = self.centers[i].to(uv.device).expand(len(uv), 3)
        return origins, torch.nn.functional.normalize(towards, dim=-1)

    def moved(self, shift: Tensor) -> Cameras:
        """The cameras in a world whose points have all moved by `shift` [3], world units."""
        poses = self.world_to_camera.clone()
        poses[:, :3, 3] -= poses[:, :3, :3] @ shift
        return Cameras(self.K, poses, self.size)

    def subset(self, indices: Sequence[int] | Tensor) -> Cameras:
        """The cameras at `indices`, in that order."""
        index = torch.as_tensor(indices, dtype=torch.int64).reshape(-1)
        return Cameras(self.K[index], self.world_to_camera[index], self.size[index])

    @classmethod
    def joined(cls, parts: Sequence[Cameras]) -> Cameras:
        """All cameras of the parts, in order."""
        return cls(
            *(torch.cat([getattr(p, name) for p in parts]) for name in ("K", "world_to_camera", "size"))
        )

    def resized(self, factors: Tensor, size: Tensor) -> Cameras:
        """The cameras of images scaled by `factors` [N,2] (x, y) to `size` [N,2]."""
        scale = torch.cat([factors.to(torch.float64), torch.ones(len(self), 1, dtype=torch.float64)], dim=1)
        return Cameras(self.K * scale[:, :, None], self.world_to_camera, size)

    def scaled_to(self, longer: int) -> Cameras:
        """The cameras of pictures with `longer` pixels on their longer side and, but for rounding, the same proportions."""
        size = (self.size * longer / self.size.amax(dim=1, keepdim=True)).round().long().clamp(min=1)
        return self.resized(size / self.size, size)

    def cropped(self, left: float, top: float, width: float, height: float) -> Cameras:
        """The cameras of a window of their pictures, given by its corner and size as shares of theirs."""
        corner = (self.size * torch.tensor([left, top])).round().long()
        size = (self.size * torch.tensor([width, height])).round().long().clamp(min=1)
        K = self.K.clone()
        K[:, :2, 2] -= corner
        return Cameras(K, self.world_to_camera, size)

    def scaled_half(self) -> Cameras:
        """The cameras of the 2x2 means: K/2, size // 2 (an odd last row or column is dropped)."""
        return self.resized(torch.full((len(self), 2), 0.5), self.size // 2)
