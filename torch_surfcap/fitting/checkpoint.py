"""Checkpoints: all that the rest of a fit depends on, in one file that is complete or absent and holds no pickle.

A fit that goes on from one ends with the same bits as one that was never stopped. What follows from the photographs
(pictures at every size, rays through given pixels, their colours) is made again; what the fit found is kept. A checkpoint
of one device may be gone on from on another, with other random numbers.
"""

from __future__ import annotations

import json
import time
import zipfile
import zlib
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torch_surfcap import codes
from torch_surfcap.data.capture import Capture
from torch_surfcap.data.files import atomic_write
from torch_surfcap.errors import InputError
from torch_surfcap.field.tiles import TileGrid
from torch_surfcap.fitting import view_color
from torch_surfcap.fitting.adam import TileAdam
from torch_surfcap.fitting.color_gain import Exposure
from torch_surfcap.fitting.late import Row
from torch_surfcap.fitting.levels import Level
from torch_surfcap.fitting.plateau import Plateau
from torch_surfcap.fitting.rays import rays_of
from torch_surfcap.fitting.settings import FitSettings
from torch_surfcap.fitting.stage import Stage, Studio, begin_adam, march_of
from torch_surfcap.fitting.view_color import ViewColor
from torch_surfcap.version import VERSION

FREE = ("device", "images")  # where a fit runs may differ between it and its resumption
VIEW = "view_"  # begins the names of what is the view-dependent colour's own


@dataclass
class Record:
    """What a fit has to tell so far. warnings; history: a row per iteration; seconds: of the levels that are done;
    level_bytes: what each level was estimated to need; left_out: cameras, by name, and why; difference: of each camera's
    photograph from what the field shows; shift: by how many pixels each photograph lay beside it when that was judged;
    abandoned: seconds of levels that were begun again."""

    warnings: list[str] = field(default_factory=list)
    history: list[dict[str, float]] = field(default_factory=list)
    seconds: list[dict[str, float]] = field(default_factory=list)
    level_bytes: list[int] = field(default_factory=list)
    left_out: dict[str, str] = field(default_factory=dict)
    difference: dict[str, float] = field(default_factory=dict)
    shift: dict[str, float] = field(default_factory=dict)
    abandoned: float = 0.0


@dataclass
class Saved:
    """What a checkpoint holds. arrays: numpy arrays by name; plain: what JSON can say."""

    arrays: dict[str, np.ndarray[Any, Any]]
    plain: dict[str, Any]

    @property
    def place(self) -> list[int]:
        """[level, iteration], counted from 0: the next one to be done."""
        return [self.plain["number"], self.plain["rule"]["count"]]

    @property
    def label(self) -> str:
        return str(self.plain["label"])

    @property
    def box(self) -> tuple[Tensor, Tensor]:
        low, high = torch.tensor(self.plain["box"], dtype=torch.float64)
        return low, high

    def stage(self, settings: FitSettings, plan: list[Level], studio: Studio) -> Stage:
        """The stage as it was; the studio gets its exposure and random numbers back. On another kind of device, which makes
        others, they begin anew, by seed, level and iteration."""
        device, plain = torch.device(settings.device), self.plain
        arrays = {
            name: torch.from_numpy(a).to(device) for name, a in self.arrays.items() if name != "generator"
        }
        studio.exposure = Exposure(arrays["gain"], arrays["bias"])
        studio.motion, studio.refines = arrays["looked"], plain["refines"]
        studio.look_again()  # the level's rays were gathered so
        studio.motion = arrays["motion"]
        if torch.device(plain["settings"]["device"]).type == device.type:
            studio.generator.set_state(torch.from_numpy(self.arrays["generator"]))
        else:
            level, iteration = self.place
            studio.generator.manual_seed(settings.seed + 1_000_003 * (1000 * level + iteration + 1))
        grid = self._grid(arrays)
        number = plain["number"]
        level, store = plan[number], arrays["store"]
        capture = studio.pictures[level.halvings]
        pixels = arrays["pixels"].split(plain["rays_per_camera"])
        counts = arrays["range_counts"].long()
        offsets = torch.cat([counts.new_zeros(1), counts.cumsum(0)])
        ranges = (offsets, arrays["ranges"]) if settings.descent.visit == "ranges" else None
        rays = rays_of(capture, grid, list(pixels), ranges, settings.descent.bundle, codes.real(store.dtype))
        rays.expose(capture, studio.backdrop, studio.exposure)
        studio.aim(rays, level)
        adam = self._continued(begin_adam(store, settings), arrays)
        march = march_of(settings, level)
        rule = Plateau(**plain["rule"])
        return Stage(
            number,
            level,
            grid,
            store,
            march,
            rays,
            adam,
            rule,
            plain["moved"],
            plain["compared"],
            plain["seconds"],
            self._view(arrays, settings),
            [Row(known) for known in plain["waiting"]],
        )

    def _view(self, arrays: dict[str, Tensor], settings: FitSettings) -> ViewColor | None:
        """The view-dependent colour, where it is on a grid of its own."""
        if "view_store" not in arrays:
            return None
        store = arrays["view_store"]
        adam = self._continued(view_color.begin_adam(store, settings), arrays, VIEW)
        return ViewColor(self._grid(arrays, VIEW), store, adam, arrays["view_depth"])

    def _grid(self, arrays: dict[str, Tensor], prefix: str = "") -> TileGrid:
        x, y, z = self.plain[prefix + "origin"]
        table, coords = arrays[prefix + "table"], arrays[prefix + "coords"]
        return TileGrid(table, coords, (x, y, z), self.plain[prefix + "voxel_size"])

    def _continued(self, adam: TileAdam, arrays: dict[str, Tensor], prefix: str = "") -> TileAdam:
        adam.first, adam.second, adam.t = arrays[prefix + "first"], arrays[prefix + "second"], self.plain["t"]
        return adam


