"""Speed against accuracy: marks of finished rows, the front that none of them beats, how costs grow, where time goes."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from torch_surfcap.data.parse import read_json
from torch_surfcap.errors import InputError
from torch_surfcap.studies.ablation import Row
from torch_surfcap.studies.rows import folder_of, read_result

BEGIN, END = (
    "<!-- chart: begin -->",
    "<!-- chart: end -->",
)  # what lies between them in a page is written anew
PRESETS, RIVALS = "Presets", "Rivals"  # titles of groups that are no sweep
# Kinds of work in metrics.json, in the order of a fit, and what they are called.
WORK = {
    "start": "start",
    "load": "load",
    "reject": "silhouettes compared",
    "box": "box",
    "floor": "floor",
    "hull": "hull",
    "prepare": "level change",
    "ranges": "ranges",
    "march": "march and gradient",  # one pass gives both
    "gather": "gathered gradient",
    "compare": "comparison of gradients",
    "view": "view-dependent colour",
    "voxels": "voxel terms",
    "adam": "Adam",
    "gains": "gains",
    "align": "registration",
    "judge": "cameras judged",
    "rest": "rest of the fit",
    "mesh": "extraction",
    "score": "scores",
    "write": "writing",
}
MARCH = ("march", "gather")
LEFT = "still to be run"
LARGE = 0.15  # of a fit's time: what takes more and is not the march is worth making faster
# Swept groups, and by which number of a mark they grow.
GROWTH = {"scale": "edge", "cameras": "views", "voxel": "per_voxel"}
AXES = {
    "edge": "image size, pixels along an edge",
    "views": "cameras",
    "per_voxel": "1/voxel, per unit of length",
}
COSTS = {
    "seconds": "seconds",
    "fit_seconds": "seconds of the fit",
    "memory": "peak memory, GiB",
    "chamfer": "Chamfer",
}


class Mark(NamedTuple):
    """A row of the chart. group: its key in the sweep's file, or PRESETS or RIVALS; scores: as ``rows.read_scores``, with
    fit_seconds, views, edge and per_voxel; work: seconds by place in the fit and kind of work; note: why it lacks them."""

    scene: str
    group: str
    title: str
    name: str
    settings: str
    scores: Mapping[str, float]
    work: Mapping[str, Mapping[str, float]]
    note: str = ""


class Published(NamedTuple):
    """A figure from elsewhere; NaN where it is not known. time: as published."""

    method: str
    data: str
    chamfer_mm: float
    psnr_db: float
    seconds: float
    memory_gib: float
    time: str
    hardware: str
    source: str


def mark_of(row: Row, group: str, out: Path) -> Mark:
    """What is known of a row whose folder lies in ``out``."""
    result = read_result(row, out)
    scores, work = dict(result.get("scores", {})), dict[str, dict[str, float]]()
    if scores:
        metrics = read_json(folder_of(row, out) / "metrics.json")
        scores |= {
            "fit_seconds": metrics["seconds"].get("fit", math.nan),
            "views": metrics["views"],
            "edge": math.sqrt(metrics["pixels"]),
            "per_voxel": 1 / metrics["chosen"]["voxel"]["value"],
        }
        work = breakdown(metrics["seconds"])
        if row.script != "fit.py" and "hull" in row.name:  # it has no colours
            scores = {name: score for name, score in scores.items() if not name.startswith(("psnr", "ssim"))}
    title = row.group.title if row.group else ""
    note = result.get("error") or ("" if scores else LEFT)
    return Mark(row.scene, group, title, row.name, row.changes, scores, work, note)


def breakdown(seconds: Mapping[str, Any]) -> dict[str, dict[str, float]]:
    """The seconds of a metrics.json by place, "before", "level 1", ..., "after", and kind of work, a key of WORK. What the
    levels do not account for of the fit is the "rest" of the last one."""
    levels: list[dict[str, float]] = [dict(level) for level in seconds.get("levels", [])]
    if levels:
        known = sum(sum(level.values()) for level in levels)
        levels[-1]["rest"] = max(0.0, seconds.get("fit", known) - known)
    places = {
        "before": ("start", "load", "reject", "box", "floor", "hull"),
        "after": ("mesh", "score", "write"),
    }
    outer = {
        place: {name: float(seconds[name]) for name in names if name in seconds}
        for place, names in places.items()
    }
    inner = {f"level {i + 1}": level for i, level in enumerate(levels)}
    return {"before": outer["before"], **inner, "after": outer["after"]}


def shares(work: Mapping[str, Mapping[str, float]]) -> dict[str, float]:
    """Of all seconds, by kind of work, in the order of WORK."""
    total = sum(sum(place.values()) for place in work.values()) or 1.0
    sums = {name: sum(place.get(name, 0.0) for place in work.values()) / total for name in WORK}
    return {name: share for name, share in sums.items() if share > 0}


def front(points: Sequence[tuple[float, float]]) -> list[int]:
    """Which points (cost, error) no other one beats in both, by rising cost; of equals the first. NaNs are left out.

    >>> front([(3.0, 1.0), (1.0, 2.0), (2.0, 2.5), (4.0, 0.5)])
    [1, 0, 3]
    """
    known = [i for i, point in enumerate(points) if all(math.isfinite(x) for x in point)]
    best, kept = math.inf, []
    for i in sorted(known, key=lambda i: (*points[i], i)):
        if points[i][1] < best:
            best = points[i][1]
            kept.append(i)
    return kept


def on_fronts(marks: Sequence[Mark]) -> set[int]:
    """Which marks, rivals aside, lie on the front of seconds and Chamfer or of seconds and PSNR within the mask."""
    found = set[int]()
    for score, sign in (("chamfer", 1.0), ("psnr_masked", -1.0)):
        points = [
            (m.scores.get("seconds", math.nan), sign * m.scores.get(score, math.nan))
            if m.title != RIVALS
            else (math.nan, math.nan)
            for m in marks
        ]
        found |= {*front(points)}
    return found


def exponent(x: Sequence[float], y: Sequence[float]) -> tuple[float, float] | None:
    """(p, c) of y = c x^p by least squares of logarithms; None for fewer than two different x.

    >>> p, c = exponent([1.0, 2.0, 4.0], [3.0, 12.0, 48.0])
    >>> round(p, 6), round(c, 6)
    (2.0, 3.0)
    """
    points = [(math.log(a), math.log(b)) for a, b in zip(x, y, strict=True) if a > 0 and b > 0]
    count = len(points)
    if len({a for a, _ in points}) < 2:
        return None
    mean_a, mean_b = (sum(column) / count for column in zip(*points, strict=True))
    variance = sum((a - mean_a) ** 2 for a, _ in points)
    p = sum((a - mean_a) * (b - mean_b) for a, b in points) / variance
    return p, math.exp(mean_b - p * mean_a)


def growth(marks: Iterable[Mark], group: str, cost: str) -> tuple[list[float], list[float]]:
    """By rising number that a group of GROWTH sweeps, that number and a cost of its marks."""
    of_group = [m.scores for m in marks if m.group == group]
    points = sorted({(s[GROWTH[group]], s[cost]) for s in of_group if cost in s and math.isfinite(s[cost])})
    return [x for x, _ in points], [y for _, y in points]


def read_published(path: Path) -> list[Published]:
    """The file's figures. Raises InputError naming the file and the line that is wrong."""
    found = []
    try:
        with path.open(newline="", encoding="utf-8") as file:
            for number, line in enumerate(csv.DictReader(file), 2):
                try:
                    numbers = {n: float(line[n] or "nan") for n in Published._fields[2:6]}
                    words = {n: line[n] for n in Published._fields if n not in numbers}
                    found.append(Published(**numbers, **words))  # type: ignore[arg-type]
                except (KeyError, ValueError, TypeError) as error:
                    expected = f"columns {', '.join(Published._fields)}"
                    raise InputError(f"{path}, line {number}: {error}, expected {expected}") from error
    except OSError as error:
        raise InputError(f"{path}: cannot read this file: {error.strerror}") from error
    return found


