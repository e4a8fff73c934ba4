"""Cameras whose calibration is off: each photograph is registered to what the field shows of it.

What all cameras together made of the field is truer than the calibration of any one. With F + T B a rendering (F the
field's own part of a ray, T its transmittance, B what is behind it), camera i's photograph P is, to first order in a motion
d of its picture plane,

    P(x) = F + T B + (grad F + B grad T) d(x),   d(x) = t + s x + r (-x_2, x_1):

the background does not move with the field. x are pixels through K^-1, so that shift t, zoom s and roll r mean the same on
every level; they are found as by Lucas and Kanade (1981). Near the subject a small rotation or translation of a camera is
such a motion. What a similarity of the whole scene explains is not the cameras' to have: else scene and cameras could
wander off together.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torch_surfcap.data.cameras import Cameras
from torch_surfcap.data.capture import Capture
from torch_surfcap.field.tiles import TileGrid
from torch_surfcap.fitting.rays import RayBatch

RAYS = 8192  # of a camera that are compared, at most
ROBUST = 0.1  # difference of colours above which it counts linearly
# What is known beforehand: shift (pixels of the level), zoom and roll are 0 to within these, a colour to within NOISE.
DEVIATION, NOISE = (1.0, 1.0, 0.01, 0.01), 0.05
FARTHEST = 0.05  # of a picture's size: a camera that seems shifted further is wrong altogether, and stays where it is
# The median shift, zoom and roll, in pixels of the level that they move the subject by, from which on a calibration is off:
# less, wrong geometry may cause.
OFF = (0.2, 0.15, 0.15)


@dataclass(frozen=True)
class Pinholes:
    """Cameras as they were calibrated, on the rays' device. K, its inverse, rotation (world to camera): [N, 3, 3]
    float64; centers: [N, 3]; widths: of the pictures."""

    K: Tensor
    inverse: Tensor
    rotation: Tensor
    centers: Tensor
    widths: list[int]

    @staticmethod
    def of(cameras: Cameras, device: torch.device) -> Pinholes:
        rotation = cameras.world_to_camera[:, :3, :3]
        parts = (cameras.K, torch.linalg.inv(cameras.K), rotation, cameras.centers)
        K, inverse, turn, centers = (part.to(device) for part in parts)
        return Pinholes(K, inverse, turn, centers, cameras.size[:, 0].tolist())

    def through(self, i: int, pixels: Tensor) -> Tensor:
        """[M, 3] float64: K^-1 times the centres of camera i's pixels, given by their row-major numbers [M]."""
        number = pixels.double()
        row = (number / self.widths[i]).floor()
        centers = torch.stack([number - self.widths[i] * row + 0.5, row + 0.5, torch.ones_like(row)], 1)
        return centers @ self.inverse[i].T

    def aim(self, rays: RayBatch, motion: Tensor) -> None:
        """Turns the rays, in place, to where the cameras look once their pictures have moved by [N, 4]."""
        for i, matrix in enumerate(_matrices(motion)):
            part = rays.of_camera(i)
            point = self.through(i, rays.pixels[part]) @ matrix.T
            rays.origins[part] = self.centers[i]
            rays.directions[part] = torch.nn.functional.normalize(point @ self.rotation[i], dim=1)

    def projections(self, motion: Tensor) -> Tensor:
        """[N, 3, 3] what takes directions in the world to pixels once the pictures have moved by [N, 4]."""
        back, _ = torch.linalg.inv_ex(_matrices(motion))  # waits for no verdict
        return self.K @ back @ self.rotation


