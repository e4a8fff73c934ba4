"""What callers hand over as arrays, checked and brought to the package's own types. Errors name the camera."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from torch_surfcap.data.cameras import Cameras, calibration_fault
from torch_surfcap.errors import InputError


def float_tensor(image: Tensor) -> Tensor:
    """A uint8 or float32 picture as float32 in [0, 1]."""
    return image / 255 if image.dtype == torch.uint8 else image.float()


def size_text(picture: Tensor) -> str:
    """Width and height for an error message."""
    return f"{picture.shape[1]} x {picture.shape[0]} pixels"


def same_count(count: int, **others: Any) -> None:
    """Raise InputError unless each of `others` that is given has one entry per image."""
    for what, values in others.items():
        if values is not None and len(values) != count:
            raise InputError(f"capture: {len(values)} {what} for {count} images, expected one each")


def as_picture(values: Any, what: str) -> Tensor:
    """[H,W,3 or 4] as uint8 or float32; 16-bit values are divided by 65535."""
    picture = _tensor(values)
    if picture.ndim != 3 or picture.shape[2] not in (3, 4) or picture.numel() == 0:
        raise InputError(f"{what}: shape {list(picture.shape)}, expected [height, width, 3 or 4]")
    return picture


def as_mask(values: Any, what: str) -> Tensor:
    """[H,W] as float32 in [0, 1]; bool and uint8 (0 to 255) are understood."""
    mask = _tensor(values)
    if mask.ndim == 3 and mask.shape[2] == 1:
        mask = mask[:, :, 0]
    if mask.ndim != 2:
        raise InputError(f"{what}: shape {list(mask.shape)}, expected [height, width]")
    return float_tensor(mask).clamp(0.0, 1.0)


def as_cameras(K: Any, world_to_camera: Any, size: Tensor, names: list[str]) -> Cameras:
    """Cameras from K [N,3,3] or [3,3] and world_to_camera [N,4,4] or [N,3,4]."""
    K, pose = _double(K), _double(world_to_camera)
    if K.ndim == 2:
        K = K.expand(len(names), *K.shape).clone()
    if pose.ndim == 3 and pose.shape[1:] == (3, 4):
        last = pose.new_tensor([0.0, 0.0, 0.0, 1.0]).expand(len(pose), 1, 4)
        pose = torch.cat([pose, last], dim=1)
    same_count(len(names), **{"matrices K": K, "matrices world_to_camera": pose})
    if K.shape[1:] != (3, 3) or pose.shape[1:] != (4, 4):
        raise InputError(
            f"capture: K {list(K.shape)} and world_to_camera {list(pose.shape)}, expected [N,3,3] and [N,4,4]"
        )
    for i, name in enumerate(names):
        fault = calibration_fault(K[i], pose[i])
        if fault:
            raise InputError(f"camera {name}: {fault}")
    return Cameras(K, pose, size)


def _double(values: Any) -> Tensor:
    """A matrix, a stack of them or a list of them (tensors or arrays) as one float64 tensor."""
    if not isinstance(values, Tensor):
        values = torch.from_numpy(np.stack([np.asarray(v, dtype=np.float64) for v in values]))
    return values.detach().to("cpu", torch.float64)


def _tensor(values: Any) -> Tensor:
    array = values.detach().cpu().numpy() if isinstance(values, Tensor) else np.asarray(values)
    if array.dtype == np.uint16:
        array = array.astype(np.float32) / np.float32(65535)
    elif array.dtype != np.uint8:
        array = array.astype(np.float32, copy=False)
    return torch.from_numpy(np.ascontiguousarray(array))
