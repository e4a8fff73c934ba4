"""How near the photometric step comes to what the device can do, at the finest level of a finished fit.

    python -m train.gpu_profile --run OUT --out profile.json [--device cuda] [--once]

Measures the device's copy bandwidth and its rate of float32 arithmetic, times the step alone, counts its samples and bytes
(see train/gpu_numbers.py) and writes all of it. --once measures nothing and calls the step and march_forward once, for a
profiler to look at. Any device will do; the CPU takes its time.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torch_surfcap import config as configs
from torch_surfcap import devices, ops
from torch_surfcap.data.capture import load_capture
from torch_surfcap.data.checks import prepare
from torch_surfcap.data.parse import read_json
from torch_surfcap.errors import InputError
from torch_surfcap.field.field import MISSING
from torch_surfcap.fitting.descent import RAY_ARGUMENTS, RAY_LOSSES
from torch_surfcap.fitting.gathered import slot_rows
from torch_surfcap.fitting.levels import plan_levels
from torch_surfcap.fitting.settings import FitSettings
from torch_surfcap.fitting.stage import Stage, begin_stage, open_studio
from torch_surfcap.run import read_run
from train.gpu_numbers import bound, flops_per_sample, step_bytes

COPIED, MATRIX = 1 << 30, 8192  # bytes of a buffer and numbers along an edge on a GPU; less on the CPU
PER_RAY = ("origins", "directions", "shift", "background", "target", "mask", "weight")


def timed(call: Callable[[], object], device: torch.device, warm: int = 3, rounds: int = 25) -> float:
    """Median seconds of a call, by the device's own events on a GPU."""
    seconds = []
    for i in range(warm + rounds):
        if device.type == "cuda":
            begin, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
            begin.record()
            call()
            end.record()
            end.synchronize()
            spent = 1e-3 * begin.elapsed_time(end)
        else:
            start = time.perf_counter()
            call()
            spent = time.perf_counter() - start
        seconds += [spent] * (i >= warm)
    return statistics.median(seconds)


def copy_bandwidth(device: torch.device, size: int = COPIED) -> float:
    """Bytes read and written per second by a copy of ``size`` bytes within the device's memory."""
    source = torch.zeros(size, dtype=torch.uint8, device=device)
    target = torch.empty_like(source)
    return 2 * size / timed(lambda: target.copy_(source), device)


def arithmetic_rate(device: torch.device, edge: int = MATRIX) -> float:
    """Float32 operations per second of a large product of matrices, TF32 off: what is reached, not what is printed."""
    before = torch.backends.cuda.matmul.allow_tf32
    torch.backends.cuda.matmul.allow_tf32 = False
    try:
        a, b = torch.rand(2, edge, edge, device=device)
        c = torch.empty_like(a)
        return 2 * edge**3 / timed(lambda: torch.mm(a, b, out=c), device, warm=2, rounds=7)
    finally:
        torch.backends.cuda.matmul.allow_tf32 = before


def last_stage(run: Path, device: torch.device) -> tuple[Stage, FitSettings]:
    """The finest level of a finished run as the fit left it, with all its rays; the exposure is left as it was taken.

    Raises InputError for a run whose records are not plain ones in float32.
    """
    config, field, _ = read_run(run, str(device))
    if field.view is not None or config.storage != 32:
        raise InputError(f"{run}: expected a fit with view_spacing=1 and storage=32")
    capture = prepare(load_capture(**configs.capture_arguments(config)))
    settings = replace(FitSettings.of(**configs.fit_arguments(config)), device=str(device))
    settings = settings.suited(capture.mask_source)
    chosen = read_json(run / "metrics.json")["chosen"]
    corners = torch.tensor(chosen["box"]["value"], dtype=torch.float64)
    plan = plan_levels(capture, (corners[:3], corners[3:]), settings.voxel, settings.levels)
    number = int(chosen["levels"]["value"]) - 1
    studio = open_studio(capture, settings, plan[number].halvings)
    store = ops.padded(field.voxels.detach()).contiguous()
    return begin_stage(settings, plan, number, field.grid, store, studio), settings


def step_arguments(stage: Stage, settings: FitSettings) -> dict[str, Any]:
    """The arguments of ``ops.photometric_step`` in an iteration, but for the ranges and memory."""
    generator = torch.Generator(stage.store.device).manual_seed(0)
    shift = torch.rand(len(stage.rays), generator=generator, device=stage.store.device) - 0.5
    loss = settings.losses
    return {
        "voxels": stage.store,
        "table": stage.table(settings),
        "frame": stage.grid.frame(*MISSING[settings.opacity]),
        **{name: getattr(stage.rays, name) for name in RAY_ARGUMENTS},
        "shift": shift * settings.descent.jitter,
        **stage.march._asdict(),
        "huber": loss.huber,
        "weights": [getattr(loss, name) for name in RAY_LOSSES],
        "detach_sample": loss.detach_sample,
        "rendered_sample": loss.sample_target == "rendered",
    }


