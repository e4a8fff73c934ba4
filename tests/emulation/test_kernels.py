"""CUDA's kernels, emulated, pass the tests of the ops: on the CPU's tensors, in the place of the CPU's kernels."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
LIBRARY = ROOT / "build/emulated/torch_surfcap/_C.abi3.so"
TESTS = ("tests/ops", "tests/test_autograd.py")


@pytest.mark.skipif("SURFCAP_EMULATED" in os.environ, reason="runs in itself")
def test_emulated_kernels() -> None:
    build = [sys.executable, "setup.py", "-q", "build_ext", "--build-lib", str(LIBRARY.parents[1])]
    run = [sys.executable, "-m", "pytest", "-q", "-p", "tests.emulation.plugin", *TESTS]
    for command, extra in (
        (build, {"TORCH_SURFCAP_CUDA": "emulated"}),
        (run, {"SURFCAP_EMULATED": str(LIBRARY)}),
    ):
        done = subprocess.run(command, cwd=ROOT, env=os.environ | extra, capture_output=True, text=True)
        assert done.returncode == 0, done.stdout[-5000:] + done.stderr[-5000:]
