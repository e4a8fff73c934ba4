"""Subject, shadow and room told apart by a picture of the empty room: exposure, noise, compression, doubt."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from tests.data.rigs import HEIGHT, WIDTH, disc, rig_cameras
from torch_surfcap.data.capture import Capture
from torch_surfcap.data.checks import prepare
from torch_surfcap.data.plates import exposure, separate

Array = NDArray[np.float32]
SIZE = (200, 160)
GAIN, BIAS = 1.15, -0.03


def room(seed: int = 0) -> Array:
    """[H,W,3] a wall in soft colours."""
    coarse = np.random.default_rng(seed).random((32, 40, 3), dtype=np.float32)
    return np.clip(0.2 + 0.5 * cv2.resize(coarse, SIZE, interpolation=cv2.INTER_CUBIC), 0, 1)


def figure() -> NDArray[np.bool_]:
    """[H,W] a body on two legs."""
    drawn = np.zeros(SIZE[::-1], np.uint8)
    cv2.ellipse(drawn, (90, 55), (26, 40), 0, 0, 360, 1, -1)
    for x in (76, 104):
        cv2.line(drawn, (x, 80), (x, 130), 1, 9)
    return drawn > 0


def shade() -> Array:
    """[H,W,3] the factor of a shadow that begins at the feet, has a penumbra and leaves more red than blue: 0.45 at its
    darkest."""
    drawn = np.zeros(SIZE[::-1], np.float32)
    cv2.ellipse(drawn, (112, 133), (48, 10), 4, 0, 360, 1.0, -1)
    soft = cv2.GaussianBlur(drawn, (0, 0), 2.0)
    return (1 - soft[:, :, None] * np.array([0.52, 0.54, 0.55], np.float32)).astype(np.float32)


def photograph(plate: Array, noise: float, seed: int = 1) -> Array:
    """[H,W,3] the figure and its shadow before the room, at another exposure."""
    picture = np.where(figure()[:, :, None], np.array([0.8, 0.3, 0.1], np.float32), shade() * plate)
    grain = noise * np.random.default_rng(seed).standard_normal(plate.shape)
    return np.clip(GAIN * picture + BIAS + grain, 0, 1).astype(np.float32)


def compressed(picture: Array) -> NDArray[np.uint8]:
    """As a JPEG of quality 92 keeps it."""
    _, data = cv2.imencode(".jpg", np.rint(255 * picture).astype(np.uint8), [cv2.IMWRITE_JPEG_QUALITY, 92])
    return np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR), np.uint8)


def grown(mask: NDArray[np.bool_], pixels: int) -> NDArray[np.bool_]:
    return cv2.dilate(mask.astype(np.uint8), np.ones((2 * pixels + 1, 2 * pixels + 1), np.uint8)) > 0


@pytest.mark.parametrize(("noise", "jpeg"), [(0.003, False), (0.01, False), (0.01, True), (0.02, False)])
def test_the_shadow_is_out_and_the_subject_is_in(noise: float, jpeg: bool) -> None:
    plate = room()
    pictures = [photograph(plate, noise), plate]
    mask, _ = separate(*(compressed(x) for x in pictures)) if jpeg else separate(*pictures)
    found, subject = mask > 0.5, figure()
    inner = ~grown(~subject, 1)
    assert (inner & ~found).sum() <= 0.003 * subject.sum()  # what is lost would be carved away for good
    fat = found & ~grown(subject, 2)
    assert fat.sum() <= 0.01 * subject.sum()
    assert (found & subject).sum() / (found | subject).sum() > 0.93


def test_the_room_in_shadow_is_what_the_photograph_shows_beside_the_subject() -> None:
    plate, noise = room(), 0.01
    picture = photograph(plate, noise)
    _, shadowed = separate(picture, plate)
    outside = ~grown(figure(), 2)
    truth = GAIN * shade() * plate + BIAS
    dark = outside & (shade()[:, :, 1] < 0.8)
    before = np.abs(GAIN * plate + BIAS - truth)[dark].mean()
    assert np.abs(shadowed - truth)[dark].mean() < 0.15 * before
    lit = outside & (shade()[:, :, 1] > 0.999)
    assert np.abs(shadowed - truth)[lit].mean() < noise
    # behind the feet the shadow goes on; behind the chest there is none to go on
    behind = figure() & (shade()[:, :, 1] < 0.5)
    assert np.median((shadowed / np.maximum(truth, 0.05))[behind]) < 1.35
    chest = np.s_[45:65, 80:100]
    np.testing.assert_allclose(shadowed[chest], truth[chest], atol=0.02)


def test_eight_bit_plates_stay_so() -> None:
    plate = room()
    picture = compressed(photograph(plate, 0.01))
    mask, shadowed = separate(picture, compressed(plate))
    assert mask.dtype == np.float32
    assert shadowed.dtype == np.uint8
    assert shadowed.shape == picture.shape


def test_a_grey_thing_before_a_grey_wall_is_no_shadow() -> None:
    rng = np.random.default_rng(0)
    plate = np.clip(0.6 + 0.01 * rng.standard_normal((*SIZE[::-1], 3)), 0, 1).astype(np.float32)
    picture = np.where(figure()[:, :, None], 0.36, 0.6) + 0.01 * rng.standard_normal(plate.shape)
    mask, _ = separate(picture.astype(np.float32), plate)
    assert mask[figure()].mean() > 0.98


def test_half_a_picture_full_of_subject_does_not_set_the_exposure() -> None:
    plate = room()
    picture = GAIN * plate + BIAS
    picture[:, :90] = (0.9, 0.2, 0.15)
    gain, bias = exposure(picture, plate)
    np.testing.assert_allclose(gain, GAIN, atol=0.005)
    np.testing.assert_allclose(bias, BIAS, atol=0.003)


def test_the_exposure_of_a_noisy_pair_with_subject_and_shadow() -> None:
    plate = room()
    noisy = plate + 0.02 * np.random.default_rng(2).standard_normal(plate.shape)
    gain, bias = exposure(photograph(plate, 0.02), noisy.astype(np.float32))
    np.testing.assert_allclose(gain, GAIN, atol=0.015)
    np.testing.assert_allclose(bias, BIAS, atol=0.01)


def test_the_fit_gets_the_room_in_shadow_and_held_out_views_the_room() -> None:
    cameras, rng = rig_cameras(), np.random.default_rng(0)
    plate = rng.integers(60, 200, (HEIGHT, WIDTH, 3), dtype=np.uint8)
    shadow = np.ones((HEIGHT, WIDTH, 1), np.float32)
    shadow[-8:] = 0.6
    pictures = []
    for i in range(len(cameras)):
        subject = disc(cameras, i)[:, :, None] > 0
        pictures.append(
            np.where(subject, np.array([250, 20, 10], np.uint8), (shadow * plate).astype(np.uint8))
        )
    plates = [plate] * len(pictures)
    capture = Capture(pictures, cameras.K, cameras.world_to_camera, plates=plates)
    capture.test = Capture(pictures, cameras.K, cameras.world_to_camera, plates=plates)
    ready = prepare(capture)
    assert ready.mask_source == "plate"
    assert ready.test is not None
    corner = np.s_[-4:, :4]
    for fitted, scored in zip(ready.plates or [], ready.test.plates or [], strict=True):
        np.testing.assert_allclose(fitted[corner].numpy(), 0.6 * plate[corner], atol=12)
        assert torch.equal(scored, torch.from_numpy(plate))
    for i, mask in enumerate(ready.masks or []):
        inside = disc(cameras, i) > 0
        assert mask.numpy()[inside].mean() > 0.9