def samples_walked(stage: Stage, arguments: dict[str, Any]) -> float:
    """Samples that the step visits: those within the ranges, up to the last one before a ray ends. That one has weight, so
    it is the last with a gradient. Needs ranges that are each ray's own."""
    rays, step, stop = stage.rays, arguments["step"], arguments["stop"]
    assert rays.ranges is not None
    offsets, stretches = rays.ranges
    length = 0.0
    for i in range(len(rays.camera_starts) - 1):
        part = rays.of_camera(i)
        own = offsets[part.start : part.stop + 1]
        ranges = (own - own[0], stretches[int(own[0]) : int(own[-1])])
        count = len(own) - 1
        given = arguments | {name: arguments[name][part] for name in PER_RAY}
        starts, first = slot_rows(ranges, step, 1, count)
        slots = stretches.new_empty(int(starts[-1]), 4)
        rows: dict[str, Any] = {"starts": starts, "first": first, "exponent": 0, "slots": slots}
        through = ops.photometric_lattice(**given, **rows, ranges=ranges)[2]
        ray = torch.arange(count, device=own.device).repeat_interleave(starts.diff())
        k = torch.arange(len(ray), device=own.device) - starts[ray] + first[ray]
        k = torch.where((slots != 0).any(1), k, -1)
        last = k.new_full((count,), -1).scatter_reduce(0, ray, k, "amax")
        end = torch.where(through < stop, (last + 1 + given["shift"]) * step, torch.inf)
        of = torch.arange(count, device=own.device).repeat_interleave(own.diff())
        inside = torch.minimum(ranges[1][:, 1], end[of]) - ranges[1][:, 0]
        length += float(inside.clamp(min=0).double().sum())
    return length / step


def profile(run: Path, device: torch.device) -> dict[str, Any]:
    """All numbers of the step at the finest level of a run."""
    small = device.type == "cpu"
    bandwidth = copy_bandwidth(device, COPIED >> 3 if small else COPIED)
    rate = arithmetic_rate(device, MATRIX >> 3 if small else MATRIX)
    stage, settings = last_stage(run, device)
    arguments = step_arguments(stage, settings)
    ranges = stage.rays.ranges
    if ranges is None or stage.rays.bundle != 1:
        raise InputError(f"{run}: expected a fit with descent.visit=ranges and descent.bundle=1")
    memory = torch.empty(1, *stage.store.shape, device=device)

    def step() -> Tensor:
        return ops.photometric_step(**arguments, ranges=ranges, gradients=memory)[1]

    met = int((step() != 0).any(-1).sum())
    seconds = timed(step, device, rounds=3 if small else 25)
    samples = samples_walked(stage, arguments)
    forward = {name: arguments[name] for name in FORWARD}
    counts: dict[str, Any] = {
        "stored": stage.store[..., 0].numel(),
        "met": met,
        "rays": len(stage.rays),
        "ranges": len(ranges[1]),
        "samples": samples,
    }
    moved = step_bytes(settings.degree, **counts)
    flops = flops_per_sample(settings.degree) * samples
    return {
        "device": devices.name(device),
        "degree": settings.degree,
        "opacity": settings.opacity,
        **counts,
        "samples_in_ranges": stage.rays.samples(arguments["step"]),
        "seconds": seconds,
        "forward_seconds": timed(lambda: ops.march_forward(**forward), device, rounds=3),
        "copy_bytes_per_second": bandwidth,
        "flops_per_second": rate,
        "flops": flops,
        "bytes": moved,
        **bound(seconds, moved["least"], flops, bandwidth, rate),
    }


FORWARD = (
    *("voxels", "table", "frame", "origins", "directions", "shift", "background"),
    *("opacity", "slope", "step", "stop"),
)


def once(run: Path, device: torch.device) -> None:
    """One photometric step and one march_forward."""
    stage, settings = last_stage(run, device)
    arguments = step_arguments(stage, settings)
    ops.photometric_step(**arguments, ranges=stage.rays.ranges, groups=1)
    ops.march_forward(**{name: arguments[name] for name in FORWARD})


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit status."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--run", required=True, type=Path, help="folder of a finished fit")
    parser.add_argument("--out", type=Path, help="JSON file to write")
    parser.add_argument("--device", default="auto")
    parser.add_argument("--once", action="store_true", help="for a profiler")
    options = parser.parse_args(arguments)
    try:
        device = devices.resolve(options.device)
        with devices.current(device):
            if options.once:
                once(options.run, device)
                return 0
            text = json.dumps(profile(options.run, device), indent=1)
    except InputError as error:
        print(error, file=sys.stderr)
        return 2
    print(text)
    if options.out:
        options.out.write_text(text + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