@dataclass(frozen=True)
class Registration:
    """How the rays of a level register with N cameras' photographs; on the rays' device.

    chosen: [M] rays of which all four neighbours are rays too, a part of each camera's; starts: [N + 1] where each camera's
    begin; beside: [4, M] their neighbours left, right, above, below. at: [M, 2] pixels through K^-1. focal: [M, 2]. prior:
    [N, 4, 4], what is known of the motions beforehand. farthest: [N], length of a shift. common [4 N, 7], inverse [7, 4 N]:
    the motions that a similarity of the scene causes, and the similarity nearest to motions.
    """

    chosen: Tensor
    starts: list[int]
    beside: Tensor
    at: Tensor
    focal: Tensor
    prior: Tensor
    farthest: Tensor
    common: Tensor
    inverse: Tensor
    pinholes: Pinholes

    @staticmethod
    def of(rays: RayBatch, given: Cameras, grid: TileGrid) -> Registration:
        """given: the cameras as they were calibrated, of the level's pictures; grid: whose box holds the scene."""
        device = rays.pixels.device
        pinholes = Pinholes.of(given, device)
        found = [_inner(rays, given, i) for i in range(len(given))]
        at = [pinholes.through(i, rays.pixels[chosen])[:, :2].float() for i, (chosen, _) in enumerate(found)]
        counts = [len(chosen) for chosen, _ in found]
        focal = given.K[:, [0, 1], [0, 1]]
        deviation = torch.tensor(DEVIATION, dtype=torch.float64).repeat(len(given), 1)
        deviation[:, :2] /= focal
        common, inverse = _similarities(given, grid)
        return Registration(
            torch.cat([chosen for chosen, _ in found]),
            [0, *itertools.accumulate(counts)],
            torch.cat([beside for _, beside in found], 1),
            torch.cat(at),
            focal.float().repeat_interleave(torch.tensor(counts), dim=0).to(device),
            torch.diag_embed((NOISE / deviation) ** 2).to(device),
            (FARTHEST * given.size.amax(1) / focal.mean(1)).to(device),
            common.to(device),
            inverse.to(device),
            pinholes,
        )

    def refined(self, motion: Tensor, rays: RayBatch, color: Tensor, transmittance: Tensor) -> Tensor:
        """The motions [N, 4] (t, s, r; float64) that the rays are aimed by, after what renderings [R, 3], [R] say."""
        through = transmittance[:, None]
        field = torch.cat([color - through * rays.background, through], 1)
        left, right, above, below = (field[index] for index in self.beside)
        slope = torch.stack([right - left, below - above], 2) / 2 * self.focal[:, None]
        slope = slope[:, :3] + rays.background[self.chosen, :, None] * slope[:, 3:]
        (u, v), (x, y) = slope.unbind(2), self.at.split(1, 1)
        residual = (rays.target - color)[self.chosen]
        weight = (ROBUST / residual.abs().clamp(min=ROBUST)).sqrt()
        rows = torch.stack([u, v, u * x + v * y, v * x - u * y, residual], 2) * weight[..., None]
        ends = zip(self.starts, self.starts[1:], strict=False)
        cameras = (rows[begin:end].flatten(0, 1).double() for begin, end in ends)
        products = torch.stack([camera.T @ camera for camera in cameras])
        normal = products[:, :4, :4] + self.prior
        step, _ = torch.linalg.solve_ex(normal, products[:, :4, 4])  # waits for no verdict, unlike `solve`
        total = motion + step
        total = total * (total[:, :2].norm(dim=1) < self.farthest)[:, None]
        return total - (self.common @ (self.inverse @ total.flatten())).view_as(total)


def displacements(given: Cameras, motion: Tensor, grid: TileGrid) -> Tensor:
    """[N, 3] how far shift, zoom and roll of motions [N, 4] move what is seen of the scene, in pixels of these cameras'
    pictures: the latter two what is seen beside the scene's middle."""
    motion, focal = motion.cpu(), given.K[:, [0, 1], [0, 1]]
    seen, radius = _extent(given, grid)
    beside = focal.mean(1) * radius / seen[:, 2].clamp(min=1e-6)
    shift = (motion[:, :2] * focal).norm(dim=1)
    return torch.cat([shift[:, None], motion[:, 2:].abs() * beside[:, None]], 1)


def is_off(moved_by: Tensor) -> bool:
    """Whether displacements [N, 3], in pixels of the level, are those of cameras whose calibration is off."""
    return bool((moved_by.median(dim=0).values > moved_by.new_tensor(OFF)).any())


def moved(cameras: Cameras, motion: Tensor) -> Cameras:
    """The cameras whose pictures have moved by [N, 4], of whatever size they are: x + d(x) = k (cos, -sin; sin, cos) x + t
    is a longer focal length, another principal point and a turn about the line of sight."""
    matrices = _matrices(motion.cpu().double())
    turn = torch.eye(4, dtype=torch.float64).repeat(len(matrices), 1, 1)
    turn[:, :2, :2] = matrices[:, :2, :2] / torch.hypot(matrices[:, 0, 0], matrices[:, 1, 0])[:, None, None]
    K = cameras.K @ torch.linalg.inv(matrices) @ turn[:, :3, :3]
    return Cameras(K, turn.transpose(1, 2) @ cameras.world_to_camera, cameras.size)


