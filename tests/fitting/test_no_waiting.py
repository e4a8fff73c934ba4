"""On a device all tensors are there, and the host queues iterations and waits for none: shown on made-up ones, and on a GPU
where there is one."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from tests.fitting.sphere import ball
from tests.fitting.stages import begun
from torch_surfcap.fitting.descent import REFRESH, descend

ROOT = Path(__file__).parents[2]
CASES = (
    "sh_degree=0",
    "sh_degree=1 opacity=transparency gain_per=camera plates=true",
    "gradient=gather",
    "gradient=gather lattice=8 opacity=transparency view_spacing=4",
    "storage=8 accumulator=16 view_spacing=8",
)


def check(program: str, case: str) -> None:
    command = [sys.executable, "-m", f"tests.fitting.{program}", *case.split()]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=300, cwd=ROOT)
    assert done.returncode == 0, done.stderr[-3000:]


@pytest.mark.parametrize("case", CASES)
def test_without_numbers(case: str) -> None:
    """Every iteration can be queued without a number of the device's, and nothing of the host's is read there."""
    check("fake_device", case)


@pytest.mark.parametrize(
    "case", [CASES[3], "storage=8 view_spacing=8", "images=host plates=true sh_degree=0"]
)
def test_a_whole_fit_there(case: str) -> None:
    """No step of a fit brings tensors of two devices together; it is the CPU's, and it can be stopped and gone on with."""
    check("made_up_device", case)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")
@pytest.mark.parametrize("case", CASES)
def test_on_a_gpu(case: str) -> None:
    """The same where torch itself refuses to wait, up to the first new integration ranges."""
    given = dict(word.partition("=")[::2] for word in case.split())
    plates = given.pop("plates", None) is not None
    settings = {name: int(text) if text.isdecimal() else text for name, text in given.items()}
    stage, studio, s = begun(ball(6, 32, plates), 0.06, 30, device="cuda", **settings)
    studio.keep_pictures("device", [0])
    stage.number = 1  # gains are fitted from the first iteration on
    rows = descend(stage, studio, s)
    next(rows)  # a level's begin may wait
    try:
        torch.cuda.set_sync_debug_mode("error")
        for _ in range(int(REFRESH) - 3):
            next(rows)
    finally:
        torch.cuda.set_sync_debug_mode("default")
