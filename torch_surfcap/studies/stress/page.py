"""The stability suite's results as a table, a heat map and the bounds that were set, between the marks of a page."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from torch_surfcap.data.files import atomic_write
from torch_surfcap.errors import InputError
from torch_surfcap.studies.marked_page import renewed
from torch_surfcap.studies.provenance import machine, program
from torch_surfcap.studies.stress.condition import Condition
from torch_surfcap.studies.stress.suite import CLEAN

Results = Mapping[
    tuple[str, Condition], dict[str, Any]
]  # by scene and condition; empty where it is still to be run
MARKS = ("<!-- stress: begin -->", "<!-- stress: end -->")
BROKEN = ("crashed", "hung", "not finite", "empty")
SAME = {"rotated": 0.3, "far away": 0.03}  # voxels that the mesh may move by on average, 0.1 unless named
SCORES = ("chamfer", "concave", "pieces", "psnr", "seconds", "memory", "moved_voxels")
WORST = 4.0  # times the clean run's, at which the heat map's colours end
DARK = 3.0  # the same, where black does not show on them

# Group and title of a condition, and how many times the clean run's Chamfer and concave part it may reach.
BOUNDS = (
    ("photometry", "gain ±20%", 1.1),
    ("photometry", "noise 0.05", 1.3),
    ("calibration", "rotation 1 px", 2.0),
    ("calibration", "translation 1 px", 2.0),
    ("calibration", "focal length 1 px", 2.0),
    ("calibration", "principal point 1 px", 2.0),
    ("calibration", "one camera wrong", 1.15),
    ("photometry", "another moment", 1.15),
    ("silhouettes", "eroded 3 px", 1.5),
    ("silhouettes", "dilated 3 px", 1.5),
    ("silhouettes", "eroded, no plates 3 px", 1.5),
    ("silhouettes", "dilated, no plates 3 px", 1.5),
    ("capture", "views 15", 2.0),
    ("subject", "uniform colour", 2.0),
    ("subject", "gloss, B = 2 0.2", 1.5),
)


def failed(result: Mapping[str, Any]) -> bool:
    """Whether a run ended without a surface and without a word of the program's."""
    return result.get("outcome") in BROKEN


def as_expected(condition: Condition, result: Mapping[str, Any]) -> bool | None:
    """Whether the program did what the condition expects of it; None where it has not been run."""
    if not result:
        return None
    if failed(result):
        return False
    fitted = result["outcome"] == "fitted"
    if condition.expected == "words":
        return bool(result["said"] or result["found"])
    if condition.expected == "same":
        return fitted and result.get("moved_voxels", 0.0) <= SAME.get(condition.name, 0.1)
    return fitted or condition.expected == "surface or words"


def in_words(result: Mapping[str, Any]) -> str:
    """One line for the terminal."""
    scores = [f"{name} {result[name]:.4g}" for name in SCORES if name in result]
    return ", ".join([result["outcome"], *scores, *result["said"], *result.get("found", [])])


def lines(results: Results) -> list[dict[str, Any]]:
    """A line of the CSV per run; lengths in millimetres, memory in bytes."""
    found = []
    for (scene, condition), result in results.items():
        line: dict[str, Any] = {"scene": scene, "group": condition.group, "condition": condition.title}
        line |= {"expected": condition.expected, "outcome": result.get("outcome", "")}
        names = [*SCORES, "psnr_masked", "hull_chamfer", "hull_concave", "hull_pieces", "status"]
        line |= {name: result.get(name, "") for name in names}
        found.append(
            line | {"said": "; ".join(result.get("said", [])), "found": "; ".join(result.get("found", []))}
        )
    return found


def ratio(results: Results, scene: str, condition: Condition, name: str) -> float:
    """Of a score to the clean run's; NaN where either is missing."""
    clean = results.get((scene, CLEAN), {}).get(name, math.nan)
    return float(results.get((scene, condition), {}).get(name, math.nan)) / clean if clean else math.nan


def bounds_table(results: Results) -> str:
    """Markdown: the bound, and what was reached: how many times the clean run's, and millimetres."""
    text = ["| condition | scene | bound | Chamfer | concave part |", "|---|---|---|---|---|"]
    bounds = {(group, title): bound for group, title, bound in BOUNDS}
    for (scene, condition), result in results.items():
        bound = bounds.get((condition.group, condition.title))
        if bound is None:
            continue
        cells = []
        for name in ("chamfer", "concave"):
            times = ratio(results, scene, condition, name)
            mark = "" if not times > bound else " **missed**"
            outcome = result.get("outcome", "still to be run")
            cells.append(outcome if math.isnan(times) else f"{times:.2f}× ({_mm(result, name)} mm){mark}")
        text.append(f"| {condition.title} | {scene} | {bound:g}× | {' | '.join(cells)} |")
    return "\n".join(text)


def table(results: Results) -> str:
    """Markdown: every run, and what the program said."""
    head = "| condition | scene | Chamfer, mm | hull's | concave part, mm | hull's | pieces | PSNR held out, dB | s | MiB | "
    text = [head + "expected | what the program said |", "|---" * 12 + "|"]
    group = None
    for condition in dict.fromkeys(condition for _, condition in results):
        if condition.group != group:
            group = condition.group
            text.append(f"| **{group or 'clean'}** |" + " |" * 11)
        text += [
            _row(scene, condition, result) for (scene, other), result in results.items() if other == condition
        ]
    return "\n".join(text)


