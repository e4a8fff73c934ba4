"""make gpu-check, but for the GPU: what is read and counted, and the page."""

from __future__ import annotations

import csv
import doctest
import json
from pathlib import Path
from typing import Any

import pytest
import torch

from tests.fitting.sphere import ball
from tests.fitting.stages import begun
from torch_surfcap import ops, reference
from torch_surfcap.fitting.settings import FitSettings
from torch_surfcap.fitting.stage import Stage
from train import gpu_check, gpu_numbers, gpu_page, gpu_profile
from train.gpu_page import page, targets

METRICS: dict[str, Any] = {
    "seconds": {
        "total": 9.0,
        "fit": 4.0,
        "mesh": 0.5,
        "levels": [{"march": 1.0, "adam": 1.0}, {"prepare": 9.0, "march": 0.5}],
    },
    "device": {"word": "cuda:0", "name": "a GPU", "torch": "2", "peak_memory_bytes": 2_000_000_000},
    "peak_memory_bytes": 5,
    "voxels": 64,
    "tiles": 1,
    "triangles": 12,
    "warnings": [],
    "test": {"psnr_volume": 20.0, "psnr_raster": 21.0, "views": 8},
}
HISTORY = [("0.0", "100.0"), ("0.0", "300.0"), ("1.0", "1000.0")]


@pytest.fixture
def finished(tmp_path: Path) -> Path:
    (tmp_path / "metrics.json").write_text(json.dumps(METRICS))
    with open(tmp_path / "history.csv", "w", newline="") as file:
        csv.writer(file).writerows([("level", "samples"), *HISTORY])
    return tmp_path


def test_numbers_of_a_run(finished: Path) -> None:
    """Two iterations in 2 s of which the march took 1 s; the third in half a second, without what came before it."""
    found = gpu_numbers.run_numbers(finished)
    one, two = found["levels"]
    assert one["iterations_per_second"] == 1.0
    assert one["samples_per_iteration"] == 200.0
    assert one["samples_per_second"] == 400.0
    assert (two["iterations"], two["iterations_per_second"], two["samples_per_second"]) == (1, 2.0, 2000.0)
    assert two["seconds"] == {"prepare": 9.0, "march": 0.5, "iterations": 0.5}
    assert found["test"]["views"] == 8
    evaluated = {"test": {"psnr_volume": 27.0, "each": {}}, "surface": {"chamfer": 0.1}}
    (finished / "evaluation.json").write_text(json.dumps(evaluated))
    found = gpu_numbers.run_numbers(finished)
    assert (found["test"], found["surface"]) == ({"psnr_volume": 27.0}, {"chamfer": 0.1})


def test_bytes_and_flops() -> None:
    """Records of 32 numbers: 10 voxels met of 30, 2 rays with 3 ranges, 5 samples."""
    found = gpu_numbers.step_bytes(2, stored=30, met=10, rays=2, ranges=3, samples=5.0)
    assert (found["records"], found["gradient"], found["zeros"]) == (1280, 2560, 2560)
    assert found["rays"] == 2 * 20 * 4 + 3 * 8 + 3 * 8
    assert found["least"] == 1280 + 2560 + 2560 + 208
    assert found["cached"] == found["added"] == 5 * 8 * 128
    # 4 GB and 10 GFLOP in 1 s, where the card does 10 GB and 50 GFLOP.
    assert gpu_numbers.bound(1.0, 4e9, 1e10, 1e10, 5e10) == {
        "shares": {"copy bandwidth": 0.4, "fp32 rate": 0.2},
        "bound_by": "copy bandwidth",
        "share": 0.4,
    }


def test_examples() -> None:
    assert all(doctest.testmod(module).failed == 0 for module in (gpu_numbers, gpu_page))


def test_constants_are_those_of_the_ops() -> None:
    assert tuple(ops.pitch(d) for d in range(3)) == gpu_numbers.PITCH
    assert tuple(ops.coefficients(d) for d in range(3)) == gpu_numbers.COEFFICIENTS


