"""The pictures of a chart, as PNG and SVG. Matplotlib is imported where it is needed."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from torch_surfcap.data.files import atomic_write
from torch_surfcap.report import DPI
from torch_surfcap.studies.chart import (
    AXES,
    COSTS,
    GROWTH,
    LARGE,
    MARCH,
    PRESETS,
    RIVALS,
    WORK,
    Mark,
    Published,
    exponent,
    front,
    growth,
)

SUFFIXES = (".png", ".svg")
AREA = 60.0  # of a mark of 1 GiB, points²
LEAST = 12.0  # of a mark, points²
WIDTH = 7.0  # of a panel, inches
HEIGHT = 5.0
OURS, RIVAL, OTHERS = "#1f5fa8", "#c03a2b", "#777777"


def write_accuracy(
    path: Path,
    marks: Sequence[Mark],
    published: Sequence[Published],
    millimetres: Mapping[str, float | None],
) -> list[Path]:
    """Accuracy against seconds: a row of panels per scene, Chamfer and held-out PSNR, the area of a mark its peak memory,
    a line through the front of ours, hollow marks for what is published. millimetres: of each scene's unit of length."""
    scenes = list(dict.fromkeys(mark.scene for mark in marks if mark.scores))
    figure, panels = _figure(len(scenes), 2)
    for scene, (left, right) in zip(scenes, panels, strict=False):  # a figure without panels is none
        here = [mark for mark in marks if mark.scene == scene and "seconds" in mark.scores]
        unit = millimetres.get(scene)
        _accuracy(left, here, "chamfer", unit or 1.0)
        left.set(ylabel=f"Chamfer, {'mm' if unit else 'unit of the capture'}", yscale="log")
        _accuracy(right, here, "psnr_masked", 1.0)
        right.set(ylabel="held-out PSNR within the mask, dB")
        if unit:
            _published(left, [(p, p.chamfer_mm) for p in published])
        _published(right, [(p, p.psnr_db) for p in published])
        for axes in (left, right):
            axes.set(xlabel="seconds, start to written files", xscale="log", title=scene)
            axes.grid(alpha=0.25, which="both")
            _plain_ticks(axes)
        left.legend(fontsize=7, loc="best")
        right.legend(fontsize=7, loc="best")
    return _save(figure, path)


def _accuracy(axes: Any, marks: Sequence[Mark], score: str, unit: float) -> None:
    """The marks of one panel; ``unit``: what the score is multiplied by."""
    sign = -1.0 if score == "psnr_masked" else 1.0
    known = [mark for mark in marks if math.isfinite(mark.scores.get(score, math.nan))]
    for title, color, form in ((PRESETS, OURS, "o"), ("", OURS, "o"), (RIVALS, RIVAL, "s")):
        chosen = [m for m in known if (m.title == title if title else m.title not in (PRESETS, RIVALS))]
        if chosen:
            axes.scatter(
                [m.scores["seconds"] for m in chosen],
                [m.scores[score] * unit for m in chosen],
                s=[max(LEAST, AREA * m.scores.get("memory", 0.0) / 2**30) for m in chosen],
                c=color,
                marker=form,
                alpha=0.95 if title else 0.35,
                linewidths=0,
                label={PRESETS: "presets", RIVALS: "same run: rivals on this CPU"}.get(title, "sweep"),
            )
        for m in chosen:
            at = (m.scores["seconds"], m.scores[score] * unit)
            axes.annotate(m.name, at, (4, 3), textcoords="offset points", fontsize=8 if title else 5)
    ours = [m for m in known if m.title != RIVALS]
    best = [ours[i] for i in front([(m.scores["seconds"], sign * m.scores[score]) for m in ours])]
    line = [m.scores["seconds"] for m in best], [m.scores[score] * unit for m in best]
    axes.plot(*line, color=OURS, linewidth=1, label="our Pareto front; area of a mark: peak memory")


def _published(axes: Any, figures: Sequence[tuple[Published, float]]) -> None:
    """Hollow marks of those figures whose time and value are known."""
    known = [(p, value) for p, value in figures if math.isfinite(value) and math.isfinite(p.seconds)]
    if not known:
        return
    axes.scatter(
        [p.seconds for p, _ in known],
        [value for _, value in known],
        s=[max(LEAST, AREA * p.memory_gib if math.isfinite(p.memory_gib) else 0.0) for p, _ in known],
        facecolors="none",
        edgecolors=OTHERS,
        label="published, other hardware and other data",
    )
    for p, value in known:
        text = f"{p.method} ({p.data})"
        axes.annotate(text, (p.seconds, value), (4, -5), textcoords="offset points", fontsize=5, color=OTHERS)


