"""One run of the suite: a scene under a condition, fitted and scored against the truth, beside the soft hull."""

from __future__ import annotations

import hashlib
import json
import resource
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh
from torch import Tensor

from torch_surfcap import report, soundness
from torch_surfcap.data.capture import Capture
from torch_surfcap.data.checks import prepare
from torch_surfcap.data.files import atomic_write
from torch_surfcap.data.sample_scene import Coat
from torch_surfcap.distance import SurfaceDistance
from torch_surfcap.errors import InputError
from torch_surfcap.field.hull import find_box
from torch_surfcap.fitting.fit import fit
from torch_surfcap.metrics import surface_scores
from torch_surfcap.studies.ablation import program_digest
from torch_surfcap.studies.stress.condition import Condition
from torch_surfcap.studies.stress.scene import Scene, photographed, true_surface

SAMPLES = 50_000  # of a surface
CUT = 0.05  # longest distance that counts, metres
DEEP = 1.5  # voxels within the clean hull from which on a point of the surface is concave
NO_PART_OF_A_TRIAL = ("page.py",)
Examine = Callable[[Capture], Sequence[str]]  # what train/check.py finds


def key_of(scene: Scene, condition: Condition) -> str:
    """Of a run: changes with the program, the scene and the condition."""
    files = sorted(f for f in Path(__file__).parent.glob("*.py") if f.name not in NO_PART_OF_A_TRIAL)
    sources = [hashlib.sha256(file.read_bytes()).hexdigest() for file in files]
    return _digest([program_digest(), sources, asdict(scene), condition.group, condition.title])


def run_trial(
    scene: Scene,
    condition: Condition,
    cache: Path,
    out: Path,
    clean: trimesh.Trimesh | None = None,
    examine: Examine | None = None,
    **settings: Any,
) -> dict[str, Any]:
    """Fit and score; lengths in the answer are millimetres of the scene as it was before it was moved.

    cache: folder of photographed scenes. out: takes mesh.ply. clean: mesh of the clean run, to measure how far this one
    is from it. settings: of the fit, before the condition's.
    """
    scene = condition.scene(scene)
    capture = condition.capture(photographed_once(scene, cache))
    truth, points = _reference(scene, cache)
    if condition.threads:
        torch.set_num_threads(condition.threads)
    begin = time.perf_counter()
    result: dict[str, Any] = {"outcome": "fitted", "said": [], "found": []}
    try:
        fitted = fit(capture, **(settings | dict(condition.settings)))
    except InputError as error:
        result |= {"outcome": "refused", "said": [str(error)]}
        fitted = None
    result["seconds"] = time.perf_counter() - begin
    unit = 1 if sys.platform == "darwin" else 1024  # of ru_maxrss, bytes
    result["memory"] = unit * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    back = torch.eye(4) if condition.world is None else torch.linalg.inv(condition.world)
    if fitted is not None:
        result["said"] = [line for line in fitted.warnings if not line.startswith("held out")]
        report.write_mesh(out / "mesh.ply", fitted.mesh)
        mesh = _moved(fitted.mesh, back)
        if not np.isfinite(mesh.vertices).all() or not bool(torch.isfinite(fitted.field.voxels).all()):
            return result | {"outcome": "not finite"}
        if len(mesh.faces) == 0:
            return result | {"outcome": "empty"}
        result |= _scores(mesh, truth, points)
        if capture.test is not None:
            views = report.score_views(fitted.field, fitted.mesh, capture.test, gains=fitted.gains)
            result |= {"psnr": views["psnr_volume"], "psnr_masked": views["psnr_masked"]}
        if clean is not None:
            result["moved_voxels"] = _apart(mesh, clean) / scene.voxel
    result |= {
        f"hull_{name}": value for name, value in _hull_scores(capture, scene, back, truth, points).items()
    }
    if examine is not None:
        try:
            result["found"] = list(examine(prepare(capture)))
        except InputError as error:
            result["found"] = [str(error)]
    return result


def photographed_once(scene: Scene, cache: Path) -> Capture:
    """The scene's capture, from the folder where it has been made before."""
    path = cache / f"{_digest([asdict(scene), program_digest()])}.npz"
    if not path.is_file():
        _save(photographed(scene), path)
    return _load(path)