@dataclass
class Checkpoints:
    """Where, and how often, a fit leaves checkpoints.

    path: the file. seconds: least time between two within a level; one is written at every change of level too.
    resume: begin with the one that is there. label: whatever the caller wants to find in it again.
    """

    path: Path
    seconds: float = 60.0
    resume: bool = False
    label: str = ""
    last: float = field(default_factory=time.monotonic)

    def due(self) -> bool:
        return time.monotonic() - self.last >= self.seconds

    def save(
        self,
        settings: FitSettings,
        capture: Capture,
        box: tuple[Tensor, Tensor],
        stage: Stage,
        studio: Studio,
        record: Record,
    ) -> None:
        """Replaces the file."""
        rays = stage.rays
        offsets, ranges = rays.ranges or (torch.zeros(1, dtype=torch.int64), torch.zeros(0, 2))
        plain = {
            "version": VERSION,
            "label": self.label,
            "settings": asdict(settings),
            "cameras": capture.names,
            "number": stage.number,
            "rule": asdict(stage.rule),
            "refines": studio.refines,
            "moved": stage.moved,
            "compared": stage.compared,
            "seconds": stage.seconds,
            "t": stage.adam.t,
            "rays_per_camera": np.diff(rays.camera_starts).tolist(),
            "box": torch.stack(box).tolist(),
            "record": asdict(record),
            "waiting": [row.read() for row in stage.waiting],
        }
        arrays = {
            "pixels": rays.pixels,
            "range_counts": offsets.diff().int(),
            "ranges": ranges,
            "generator": studio.generator.get_state(),
            "gain": studio.exposure.gain,
            "bias": studio.exposure.bias,
            "motion": studio.motion,
            "looked": studio.looked,
        }
        fields = [("", stage.grid, stage.adam)]
        if stage.view:
            fields.append((VIEW, stage.view.grid, stage.view.adam))
            arrays["view_depth"] = stage.view.depth
        for prefix, grid, adam in fields:
            plain |= {prefix + "origin": grid.origin, prefix + "voxel_size": grid.voxel_size}
            kept = {"store": adam.store, "first": adam.first, "second": adam.second}
            kept |= {"table": grid.table, "coords": grid.coords}
            arrays |= {prefix + name: array for name, array in kept.items()}
        data: dict[str, Any] = {name: array.cpu().numpy() for name, array in arrays.items()}
        data["plain"] = np.frombuffer(json.dumps(plain).encode(), dtype=np.uint8)
        with atomic_write(self.path) as partial, open(partial, "wb") as file:
            np.savez(file, **data)
        self.last = time.monotonic()

    def load(self, arrays: bool = True) -> Saved | None:
        """The checkpoint to begin with; None where there is none, or none is wanted. Without ``arrays`` only what it says
        of itself is read.

        Raises InputError for a file that is no checkpoint or another version's.
        """
        if not (self.resume and self.path.exists()):
            return None
        try:
            with np.load(self.path, allow_pickle=False) as data:
                plain = json.loads(bytes(data["plain"]).decode())
                found = {name: data[name] for name in data.files if arrays and name != "plain"}
        except (OSError, EOFError, KeyError, ValueError, zipfile.BadZipFile, zlib.error) as error:
            raise InputError(f"{self.path}: a damaged checkpoint ({error}), expected one of a fit") from error
        if plain["version"] != VERSION:
            raise InputError(
                f"{self.path}: written by version {plain['version']}, expected {VERSION}, this one's"
            )
        return Saved(found, plain)

    def check(self, saved: Saved, settings: FitSettings, capture: Capture) -> None:
        """Raises InputError where a checkpoint is of other settings or other cameras."""
        plain = json.loads(json.dumps(asdict(settings)))
        for name, value in saved.plain["settings"].items():
            if name not in FREE and plain.get(name) != value:
                raise InputError(
                    f"{self.path}: {name} is {value} there and {plain.get(name)} now, expected the same to resume"
                )
        if saved.plain["cameras"] != capture.names:
            raise InputError(f"{self.path}: of other cameras, expected the same capture to resume")