def write_growth(path: Path, marks: Sequence[Mark], millimetres: Mapping[str, float | None]) -> list[Path]:
    """How COSTS grow with what GROWTH sweeps, both on logarithmic axes, with the fitted power of each scene."""
    scenes = list(dict.fromkeys(mark.scene for mark in marks))
    figure, panels = _figure(len(COSTS), len(GROWTH), 4.2, 3.2)
    for axes_of_cost, (cost, words) in zip(panels, COSTS.items(), strict=True):
        for axes, (group, axis) in zip(axes_of_cost, GROWTH.items(), strict=True):
            drawn = False
            for number, scene in enumerate(scenes):
                x, y = growth([mark for mark in marks if mark.scene == scene], group, cost)
                fit = exponent(x, y)
                if fit is None:
                    continue
                unit = (millimetres.get(scene) or 1.0) if cost == "chamfer" else 1.0
                y = [value * unit for value in y]
                power, factor = fit
                axes.plot(x, y, "o", color=f"C{number}", markersize=4, label=f"{scene}: power {power:+.2f}")
                ends = np.array([min(x), max(x)])
                axes.plot(ends, factor * unit * ends**power, color=f"C{number}", linewidth=1, alpha=0.6)
                drawn = True
            axes.set(xlabel=AXES[axis], ylabel=words, xscale="log", yscale="log")
            axes.grid(alpha=0.25, which="both")
            if drawn:
                _plain_ticks(axes)
                axes.legend(fontsize=7)
    return _save(figure, path)


def write_work(path: Path, marks: Sequence[Mark]) -> list[Path]:
    """Where the presets' seconds go: a stacked bar per place in the fit; the legend's shares are of the whole run, and an
    asterisk marks what exceeds LARGE and is not the march."""
    shown = [mark for mark in marks if mark.title == PRESETS and mark.work]
    figure, panels = _figure(1, max(1, len(shown)), 3.8, 4.6)
    for axes, mark in zip(panels[0], shown, strict=False):
        places = list(mark.work)
        total = sum(sum(kinds.values()) for kinds in mark.work.values())
        base = np.zeros(len(places))
        for number, kind in enumerate(WORK):
            height = np.array([mark.work[place].get(kind, 0.0) for place in places])
            if not height.any():
                continue
            share = float(height.sum()) / total
            star = " *" if share > LARGE and kind not in MARCH else ""
            hatch = "///" if number >= 10 else None  # there are ten colours
            color = f"C{number % 10}"
            label = f"{WORK[kind]} {100 * share:.0f} %{star}"
            axes.bar(places, height, bottom=base, color=color, hatch=hatch, edgecolor="white", label=label)
            base += height
        axes.set(title=f"{mark.scene}, {mark.name}: {total:.1f} s", ylabel="seconds")
        axes.tick_params(axis="x", rotation=45)
        axes.legend(fontsize=6)
    return _save(figure, path)


def _figure(rows: int, columns: int, width: float = WIDTH, height: float = HEIGHT) -> tuple[Any, Any]:
    """A figure and its panels [rows, columns], each so many inches large."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    size = (columns * width, max(1, rows) * height)
    figure = Figure(figsize=size, dpi=DPI, layout="constrained")
    FigureCanvasAgg(figure)
    return figure, figure.subplots(max(1, rows), columns, squeeze=False)


def _plain_ticks(axes: Any) -> None:
    """Numbers as they are spoken, also where an axis spans less than a power of ten."""
    from matplotlib.ticker import FuncFormatter, LogLocator

    for axis in (axes.xaxis, axes.yaxis):
        if axis.get_scale() == "log":
            axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
            axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
            axis.set_minor_formatter(FuncFormatter(lambda value, _: ""))


def _save(figure: Any, path: Path) -> list[Path]:
    """Beside ``path``, with each of SUFFIXES; without dates, so that the same numbers give the same files."""
    from matplotlib import rc_context

    files = [path.with_suffix(suffix) for suffix in SUFFIXES]
    for file in files:
        with atomic_write(file) as partial, rc_context({"svg.hashsalt": "chart", "svg.fonttype": "none"}):
            figure.savefig(partial, metadata={"Date": None} if file.suffix == ".svg" else None)
    return files
