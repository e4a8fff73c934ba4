"""Captures from arrays: what is accepted, halved, prepared, and refused."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from torch_surfcap.data.capture import Capture
from torch_surfcap.data.checks import prepare
from torch_surfcap.errors import InputError

from .rigs import HEIGHT, VIEWS, WIDTH, disc, photograph, rig_cameras


def ball(background: int = 0, **changes: Any) -> Capture:
    """The ball of rigs.py as arrays."""
    cameras = rig_cameras()
    images = [photograph(cameras, i, background) for i in range(VIEWS)]
    return Capture(
        **{"images": images, "K": cameras.K, "world_to_camera": cameras.world_to_camera, **changes}
    )


def masks() -> list[Any]:
    cameras = rig_cameras()
    return [disc(cameras, i) for i in range(VIEWS)]


def test_arrays_become_a_capture() -> None:
    capture = ball(masks=masks())
    assert len(capture) == VIEWS
    assert capture.train is capture
    assert capture.test is None
    assert capture.names[1] == "001"
    assert capture.cameras.size.tolist() == [[WIDTH, HEIGHT]] * VIEWS
    assert capture.masks is not None
    assert float(capture.masks[0].max()) == 1.0
    photo = capture.photograph(0)
    assert photo.dtype == torch.float32
    torch.testing.assert_close(photo, capture.images[0] / 255)


def test_images_of_different_sizes_and_kinds() -> None:
    rng = np.random.default_rng(0)
    images = [
        rng.random((4, 6, 3)),
        rng.integers(0, 65536, (8, 2, 3)).astype(np.uint16),
        torch.zeros(5, 5, 3, dtype=torch.uint8),
    ]
    K = np.array([[9.0, 0, 3], [0, 9, 2], [0, 0, 1]])
    capture = Capture(images, K, np.tile(np.eye(4), (3, 1, 1))[:, :3])
    assert capture.cameras.size.tolist() == [[6, 4], [2, 8], [5, 5]]
    assert [image.dtype for image in capture.images] == [torch.float32, torch.float32, torch.uint8]
    assert float(capture.images[1].max()) <= 1.0


def test_alpha_becomes_the_mask() -> None:
    images = torch.rand(2, 6, 8, 4, generator=torch.Generator().manual_seed(0))
    capture = Capture(images, torch.eye(3), torch.eye(4).expand(2, 4, 4))
    assert capture.mask_source == "alpha"
    assert capture.masks is not None
    torch.testing.assert_close(capture.masks[1], images[1, :, :, 3])
    torch.testing.assert_close(capture.images[1], images[1, :, :, :3])


def test_halving_commutes_with_compositing() -> None:
    generator = torch.Generator().manual_seed(0)
    image, mask = torch.rand(7, 6, 3, generator=generator), torch.rand(7, 6, generator=generator)
    half = Capture(image[None], torch.eye(3), torch.eye(4)[None], masks=mask[None]).halved()
    assert half.masks is not None
    composite = (mask[:, :, None] * image)[:6].reshape(3, 2, 3, 2, 3).mean(dim=(1, 3))
    torch.testing.assert_close(half.masks[0][:, :, None] * half.images[0], composite)
    assert half.cameras.size.tolist() == [[3, 3]]
    torch.testing.assert_close(half.cameras.K[0, 0, 0], torch.tensor(0.5, dtype=torch.float64))


def test_halving_with_plates_is_a_plain_mean() -> None:
    images = torch.rand(2, 1, 4, 4, 3, generator=torch.Generator().manual_seed(0))
    half = Capture(images[0], torch.eye(3), torch.eye(4)[None], torch.rand(1, 4, 4), images[1]).halved()
    assert half.plates is not None
    expected = images.reshape(2, 1, 2, 2, 2, 2, 3).mean(dim=(3, 5))
    torch.testing.assert_close(half.images[0], expected[0, 0])
    torch.testing.assert_close(half.plates[0], expected[1, 0])


def test_subset_shares_pictures() -> None:
    capture = ball(masks=masks())
    part = capture.subset([4, 0])
    assert part.names == ["004", "000"]
    assert part.images[1].data_ptr() == capture.images[0].data_ptr()


def test_prepare_finds_silhouettes_before_black() -> None:
    capture = prepare(ball())
    assert capture.mask_source == "threshold"
    assert capture.masks is not None
    for mask, truth in zip(capture.masks, masks(), strict=True):
        inside, true = mask.numpy() > 0.5, truth > 0
        assert (inside & true).sum() / (inside | true).sum() > 0.93
    assert prepare(capture) is capture


@pytest.mark.parametrize(
    ("mask", "image", "reason"),
    [
        (0, None, "empty"),
        (1, None, "full"),
        (None, float("nan"), "broken"),
        (None, 0.0, "blind"),
    ],
)
def test_a_useless_camera_is_left_out_and_named(mask: int | None, image: float | None, reason: str) -> None:
    capture = ball(masks=masks())
    assert capture.masks is not None
    if mask is not None:
        capture.masks[2] = torch.full_like(capture.masks[2], mask)
    if image is not None:
        capture.images[2] = torch.full((HEIGHT, WIDTH, 3), image)
    kept = prepare(capture)
    assert kept.names == ["000", "001", "003", "004"]
    assert kept.warnings[0].startswith(f"camera 002 is left out: {reason}")


def test_a_camera_that_looks_away_is_left_out() -> None:
    capture = ball(masks=masks())
    turned = torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0], dtype=torch.float64))
    capture.cameras.world_to_camera[3] = turned @ capture.cameras.world_to_camera[3]
    kept = prepare(capture)
    assert kept.names == ["000", "001", "002", "004"]
    assert "looks away" in kept.warnings[0]


def test_too_few_cameras_remain() -> None:
    capture = ball(masks=masks())
    assert capture.masks is not None
    for i in range(3):
        capture.masks[i] = torch.zeros_like(capture.masks[i])
    with pytest.raises(InputError, match=r"2 usable cameras of 5 .*camera 000.*expected at least 3"):
        prepare(capture)


def test_no_way_to_tell_the_subject() -> None:
    with pytest.raises(InputError, match="no masks, no alpha, no plates"):
        prepare(ball(background=110))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"names": ["a", "a", "b", "c", "d"]}, "camera a: this name is given twice"),
        ({"masks": np.zeros((4, HEIGHT, WIDTH))}, "4 masks for 5 images"),
        (
            {"masks": np.zeros((5, HEIGHT, WIDTH + 1))},
            "mask of camera 000: 41 x 30 pixels, expected the image's 40 x 30",
        ),
        ({"plates": np.zeros((5, HEIGHT - 1, WIDTH, 3))}, "plate of camera 000: 40 x 29 pixels"),
        ({"images": np.zeros((5, 3, HEIGHT, WIDTH))}, "image of camera 000: shape"),
        ({"world_to_camera": np.zeros((4, 4, 4))}, "4 matrices world_to_camera for 5 images"),
        ({"K": np.full((3, 3), np.nan)}, "camera 000: K holds NaN"),
        ({"world_to_camera": np.zeros((5, 4, 4))}, "camera 000: the last row of the pose"),
    ],
)
def test_bad_arrays_are_refused(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        ball(**changes)
