"""The numbers of a check on a GPU: read from what its steps leave, and counted. Python's own library alone."""

from __future__ import annotations

import csv
import json
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

PITCH, COEFFICIENTS = (4, 16, 32), (4, 13, 28)  # of a record by SH degree: stored, and used
NUMBER = 4  # bytes
RAY_NUMBERS = 3 + 3 + 1 + 3 + 3 + 1 + 1  # origin, direction, shift, background, target, mask, weight
RAY_RESULTS = 3 + 1 + 1  # colour, transmittance, depth
KERNELS = ("step_rays", "render_rays")  # of photometric_step and march_forward
METRICS = {
    "dram__throughput.avg.pct_of_peak_sustained_elapsed": "dram, %",
    "lts__throughput.avg.pct_of_peak_sustained_elapsed": "L2, %",
    "l1tex__throughput.avg.pct_of_peak_sustained_elapsed": "L1, %",
    "sm__throughput.avg.pct_of_peak_sustained_elapsed": "SM, %",
    "sm__warps_active.avg.pct_of_peak_sustained_active": "occupancy, %",
    "launch__registers_per_thread": "registers",
    "gpu__time_duration.sum": "ns",
}


def step_bytes(
    degree: int, stored: int, met: int, rays: int, ranges: int, samples: float
) -> dict[str, float]:
    """Bytes of one photometric step in float32. ``least``: what moves however good the caches are, namely records of the
    voxels met, read once, and their gradient, read and written once; the zeros of the other voxels' gradient; rays,
    observations, ranges and results once. ``cached``: what the samples read through the caches, 8 records each; as much is
    added to the gradient, ``added``.

    >>> step_bytes(0, stored=10, met=4, rays=2, ranges=1, samples=3)["least"]
    480.0
    """
    record = NUMBER * PITCH[degree]
    parts = {
        "records": 1.0 * record * met,
        "gradient": 2.0 * record * met,
        "zeros": 1.0 * record * (stored - met),
        "rays": 1.0 * NUMBER * (RAY_NUMBERS + RAY_RESULTS) * rays + 8 * (rays + 1) + 2 * NUMBER * ranges,
    }
    through = 8.0 * record * samples
    return {**parts, "least": sum(parts.values()), "cached": through, "added": through}


def flops_per_sample(degree: int) -> int:
    """A multiplication or an addition is one. Place and corner weights 40; interpolation of C coefficients 16 C; colour
    6 (B + 1)²; opacity and compositing 40; the walk back 60; the gradient by the records C + 16 C.

    >>> flops_per_sample(0), flops_per_sample(2)
    (278, 1118)
    """
    return 40 + 33 * COEFFICIENTS[degree] + 6 * (degree + 1) ** 2 + 40 + 60


def bound(seconds: float, moved: float, flops: float, bandwidth: float, rate: float) -> dict[str, Any]:
    """Which of the card's two limits a computation is nearer to, and what share of each it reaches."""
    shares = {"copy bandwidth": moved / bandwidth / seconds, "fp32 rate": flops / rate / seconds}
    name = max(shares, key=lambda key: shares[key])
    return {"shares": shares, "bound_by": name, "share": shares[name]}


def levels(metrics: Mapping[str, Any], history: Iterable[Mapping[str, str]]) -> list[dict[str, Any]]:
    """Per level of a fit: iterations, seconds by kind of work and together (of "prepare", which is before the first
    iteration, only there), iterations per second, samples per iteration and per second of the march."""
    rows = list(history)
    found = []
    for number, seconds in enumerate(metrics["seconds"]["levels"]):
        own = [row for row in rows if int(float(row["level"])) == number]
        samples = sum(float(row["samples"]) for row in own)
        spent = sum(value for name, value in seconds.items() if name != "prepare")
        march = seconds.get("march", 0.0)
        found.append(
            {
                "level": number + 1,
                "iterations": len(own),
                "seconds": {**seconds, "iterations": spent},
                "iterations_per_second": len(own) / spent if spent else None,
                "samples_per_iteration": samples / len(own) if own else None,
                "samples_per_second": samples / march if march else None,
            }
        )
    return found


def run_numbers(run: Path) -> dict[str, Any]:
    """What a finished run tells: its time, memory, size, levels and, where it was evaluated, scores."""
    metrics = json.loads((run / "metrics.json").read_text(encoding="utf-8"))
    with open(run / "history.csv", encoding="utf-8", newline="") as file:
        by_level = levels(metrics, csv.DictReader(file))
    numbers = {
        "device": metrics["device"],
        "seconds": {k: v for k, v in metrics["seconds"].items() if k != "levels"},
        "peak_host_bytes": metrics["peak_memory_bytes"],
        **{name: metrics[name] for name in ("voxels", "tiles", "triangles", "warnings")},
        "levels": by_level,
        "test": metrics.get("test"),
        "surface": None,
    }
    path = run / "evaluation.json"
    if path.is_file():
        evaluated = json.loads(path.read_text(encoding="utf-8"))
        if "test" in evaluated:
            numbers["test"] = {k: v for k, v in evaluated["test"].items() if k != "each"}
        numbers["surface"] = evaluated.get("surface")
    return numbers


def junit_counts(path: Path) -> dict[str, Any]:
    """Counts of a junit file, and the names of the tests that failed."""
    found: dict[str, Any] = {"passed": 0, "failed": 0, "skipped": 0, "names": []}
    for case in ElementTree.parse(path).getroot().iter("testcase"):
        bad = case.find("failure") is not None or case.find("error") is not None
        kind = "failed" if bad else "skipped" if case.find("skipped") is not None else "passed"
        found[kind] += 1
        if bad:
            found["names"].append(f"{case.get('classname')}::{case.get('name')}")
    return found


def kernels_of_ncu(text: str) -> list[dict[str, Any]]:
    """What `ncu --csv` says of each launch, a line per metric: the kernel and the values of METRICS."""
    lines = text.splitlines()
    begin = next((i for i, line in enumerate(lines) if line.startswith('"ID"')), len(lines))
    found: dict[str, dict[str, Any]] = {}
    for row in csv.DictReader(lines[begin:]):
        name = next((k for k in KERNELS if k in (row.get("Kernel Name") or "")), row.get("Kernel Name"))
        launch = found.setdefault(row["ID"], {"kernel": name})
        title = METRICS.get(row.get("Metric Name") or "")
        if title:
            try:
                launch[title] = float(row["Metric Value"].replace(",", ""))
            except ValueError:
                launch[title] = None  # "n/a"
    return list(found.values())


def registers_of(text: str) -> dict[str, dict[str, int]]:
    """Of what `cuobjdump --dump-resource-usage` prints: for each of KERNELS in either precision how many variants there
    are, and the most registers and bytes of stack, where registers spill to, that one of them takes."""
    found: dict[str, dict[str, int]] = {}
    usage = re.compile(r"Function (\S+?):\s*\n\s*REG:(\d+) STACK:(\d+)")
    for name, registers, stack in usage.findall(text):
        kernel = next((k for k in KERNELS if k in name), None)
        if kernel is not None:
            kernel += ", double" if "WalkingId" in name else ", float"
            of = found.setdefault(kernel, {"variants": 0, "registers": 0, "stack": 0})
            of["variants"] += 1
            of["registers"] = max(of["registers"], int(registers))
            of["stack"] = max(of["stack"], int(stack))
    return found
