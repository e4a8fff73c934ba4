"""The suite's scenes: a description, the true surface, and the capture with plates, masks and held-out views.

Two subjects: the sample scene's figure, and a deep bowl on a foot that no silhouette shows the inside of. Metres.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import lru_cache, partial

import numpy as np
import torch
import trimesh
from numpy.typing import NDArray
from skimage.measure import marching_cubes

from torch_surfcap.data.cameras import Cameras
from torch_surfcap.data.capture import Capture
from torch_surfcap.data.load import in_threads
from torch_surfcap.data.sample_figure import figure_mesh
from torch_surfcap.data.sample_scene import DISTANCE, Coat, render_view, sample_cameras
from torch_surfcap.errors import InputError

Array = NDArray[np.float64]

SUBJECTS = ("figure", "bowl")
RIGS = ("ring", "mixed", "inside")
WRONG = 3  # number of the camera that is out of line, where one is
BOWL = ((0.0, 0.0, 1.05), 0.46, 0.38)  # centre, outer and inner radius
OPENING = (0.0, -0.75, 0.66)  # direction the bowl opens to: a third of the cameras look into it
FOOT = 0.12  # radius
SPACING = 0.01  # of the bowl's marching cubes
WIRE_LENGTH, FINGER_LENGTH, HAIR_LENGTH, HAIR_WIDTH = 0.35, 0.12, 0.08, 0.003
FINGERS = 5
HAIRS = 300
SUNK = 0.03  # depth in the floor of a subject that touches it
LIGHT = (0.5, 0.3, -0.8)  # direction of the light that throws the shadow
SHADE = 0.6  # brightness of what lies in it


@dataclass(frozen=True)
class Scene:
    """What is photographed, and from where.

    subject: one of SUBJECTS. depth: of the bowl, metres. wires: their width in voxels, 0: none. fingers: the width of
    parallel ones, and of the gaps between them, in voxels, 0: none. fringe: hairs all over. second: a ball beside it.
    sunk: it stands in the floor, flat below. shadow: it throws one, and the masks hold it. moment: camera WRONG saw it
    turned by 40 degrees. rig: "ring"; "mixed": distances, focal lengths and sizes that differ several times; "inside":
    one camera stands within the subject's box. size: of the square pictures, pixels.
    """

    subject: str = "figure"
    coat: Coat = field(default_factory=Coat)
    depth: float = 0.2
    wires: float = 0.0
    fingers: float = 0.0
    fringe: bool = False
    second: bool = False
    sunk: bool = False
    shadow: bool = False
    moment: bool = False
    rig: str = "ring"
    views: int = 30
    test_views: int = 4
    size: int = 128
    seed: int = 0

    def __post_init__(self) -> None:
        if self.subject not in SUBJECTS or self.rig not in RIGS:
            raise InputError(
                f"scene: found {self.subject}, {self.rig}, expected one of {SUBJECTS} and one of {RIGS}"
            )

    @property
    def voxel(self) -> float:
        """Edge of the finest voxels of a fit: a pixel's footprint, metres."""
        return DISTANCE / float(sample_cameras(1, self.size).K[0, 0, 0])


def true_surface(scene: Scene) -> trimesh.Trimesh:
    """The closed surface; parts that stand in each other keep what is hidden inside."""
    mesh = _subject(scene.subject, scene.depth)
    parts = [mesh]
    rng = np.random.default_rng(scene.seed)
    top = np.array([0.0, 0.0, mesh.vertices[:, 2].max() - 0.05])
    if scene.fingers:
        width = scene.fingers * scene.voxel
        for i in range(FINGERS):
            foot = top + np.array([2 * width * (i - (FINGERS - 1) / 2), 0.0, 0.0])
            parts.append(_rod(foot, foot + np.array([0.0, 0.0, 0.05 + FINGER_LENGTH]), width))
    if scene.wires:
        for angle in (0.3, 2.4, 4.5):
            tip = np.array([0.6 * np.cos(angle), 0.6 * np.sin(angle), 0.8])
            parts.append(_rod(top, top + WIRE_LENGTH * tip, scene.wires * scene.voxel))
    if scene.fringe:
        points, faces = trimesh.sample.sample_surface(mesh, HAIRS, seed=int(rng.integers(1 << 31)))[:2]
        for start, normal in zip(points, np.asarray(mesh.face_normals)[faces], strict=True):
            parts.append(_rod(start, start + HAIR_LENGTH * normal, HAIR_WIDTH))
    if scene.second:
        ball = trimesh.creation.icosphere(4, 0.13)
        ball.apply_translation((0.72, -0.35, 0.5))
        parts.append(ball)
    before = np.cumsum([0, *(len(part.vertices) for part in parts)])
    vertices = np.concatenate([part.vertices for part in parts])
    faces = np.concatenate([part.faces + first for part, first in zip(parts, before, strict=False)])
    if scene.sunk:
        vertices[:, 2] = np.maximum(vertices[:, 2] - SUNK, 0)
    return trimesh.Trimesh(vertices, faces, process=False)


