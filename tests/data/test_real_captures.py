"""A light look at real captures, in the folder that SURFCAP_DATA names (default ../shared/data)."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import pytest
import torch

from torch_surfcap.data.capture import load_capture

DATA = Path(os.environ.get("SURFCAP_DATA", Path(__file__).resolve().parents[3] / "shared" / "data"))

CAPTURES: dict[str, tuple[dict[str, Any], int, int, str]] = {
    "human_a": ({"scale": 0.25}, 60, 10, "alpha"),
    "human_a_room": ({"scale": 0.25}, 32, 6, "file"),
    "lego": ({"scale": 0.25, "holdout": 8}, 87, 13, "alpha"),
    "dtu_scan65": ({"scale": 0.25}, 49, 0, "file"),
    "middlebury/dinoSparseRing": ({"scale": 0.5}, 16, 0, "threshold"),
    "middlebury/templeSparseRing": ({"scale": 0.5}, 16, 0, "threshold"),
}


@pytest.mark.parametrize("name", CAPTURES)
def test_cameras_look_at_the_subject(name: str) -> None:
    if not (DATA / name).is_dir():
        pytest.skip(f"no {DATA / name}: set SURFCAP_DATA to the folder with the captures")
    options, train, test, source = CAPTURES[name]
    capture = load_capture(DATA / name, **options)
    assert len(capture) == train
    assert (0 if capture.test is None else len(capture.test)) == test
    assert capture.mask_source == source
    assert not capture.warnings
    assert capture.masks is not None
    # the box of the masks' middles: all cameras see one place, and it lies on or near their subject
    sights = []
    for i, mask in enumerate(capture.masks):
        rows, columns = torch.nonzero(mask > 0.5, as_tuple=True)
        middle = torch.stack([columns.double().mean(), rows.double().mean()]) + 0.5
        sights.append(capture.cameras.rays(i, middle[None]))
    origins, directions = (torch.cat(part) for part in zip(*sights, strict=True))
    across = torch.eye(3, dtype=torch.float64) - directions[:, :, None] * directions[:, None]
    place = torch.linalg.solve(across.sum(dim=0), (across @ origins[:, :, None]).sum(dim=0))[:, 0]
    for i, mask in enumerate(capture.masks):
        uv, depth = capture.cameras.project(i, place[None])
        assert depth[0] > 0
        rows, columns = torch.nonzero(mask > 0.5, as_tuple=True)
        reach = max(int(rows.max() - rows.min()), int(columns.max() - columns.min()))
        middle = torch.stack([columns.double().mean(), rows.double().mean()])
        assert float((uv[0] - middle).norm()) < 0.35 * reach
