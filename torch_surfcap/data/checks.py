"""Silhouettes for captures that have none yet or wrong ones, and the cameras that are of no use to a fit."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from torch_surfcap.data.borders import border_offset
from torch_surfcap.data.images import Picture
from torch_surfcap.data.load import in_threads
from torch_surfcap.data.morphology import widened
from torch_surfcap.data.plates import separate
from torch_surfcap.data.silhouettes import black_silhouette, fit_to_background
from torch_surfcap.errors import InputError

if TYPE_CHECKING:
    from torch_surfcap.data.capture import Capture

FEWEST = 3  # cameras; two silhouettes bound a subject, but nothing then checks them
EMPTY, FULL = 1e-5, 0.995  # share of the picture that the subject covers in a mask that says nothing


def prepare(capture: Capture) -> Capture:
    """The capture with silhouettes for every view and without the cameras that see nothing useful.

    Each camera left out is named in `.warnings`; the held-out views are treated alike. Where silhouettes are found by
    plates, the plates of the views to fit become the room in the subject's shadow; held-out views are scored against
    the room as it is. A prepared capture is returned as it is. Raises InputError where silhouettes cannot be found or
    fewer than 3 cameras remain.
    """
    if capture.prepared:
        return capture
    test = capture.test
    sound = _find_masks(capture)
    faults = _faults(sound)
    kept = leave_out(sound, faults)
    if len(kept) < FEWEST:
        first = f" ({next(iter(kept.warnings))})" if faults else ""
        raise InputError(
            f"capture: {len(kept)} usable cameras of {len(capture)}{first}, expected at least {FEWEST}"
        )
    if test is not None:
        test = _find_masks(test, shadows=False)
        kept_test = leave_out(test, _faults(test, subject=meeting_point(kept)))
        kept.warnings += [f"held out: {line}" for line in kept_test.warnings]
        kept_test.prepared = True
        kept.test = kept_test if len(kept_test) else None
    kept.prepared = True
    return kept


def leave_out(capture: Capture, faults: dict[int, str]) -> Capture:
    """A copy without some cameras, given by number with what is wrong; each is named in its warnings."""
    kept = capture.subset([i for i in range(len(capture)) if i not in faults])
    kept.warnings += [f"camera {capture.names[i]} is left out: {why}" for i, why in faults.items()]
    return kept


def _find_masks(capture: Capture, shadows: bool = True) -> Capture:
    """A copy with masks: found by plates, or by a black background, where the capture has none; given ones that are too
    wide or too narrow are found anew by the plates, or corrected where there are none.

    With `shadows` plates that were needed for it become the room in the subject's shadow.
    """
    found = capture.subset(range(len(capture)))
    photographs = [image.numpy() for image in capture.images]
    if capture.masks is not None:
        pixels = _correct_masks(found, photographs)
        if capture.plates is None or not pixels:
            return found
        found.warnings.append(f"{_wrong_by(pixels)}, silhouettes are found by the plates instead")
    if capture.plates is not None:
        plates = [plate.numpy() for plate in capture.plates]
        separated = in_threads(lambda pair: separate(*pair), zip(photographs, plates, strict=True))
        found.masks, rooms = ([torch.from_numpy(x) for x in part] for part in zip(*separated, strict=True))
        found.plates = rooms if shadows else found.plates
        found.mask_source = "plate"
        return found
    masks = in_threads(black_silhouette, photographs)
    bright = [name for name, mask in zip(capture.names, masks, strict=True) if mask is None]
    if 2 * len(bright) > len(masks):
        raise InputError(
            f"capture: no masks, no alpha, no plates, and the background of {len(bright)} of {len(masks)} pictures "
            f"(first: {bright[0]}) is not black, expected one of these to tell the subject from the room"
        )
    found.mask_source = "threshold"
    blank = [torch.zeros(image.shape[:2]) for image in capture.images]
    found.masks = [
        none if mask is None else torch.from_numpy(mask) for mask, none in zip(masks, blank, strict=True)
    ]
    return found


def _correct_masks(capture: Capture, photographs: list[Picture]) -> int:
    """By how many pixels the masks end within the subject (beyond it where negative); those before a background of one
    colour or, without plates, any other are corrected."""
    assert capture.masks is not None
    masks, pixels = [mask.numpy() for mask in capture.masks], None
    if capture.plates is None:
        fitted, pixels = fit_to_background(photographs, masks)
    if pixels is None:  # alpha goes with its colours, which end nowhere
        pixels = border_offset(photographs, masks) if capture.mask_source == "file" else 0
        fitted = [widened(mask, pixels) for mask in masks] if pixels else masks
    if pixels and capture.plates is None:
        capture.masks = [torch.from_numpy(mask) for mask in fitted]
        capture.warnings.append(f"{_wrong_by(pixels)}, corrected")
    return pixels


def _wrong_by(pixels: int) -> str:
    what = "cut a part of the subject off" if pixels > 0 else "include the background"
    return f"masks: {what}, by up to {abs(pixels)} pixels"


def _faults(capture: Capture, subject: Tensor | None = None) -> dict[int, str]:
    """Camera number -> why it is of no use. `subject` [3] is where the cameras look, found here by default."""
    faults: dict[int, str] = {}
    for i, why in enumerate(in_threads(lambda i: _picture_fault(capture, i), range(len(capture)))):
        if why:
            faults[i] = why
    good = [i for i in range(len(capture)) if i not in faults]
    if subject is None and len(good) >= FEWEST:
        subject = meeting_point(capture.subset(good))
    if subject is not None:
        away = {i: why for i in good if (why := _pose_fault(capture, i, subject))}
        # where many cameras seem to look elsewhere the convention is wrong, not the cameras: train/check.py tells
        if 3 * len(away) <= len(good):
            faults.update(away)
    return dict(sorted(faults.items()))


def _picture_fault(capture: Capture, i: int) -> str | None:
    assert capture.masks is not None
    image, mask = capture.images[i].numpy(), capture.masks[i].numpy()
    low, high = float(image.min()), float(image.max())  # NaN where there is one
    if not np.isfinite([low, high]).all():
        return "broken, its picture holds NaN or infinite values"
    if not np.isfinite([mask.min(), mask.max()]).all():
        return "broken, its mask holds NaN or infinite values"
    level = 255.0 if image.dtype == np.uint8 else 1.0
    measured = capture.mask_source in ("plate", "threshold")
    if high - low < 0.01 * level and (measured or high < 0.01 * level):
        return f"blind, its picture is one colour ({low / level:.2f})"
    covered = float(np.count_nonzero(mask > 0.5)) / mask.size
    if covered <= EMPTY:
        return "empty, its mask holds no subject"
    if covered >= FULL:
        return "full, its mask holds no background"
    return None


def _sight(capture: Capture, i: int) -> tuple[Tensor, Tensor]:
    """Camera i's centre [3] and the unit direction [3] to the middle of its mask."""
    assert capture.masks is not None
    subject = capture.masks[i].numpy() > 0.5
    u, v = (
        np.arange(n) @ subject.sum(axis=axis) / subject.sum() + 0.5
        for axis, n in enumerate(subject.shape[::-1])
    )
    middle = torch.tensor([u, v], dtype=torch.float64)
    origins, directions = capture.cameras.rays(i, middle[None])
    return origins[0], directions[0]


