"""Undistortion, shrinking, silhouettes before a black background, files that are complete or absent."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from torch_surfcap.data.files import atomic_write
from torch_surfcap.data.images import shrink, undistort
from torch_surfcap.data.silhouettes import black_silhouette, fit_to_background
from torch_surfcap.errors import InputError

LENS = (-0.25, 0.08, 0.002, -0.001, 0.01)


def spot(u: float, v: float, size: tuple[int, int] = (160, 120)) -> NDArray[np.float32]:
    """[H,W,3] a soft spot whose centre is at pixel position (u, v), the first pixel's centre being (0.5, 0.5)."""
    x, y = np.meshgrid(np.arange(size[0]) + 0.5, np.arange(size[1]) + 0.5)
    picture = np.exp(-((x - u) ** 2 + (y - v) ** 2) / 8)
    return np.repeat(picture[:, :, None], 3, axis=2).astype(np.float32)


def middle(picture: NDArray[np.float32]) -> tuple[float, float]:
    """Where the spot is."""
    weight = picture[:, :, 0].astype(np.float64) ** 2
    x, y = np.meshgrid(np.arange(weight.shape[1]) + 0.5, np.arange(weight.shape[0]) + 0.5)
    return float((weight * x).sum() / weight.sum()), float((weight * y).sum() / weight.sum())


@pytest.mark.parametrize("skew", [0.0, 6.0])
def test_undistorted_points_lie_where_the_pinhole_sees_them(skew: float) -> None:
    K = np.array([[150.0, skew, 83.0], [0.0, 145.0, 57.0], [0.0, 0.0, 1.0]])
    for x, y in ((0.3, 0.2), (-0.35, 0.25), (0.0, -0.3), (-0.4, -0.3)):
        point = np.array([[x, y, 1.0]])
        bent, _ = cv2.projectPoints(point, np.zeros(3), np.zeros(3), np.eye(3), np.array(LENS))
        seen = K @ [*bent.ravel(), 1.0]
        found = middle(undistort(spot(seen[0], seen[1]), K, LENS).astype(np.float32))
        assert found == pytest.approx(tuple((K @ point[0])[:2]), abs=0.08)


def test_weighted_means_keep_composites() -> None:
    rng = np.random.default_rng(0)
    picture, weight = (
        rng.integers(0, 256, (12, 16, 3), dtype=np.uint8),
        rng.random((12, 16), dtype=np.float32),
    )
    weight[:4, :4] = 0
    small = shrink(picture, (8, 6), weight)
    composite = (weight[:, :, None] * picture / 255).reshape(6, 2, 8, 2, 3).mean(axis=(1, 3))
    mean = weight.reshape(6, 2, 8, 2).mean(axis=(1, 3))
    np.testing.assert_allclose(mean[:, :, None] * small, composite, atol=1e-6)
    plain = picture[:2, :2].reshape(4, 3).mean(axis=0) / 255
    np.testing.assert_allclose(small[0, 0], plain, atol=1 / 255)  # no weight: the plain mean


def overlap(mask: NDArray[np.float32], truth: NDArray[np.bool_]) -> float:
    inside = mask > 0.5
    return float((inside & truth).sum() / (inside | truth).sum())


def test_black_silhouette_keeps_shaded_parts() -> None:
    rng = np.random.default_rng(0)
    x, y = np.meshgrid(np.arange(160), np.arange(120))
    subject = (x - 70) ** 2 + (y - 60) ** 2 < 35**2
    light = np.clip(0.95 - 0.008 * np.abs(x - 40), 0.25, 1.0)
    picture = np.where(subject, light, 0.03) + 0.01 * rng.standard_normal(subject.shape)
    picture[20:24, 140:144] = 0.6  # a speck
    picture[58:61, 60:63] = 0.02  # a dark pit
    mask = black_silhouette(np.repeat(np.clip(picture, 0, 1)[:, :, None], 3, axis=2).astype(np.float32))
    assert mask is not None
    assert overlap(mask, subject) > 0.96
    assert mask[22, 142] == 0
    assert mask[59, 61] == 1


