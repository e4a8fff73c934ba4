"""Saved fields: nothing is lost, and no damaged or contradictory file is taken for one."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from tests.field.test_field import random_field
from torch_surfcap import InputError, SurfaceField


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_file_keeps_everything(dtype: torch.dtype, tmp_path: Path) -> None:
    field = random_field(2, dtype=dtype).to(dtype)
    field.save(tmp_path / "field.npz")
    loaded = SurfaceField.load(tmp_path / "field.npz")
    assert loaded.voxels.dtype == dtype
    assert torch.equal(loaded.voxels, field.voxels)
    assert torch.equal(loaded.table, field.table)
    assert torch.equal(loaded.tile_coords, field.tile_coords)
    assert loaded.frame == field.frame
    assert [p.name for p in tmp_path.iterdir()] == ["field.npz"]


def test_damaged_files_are_refused(tmp_path: Path) -> None:
    """Cut short, flipped bits, an array instead of an archive, pickled objects: one line with the file's name."""
    random_field().save(tmp_path / "good.npz")
    good = (tmp_path / "good.npz").read_bytes()
    flipped = bytearray(good)
    flipped[len(good) // 2] ^= 255
    (tmp_path / "flipped.npz").write_bytes(flipped)
    for i, part in enumerate((0, 1, 10, len(good) // 2, len(good) - 1)):
        (tmp_path / f"cut{i}.npz").write_bytes(good[:part])
    with open(tmp_path / "array.npz", "wb") as file:
        np.save(file, np.zeros(3))
    with np.load(tmp_path / "good.npz") as data:
        content = dict(data)
    np.savez(tmp_path / "object.npz", **{**content, "voxels": np.array([{}], dtype=object)})
    for path in sorted(tmp_path.iterdir()):
        if path.name == "good.npz":
            continue
        with pytest.raises(InputError, match=path.name) as caught:
            SurfaceField.load(path)
        assert "\n" not in str(caught.value)


def test_contradictory_files_are_refused(tmp_path: Path) -> None:
    """The ops read the memory that the table names: a table that names tiles which are not there is refused."""
    random_field().save(tmp_path / "good.npz")
    with np.load(tmp_path / "good.npz") as data:
        content = dict(data)
    table, coords = content["table"], content["tile_coords"]
    beyond, low = table.copy(), table.copy()
    beyond[beyond == 0] = len(coords)
    low[0, 0, 0] = -(2**31)
    wrong: dict[str, dict[str, Any]] = {
        "table: expected the": {"table": beyond},
        "table: expected int32": {"table": table[0]},
        "tile_coords: expected places": {"tile_coords": coords + 9},
        "tile_coords: expected int32": {"tile_coords": coords[:, :2]},
        "voxels: expected": {"voxels": content["voxels"][1:]},
        "voxel_size: expected": {"voxel_size": np.float64(-1.0)},
        "opacity: expected": {"opacity": np.str_("alpha")},
        "format 1, expected 3": {"format": np.int64(1)},
        "step: expected": {"step": np.float64(-1.0)},
        "not enough values": {"origin": content["origin"][:2]},
    }
    for match, change in wrong.items():
        np.savez(tmp_path / "bad.npz", **{**content, **change})
        with pytest.raises(InputError, match=match):
            SurfaceField.load(tmp_path / "bad.npz")
    np.savez(tmp_path / "low.npz", **{**content, "table": low})
    assert torch.equal(SurfaceField.load(tmp_path / "low.npz").table, random_field().table)
