"""What a device tells without being waited for: numbers that come an iteration later, and times between its events.

On the CPU both are there at once.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torch_surfcap.devices import CPU


class Reading:
    """Values on their way to the host, through memory that the device writes to while the host goes on."""

    def __init__(self, values: Tensor) -> None:
        self.values, self.event = values, None
        if values.device.type != "cpu":
            self.values = torch.empty(values.shape, dtype=values.dtype, pin_memory=True)
            self.values.copy_(values, non_blocking=True)
            self.event = _event()

    def wait(self) -> Tensor:
        """The values on the host."""
        if self.event is not None:
            self.event.synchronize()
        return self.values


@dataclass
class Row:
    """A row of the history whose numbers may still be on their way: what is ``known`` comes first, the weighted sum of
    the first ``reading`` is its "loss", then the readings by ``names``."""

    known: dict[str, float]
    reading: Reading | None = None
    names: Sequence[str] = ()
    weights: Sequence[float] = ()

    def read(self) -> dict[str, float]:
        """All of it. Waits for the iteration that it is of."""
        if self.reading is not None:
            values = self.reading.wait()
            losses = values[: len(self.weights)]
            self.known["loss"] = float(losses @ losses.new_tensor(self.weights))
            self.known |= zip(self.names, values.tolist(), strict=True)
            self.reading = None
        return self.known


class Stopwatch:
    """Adds up seconds by kind of work: on the CPU those of the clock, on a device those between its events, which are added
    once it has come there."""

    def __init__(self, seconds: dict[str, float], device: torch.device = CPU) -> None:
        self.seconds, self.on_host = seconds, device.type == "cpu"
        self.last: Any = self._now()
        self.open: deque[tuple[str, Any, Any]] = deque()

    def lap(self, stage: str) -> None:
        """What was done since the last lap is of this kind."""
        now = self._now()
        self.open.append((stage, self.last, now))
        self.last = now
        while self.open and (self.on_host or self.open[0][2].query()):
            self._add(*self.open.popleft())

    def stop(self) -> None:
        """Waits until all laps are added."""
        while self.open:
            self.open[0][2].synchronize()
            self._add(*self.open.popleft())

    def _now(self) -> Any:
        return time.perf_counter() if self.on_host else _event(enable_timing=True)

    def _add(self, stage: str, begin: Any, end: Any) -> None:
        spent = end - begin if self.on_host else 1e-3 * begin.elapsed_time(end)
        self.seconds[stage] = self.seconds.get(stage, 0.0) + spent


def _event(enable_timing: bool = False) -> Any:
    """A moment in the current device's work, from now on."""
    event = torch.cuda.Event(enable_timing=enable_timing)
    event.record()
    return event