def _row(scene: str, condition: Condition, result: dict[str, Any]) -> str:
    verdict = {None: "", True: "yes", False: "**no**"}[as_expected(condition, result)]
    words = [f"check: {line}" for line in result.get("found", [])]
    words = [*result.get("said", []), *words]
    if "moved_voxels" in result:
        words.insert(0, f"{result['moved_voxels']:.3f} voxel from the clean mesh")
    outcome = result.get("outcome", "still to be run")
    if outcome != "fitted":
        words.insert(0, f"*{outcome}*")
    cells = [
        condition.title,
        scene,
        *(_mm(result, name) for name in ("chamfer", "hull_chamfer", "concave", "hull_concave")),
        *(
            _text(result, name, form)
            for name, form in (("pieces", ".0f"), ("psnr", ".1f"), ("seconds", ".1f"))
        ),
        f"{result['memory'] / 2**20:.0f}" if "memory" in result else "",
        f"{condition.expected}: {verdict}",
        "; ".join(words).replace("|", "\\|").replace("\n", " "),
    ]
    return f"| {' | '.join(cells)} |"


def _text(result: Mapping[str, Any], name: str, form: str) -> str:
    return format(result[name], form) if isinstance(result.get(name), (int, float)) else ""


def _mm(result: Mapping[str, Any], name: str) -> str:
    return _text(result, name, ".2f")


def write_heat_map(path: Path, results: Results) -> None:
    """PNG: Chamfer and concave part relative to the clean run, a row per condition, a column per scene and score."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.colors import LogNorm
    from matplotlib.figure import Figure

    scenes = list(dict.fromkeys(scene for scene, _ in results))
    conditions = list(dict.fromkeys(condition for _, condition in results))
    columns = [(scene, name) for scene in scenes for name in ("chamfer", "concave")]
    values = np.array([[ratio(results, scene, c, name) for scene, name in columns] for c in conditions])
    half = (len(conditions) + 1) // 2
    figure = Figure(figsize=(5 + 2.2 * len(scenes), 1.2 + 0.2 * half), dpi=110, layout="constrained")
    FigureCanvasAgg(figure)
    panels = [part for part in (slice(0, half), slice(half, None)) if conditions[part]]
    for axes, part in zip(figure.subplots(1, len(panels), squeeze=False)[0], panels, strict=True):
        shown = values[part].reshape(-1, len(columns))
        image = axes.imshow(shown, cmap="RdYlGn_r", norm=LogNorm(1 / WORST, WORST), aspect="auto")
        for row, condition in enumerate(conditions[part]):
            for column, (scene, _) in enumerate(columns):
                result, times = results.get((scene, condition), {}), shown[row, column]
                word = f"{times:.2f}" if not math.isnan(times) else result.get("outcome", "")
                spoken = "*" if result.get("said") or result.get("found") else ""
                dark = max(times, 1 / times) > DARK
                color = "white" if dark else "black"
                axes.text(column, row, word + spoken, ha="center", va="center", fontsize=6, color=color)
        axes.set_xticks(range(len(columns)), [f"{s}\n{n}" for s, n in columns], fontsize=7)
        axes.set_yticks(range(len(shown)), [c.title for c in conditions[part]], fontsize=6)
        axes.tick_params(length=0, top=True, labeltop=True, bottom=False, labelbottom=False)
    bar = figure.colorbar(image, ax=figure.axes, shrink=0.4, extend="both")
    bar.set_label("times the clean run's; *: the program said something")
    bar.ax.minorticks_off()
    bar.set_ticks([1 / WORST, 0.5, 1, 2, WORST], labels=[f"{1 / WORST:g}", "0.5", "1", "2", f"{WORST:g}"])
    with atomic_write(path) as partial:
        figure.savefig(partial)


def write(path: Path, results: Results, command: str, jobs: int = 1) -> None:
    """Put everything between the marks of a page, which is made where there is none, and the picture beside it. jobs: runs
    at a time."""
    text = path.read_text(encoding="utf-8") if path.is_file() else f"# Stability\n\n{MARKS[0]}\n{MARKS[1]}\n"
    if text.count(MARKS[0]) != 1 or text.count(MARKS[1]) != 1:
        raise InputError(f"{path}: expected the marks {MARKS[0]} and {MARKS[1]}, once each")
    picture = path.with_suffix(".png")
    write_heat_map(picture, results)
    done = sum(bool(result) for result in results.values())
    wrong = sum(as_expected(condition, result) is False for (_, condition), result in results.items())
    count = f"{done} of {len(results)} runs are done; in {wrong} the program did not do what is expected."
    sentences = "\n".join(
        f"- *{c.title}*: {c.sentence}" for c in dict.fromkeys(condition for _, condition in results)
    )
    parts = [
        f"Written by\n\n    {command}\n\nwith {program()} on {machine()}, {jobs} runs at a time. {count}",
        f"![heat map]({picture.name})",
    ]
    parts += ["## Bounds", bounds_table(results), "## Every run", table(results), "## Conditions", sentences]
    page = renewed(text, "\n\n".join(parts), MARKS)
    with atomic_write(path) as partial:
        partial.write_text(page, encoding="utf-8")