def test_a_bright_room_is_not_black() -> None:
    wall = 0.45 + 0.1 * np.random.default_rng(0).random((120, 160, 3), dtype=np.float32)
    assert black_silhouette(wall) is None
    assert black_silhouette(np.zeros((20, 20, 3), np.uint8)) is None


def test_atomic_write_replaces_or_leaves(tmp_path: Path) -> None:
    target = tmp_path / "made" / "result.txt"
    with atomic_write(target) as partial:
        assert partial.parent == target.parent
        assert partial.suffix == ".txt"
        partial.write_text("one")
        assert not target.exists()
    assert target.read_text() == "one"

    def interrupted() -> None:
        with atomic_write(target) as partial:
            partial.write_text("half")
            raise RuntimeError("interrupted")

    with pytest.raises(RuntimeError, match="interrupted"):
        interrupted()
    assert target.read_text() == "one"
    assert [path.name for path in target.parent.iterdir()] == ["result.txt"]


def test_unwritable_folders_are_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with (
        pytest.raises(InputError, match="file: cannot make this folder"),
        atomic_write(tmp_path / "file" / "a.txt"),
    ):
        pass


def test_masks_are_corrected_by_a_background_of_one_colour() -> None:
    x, y = np.meshgrid(np.arange(160), np.arange(160))
    disk, rod = (x - 80) ** 2 + (y - 80) ** 2 < 30**2, (np.abs(y - 80) < 2) & (x > 80) & (x < 140)
    subject = disk | rod
    picture = np.where(subject[..., None], (0.5, 0.2, 0.1), (1.0, 1.0, 1.0)).astype(np.float32)
    picture[50:60, 76:84] = 1.0  # a white place at the subject's border
    true = subject.astype(np.float32)
    for wide in (1, 5):
        ring = np.ones((2 * wide + 1, 2 * wide + 1), np.uint8)
        fat, thin = (change(true, ring).astype(np.float32) for change in (cv2.dilate, cv2.erode))
        (cut,), pixels = fit_to_background([picture], [fat])
        assert pixels == -wide
        assert cut[~subject].sum() == 0
        assert (cut[subject] >= 0.5).mean() > 0.97  # but for the white place
        assert cut[rod].all()
        (grown,), pixels = fit_to_background([picture], [thin])
        assert pixels == wide
        assert grown[~subject].sum() == 0
        assert (grown[disk] >= 0.5).mean() > 0.97
    # Before a background that its border pixels are mixed with, the mask gets their shares.
    shares = cv2.blur(true, (3, 3))
    mixed = shares[..., None] * picture + (1 - shares[..., None])
    (soft,), pixels = fit_to_background([mixed], [cv2.dilate(true, ring).astype(np.float32)])
    assert pixels is not None
    assert pixels < 0
    upper = slice(90, 160)  # away from the white place
    assert np.abs(soft - shares)[upper].mean() < 0.6 * np.abs(true - shares)[upper].mean()
    (same,), pixels = fit_to_background([picture], [true])
    assert pixels == 0
    assert np.array_equal(same, true)


@pytest.mark.parametrize("behind", ["room", "subject", "nothing"])
def test_masks_that_cannot_be_judged_stay(behind: str) -> None:
    mask = np.zeros((90, 90), np.float32)
    mask[5:85, 5:85] = 1.0
    picture = np.zeros((90, 90, 3), np.float32)  # "subject": all black before black
    if behind == "room":
        picture = np.random.default_rng(0).random((90, 90, 3), dtype=np.float32)
    if behind == "nothing":
        mask[:] = 1.0
    (same,), pixels = fit_to_background([picture], [mask])
    assert pixels == (0 if behind == "subject" else None)
    assert np.array_equal(same, mask)
