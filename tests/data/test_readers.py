"""Readers: the same rig in every format is the same rig, and bad files are named in one line."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from torch_surfcap.data.capture import load_capture
from torch_surfcap.errors import InputError

from .rigs import (
    HEIGHT,
    VIEWS,
    WIDTH,
    WRITERS,
    disc,
    photograph,
    read_json,
    rig_cameras,
    write_idr,
    write_json,
    write_middlebury,
    write_picture,
    write_rig,
    write_transforms,
)

SOURCES = {"transforms": "alpha", "rig": "file", "idr": "file", "middlebury": "threshold"}


@pytest.mark.parametrize("format", WRITERS)
@pytest.mark.parametrize("by_file", [False, True])
def test_every_format_gives_the_same_rig(tmp_path: Path, format: str, by_file: bool) -> None:
    path = WRITERS[format](tmp_path)
    capture = load_capture(path if by_file else tmp_path)
    truth = rig_cameras()
    assert capture.format == format
    assert capture.mask_source == SOURCES[format]
    assert capture.masks is not None
    torch.testing.assert_close(capture.cameras.K, truth.K, rtol=0, atol=1e-9)
    torch.testing.assert_close(capture.cameras.world_to_camera, truth.world_to_camera, rtol=0, atol=1e-9)
    assert capture.cameras.size.tolist() == [[WIDTH, HEIGHT]] * VIEWS
    for i in range(VIEWS):
        np.testing.assert_array_equal(capture.images[i].numpy(), photograph(truth, i))
        inside, true = capture.masks[i].numpy() > 0.5, disc(truth, i) > 0
        assert (inside & true).sum() / (inside | true).sum() > (0.93 if format == "middlebury" else 0.999)


@pytest.mark.parametrize("format", WRITERS)
def test_a_missing_picture_is_named(tmp_path: Path, format: str) -> None:
    WRITERS[format](tmp_path)
    picture = sorted(tmp_path.rglob("*2.png"), key=lambda path: "mask" in str(path))[0]
    picture.unlink()
    with pytest.raises(InputError) as error:
        load_capture(tmp_path)
    assert "\n" not in str(error.value)
    expected = (
        "4 pictures" if format == "idr" else f"{picture.stem}"
    )  # IDR numbers its pictures by their order
    assert expected in str(error.value)


def test_a_damaged_picture_is_named(tmp_path: Path) -> None:
    write_rig(tmp_path)
    data = (tmp_path / "001.png").read_bytes()
    for broken in (data[: len(data) // 2], b"", b"no picture at all"):
        (tmp_path / "001.png").write_bytes(broken)
        with pytest.raises(InputError, match=r"001\.png: .*expected a PNG, JPEG or TIFF picture"):
            load_capture(tmp_path)


def test_camera_angle_and_held_out_split(tmp_path: Path) -> None:
    write_transforms(tmp_path)
    content = read_json(tmp_path / "transforms.json")
    frames = content["frames"]
    (tmp_path / "transforms.json").unlink()
    angle = 2 * np.arctan(0.5 * WIDTH / 45.0)
    write_json(tmp_path / "transforms_train.json", {"camera_angle_x": angle, "frames": frames[:3]})
    write_json(tmp_path / "transforms_test.json", {"camera_angle_x": angle, "frames": frames[3:]})
    capture = load_capture(tmp_path, holdout=2)
    assert len(capture) == 3
    assert capture.test is not None
    assert capture.test.names == ["images/003", "images/004"]
    assert "holdout=2 is ignored" in capture.warnings[0]
    expected = [[45.0, 0.0, WIDTH / 2], [0.0, 45.0, HEIGHT / 2], [0.0, 0.0, 1.0]]
    torch.testing.assert_close(capture.cameras.K[0], torch.tensor(expected, dtype=torch.float64))


def test_frames_may_hold_their_own_intrinsics_and_split(tmp_path: Path) -> None:
    write_transforms(tmp_path, test_filenames=["./images/001"])
    content = read_json(tmp_path / "transforms.json")
    content["frames"][2].update(fl_x=50.0, fl_y=51.0, cx=18.0, cy=14.0)
    write_json(tmp_path / "transforms.json", content)
    capture = load_capture(tmp_path)
    assert capture.names == ["images/000", "images/002", "images/003", "images/004"]
    assert capture.cameras.K[1, 1].tolist() == [0.0, 51.0, 14.0]
    assert capture.test is not None
    assert capture.test.names == ["images/001"]


def test_mask_and_plate_paths(tmp_path: Path) -> None:
    write_transforms(tmp_path)
    content, cameras = read_json(tmp_path / "transforms.json"), rig_cameras()
    for i, frame in enumerate(content["frames"]):
        write_picture(tmp_path / f"masks/{i}.png", disc(cameras, i) // 255)  # labels 0 and 1
        write_picture(tmp_path / f"empty/{i}.png", np.full((HEIGHT, WIDTH, 3), 9, np.uint8))
        frame.update(mask_path=f"masks/{i}.png", background_path=f"empty/{i}.png")
    write_json(tmp_path / "transforms.json", content)
    capture = load_capture(tmp_path)
    assert capture.mask_source == "file"
    assert capture.masks is not None
    np.testing.assert_array_equal(capture.masks[3].numpy(), disc(cameras, 3) / 255)
    assert capture.plates is not None
    assert int(capture.plates[0].max()) == 9
    assert load_capture(tmp_path, plates=False).plates is None
    assert load_capture(tmp_path, masks=False).mask_source == "plate"
    del content["frames"][1]["background_path"]
    write_json(tmp_path / "transforms.json", content)
    with pytest.raises(InputError, match="frame 1: no plate for camera images/001"):
        load_capture(tmp_path)


def test_holdout_and_skip(tmp_path: Path) -> None:
    write_rig(tmp_path, rig_cameras(9))
    capture = load_capture(tmp_path, holdout=4, skip=["002", 7])
    assert capture.names == ["001", "003", "005", "006"]
    assert capture.test is not None
    assert capture.test.names == ["000", "004", "008"]


def test_take_spreads_over_the_training_views(tmp_path: Path) -> None:
    write_rig(tmp_path, rig_cameras(9))
    capture = load_capture(tmp_path, holdout=4, skip=["002"], take=3)  # of 001, 003, 005, 006, 007
    assert capture.names == ["001", "003", "006"]
    assert capture.test is not None
    assert capture.test.names == ["000", "004", "008"]
    assert len(load_capture(tmp_path, take=9)) == 9
    with pytest.raises(InputError, match=r"cameras to take: 10 of 9 training views, expected 0 \(all\) to 9"):
        load_capture(tmp_path, take=10)


def test_held_out_cameras_of_a_rig(tmp_path: Path) -> None:
    content = read_json(write_rig(tmp_path))
    content["cameras"][1]["held_out"] = True
    write_json(tmp_path / "rig.json", content)
    capture = load_capture(tmp_path)
    assert capture.names == ["000", "002", "003", "004"]
    assert capture.test is not None
    assert capture.test.names == ["001"]
    assert capture.test.masks is not None


def test_scale_keeps_what_a_point_projects_to(tmp_path: Path) -> None:
    write_rig(tmp_path)
    full, small = load_capture(tmp_path), load_capture(tmp_path, scale=0.5)
    assert small.cameras.size.tolist() == [[20, 15]] * VIEWS
    point = torch.tensor([[0.2, 0.1, 0.8]], dtype=torch.float64)
    torch.testing.assert_close(2 * small.cameras.project(1, point)[0], full.cameras.project(1, point)[0])
    third = load_capture(tmp_path, scale=0.34).cameras
    assert third.size[0].tolist() == [14, 10]
    uv, whole = third.project(1, point)[0], full.cameras.project(1, point)[0]
    torch.testing.assert_close(uv / third.size[1], whole / full.cameras.size[1])


def test_sixteen_bit_grey_and_tiff_pictures(tmp_path: Path) -> None:
    content = read_json(write_rig(tmp_path))
    truth = photograph(rig_cameras(), 0)
    write_picture(tmp_path / "deep.tif", truth.astype(np.uint16) * 257)
    write_picture(tmp_path / "grey.png", truth[:, :, 0].astype(np.uint16) * 257)
    content["cameras"][0]["image"], content["cameras"][1]["image"] = "deep.tif", "grey.png"
    write_json(tmp_path / "rig.json", content)
    capture = load_capture(tmp_path)
    torch.testing.assert_close(capture.images[0], torch.from_numpy(truth).float() / 255)
    torch.testing.assert_close(
        capture.images[1][:, :, 2], torch.from_numpy(truth[:, :, 0].copy()).float() / 255
    )


def test_exif_rotation_is_ignored(tmp_path: Path) -> None:
    image = pytest.importorskip("PIL.Image")
    content = read_json(write_rig(tmp_path))
    exif = image.Exif()
    exif[274] = 6  # turn by a quarter
    image.fromarray(photograph(rig_cameras(), 0)).save(tmp_path / "turned.jpg", exif=exif)
    content["cameras"][0]["image"] = "turned.jpg"
    write_json(tmp_path / "rig.json", content)
    assert load_capture(tmp_path).cameras.size[0].tolist() == [WIDTH, HEIGHT]


def test_cameras_of_different_sizes(tmp_path: Path) -> None:
    content = read_json(write_rig(tmp_path))
    write_picture(tmp_path / "000.png", np.repeat(np.repeat(photograph(rig_cameras(), 0), 2, 0), 2, 1))
    write_picture(tmp_path / "mask/000.png", np.repeat(np.repeat(disc(rig_cameras(), 0), 2, 0), 2, 1))
    content["cameras"][0]["K"] = (np.diag([2.0, 2, 1]) @ np.array(content["cameras"][0]["K"])).tolist()
    write_json(tmp_path / "rig.json", content)
    capture = load_capture(tmp_path, scale=0.5)
    assert capture.cameras.size[:2].tolist() == [[WIDTH, HEIGHT], [WIDTH // 2, HEIGHT // 2]]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"K": [[1, 0], [0, 1]]}, "rig.json, camera 001: K is 2x2, expected 3x3 numbers"),
        ({"K": [[float("nan")] * 3] * 3}, "rig.json, camera 001: K holds NaN"),
        ({"K": [[0, 0, 20], [0, 45, 15], [0, 0, 1]]}, "rig.json, camera 001: K is singular"),
        ({"R": [[1, 0, 0], [0, 1, 0], [0, 0, 2]]}, "rig.json, camera 001: R is no rotation"),
        ({"t": ["a", 0, 0]}, "rig.json, camera 001: t is not numeric"),
        ({"distortion": [0.1]}, "rig.json, camera 001: distortion"),
        ({"held_out": 1}, "held_out is 1, expected true or false"),
        ({"mask_path": "x.png"}, "unknown key mask_path"),
        ({"mask": "absent.png"}, "absent.png: no such file"),
        ({"name": "000"}, "camera 000: this name is given twice"),
    ],
)
def test_bad_rigs_are_refused(tmp_path: Path, change: dict[str, object], message: str) -> None:
    content = read_json(write_rig(tmp_path))
    content["cameras"][1].update(change)
    write_json(tmp_path / "rig.json", content)
    with pytest.raises(InputError, match=message):
        load_capture(tmp_path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"w": WIDTH + 1}, r"000\.png: 40 x 30 pixels, expected 41 x 30 as in .*transforms\.json, frame 0"),
        (
            {"fl_x": None, "frames": [{"file_path": "a"}]},
            "frame 0: keys .*expected file_path and transform_matrix",
        ),
        ({"frames": "none"}, "no list of frames"),
        ({"frames": []}, "no cameras, expected at least 3"),
        ({"camera_model": "OPENCV_FISHEYE"}, "camera model OPENCV_FISHEYE"),
        ({"fl_x": "wide"}, "fl_x is not numeric"),
    ],
)
def test_bad_transforms_are_refused(tmp_path: Path, change: dict[str, Any], message: str) -> None:
    write_transforms(tmp_path, **change)
    with pytest.raises(InputError, match=message):
        load_capture(tmp_path, format="transforms")


def test_singular_and_nan_poses_are_refused(tmp_path: Path) -> None:
    for value, message in ((np.zeros((4, 4)), "singular"), (np.full((4, 4), np.nan), "NaN")):
        content = read_json(write_transforms(tmp_path))
        content["frames"][2]["transform_matrix"] = value.tolist()
        write_json(tmp_path / "transforms.json", content)
        with pytest.raises(InputError, match=f"frame 2: .*{message}"):
            load_capture(tmp_path)


def test_counts_that_differ_are_refused(tmp_path: Path) -> None:
    write_idr(tmp_path / "idr")
    write_picture(tmp_path / "idr/image/000009.png", photograph(rig_cameras(), 0))
    with pytest.raises(InputError, match=r"5 cameras \(world_mat_i\) for 6 pictures"):
        load_capture(tmp_path / "idr")
    path = write_middlebury(tmp_path / "middlebury")
    lines = path.read_text().splitlines()
    path.write_text("\n".join(lines[:-1]))
    with pytest.raises(InputError, match="4 lines of cameras, expected 5"):
        load_capture(path)
    path.write_text("\n".join([*lines[:-1], lines[-1] + " 1"]))
    with pytest.raises(InputError, match="line 6: 22 numbers after"):
        load_capture(path)


def test_what_is_no_capture_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no calibration found, expected transforms"):
        load_capture(tmp_path)
    with pytest.raises(InputError, match="no such file or folder"):
        load_capture(tmp_path / "absent")
    with pytest.raises(InputError, match="format=colmap, expected one of auto"):
        load_capture(tmp_path, format="colmap")
    (tmp_path / "rig.json").write_text("{")
    with pytest.raises(InputError, match=r"rig\.json: no valid JSON"):
        load_capture(tmp_path)
    write_rig(tmp_path)
    with pytest.raises(InputError, match="scale=2, expected"):
        load_capture(tmp_path, scale=2.0)
    with pytest.raises(InputError, match="no camera 003a among 5, did you mean 003"):
        load_capture(tmp_path, skip=["003a"])