def photographed(scene: Scene) -> Capture:
    """The capture, with masks and plates and the held-out views, which see the scene as it is and from the plain ring."""
    mesh = true_surface(scene)
    turn = float(np.random.default_rng(scene.seed).uniform(0, 2 * np.pi))
    capture = _taken(scene, mesh, _rig(scene, turn))
    if scene.test_views:
        plain = replace(scene, shadow=False, moment=False)
        capture.test = _taken(plain, mesh, sample_cameras(scene.test_views, scene.size, turn + 0.2))
    return capture


def _taken(scene: Scene, mesh: trimesh.Trimesh, cameras: Cameras) -> Capture:
    turned, shadow = mesh, None
    if scene.moment:
        turned = mesh.copy()
        turned.apply_transform(trimesh.transformations.rotation_matrix(np.radians(40), (0, 0, 1)))
    if scene.shadow:
        shadow = _shadow(mesh)
    for shared in (mesh, turned, shadow):
        _ = shared is not None and (
            shared.vertex_normals,
            shared.ray,
        )  # made once, before the threads share it
    view = partial(_view, scene, mesh, turned, shadow, cameras)
    pictures = zip(*in_threads(view, range(len(cameras))), strict=True)
    images, masks, plates = ([torch.from_numpy(_bytes(picture)) for picture in kind] for kind in pictures)
    return Capture(images, cameras.K, cameras.world_to_camera, masks, plates)


def _view(
    scene: Scene,
    mesh: trimesh.Trimesh,
    turned: trimesh.Trimesh,
    shadow: trimesh.Trimesh | None,
    cameras: Cameras,
    i: int,
) -> tuple[Array, Array, Array]:
    """Photograph, mask and plate of camera i."""
    shown = turned if scene.moment and i == WRONG else mesh
    photograph, mask, plate = render_view(shown, cameras, i, scene.seed, scene.coat)
    if shadow is not None:
        _, dark, _ = render_view(shadow, cameras, i, scene.seed, scene.coat)
        shade = 1 - (1 - SHADE) * (dark * (1 - mask))[:, :, None]
        photograph, mask = photograph * shade, np.maximum(mask, dark)
    return photograph, mask, plate


def _rig(scene: Scene, turn: float) -> Cameras:
    cameras = sample_cameras(scene.views, scene.size, turn)
    K, pose, size = cameras.K.clone(), cameras.world_to_camera.clone(), cameras.size.clone()
    if scene.rig == "mixed":
        rng = np.random.default_rng(scene.seed + 1)
        for i in range(len(cameras)):
            nearer, zoom, scale = rng.uniform(0.65, 1.15), rng.uniform(0.8, 1.25), rng.choice([0.5, 1.0, 1.5])
            pose[i, 2, 3] += (nearer - 1) * DISTANCE  # along the line of sight, on which the target lies
            K[i, :2, :2] *= nearer * zoom  # what fills the picture goes on filling it
            K[i, :2] *= scale
            size[i] = round(scale * scene.size)
    elif scene.rig == "inside":
        pose[WRONG, 2, 3] += 0.3 - DISTANCE  # 0.3 from the target: within the subject's box, beside its trunk
    return Cameras(K, pose, size)


@lru_cache(maxsize=2)
def _subject(name: str, depth: float) -> trimesh.Trimesh:
    return figure_mesh() if name == "figure" else _bowl(depth)


def _bowl(depth: float) -> trimesh.Trimesh:
    """A hollow ball cut open, on a foot that reaches the floor; `depth` goes from the opening to the bottom, metres."""
    center, outer, inner = np.array(BOWL[0]), BOWL[1], BOWL[2]
    margin = (
        0.0337  # no plane of the lattice lies in one of the bowl's, where marching cubes would leave holes
    )
    low, high = center - outer - margin, center + outer + margin
    low[2] = -margin
    axes = [np.arange(a, b, SPACING) for a, b in zip(low, high, strict=True)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1) - center
    radius = np.linalg.norm(points, axis=-1)
    opening = np.array(OPENING) / np.linalg.norm(OPENING)
    shell = np.maximum(np.maximum(radius - outer, inner - radius), points @ opening - (depth - inner))
    pillar = np.linalg.norm(points[..., :2], axis=-1) - FOOT
    height = points[..., 2] + center[2]
    foot = np.maximum(np.maximum(pillar, -height), np.maximum(height - center[2], inner - radius))
    distance = np.minimum(shell, foot)
    vertices, faces, _, _ = marching_cubes(distance, 0.0, spacing=(SPACING,) * 3)
    mesh = trimesh.Trimesh(vertices + low, faces)
    if mesh.volume < 0:
        mesh.invert()
    return mesh


def _rod(start: Array, end: Array, width: float) -> trimesh.Trimesh:
    return trimesh.creation.cylinder(0.5 * width, segment=np.stack([start, end]), sections=8)


def _shadow(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """What of the floor the light does not reach, a hair above it."""
    down = np.array(LIGHT)
    vertices = np.array(mesh.vertices)
    vertices -= (vertices[:, 2:] / down[2]) * down
    vertices[:, 2] = 1e-3
    return trimesh.Trimesh(vertices, mesh.faces, process=False)


def _bytes(picture: Array) -> NDArray[np.uint8]:
    return np.round(255 * np.clip(picture, 0, 1)).astype(np.uint8)
