"""What a page of measurements says of where it comes from: the machine, the state of the program."""

from __future__ import annotations

import platform
import subprocess
from importlib.metadata import version
from pathlib import Path

import psutil
import torch

from torch_surfcap.studies.ablation import PACKAGE, program_digest


def machine() -> str:
    """Processor, threads, memory, torch."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text(encoding="utf-8").splitlines() if info.is_file() else []
    models = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    isa, memory = torch.backends.cpu.get_cpu_capability(), psutil.virtual_memory().total / 2**30
    return (
        f"{models[0] if models else platform.machine()}, {torch.get_num_threads()} threads, {isa}, {memory:.0f} GiB, "
        f"{platform.system()}, torch {torch.__version__.partition('+')[0]}"
    )


def program() -> str:
    """Commit of the repository, and whether files differ from it ("unknown" without git); digest of the program; version."""
    return f"{_commit()} (program {program_digest()}, torch_surfcap {version('torch_surfcap')})"


def _commit() -> str:
    said = []
    for words in (["rev-parse", "--short", "HEAD"], ["status", "--porcelain", "--untracked-files=no"]):
        try:
            done = subprocess.run(
                ["git", "-C", str(PACKAGE), *words], capture_output=True, text=True, check=True
            )
        except (OSError, subprocess.CalledProcessError):
            return "unknown"
        said.append(done.stdout.strip())
    return said[0] + (", changed" if said[1] else "")