def csv_lines(marks: Iterable[Mark]) -> list[dict[str, Any]]:
    """Every number of every mark: scores, and seconds as "level 1: march" and so on; lengths in the capture's unit."""
    lines = []
    for mark in marks:
        words = {name: getattr(mark, name) for name in ("scene", "group", "name", "settings", "note")}
        work = {
            f"{place}: {name}": value for place, kinds in mark.work.items() for name, value in kinds.items()
        }
        lines.append({**words, **mark.scores, **work})
    return lines


def growth_table(marks: Sequence[Mark]) -> str:
    """Markdown: by scene and what is swept, the exponents of COSTS."""
    text = ["| scene | with | " + " | ".join(COSTS.values()) + " |", "|---" * (2 + len(COSTS)) + "|"]
    for scene in dict.fromkeys(mark.scene for mark in marks):
        here = [mark for mark in marks if mark.scene == scene]
        for group, axis in GROWTH.items():
            fits = [exponent(*growth(here, group, cost)) for cost in COSTS]
            if any(fits):
                cells = " | ".join("" if fit is None else f"{fit[0]:+.2f}" for fit in fits)
                text.append(f"| {scene} | {AXES[axis]} | {cells} |")
    return "\n".join(text)


def work_table(marks: Sequence[Mark]) -> str:
    """Markdown: by preset, the share of each kind of work in its seconds; bold what is LARGE and not the march."""
    shown = [mark for mark in marks if mark.title == PRESETS and mark.work]
    found = [shares(mark.work) for mark in shown]
    kinds = [name for name in WORK if any(name in share for share in found)]
    text = ["| scene | preset | " + " | ".join(WORK[name] for name in kinds) + " |"]
    text.append("|---" * (2 + len(kinds)) + "|")
    for mark, share in zip(shown, found, strict=True):
        cells = [f"{100 * share.get(name, 0.0):.0f} %" for name in kinds]
        bold = [share.get(name, 0.0) > LARGE and name not in MARCH for name in kinds]
        cells = [f"**{cell}**" if large else cell for cell, large in zip(cells, bold, strict=True)]
        text.append(f"| {mark.scene} | {mark.name} | {' | '.join(cells)} |")
    return "\n".join(text)


def published_table(figures: Sequence[Published]) -> str:
    """Markdown of all figures with their source."""
    text = ["| method | data | Chamfer, mm | PSNR, dB | time | memory, GiB | source |", "|---" * 7 + "|"]
    for figure in figures:
        numbers = [
            "" if math.isnan(x) else f"{x:g}" for x in (figure.chamfer_mm, figure.psnr_db, figure.memory_gib)
        ]
        text.append(
            f"| {figure.method} | {figure.data} | {numbers[0]} | {numbers[1]} | {figure.time} | {numbers[2]} "
            f"| {figure.source} |"
        )
    return "\n".join(text)
