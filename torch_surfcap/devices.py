"""The devices that a fit may run on: what a word means, what is free there, and what it is called."""

from __future__ import annotations

import contextlib
import re

import psutil
import torch

import torch_surfcap._C  # noqa: F401  (loads the library, which registers the ops)
from torch_surfcap.errors import InputError

CPU = torch.device("cpu")
WORDS = "auto, cpu, cuda, cuda:0, cuda:1, ..."
WORD = re.compile(r"auto|cpu|cuda(:\d{1,3})?")
BUILD = "TORCH_SURFCAP_CUDA=1 pip install --no-build-isolation -e . with a CUDA torch and nvcc builds them"


def has_kernels() -> bool:
    """Whether this build has the ops for CUDA."""
    return torch._C._dispatch_has_kernel_for_dispatch_key("torch_surfcap::march_forward", "CUDA")


def resolve(word: str) -> torch.device:
    """The device that a word means, a GPU with its number; auto is a GPU where it can be used, else the CPU.

    Raises InputError for any other word and for a GPU that cannot be used.

    >>> resolve("cpu")
    device(type='cpu')
    """
    if not WORD.fullmatch(word):
        raise InputError(f"device: found {word}, expected one of {WORDS}")
    if word == "cpu" or (word == "auto" and not (has_kernels() and torch.cuda.is_available())):
        return torch.device("cpu")
    if not has_kernels():
        raise InputError(f"device: found {word}, expected cpu: this build has no CUDA kernels ({BUILD})")
    if not torch.cuda.is_available():
        raise InputError(f"device: found {word}, expected cpu: torch finds no GPU")
    if ":" not in word:
        return torch.device("cuda", torch.cuda.current_device())
    device, count = torch.device(word), torch.cuda.device_count()
    if device.index >= count:
        there = "cuda:0" if count == 1 else f"cuda:0 to cuda:{count - 1}"
        raise InputError(f"device: found {word}, expected {there}: torch finds no other GPU")
    return device


def current(device: torch.device) -> contextlib.AbstractContextManager[object]:
    """Within it, streams and events are those of this device."""
    return torch.cuda.device(device) if device.type == "cuda" else contextlib.nullcontext()


def free_bytes(device: torch.device) -> int:
    """Memory that can be allocated there; on a GPU with what torch holds without using it."""
    if device.type != "cuda":
        return psutil.virtual_memory().available
    held = torch.cuda.memory_reserved(device) - torch.cuda.memory_allocated(device)
    return int(torch.cuda.mem_get_info(device)[0]) + held


def may_run_out(device: torch.device) -> bool:
    """Whether a fit there must be ready for torch.OutOfMemoryError. Host memory is promised before it is used."""
    return device.type != "cpu"


def reset_peak(device: torch.device) -> None:
    """Begins to count :func:`peak_bytes` anew."""
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)


def peak_bytes(device: torch.device) -> int | None:
    """Most memory that tensors had there at once since :func:`reset_peak`; None on the CPU, which counts processes."""
    return torch.cuda.max_memory_allocated(device) if device.type == "cuda" else None


def name(device: torch.device) -> str:
    """What the device is called: the GPU's name, or the instructions that torch uses of the CPU."""
    if device.type == "cuda":
        return torch.cuda.get_device_name(device)
    return f"CPU, {torch.backends.cpu.get_cpu_capability()}"
