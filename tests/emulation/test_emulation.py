"""The emulation of CUDA passes its own test, self_test.cpp."""

from __future__ import annotations

import os
import shlex
import shutil
import subprocess
from pathlib import Path

import pytest

HERE = Path(__file__).parent
CXX = shlex.split(os.environ.get("CXX", "c++"))


@pytest.mark.skipif(shutil.which(CXX[0]) is None, reason="no C++ compiler")
def test_self_test(tmp_path: Path) -> None:
    program = tmp_path / "self_test"
    sources = [str(HERE / name) for name in ("emulation.cpp", "self_test.cpp")]
    compile_it = [*CXX, "-std=c++20", "-O1", "-pthread", f"-I{HERE}", *sources, "-o", str(program)]
    for command in (compile_it, [str(program)]):
        done = subprocess.run(command, capture_output=True, text=True, timeout=120)
        assert done.returncode == 0, done.stdout + done.stderr
