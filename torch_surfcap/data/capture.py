"""A capture: photographs with cameras, and what is known about subject and background."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torch_surfcap.data.arrays import as_cameras, as_mask, as_picture, float_tensor, same_count, size_text
from torch_surfcap.data.cameras import Cameras
from torch_surfcap.data.checks import prepare
from torch_surfcap.data.images import shrink
from torch_surfcap.data.load import evenly, load_views, without
from torch_surfcap.data.readers import read_views
from torch_surfcap.data.view import View
from torch_surfcap.errors import InputError

Pictures = Sequence[Any] | Tensor | np.ndarray


class Capture:
    """Photographs of a subject from calibrated cameras, with silhouettes and pictures of the empty room where known.

    images:          N pictures [H,W,3] or [H,W,4] (straight alpha), uint8, 16 bit or float in [0, 1]; one tensor or,
                     where sizes differ, a list. Alpha becomes the mask unless masks are given
    K:               [N,3,3] (or [3,3] for all), pixels, the first one centred at (0.5, 0.5)
    world_to_camera: [N,4,4] or [N,3,4], OpenCV axes
    masks:           N of [H,W], 1 on the subject, soft edges welcome
    plates:          N pictures [H,W,3] of the empty room
    names:           N unique names, "000", "001", ... by default

    Attributes: .images (list, uint8 or float32), .masks (list of float32, or None until `prepare`), .plates (list or
    None), .names, .cameras, .mask_source ("file", "alpha", "plate", "threshold" or None), .format (of the calibration,
    or "arrays"), .warnings (one sentence each), .test (the held-out views or None), .train (itself).
    Raises InputError where counts, sizes or calibrations do not hold.

    >>> import torch
    >>> K = torch.tensor([[100.0, 0, 32], [0, 100, 24], [0, 0, 1]])
    >>> capture = Capture(torch.zeros(1, 48, 64, 3), K[None], torch.eye(4)[None])
    >>> capture.cameras.size.tolist()
    [[64, 48]]
    """

    def __init__(
        self,
        images: Pictures,
        K: Any,
        world_to_camera: Any,
        masks: Pictures | None = None,
        plates: Pictures | None = None,
        names: Sequence[str] | None = None,
    ) -> None:
        self.names = (
            [f"{i:03d}" for i in range(len(images))] if names is None else [str(name) for name in names]
        )
        same_count(len(images), names=self.names, masks=masks, plates=plates)
        if len(set(self.names)) != len(self.names):
            twice = next(name for name in self.names if self.names.count(name) > 1)
            raise InputError(f"camera {twice}: this name is given twice, expected one name per camera")
        pictures = [
            as_picture(image, f"image of camera {name}")
            for image, name in zip(images, self.names, strict=True)
        ]
        self.images: list[Tensor] = [picture[..., :3].contiguous() for picture in pictures]
        self.mask_source: str | None = "file" if masks is not None else None
        if masks is None and pictures and all(picture.shape[2] == 4 for picture in pictures):
            masks = [picture[..., 3] for picture in pictures]
            self.mask_source = "alpha"
        self.masks: list[Tensor] | None = None
        if masks is not None:
            self.masks = [
                as_mask(mask, f"mask of camera {name}") for mask, name in zip(masks, self.names, strict=True)
            ]
        self.plates: list[Tensor] | None = None
        if plates is not None:
            found = [
                as_picture(plate, f"plate of camera {name}")
                for plate, name in zip(plates, self.names, strict=True)
            ]
            self.plates = [plate[..., :3].contiguous() for plate in found]
        size = torch.tensor([[i.shape[1], i.shape[0]] for i in self.images], dtype=torch.int64).reshape(-1, 2)
        for kind, others in (("mask", self.masks), ("plate", self.plates)):
            for name, image, other in zip(self.names, self.images, others or self.images, strict=True):
                if image.shape[:2] != other.shape[:2]:
                    raise InputError(
                        f"{kind} of camera {name}: {size_text(other)}, expected the image's {size_text(image)}"
                    )
        self.cameras = as_cameras(K, world_to_camera, size, self.names)
        self.format = "arrays"
        self.warnings: list[str] = []
        self.test: Capture | None = None
        self.prepared = False

    def __len__(self) -> int:
        return len(self.images)

    @property
    def train(self) -> Capture:
        """The views that a fit may see: this capture."""
        return self

    def photograph(self, i: int) -> Tensor:
        """Image i as float32 [H,W,3] in [0, 1]."""
        return float_tensor(self.images[i])

    def plate(self, i: int) -> Tensor:
        """Plate i as float32 [H,W,3] in [0, 1]; a capture without plates has none to give (ValueError)."""
        if self.plates is None:
            raise ValueError("this capture has no plates")
        return float_tensor(self.plates[i])

    def subset(self, indices: Sequence[int] | Tensor) -> Capture:
        """The views at `indices`, in that order; pictures are shared, held-out views and warnings stay."""
        chosen = [int(i) for i in indices]
        return self._with(
            images=[self.images[i] for i in chosen],
            masks=None if self.masks is None else [self.masks[i] for i in chosen],
            plates=None if self.plates is None else [self.plates[i] for i in chosen],
            names=[self.names[i] for i in chosen],
            cameras=self.cameras.subset(chosen),
        )

    def on(self, device: torch.device | str) -> Capture:
        """The same views with images, masks and plates on a device; held-out views stay where they are."""
        pictures = (
            None if part is None else [picture.to(device) for picture in part]
            for part in (self.images, self.masks, self.plates)
        )
        images, masks, plates = pictures
        return self._with(images or [], masks, plates, self.names, self.cameras)

    def moved(self, shift: Tensor) -> Capture:
        """The same views, held-out ones too, in a world whose points have all moved by `shift` [3]."""
        moved = self._with(self.images, self.masks, self.plates, self.names, self.cameras.moved(shift))
        moved.test = self.test and self.test.moved(shift)
        return moved

    @property
    def nbytes(self) -> int:
        """Of images, masks and plates."""
        return sum(p.nbytes for part in (self.images, self.masks, self.plates) for p in part or ())

    def halved(self) -> Capture:
        """2x2 means of images, masks and plates, with K/2; an odd last row or column is dropped.

        Without plates the photographs are averaged with their masks as weights, because they will be composited with
        the averaged masks; with plates the mean is plain. The held-out views stay at their size.
        """
        images, masks, plates = [], [], []
        for i, image in enumerate(self.images):
            height, width = image.shape[0] // 2, image.shape[1] // 2
            size, window = (width, height), (slice(2 * height), slice(2 * width))
            mask = None if self.masks is None else self.masks[i][window].numpy()
            weight = mask if self.plates is None else None
            images.append(torch.from_numpy(shrink(image[window].numpy(), size, weight)))
            if mask is not None:
                masks.append(torch.from_numpy(shrink(mask, size)))
            if self.plates is not None:
                plates.append(torch.from_numpy(shrink(self.plates[i][window].numpy(), size)))
        return self._with(images, masks or None, plates or None, self.names, self.cameras.scaled_half())

    def _with(
        self,
        images: list[Tensor],
        masks: list[Tensor] | None,
        plates: list[Tensor] | None,
        names: list[str],
        cameras: Cameras,
    ) -> Capture:
        """A copy that holds these views; they are known to be sound, so nothing is checked again."""
        copy = object.__new__(Capture)
        copy.images, copy.masks, copy.plates = images, masks, plates
        copy.names, copy.cameras = names, cameras
        copy.format, copy.mask_source, copy.test, copy.prepared = (
            self.format,
            self.mask_source,
            self.test,
            self.prepared,
        )
        copy.warnings = list(self.warnings)
        return copy


def load_capture(
    path: str | Path,
    format: str = "auto",
    scale: float = 1.0,
    holdout: int = 0,
    masks: bool = True,
    plates: bool = True,
    skip: Sequence[str | int] = (),
    take: int = 0,
) -> Capture:
    """Read a capture; the result holds the training views, `.test` the held-out ones (or None).

    path:    a folder, or the calibration file itself
    format:  "transforms" (NeRF-synthetic, nerfstudio, instant-ngp), "idr" (IDR, NeuS), "middlebury", "rig" (our JSON),
             or "auto" to find out
    scale:   0 < scale <= 1, pictures made smaller by area means; 1 leaves the pixels alone
    holdout: every so many-th view is held out (8: views 0, 8, 16, ...) where the capture names no held-out views
    masks:   read mask files and alpha; False: find silhouettes by plate or threshold
    plates:  read pictures of the empty room
    skip:    names or numbers of cameras to leave out
    take:    so many of the training views that are left, evenly spread in the capture's order; 0 takes all

    Masks are never None afterwards. Cameras that see nothing useful are left out and named in `.warnings`.
    Raises InputError (one line: file, found, expected) for anything that cannot be used.
    """
    format, views = read_views(Path(path), format)
    named = any(view.held_out for view in views)
    if holdout and not named:
        for view in views[::holdout]:
            view.held_out = True
    views = without(views, skip)
    training = evenly([view for view in views if not view.held_out], take)
    capture = _from_views(training, scale, masks, plates)
    capture.format = format
    if holdout and named:
        capture.warnings.append(f"holdout={holdout} is ignored: the capture itself names its held-out views")
    held_out = [view for view in views if view.held_out]
    if held_out:
        capture.test = _from_views(held_out, scale, masks, plates)
    return prepare(capture)


def _from_views(views: list[View], scale: float, masks: bool, plates: bool) -> Capture:
    read = load_views(views, scale, masks, plates)
    capture = Capture(read.images, read.K, read.world_to_camera, read.masks, read.plates, read.names)
    capture.mask_source = read.mask_source
    return capture
