"""A finished run made by hand, for the commands that read one."""

import json
import math
from pathlib import Path

import cv2
import numpy as np
import torch

from tests.surface.shapes import CENTER
from torch_surfcap import config as settings
from torch_surfcap import report
from torch_surfcap.data.cameras import Cameras
from torch_surfcap.field.field import SurfaceField
from torch_surfcap.surface.extract import extract_mesh
from torch_surfcap.surface.render import mesh_mask, volume

SIZE, FOCAL, AWAY = 48, 70.0, 2.0


def camera_to_world(angle: float) -> np.ndarray:
    """OpenGL axes: on a circle about the ball, looking at its centre."""
    back = np.array([math.cos(angle), math.sin(angle), 0.0])
    up = np.array([0.0, 0.0, 1.0])
    pose = np.eye(4)
    pose[:3, :3] = np.stack([np.cross(up, back), up, back], axis=1)
    pose[:3, 3] = CENTER + AWAY * back
    return pose


def write_run(base: Path, field: SurfaceField) -> None:
    """base/scene, a capture of the field about CENTER with 8 views and 3 held out, and base/run, which fits it perfectly."""
    mesh = extract_mesh(field)
    K = torch.tensor([[FOCAL, 0, SIZE / 2], [0, FOCAL, SIZE / 2], [0, 0, 1]], dtype=torch.float64)
    for split, count, turn in (("train", 8, 0.0), ("test", 3, 0.3)):
        frames = []
        (base / "scene" / split).mkdir(parents=True)
        for i in range(count):
            pose = camera_to_world(turn + 2 * math.pi * i / count)
            to_camera = torch.from_numpy(np.linalg.inv(pose @ np.diag([1.0, -1, -1, 1])))
            cameras = Cameras(K[None], to_camera[None], torch.tensor([[SIZE, SIZE]]))
            alpha = mesh_mask(mesh, cameras, 0)
            color = volume(field, cameras, 0, 1.0).clamp(0, 1)
            rgba = (255 * torch.cat([color.flip(-1), alpha[..., None]], -1)).round().byte().numpy()
            cv2.imwrite(str(base / "scene" / split / f"{i}.png"), rgba)
            frames.append({"file_path": f"{split}/{i}", "transform_matrix": pose.tolist()})
        angle = 2 * math.atan(SIZE / 2 / FOCAL)
        text = json.dumps({"camera_angle_x": angle, "frames": frames})
        (base / "scene" / f"transforms_{split}.json").write_text(text)
    settings.save(settings.load(None, [f"data.path={base / 'scene'}"]), base / "run" / "config.yaml")
    field.save(base / "run" / "field.npz")
    report.write_mesh(base / "run" / "mesh.ply", mesh)