def aligned(capture: Capture, motions: Mapping[str, Sequence[float]]) -> Capture:
    """A capture as its cameras look after motions (t, s, r) by name; the others stay."""
    motion = torch.tensor([[*motions.get(name, (0.0,) * 4)] for name in capture.names], dtype=torch.float64)
    found = capture.subset(range(len(capture)))
    found.cameras = moved(capture.cameras, motion)
    return found


def _matrices(motion: Tensor) -> Tensor:
    """[N, 3, 3] x -> x + d(x) on pixels through K^-1, of motions [N, 4]."""
    tx, ty, zoom, roll = motion.unbind(1)
    one, zero = torch.ones_like(zoom), torch.zeros_like(zoom)
    rows = ((one + zoom, -roll, tx), (roll, one + zoom, ty), (zero, zero, one))
    return torch.stack([torch.stack(row, 1) for row in rows], 1)


def _inner(rays: RayBatch, cameras: Cameras, i: int) -> tuple[Tensor, Tensor]:
    """Some rays [M] of camera i, evenly spread, of which all neighbours [4, M] are rays too."""
    width, height = cameras.size[i].tolist()
    part = rays.of_camera(i)
    pixels = rays.pixels[part].long()
    stride = width + 2  # a border without rays: nothing beyond it is a neighbour
    place = (pixels // width + 1) * stride + pixels % width + 1
    number = pixels.new_full(((height + 2) * stride,), -1)
    number[place] = torch.arange(part.start, part.stop, device=pixels.device)
    beside = torch.stack([number[place + step] for step in (-1, 1, -stride, stride)])
    inner = (beside >= 0).all(0).nonzero()[:, 0]
    inner = inner[:: max(1, -(-len(inner) // RAYS))]
    return inner + part.start, beside[:, inner]


def _similarities(cameras: Cameras, grid: TileGrid) -> tuple[Tensor, Tensor]:
    """Motions [4 N, 7] by which pictures follow a shift, turn and growth of the scene about its middle, and the operator
    [7, 4 N] that finds those nearest to given motions, as lengths at the middle of the scene."""
    R = cameras.world_to_camera[:, :3, :3]
    seen, radius = _extent(cameras, grid)
    depth = seen[:, 2].clamp(min=1e-6)
    x, y = (seen[:, :2] / depth[:, None]).unbind(1)
    effect = torch.zeros(len(R), 4, 7, dtype=torch.float64)  # lengths
    effect[:, :2, :3], effect[:, 2, :3] = R[:, :2], -R[:, 2] * (radius / depth)[:, None]
    effect[:, 3, 3:6], effect[:, 2, 6] = R[:, 2] * radius, radius
    # From a motion to lengths: how far it moves what is seen of the middle, and what is `radius` beside it.
    lengths = torch.zeros(len(R), 4, 4, dtype=torch.float64)
    lengths[:, 0, 0] = lengths[:, 1, 1] = depth
    lengths[:, 0, 2], lengths[:, 1, 2] = depth * x, depth * y
    lengths[:, 0, 3], lengths[:, 1, 3] = -depth * y, depth * x
    lengths[:, 2, 2] = lengths[:, 3, 3] = radius
    common = torch.linalg.solve(lengths, effect).flatten(0, 1)
    nearest = torch.linalg.pinv(effect.flatten(0, 1)).view(7, len(R), 4)
    return common, torch.einsum("knj,nji->kni", nearest, lengths).flatten(1)


def _extent(cameras: Cameras, grid: TileGrid) -> tuple[Tensor, float]:
    """Where the cameras see the middle of the scene, [N, 3], and how far from it, on average, there is something to turn
    and to grow."""
    half = torch.tensor(grid.size, dtype=torch.float64) * (4 * grid.voxel_size / 2)
    middle = torch.tensor(grid.origin, dtype=torch.float64) + half
    pose = cameras.world_to_camera
    return pose[:, :3, :3] @ middle + pose[:, :3, 3], float(half.max()) / 2
