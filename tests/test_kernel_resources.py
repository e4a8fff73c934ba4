"""The report on CUDA's kernels, from lines as nvcc writes them."""

from __future__ import annotations

from tests.kernel_resources import parse, report

LOG = """
ptxas info    : Compiling entry function '_Z9step_raysI7WalkingIfLi2EEEvT_' for 'sm_90'
ptxas info    : Function properties for _Z9step_raysI7WalkingIfLi2EEEvT_
    16 bytes stack frame, {stores} bytes spill stores, {loads} bytes spill loads
ptxas info    : Used 110 registers, used 0 barriers, 16 bytes cumulative stack size
ptxas info    : Compiling entry function '_Z8sum_rowsILi3EEvPKd' for 'sm_90'
ptxas info    : Function properties for _Z8sum_rowsILi3EEvPKd
    0 bytes stack frame, 4 bytes spill stores, 4 bytes spill loads
ptxas info    : Used 32 registers, used 1 barriers, 2048 bytes smem
"""


def test_kernels_and_their_resources() -> None:
    walk, total = parse(LOG.format(stores=0, loads=0))
    assert (walk.arch, walk.registers, walk.stack, walk.spills, walk.walks_rays) == (
        "sm_90",
        110,
        16,
        0,
        True,
    )
    assert (total.registers, total.spills, total.walks_rays) == (32, 8, False)


def test_only_spills_of_the_march_fail() -> None:
    text, sound = report(parse(LOG.format(stores=0, loads=0)))
    assert sound
    assert "110" in text
    text, sound = report(parse(LOG.format(stores=8, loads=12)))
    assert not sound
    assert "20 bytes" in text