def _save(capture: Capture, path: Path) -> None:
    """Cameras and 8-bit pictures of either split, each picture an array of its own: their sizes may differ."""
    arrays = dict[str, Any]()
    for split, part in {"train": capture, "test": capture.test}.items():
        if part is not None:
            arrays[f"{split}.K"] = part.cameras.K.numpy()
            arrays[f"{split}.world_to_camera"] = part.cameras.world_to_camera.numpy()
            masks = [report.as_bytes(mask) for mask in part.masks or ()]
            for kind, pictures in (("images", part.images), ("masks", masks), ("plates", part.plates)):
                arrays |= {f"{split}.{kind}.{i:04}": np.asarray(p) for i, p in enumerate(pictures or ())}
    with atomic_write(path) as partial, partial.open("wb") as file:
        np.savez(file, **arrays)


def _load(path: Path) -> Capture:
    """The capture that ``_save`` left there."""
    with np.load(path, allow_pickle=False) as stored:
        arrays = dict(stored)
    parts = {}
    for split in dict.fromkeys(name.partition(".")[0] for name in arrays):
        images, masks, plates = (
            [arrays[name] for name in sorted(arrays) if name.startswith(f"{split}.{kind}.")]
            for kind in ("images", "masks", "plates")
        )
        cameras = arrays[f"{split}.K"], arrays[f"{split}.world_to_camera"]
        parts[split] = Capture(images, *cameras, masks or None, plates or None)
    parts["train"].test = parts.get("test")
    return parts["train"]


def _reference(scene: Scene, cache: Path) -> tuple[trimesh.Trimesh, dict[str, np.ndarray]]:
    """The true surface, points of it that the whole ring of cameras sees, and those of them that no silhouette shows."""
    truth = true_surface(scene)
    ring = replace(
        scene, coat=Coat(), shadow=False, moment=False, rig="ring", views=Scene.views, test_views=0
    )
    path = cache / f"{_digest([asdict(ring), program_digest(), 'points'])}.npz"
    if not path.is_file():
        capture = photographed_once(ring, cache)
        points = np.asarray(trimesh.sample.sample_surface(truth, SAMPLES, seed=0)[0])
        points = points[_visible(points, truth, capture.cameras.centers.numpy())]
        box = find_box(capture)
        cells = int(float((box[1] - box[0]).max()) / scene.voxel)
        depth = SurfaceDistance(soundness.hull_mesh(capture, box, cells))(points, CUT).distance
        with atomic_write(path) as partial, partial.open("wb") as file:
            np.savez(file, visible=points, concave=points[depth > DEEP * scene.voxel])
    with np.load(path) as stored:
        return truth, dict(stored)


def _visible(points: np.ndarray, mesh: trimesh.Trimesh, centers: np.ndarray) -> np.ndarray:
    """[P] whether any camera sees a point of the surface."""
    seen = np.zeros(len(points), bool)
    for center in centers:
        left = np.flatnonzero(~seen)
        toward = center - points[left]
        toward /= np.linalg.norm(toward, axis=1, keepdims=True)
        seen[left] = ~mesh.ray.intersects_any(points[left] + 1e-4 * toward, toward)
    return seen


def _scores(mesh: trimesh.Trimesh, truth: trimesh.Trimesh, points: dict[str, np.ndarray]) -> dict[str, float]:
    scores = surface_scores(
        mesh, truth, points["visible"], points["concave"], CUT, normals_within=CUT, samples=SAMPLES
    )
    return {
        "chamfer": 1000 * scores["chamfer"],
        "concave": 1000 * scores["concave"],
        "pieces": scores["pieces"],
    }


def _hull_scores(
    capture: Capture, scene: Scene, back: Tensor, truth: trimesh.Trimesh, points: dict[str, np.ndarray]
) -> dict[str, float]:
    """Of the soft hull's level 1/2 of the same input; none where there is no hull."""
    try:
        sound = prepare(capture)
        box = find_box(sound)
    except InputError:
        return {}
    voxel = scene.voxel / float(torch.linalg.det(back[:3, :3])) ** (1 / 3)
    hull = soundness.hull_mesh(sound, box, int(min(256, float((box[1] - box[0]).max()) / voxel)))
    return _scores(_moved(hull, back), truth, points) if len(hull.faces) else {}


def _apart(a: trimesh.Trimesh, b: trimesh.Trimesh) -> float:
    """Mean distance between two surfaces, both ways, metres."""
    return surface_scores(a, b, cut=CUT, samples=SAMPLES)["chamfer"]


def _moved(mesh: trimesh.Trimesh, through: Tensor) -> trimesh.Trimesh:
    moved = mesh.copy()
    moved.apply_transform(through.numpy())
    return moved


def _digest(content: Any) -> str:
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:10]
