"""One small synthetic rig, written in every format, for the tests of the readers."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from torch_surfcap.data.cameras import Cameras
from torch_surfcap.data.sample_scene import sample_cameras

WIDTH, HEIGHT, VIEWS = 40, 30, 5
Array = NDArray[np.float64]


def rig_cameras(views: int = VIEWS) -> Cameras:
    """Cameras around a ball at the sample scene's target, with unequal focal lengths and no central axis."""
    cameras = sample_cameras(views, WIDTH)
    cameras.K[:, 0, 0], cameras.K[:, 1, 1] = 45.0, 44.0
    cameras.K[:, 0, 2], cameras.K[:, 1, 2] = 19.25, 15.5
    cameras.size[:, 1] = HEIGHT
    return cameras


def disc(cameras: Cameras, i: int) -> Array:
    """[H,W] uint8 mask: the ball of radius 0.5 that the cameras look at, as camera i sees it."""
    origins, directions = (x.numpy() for x in cameras.rays(i))
    to_center = np.array([0.0, 0.0, 0.92]) - origins
    along = (to_center * directions).sum(axis=1)
    miss = np.linalg.norm(to_center - along[:, None] * directions, axis=1)
    return (255 * (miss < 0.5)).astype(np.uint8).reshape(HEIGHT, WIDTH)


def photograph(cameras: Cameras, i: int, background: int = 0) -> Array:
    """[H,W,3] uint8 (RGB): the ball in bright colours on one grey level."""
    rng = np.random.default_rng(i)
    picture = rng.integers(120, 255, (HEIGHT, WIDTH, 3), dtype=np.uint8)
    return np.where(disc(cameras, i)[:, :, None] > 0, picture, np.uint8(background)).astype(np.uint8)


def write_picture(path: Path, picture: NDArray[Any]) -> None:
    """Write RGB(A) or grey pixels."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if picture.ndim == 3:
        picture = cv2.cvtColor(picture, cv2.COLOR_RGBA2BGRA if picture.shape[2] == 4 else cv2.COLOR_RGB2BGR)
    assert cv2.imwrite(str(path), picture)


def write_transforms(folder: Path, cameras: Cameras | None = None, **changes: Any) -> Path:
    """RGBA pictures and transforms.json; `changes` are merged into the file's top level."""
    cameras = rig_cameras() if cameras is None else cameras
    frames = []
    for i in range(len(cameras)):
        rgba = np.concatenate([photograph(cameras, i), disc(cameras, i)[:, :, None]], axis=2)
        write_picture(folder / f"images/{i:03d}.png", rgba)
        to_world = np.linalg.inv(cameras.world_to_camera[i].numpy()) @ np.diag([1.0, -1.0, -1.0, 1.0])
        frames.append({"file_path": f"./images/{i:03d}", "transform_matrix": to_world.tolist()})
    K = cameras.K[0].tolist()
    content = {"fl_x": K[0][0], "fl_y": K[1][1], "cx": K[0][2], "cy": K[1][2], "w": WIDTH, "h": HEIGHT}
    return write_json(folder / "transforms.json", {**content, "frames": frames, **changes})


def write_rig(folder: Path, cameras: Cameras | None = None) -> Path:
    """Photographs, masks and rig.json."""
    cameras = rig_cameras() if cameras is None else cameras
    entries = []
    for i in range(len(cameras)):
        write_picture(folder / f"{i:03d}.png", photograph(cameras, i))
        write_picture(folder / f"mask/{i:03d}.png", disc(cameras, i))
        pose = cameras.world_to_camera[i].numpy()
        entry = {"name": f"{i:03d}", "image": f"{i:03d}.png", "mask": f"mask/{i:03d}.png"}
        calibration = {"K": cameras.K[i].tolist(), "R": pose[:3, :3].tolist(), "t": pose[:3, 3].tolist()}
        entries.append({**entry, **calibration})
    return write_json(folder / "rig.json", {"cameras": entries})


def write_idr(folder: Path, cameras: Cameras | None = None) -> Path:
    """image/, mask/ and cameras_sphere.npz with projection matrices of odd scale and sign, integer pixel centres."""
    cameras = rig_cameras() if cameras is None else cameras
    matrices = {}
    for i, P in enumerate(_integer_centres(cameras) @ cameras.world_to_camera[:, :3].numpy()):
        write_picture(folder / f"image/{i:06d}.png", photograph(cameras, i))
        write_picture(folder / f"mask/{i:03d}.png", np.repeat(disc(cameras, i)[:, :, None], 3, axis=2))
        matrices[f"world_mat_{i}"] = np.vstack([P * (-1.0) ** i * (1 + i), [0, 0, 0, 1]])
        matrices[f"scale_mat_{i}"] = np.eye(4)
    np.savez(folder / "cameras_sphere.npz", **matrices)  # type: ignore[arg-type]
    return folder / "cameras_sphere.npz"


def write_middlebury(folder: Path, cameras: Cameras | None = None) -> Path:
    """Photographs before black and ball_par.txt, integer pixel centres."""
    cameras = rig_cameras() if cameras is None else cameras
    lines = [str(len(cameras))]
    folder.mkdir(exist_ok=True)
    for i, K in enumerate(_integer_centres(cameras)):
        write_picture(folder / f"ball{i:04d}.png", photograph(cameras, i))
        pose = cameras.world_to_camera[i].numpy()
        values = np.concatenate([K.ravel(), pose[:3, :3].ravel(), pose[:3, 3]])
        lines.append(" ".join([f"ball{i:04d}.png", *(f"{v:.17g}" for v in values)]))
    path = folder / "ball_par.txt"
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def _integer_centres(cameras: Cameras) -> Array:
    K: Array = cameras.K.numpy().copy()
    K[:, :2, 2] -= 0.5
    return K


def write_json(path: Path, content: dict[str, Any]) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content), encoding="utf-8")
    return path


def read_json(path: Path) -> Any:
    return json.loads(path.read_text(encoding="utf-8"))


WRITERS = {"transforms": write_transforms, "rig": write_rig, "idr": write_idr, "middlebury": write_middlebury}