def meeting_point(capture: Capture) -> Tensor:
    """[3] the point nearest to all cameras' lines to the middle of their masks.

    Nearest by the sum of distances, not of their squares, so that one wrong camera does not move it.
    """
    sights = [_sight(capture, i) for i in range(len(capture))]
    origins, directions = (torch.stack(part) for part in zip(*sights, strict=True))
    across = torch.eye(3, dtype=torch.float64) - directions[:, :, None] * directions[:, None, :]
    weight = torch.ones(len(origins), dtype=torch.float64)
    point = origins.mean(dim=0)
    scale = float((origins - point).norm(dim=1).mean()) + 1e-12
    for _ in range(30):
        A = (weight[:, None, None] * across).sum(dim=0) + 1e-9 * torch.eye(3, dtype=torch.float64)
        b = (weight[:, None, None] * across @ origins[:, :, None]).sum(dim=0)[:, 0] + 1e-9 * origins.mean(
            dim=0
        )
        point = torch.linalg.solve(A, b)
        miss = (across @ (point - origins)[:, :, None])[:, :, 0].norm(dim=1)
        weight = 1.0 / (miss + 1e-3 * scale)
    return point


def _pose_fault(capture: Capture, i: int, subject: Tensor) -> str | None:
    uv, depth = capture.cameras.project(i, subject[None])
    if depth[0] <= 0:
        return "blind, it looks away from what the others see"
    size = capture.cameras.size[i].to(torch.float64)
    beyond = torch.maximum(-uv[0], uv[0] - size) / size
    if beyond.max() > 0.5:
        return f"broken, what the others see lies {float(beyond.max()):.1f} picture sizes outside its picture"
    return None
