"""Films are read back frame by frame."""

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from PIL import Image

from torch_surfcap.errors import InputError
from torch_surfcap.movie import film_suffix, frames_in, write_film

SIZE = (64, 48)
LEVELS = [0.1, 0.4, 0.7, 1.5]  # the last is clipped

encodes = pytest.mark.skipif(film_suffix(SIZE) != ".mp4", reason="this OpenCV has no codec for MP4")


def frame(level: float) -> torch.Tensor:
    picture = torch.zeros(SIZE[1], SIZE[0], 3)
    picture[..., 0] = level
    return picture


@encodes
def test_mp4(tmp_path: Path) -> None:
    path = tmp_path / "new" / "film.mp4"
    with write_film(path, SIZE) as add:
        for level in LEVELS:
            add(frame(level))
    assert frames_in(path) == len(LEVELS)
    film = cv2.VideoCapture(str(path))
    for level in LEVELS:
        picture = np.asarray(film.read()[1])
        assert picture.shape == (SIZE[1], SIZE[0], 3)
        assert picture.mean((0, 1))[::-1] == pytest.approx([255 * min(level, 1.0), 0, 0], abs=6)
    assert [p.name for p in path.parent.iterdir()] == ["film.mp4"]


def test_gif(tmp_path: Path) -> None:
    path = tmp_path / "film.gif"
    with write_film(path, SIZE) as add:
        for level in LEVELS:
            add(frame(level))
    with Image.open(path) as film:
        assert getattr(film, "n_frames", 1) == len(LEVELS)
        for i, level in enumerate(LEVELS):
            film.seek(i)
            picture = np.asarray(film.convert("RGB"))
            assert picture.mean((0, 1)) == pytest.approx([255 * min(level, 1.0), 0, 0], abs=2)
    assert len(list(tmp_path.iterdir())) == 1


@pytest.mark.parametrize("name", ["film.mp4", "film.gif"])
def test_a_broken_off_film_leaves_nothing(tmp_path: Path, name: str) -> None:
    def break_off() -> None:
        with write_film(tmp_path / name, SIZE) as add:
            add(frame(0.5))
            raise RuntimeError

    with pytest.raises(RuntimeError):
        break_off()
    assert list(tmp_path.iterdir()) == []


@encodes
def test_frames_that_the_codec_drops_are_noticed(tmp_path: Path) -> None:

    def write_two_sizes() -> None:
        with write_film(tmp_path / "film.mp4", SIZE) as add:
            add(frame(0.5))
            add(frame(0.5)[:10])

    with pytest.raises(InputError, match="1 of 2 frames could be encoded"):
        write_two_sizes()
    assert list(tmp_path.iterdir()) == []