def test_junit(tmp_path: Path) -> None:
    path = tmp_path / "junit.xml"
    cases = [
        '<testcase classname="a" name="x"/>',
        '<testcase classname="a" name="y[cuda]"><failure/></testcase>',
        '<testcase classname="a" name="z"><error/></testcase>',
        '<testcase classname="a" name="w"><skipped/></testcase>',
    ]
    path.write_text(f"<testsuites><testsuite>{''.join(cases)}</testsuite></testsuites>")
    found = {"passed": 1, "failed": 2, "skipped": 1, "names": ["a::y[cuda]", "a::z"]}
    assert gpu_numbers.junit_counts(path) == found


NCU = """==PROF== Connected to process 7
"ID","Process ID","Kernel Name","Metric Name","Metric Unit","Metric Value"
"0","7","void surfcap::step_rays<A, float>(A)","launch__registers_per_thread","register/thread","128"
"0","7","void surfcap::step_rays<A, float>(A)","gpu__time_duration.sum","ns","1,234,567"
"1","7","render_rays","dram__throughput.avg.pct_of_peak_sustained_elapsed","%","n/a"
"""
CUOBJDUMP = """Fatbin elf code:
Resource usage:
 Common:
  GLOBAL:0
 Function _ZN7surfcap9step_raysINS_4cuda7WalkingIfLi2E:
  REG:128 STACK:16 SHARED:0 LOCAL:0 CONSTANT[0]:900
 Function _ZN7surfcap9step_raysINS_4cuda7WalkingIdLi0E:
  REG:200 STACK:0 SHARED:0 LOCAL:0 CONSTANT[0]:900
 Function _ZN7surfcap5adamIdE:
  REG:20 STACK:0 SHARED:0 LOCAL:0 CONSTANT[0]:900
"""


def test_profilers() -> None:
    assert gpu_numbers.kernels_of_ncu(NCU) == [
        {"kernel": "step_rays", "registers": 128.0, "ns": 1234567.0},
        {"kernel": "render_rays", "dram, %": None},
    ]
    assert gpu_numbers.kernels_of_ncu("==ERROR== no permission") == []
    assert gpu_numbers.registers_of(CUOBJDUMP) == {
        "step_rays, float": {"variants": 1, "registers": 128, "stack": 16},
        "step_rays, double": {"variants": 1, "registers": 200, "stack": 0},
    }


def a_level(**given: Any) -> tuple[Stage, FitSettings]:
    stage, _, settings = begun(ball(4, 24), 0.12, 1, sh_degree=0, **given)
    stage.rays.target.fill_(0.2)
    stage.rays.background.fill_(0.9)
    return stage, settings


@pytest.mark.parametrize("stop", [0.0, 0.3])
def test_samples_walked(stop: float, device: str) -> None:
    """As many as the reference visits within the ranges, up to where they begin and end."""
    stage, settings = a_level(opacity="transparency", descent={"stop": stop}, device=device)
    stage.store[..., 0] = stage.store[..., 0].clamp(max=0.6)
    stage.rays.find_ranges(stage.store, stage.grid, settings.opacity, stage.march)
    arguments = gpu_profile.step_arguments(stage, settings)
    found, most = gpu_profile.samples_walked(stage, arguments), stage.rays.samples(arguments["step"])
    names = ("voxels", "table", "frame", "origins", "directions", "shift", "opacity", "slope", "step", "stop")
    march: Any = reference.rays.march(*(arguments[name] for name in names))
    offsets, ranges = stage.rays.ranges or (None, None)
    assert offsets is not None
    assert ranges is not None
    visited = 0
    for ray in range(len(stage.rays)):
        own = ranges[offsets[ray] : offsets[ray + 1]]
        within = ((march.t[ray, :, None] >= own[:, 0]) & (march.t[ray, :, None] < own[:, 1])).any(1)
        left = torch.cumprod(torch.where(within, march.a[ray], 1.0), 0)
        alive = torch.nn.functional.pad(left[:-1], (1, 0), value=1.0) >= stop
        visited += int((within & alive).sum())
    assert found <= most + 1e-6
    assert abs(found - visited) < 0.05 * visited
    if stop:
        assert found < 0.95 * most
    else:
        assert found == pytest.approx(most)


