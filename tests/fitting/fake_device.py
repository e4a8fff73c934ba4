"""Iterations of a fit on a device that is none: tensors have shapes and a device, but no numbers.

    python -m tests.fitting.fake_device KEY=VALUE ...

Exit 0 if the host could queue every iteration without a number of the device's, and all tensors that meet are there. It is
a program of its own, because torch cannot forget a device that was made up.
"""

from __future__ import annotations

import copy
import itertools
import sys
from dataclasses import fields, is_dataclass, replace
from types import SimpleNamespace
from typing import Any

import torch
import yaml
from torch import Tensor
from torch._subclasses.fake_tensor import FakeTensorMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves
from torch.utils.backend_registration import _setup_privateuseone_for_python_backend

from tests.fitting.made_up_device import DEVICE, Moment
from tests.fitting.sphere import ball
from tests.fitting.stages import begun
from torch_surfcap import Cameras, Capture
from torch_surfcap.fitting import descent, late
from torch_surfcap.fitting.adam import TileAdam
from torch_surfcap.fitting.alignment import Registration
from torch_surfcap.fitting.gathered import GatheredGradient
from torch_surfcap.fitting.rays import RayBatch

ROWS = 4


class NoWaiting(TorchDispatchMode):
    """Refuses what FakeTensorMode lets pass although the host or the device would wait: copies between the two, other than
    into pinned memory in the background, host tensors that are looked up by, and masks that choose rows."""

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        out = func(*args, **kwargs)
        tensors = [x for x in tree_leaves((args, kwargs, out)) if isinstance(x, Tensor)]
        there = [x for x in tensors if x.device.type == DEVICE]
        here = [x for x in tensors if x.device.type == "cpu" and (x.dim() > 0 or "copy" in func.__name__)]
        background = kwargs.get("non_blocking") or (func.__name__.startswith("copy_") and args[2:] == (True,))
        if there and here and not (background and args[0].device.type == "cpu"):
            raise RuntimeError(f"{func}: between host and device, {[tuple(x.shape) for x in here]}")
        if there and func.__name__.startswith("index") and any(x.dtype == torch.bool for x in there[1:]):
            raise RuntimeError(f"{func}: rows chosen by a mask")
        return out


def moved(value: Any) -> Any:
    """A copy whose tensors are on the device."""
    if isinstance(value, Tensor):
        return torch.empty(value.shape, dtype=value.dtype, device=DEVICE)
    if isinstance(value, (list, tuple)) and not hasattr(value, "_fields"):
        return type(value)(moved(item) for item in value)
    if isinstance(value, (Capture, TileAdam, GatheredGradient)):
        there = copy.copy(value)
        vars(there).update({name: moved(item) for name, item in vars(value).items()})
        return there
    if isinstance(value, torch.Generator):
        return None
    if is_dataclass(value) and not isinstance(value, (type, Cameras)):
        parts = {f.name: getattr(value, f.name) for f in fields(value)}
        return replace(value, **{name: moved(part) for name, part in parts.items()})
    return value


def iterate(plates: bool = False, **given: Any) -> int:
    """So many rows of the history came."""
    stage, studio, settings = begun(ball(6, 24, plates), 0.06, 30, gains="on", **given)
    real = None
    if settings.gradient == "gather":
        real = GatheredGradient(stage.rays, stage.grid, settings, stage.march)
    registration = Registration.of(stage.rays, studio.given[0], stage.grid)
    studio.refines = True
    count = stage.rays.samples(stage.march.step)

    def told(row: late.Row) -> dict[str, float]:
        return row.known | {"loss": 1.0}

    patched: Any = RayBatch
    patched.samples = lambda self, step: count
    patched = late
    patched._event, patched.Row.read = lambda enable_timing=False: Moment(), told
    patched = descent
    with FakeTensorMode(), NoWaiting():
        stage, studio = moved(stage), moved(studio)
        stage.number = 1  # gains are fitted from the first iteration on
        if real is not None:
            there = moved(real)
            there.rays = stage.rays
            patched.GatheredGradient = lambda *_: there
        known = moved(registration)
        patched.Registration = SimpleNamespace(of=lambda *_: known)
        return len(list(itertools.islice(descent.descend(stage, studio, settings), ROWS)))


def refuses() -> int:
    """How many of six things that wait are seen."""
    found = 0
    with FakeTensorMode(), NoWaiting():
        x = torch.zeros(3, device=DEVICE)
        for wait in (
            lambda: float(x.sum()),
            lambda: x[x > 0],
            lambda: x + torch.tensor([1.0, 2.0, 3.0]),
            lambda: x.cpu(),
            lambda: torch.tensor([1.0, 2.0]).to(DEVICE),
            lambda: x[torch.tensor([0, 1])],
        ):
            try:
                wait()
            except (RuntimeError, NotImplementedError) as error:
                found += 1
                print(type(error).__name__, str(error)[:80])
    return found


if __name__ == "__main__":
    _setup_privateuseone_for_python_backend(DEVICE)
    words = dict(word.partition("=")[::2] for word in sys.argv[1:])
    assert refuses() == 6
    assert iterate(**{name: yaml.safe_load(text) for name, text in words.items()}) == ROWS
