"""check.py: a sound capture passes, wrong conventions and wrong cameras are named, bad input is one line."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from torch_surfcap.data.sample_scene import make_sample_scene
from train import check

Pose = NDArray[np.float64]
FLIP = np.diag([1.0, -1.0, -1.0, 1.0])


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_sample_scene(tmp_path_factory.mktemp("sample"), views=10, test_views=0, size=128)


def changed(scene: Path, folder: Path, pose: Callable[[Pose, int], Pose], shift: float = 0.0) -> Path:
    """The scene with other poses in its file, and principal points moved by `shift` pixels."""
    shutil.copytree(scene, folder)
    content = json.loads((scene / "transforms_train.json").read_text())
    content["cx"], content["cy"] = content["cx"] + shift, content["cy"] + shift
    for i, frame in enumerate(content["frames"]):
        frame["transform_matrix"] = pose(np.array(frame["transform_matrix"]), i).tolist()
    (folder / "transforms_train.json").write_text(json.dumps(content))
    return folder


def findings(data: Path, out: Path) -> tuple[int, list[str]]:
    """Exit status and findings of the command."""
    status = check.main([str(data), f"out={out}"])
    return status, json.loads((out / "check.json").read_text())["findings"]


def test_a_sound_capture(scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert findings(scene, tmp_path / "out") == (0, [])
    printed = capsys.readouterr().out.splitlines()
    assert "sound" in printed
    assert sum(line.startswith("train/0") for line in printed) == 10
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"check.json", "check.png", "hull.ply"}
    report = json.loads((tmp_path / "out/check.json").read_text())
    assert all(camera["filled"] > 0.9 for camera in report["cameras"])
    assert report["box"][1][2] == pytest.approx(1.8, abs=0.15)


@pytest.mark.parametrize(
    ("pose", "found"),
    [
        (lambda M, i: M @ FLIP, "camera-to-world with OpenCV axes"),
        (lambda M, i: np.linalg.inv(M @ FLIP), "world-to-camera with OpenCV axes"),
        (lambda M, i: np.linalg.inv(M), "world-to-camera with OpenGL axes"),
    ],
)
def test_wrong_poses_are_named(
    scene: Path, tmp_path: Path, pose: Callable[[Pose, int], Pose], found: str
) -> None:
    status, lines = findings(changed(scene, tmp_path / "data", pose), tmp_path / "out")
    assert status == 1
    expected = f"the poses are {found} where camera-to-world with OpenGL axes is expected"
    assert any(line.startswith(expected) for line in lines)


def test_half_a_pixel_is_named(scene: Path, tmp_path: Path) -> None:
    status, lines = findings(changed(scene, tmp_path / "data", lambda M, i: M, shift=-0.5), tmp_path / "out")
    assert status == 1
    assert any("add 0.5 to them" in line for line in lines)


def test_one_wrong_camera_is_named(scene: Path, tmp_path: Path) -> None:
    def pose(M: Pose, i: int) -> Pose:
        M[:3, 3] += (0.3, 0.2, 0.1) if i == 5 else (0.0, 0.0, 0.0)
        return M

    status, lines = findings(changed(scene, tmp_path / "data", pose), tmp_path / "out")
    assert status == 1
    assert any(line.startswith("camera train/005 alone keeps") for line in lines)


def test_one_dark_picture_is_named(scene: Path, tmp_path: Path) -> None:
    data = changed(scene, tmp_path / "data", lambda M, i: M)
    path = str(data / "train/003.png")
    picture = cv2.imread(path)
    assert picture is not None
    assert cv2.imwrite(path, np.asarray(picture, dtype=np.uint8) // np.uint8(6))
    status, lines = findings(data, tmp_path / "out")
    assert status == 1
    assert [line[:18] for line in lines] == ["camera train/003: "]


def test_bad_input_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for arguments, expected in (
        ([str(tmp_path)], "no calibration found"),
        ([str(tmp_path / "absent")], "no such file or folder"),
        ([str(tmp_path), "data.scael=0.5"], "data.scale"),
    ):
        assert check.main(arguments) == 2
        printed = capsys.readouterr()
        assert len(printed.err.splitlines()) == 1
        assert expected in printed.err