def test_the_cards_own_limits(device: str) -> None:
    there = torch.device(device)
    assert gpu_profile.copy_bandwidth(there, 1 << 20) > 1e7
    assert gpu_profile.arithmetic_rate(there, 128) > 1e7


def numbers(fit: dict[str, Any]) -> dict[str, Any]:
    profile = {
        "opacity": "transparency",
        "degree": 2,
        **dict.fromkeys(("rays", "ranges", "stored", "met"), 7),
        **{"samples": 9.0, "samples_in_ranges": 10.0, "seconds": 0.01, "forward_seconds": 0.02},
        **{"copy_bytes_per_second": 3e12, "flops_per_second": 5e13, "flops": 2e11},
        "bytes": gpu_numbers.step_bytes(2, 7, 7, 7, 7, 9.0),
        **gpu_numbers.bound(0.01, 1.5e10, 2e11, 3e12, 5e13),
    }
    return {
        "machine": {"gpu": "a GPU", "arch": "9.0", "cores": 16, "torch": "2.11", "cuda": "13.0"},
        "seconds": 400.0,
        "steps": [{"name": "build", "seconds": 60.0, "limit": 240.0, "result": "done", "failed": False}],
        "tests": {"tests of ops": {"passed": 3, "failed": 1, "skipped": 0, "names": ["a::y"]}},
        "fits": {"lego_transparency": {**fit, "to_cpu": {"chamfer": 0.001}}},
        "profiles": {"lego_transparency": profile},
        "ncu": gpu_numbers.kernels_of_ncu(NCU),
        "registers": gpu_numbers.registers_of(CUOBJDUMP),
    }


def test_page(finished: Path) -> None:
    found = numbers(gpu_numbers.run_numbers(finished))
    assert [row[3:] for row in targets(found)] == [
        [20.0, "no"],  # PSNR by volume
        [21.0, "no"],
        [4.0, "yes"],  # seconds
        [2.0, "yes"],  # GB
        [50.0, "yes"],  # % of the copy bandwidth
    ]
    text = page(found)
    assert "| PSNR volume, transparency, dB | 26.4 | >= 26.4 | 20 | no |" in text
    assert "a GPU (sm_90), 16 CPU cores, driver unknown, cuda 13.0, torch 2.11, commit unknown" in text
    assert "- `a::y`" in text
    assert "| copy bandwidth, GB/s | 3000 |" in text
    assert "| step_rays | 128 | 1234567 | – |" in text
    for line in text.splitlines():
        assert not line.startswith("|") or line.endswith("|")
    bare = page({**found, "tests": {}, "fits": {}, "profiles": {}, "ncu": None, "registers": None})
    assert "## Fits" not in bare
    assert "## Steps" in bare


def test_fits_of_a_folder(tmp_path: Path) -> None:
    """Lego first, with both opacities; a person on both devices, the CPU last."""
    for name in ("chair", "human_a", "lego", "wheels"):
        (tmp_path / name).mkdir()
    (tmp_path / "lego" / "transforms_train.json").touch()
    found = gpu_check.fits_of(tmp_path)
    names = ["lego_transparency", "lego_distance", "chair_cuda", "human_a_cuda", "human_a_cpu"]
    assert list(found) == names
    lego = [f"data.path={tmp_path / 'lego'}", "data.holdout=8", "sh_degree=2", "opacity=distance"]
    assert found["lego_distance"] == [*lego, "device=cuda"]
    assert found["human_a_cpu"] == [f"data.path={tmp_path / 'human_a'}", "device=cpu"]


def test_without_a_gpu(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    probe = gpu_check.PROBE.replace("torch.cuda.is_available()", "False")
    monkeypatch.setattr(gpu_check, "PROBE", probe)
    out = tmp_path / "results"
    assert gpu_check.main(["--data", str(tmp_path), "--results", str(out)]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert "no GPU that torch" in said
    assert not out.exists()
    monkeypatch.setattr(gpu_check, "PROBE", "import no_such_torch")
    assert gpu_check.main(["--data", str(tmp_path), "--results", str(out)]) == 2
    assert "No module named 'no_such_torch'" in capsys.readouterr().err
