"""Masks that are wider or narrower than the subject are recognised before any background."""

from __future__ import annotations

from functools import lru_cache

import pytest
import torch

from torch_surfcap import Capture
from torch_surfcap.data.borders import border_offset
from torch_surfcap.data.checks import prepare
from torch_surfcap.data.morphology import widened
from torch_surfcap.studies.stress.scene import Scene, photographed


@lru_cache(maxsize=1)
def figure() -> Capture:
    return photographed(Scene(views=6, test_views=0, size=128))


def with_masks(pixels: int, plates: bool = False) -> Capture:
    """The figure with masks that are so many pixels too wide."""
    found = figure().subset(range(6))
    assert found.masks is not None
    found.masks = [torch.from_numpy(widened(mask.numpy(), pixels)) for mask in found.masks]
    found.plates = found.plates if plates else None
    return found


@pytest.mark.parametrize("pixels", [-3, -2, -1, 0, 1, 2, 3, 8])
def test_offset(pixels: int) -> None:
    capture = with_masks(pixels)
    assert capture.masks is not None
    images, masks = ([picture.numpy() for picture in part] for part in (capture.images, capture.masks))
    assert border_offset(images, masks) == -pixels


def test_nothing_to_tell_it_by() -> None:
    capture = figure()
    assert capture.masks is not None
    blank = [0 * image.numpy() for image in capture.images]
    assert border_offset(blank, [mask.numpy() for mask in capture.masks]) == 0


@pytest.mark.parametrize("pixels", [-2, 3])
def test_corrected_without_plates(pixels: int) -> None:
    given, right = with_masks(pixels), figure().masks
    found = prepare(given)
    assert given.masks is not None
    assert found.masks is not None
    assert right is not None
    before, after = (
        sum(float((a - b).abs().sum()) for a, b in zip(masks, right, strict=True))
        for masks in (given.masks, found.masks)
    )
    assert after < 0.35 * before
    assert [line for line in found.warnings if "masks: " in line and f"by up to {abs(pixels)} pixels" in line]


def test_plates_are_asked_instead() -> None:
    found = prepare(with_masks(-3, plates=True))
    assert found.mask_source == "plate"
    assert "silhouettes are found by the plates instead" in found.warnings[0]


@pytest.mark.parametrize("plates", [False, True])
def test_right_masks_stay(plates: bool) -> None:
    given = with_masks(0, plates)
    found = prepare(given)
    assert given.masks is not None
    assert found.masks is not None
    assert all(torch.equal(a, b) for a, b in zip(given.masks, found.masks, strict=True))
    assert found.warnings == []
    assert found.mask_source == "file"
