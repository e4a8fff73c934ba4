"""Whole fits on a device that the CPU plays: its tensors compute, but do not meet the host's other than by copies.

    python -m tests.fitting.made_up_device KEY=VALUE ...

Exit 0 if the fit is the CPU's, as far as it can be. It is a program of its own, because torch cannot
forget a device that was made up.
"""

from __future__ import annotations

import sys
from contextlib import suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch
import yaml
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves, tree_map
from torch.utils.backend_registration import _setup_privateuseone_for_python_backend

from tests.fitting.sphere import ball
from torch_surfcap import SurfaceField, devices, fit
from torch_surfcap.fitting import late
from torch_surfcap.fitting.checkpoint import Checkpoints
from torch_surfcap.fitting.course import Progress
from torch_surfcap.surface.render import volume

DEVICE = "made_up"
CROSSING = ("_to_copy", "copy_")
SMALL: dict[str, Any] = {"levels": 2, "voxel": 0.06}


class There(Tensor):
    """A tensor of the device, played by the CPU's ``held``."""

    held: Tensor
    __torch_function__ = torch._C._disabled_torch_function_impl  # type: ignore[assignment]

    @staticmethod
    def __new__(cls, held: Tensor) -> There:
        device = torch.device(DEVICE, 0)
        like: dict[str, Any] = {"strides": held.stride(), "storage_offset": held.storage_offset()}
        tensor = Tensor._make_wrapper_subclass(cls, held.size(), dtype=held.dtype, device=device, **like)
        tensor.held = held
        return tensor

    @classmethod
    def __torch_dispatch__(  # type: ignore[override]
        cls, func: Any, types: Any, args: Any = (), kwargs: Any = None
    ) -> Any:
        return played(func, args, kwargs or {})


class Played(TorchDispatchMode):
    """Makes the device's tensors where they are asked for."""

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return played(func, args, kwargs or {})


def played(func: Any, args: Any, kwargs: dict[str, Any]) -> Any:
    """The op on the CPU; its result is on the device if its arguments are, or if it is asked for there."""
    name = func.__name__.partition(".")[0]
    tensors = [x for x in tree_leaves((args, kwargs)) if isinstance(x, Tensor)]
    there = [x for x in tensors if isinstance(x, There)]
    here = [x for x in tensors if not isinstance(x, There) and x.dim() > 0 and not sparse(x)]
    if there and here and name not in CROSSING:
        raise RuntimeError(f"{func}: of {[tuple(x.shape) for x in here]} on the host and others there")
    result_there = bool(there) if name != "copy_" else isinstance(args[0], There)
    if kwargs.get("device") is not None:
        result_there = torch.device(kwargs["device"]).type == DEVICE
        kwargs = kwargs | {"device": torch.device("cpu")}
    kwargs = {key: value for key, value in kwargs.items() if key != "pin_memory"}
    wrappers = {id(x.held): x for x in there}
    unwrapped = tree_map(lambda x: x.held if isinstance(x, There) else x, (args, kwargs))
    out = func(*unwrapped[0], **unwrapped[1])

    def wrapped(value: Any) -> Any:
        if not isinstance(value, Tensor) or not result_there or sparse(value):
            return value
        return wrappers.get(id(value)) if id(value) in wrappers else There(value)

    return tree_map(wrapped, out)


def sparse(tensor: Tensor) -> bool:
    """Whether it has no strides, and so cannot be held: it is let through, wherever it is."""
    return tensor.layout != torch.strided


class Moment:
    """An event that has always happened."""

    def query(self) -> bool:
        return True

    def synchronize(self) -> None:
        pass

    def elapsed_time(self, other: Moment) -> float:
        return 1.0


class Generator(torch.Generator):
    """The CPU's, whatever the device."""

    def __new__(cls, device: object = None) -> Generator:
        return super().__new__(cls, "cpu")  # type: ignore[call-arg]


def begin() -> None:
    """From now on there is the device, and all fits run there."""
    _setup_privateuseone_for_python_backend(DEVICE)
    torch._C._set_only_lift_cpu_tensors(True)  # torch.tensor(list) takes its way by the host
    patched: Any = torch
    patched.Generator = Generator
    patched = devices
    patched.resolve = lambda word: torch.device(f"{DEVICE}:0")
    patched = late
    patched._event = lambda enable_timing=False: Moment()


def main(words: list[str]) -> None:
    """Compares a fit there, a fit that was stopped there and went on, and one on the CPU."""
    given = dict(word.partition("=")[::2] for word in words)
    settings: dict[str, Any] = SMALL | {name: yaml.safe_load(text) for name, text in given.items()}
    capture = ball(6, 32, settings.pop("plates", False))
    here = fit(capture, **settings)
    begin()

    def stop(at: Progress) -> None:
        if at.row.get("iteration") == 7 and at.number == 1:
            raise KeyboardInterrupt

    with Played(), TemporaryDirectory() as folder:
        there = fit(capture, **settings)
        path = Path(folder) / "checkpoint.npz"
        with suppress(KeyboardInterrupt):
            fit(capture, stop, Checkpoints(path, seconds=0), **settings)
        again = fit(capture, None, Checkpoints(path, resume=True), **settings)
        there.field.save(Path(folder) / "field.npz")
        loaded = SurfaceField.load(Path(folder) / "field.npz")
        seen = [volume(f, capture.cameras, 0, 0.0) for f in (there.field, loaded, loaded.to(DEVICE))]
    assert again.resumed_from == [1, 7]
    assert isinstance(there.field.voxels.detach(), There)
    assert there.field.voxels.equal(again.field.voxels)
    assert there.history == again.history
    assert isinstance(loaded.voxels.detach(), There)
    assert seen[0].equal(seen[1])
    assert seen[0].equal(seen[2])
    # The rule learns of a loss an iteration later; until it acts, all is as on the CPU but for the gains' sums.
    falls = next(i for i, row in enumerate(here.history) if row["rate"] < 1)
    assert [row["rate"] for row in there.history[: falls + 2]] == [1.0] * (falls + 1) + [0.3]
    for one, two in zip(here.history[: falls + 1], there.history, strict=False):
        torch.testing.assert_close(two["loss"], one["loss"], rtol=1e-5, atol=0)
    assert 0.5 < there.history[-1]["loss"] / here.history[-1]["loss"] < 2


if __name__ == "__main__":
    main(sys.argv[1:])
