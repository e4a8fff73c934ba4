"""The figure of a section holds what its legend names."""

from pathlib import Path

import cv2
import numpy as np

from tests.surface.shapes import CENTER, ball
from torch_surfcap.figures import SURFACE, write_section
from torch_surfcap.surface.section import INSIDE_COLOR, OUTSIDE_COLOR


def share(picture: np.ndarray, color: np.ndarray) -> float:
    """Part of a picture [H, W, 3] (BGR) that is within 3 of 255 of a colour (RGB, 0 to 1)."""
    return float((np.abs(picture[:, :, ::-1] - 255.0 * color).max(axis=2) <= 3).mean())


def test_section(tmp_path: Path) -> None:
    write_section(tmp_path / "section.png", ball(), 2, CENTER[2], size=400)
    picture = cv2.imread(str(tmp_path / "section.png"))
    assert picture is not None
    height, width = picture.shape[:2]
    assert 350 < height < 520  # of a square section, with its letters; the detail stands beside it
    assert width > 1.7 * height
    surface = np.array([int(SURFACE[k : k + 2], 16) for k in (1, 3, 5)]) / 255
    for color, least in ((INSIDE_COLOR, 0.02), (OUTSIDE_COLOR, 0.02), (surface, 0.002), ((0, 0, 0), 0.01)):
        assert share(np.asarray(picture), np.array(color)) > least
    assert [p.name for p in tmp_path.iterdir()] == ["section.png"]
