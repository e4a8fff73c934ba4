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
    shares,
)
from torch_surfcap.studies.chart_names import Spot, write_names

SUFFIXES = (".png", ".svg")
AREA = 60.0  # of a mark of 1 GiB, points²
LEAST = 12.0  # of a mark, points²
SIZES = (0.5, 1.0, 4.0)  # GiB whose marks the legend shows
WIDTH = 5.6  # of a panel, inches
HEIGHT = 5.4
OURS, SWEEP, RIVAL, OTHERS = "#1f5fa8", "#8fb3d9", "#c03a2b", "#555555"
TEXT = "#6288b3"  # of a sweep's names
UNITS = {"memory": 2.0**-30}  # what a cost is multiplied by before it is drawn
SHOWN = 0.04  # share of a bar in all seconds from which on it is written there


def write_accuracy(
    path: Path,
    marks: Sequence[Mark],
    published: Sequence[Published],
    millimetres: Mapping[str, float | None],
) -> list[Path]:
    """Accuracy against seconds: a row of panels per scene, Chamfer and PSNR of whole held-out pictures, which is what others
    publish; the area of a mark its peak memory, a line through the front of ours, hollow and numbered marks for what is
    published. millimetres: of each scene's unit of length."""
    scenes = list(dict.fromkeys(mark.scene for mark in marks if mark.scores))
    figure, panels = _figure(len(scenes), 2)
    numbered = [p for p in published if math.isfinite(p.seconds)]
    drawn = []
    for scene, (left, right) in zip(scenes, panels, strict=False):  # a figure without panels is none
        here = [mark for mark in marks if mark.scene == scene and "seconds" in mark.scores]
        unit = millimetres.get(scene)
        spots = _ours(left, here, "chamfer", unit or 1.0)
        spots += _published(left, [p.chamfer_mm if unit else math.nan for p in numbered], numbered)
        drawn.append((left, spots))
        spots = _ours(right, here, "psnr_volume", 1.0)
        drawn.append((right, spots + _published(right, [p.psnr_db for p in numbered], numbered)))
        left.set(ylabel=f"Chamfer, {'mm' if unit else 'unit of the capture'}", yscale="log")
        right.set(ylabel="PSNR of whole held-out pictures, dB")
        for axes in (left, right):
            axes.set(xlabel="seconds, start to written files", xscale="log", title=scene)
            axes.grid(alpha=0.25, which="both")
            axes.margins(0.08)
            _plain_ticks(axes)
    _legend(figure, numbered)
    figure.draw_without_rendering()  # lays the panels out: only now is known where there is room
    figure.set_layout_engine("none")
    for axes, spots in drawn:
        write_names(axes, spots)
    return _save(figure, path)


def _ours(axes: Any, marks: Sequence[Mark], score: str, unit: float) -> list[Spot]:
    """Draws the marks of one panel and the front; ``unit``: what the score is multiplied by."""
    known = [mark for mark in marks if math.isfinite(mark.scores.get(score, math.nan))]
    presets = {_at(mark, score, unit) for mark in known if mark.title == PRESETS}
    kinds: dict[str, list[Spot]] = {"": [], RIVALS: [], PRESETS: []}
    for mark in known:
        at, kind = _at(mark, score, unit), mark.title if mark.title in kinds else ""
        if kind or at not in presets:  # a sweep comes by the preset that it changes
            look = {PRESETS: (OURS, 9.0), RIVALS: (RIVAL, 8.0)}.get(kind, (TEXT, 6.5))
            kinds[kind].append(Spot(*at, _area(mark.scores.get("memory")), mark.name, *look, bool(kind)))
    for kind, form in (("", "o"), (RIVALS, "s"), (PRESETS, "o")):
        x, y, areas, *_ = zip(*kinds[kind], strict=True) if kinds[kind] else ((), (), ())
        color = OURS if kind == PRESETS else RIVAL if kind else SWEEP
        alpha = 0.9 if kind else 0.6
        axes.scatter(x, y, areas, color, marker=form, linewidths=0, alpha=alpha, zorder=3)
    ours = [_at(mark, score, unit) for mark in known if mark.title != RIVALS]
    best = [ours[i] for i in front([(x, -y if score.startswith("psnr") else y) for x, y in ours])]
    axes.plot([x for x, _ in best], [y for _, y in best], color=OURS, linewidth=1)
    return [*kinds[PRESETS], *kinds[RIVALS], *kinds[""]]


def _at(mark: Mark, score: str, unit: float) -> tuple[float, float]:
    return mark.scores["seconds"], mark.scores[score] * unit


def _area(memory: float | None) -> float:
    """Of the mark of so many bytes, points²."""
    return max(LEAST, AREA * (memory or 0.0) / 2**30)


def _published(axes: Any, values: Sequence[float], figures: Sequence[Published]) -> list[Spot]:
    """Hollow marks of those figures whose value is known, with their numbers in the legend."""
    spots = []
    for number, (figure, value) in enumerate(zip(figures, values, strict=True), 1):
        if math.isfinite(value):
            sized = math.isfinite(figure.memory_gib)
            area = _area(figure.memory_gib * 2**30) if sized else 2 * LEAST
            form = "o" if sized else "D"
            axes.scatter(figure.seconds, value, area, marker=form, facecolors="none", edgecolors=OTHERS)
            spots.append(Spot(figure.seconds, value, area, str(number), OTHERS, 8.0))
    return spots


def _legend(figure: Any, figures: Sequence[Published]) -> None:
    """One for the whole figure, beside the panels."""
    from matplotlib.lines import Line2D

    def mark(label: str, color: str, form: str = "o", area: float = AREA, **more: Any) -> Line2D:
        look = {"markeredgewidth": 0, "markersize": math.sqrt(area)} | more
        return Line2D([], [], color=color, linestyle="none", marker=form, label=label, **look)

    hollow: dict[str, Any] = {"markerfacecolor": "none", "markeredgewidth": 1}
    handles = [
        mark("presets", OURS),
        mark("sweep", SWEEP),
        mark("same run: rivals on this CPU", RIVAL, "s"),
        Line2D([], [], color=OURS, linewidth=1, label="our Pareto front"),
        *(mark(f"peak memory of {size:g} GiB", "#bbbbbb", area=AREA * size) for size in SIZES),
    ]
    if figures:
        handles.append(mark("published, other hardware and other data", OTHERS, **hollow))
        handles.append(mark("the same, memory not known", OTHERS, "D", 2 * LEAST, **hollow))
    for number, one in enumerate(figures, 1):
        handles.append(mark(f"{one.method} ({one.data})", OTHERS, f"${number}$", 40.0 * len(str(number))))
    figure.legend(handles=handles, loc="outside right upper", fontsize=8, labelspacing=0.5, frameon=False)


def write_growth(path: Path, marks: Sequence[Mark], millimetres: Mapping[str, float | None]) -> list[Path]:
    """How COSTS grow with what GROWTH sweeps, both on logarithmic axes; above each panel the fitted power of each scene."""
    from matplotlib.lines import Line2D

    scenes = list(dict.fromkeys(mark.scene for mark in marks))
    swept = {group: axis for group, axis in GROWTH.items() if any(mark.group == group for mark in marks)}
    figure, panels = _figure(len(COSTS), max(1, len(swept)), 4.2, 3.2)
    for axes_of_cost, (cost, words) in zip(panels, COSTS.items(), strict=True):
        for axes, (group, axis) in zip(axes_of_cost, (swept or GROWTH).items(), strict=False):
            powers = []
            for number, scene in enumerate(scenes):
                x, y = growth([mark for mark in marks if mark.scene == scene], group, cost)
                fit = exponent(x, y)
                if fit is None:
                    continue
                unit = (millimetres.get(scene) or 1.0) if cost == "chamfer" else UNITS.get(cost, 1.0)
                power, factor = fit
                axes.plot(x, [value * unit for value in y], "o", color=f"C{number}", markersize=4)
                ends = np.array([min(x), max(x)])
                axes.plot(ends, factor * unit * ends**power, color=f"C{number}", linewidth=1, alpha=0.6)
                powers.append(f"{scene}: power {power:+.2f}")
            axes.set_visible(bool(powers))
            axes.set(xlabel=AXES[axis], ylabel=words, xscale="log", yscale="log")
            axes.set_title(", ".join(powers), fontsize=9)
            axes.grid(alpha=0.25, which="both")
            if powers:
                _plain_ticks(axes)
    known = [Line2D([], [], color=f"C{i}", marker="o", label=scene) for i, scene in enumerate(scenes)]
    figure.legend(handles=known, loc="outside upper center", ncols=len(known) or 1, frameon=False)
    return _save(figure, path)


def write_work(path: Path, marks: Sequence[Mark]) -> list[Path]:
    """Where the presets' seconds go: a row of panels per scene, a stacked bar per place in the fit, with the shares of all
    seconds from SHOWN on; an asterisk marks what exceeds LARGE altogether and is not the march."""
    from matplotlib.patches import Patch

    shown = [mark for mark in marks if mark.title == PRESETS and mark.work]
    scenes = {mark.scene: [m for m in shown if m.scene == mark.scene] for mark in shown}
    figure, panels = _figure(len(scenes), max(1, *map(len, scenes.values()), 0), 4.2, 4.6)
    for axes in panels.flat:
        axes.set_visible(False)
    used = set[str]()
    for row, here in zip(panels, scenes.values(), strict=False):
        for axes, mark in zip(row, here, strict=False):
            axes.set_visible(True)
            used |= _bars(axes, mark)
    order = [kind for kind in reversed(WORK) if kind in used]  # as the bars are stacked
    handles = [Patch(**_bar(kind), label=WORK[kind]) for kind in order]
    figure.legend(handles=handles, loc="outside right upper", fontsize=9, frameon=False)
    return _save(figure, path)


def _bars(axes: Any, mark: Mark) -> set[str]:
    """The panel of one fit; which kinds of work took any time."""
    places = list(mark.work)
    total = sum(sum(kinds.values()) for kinds in mark.work.values())
    base, used, share = np.zeros(len(places)), set[str](), shares(mark.work)
    for kind in WORK:
        height = np.array([mark.work[place].get(kind, 0.0) for place in places])
        if not height.any():
            continue
        used.add(kind)
        star = " *" if share[kind] > LARGE and kind not in MARCH else ""
        axes.bar(places, height, bottom=base, **_bar(kind))
        for place, (low, seconds) in enumerate(zip(base, height, strict=True)):
            if seconds > SHOWN * total:
                text = f"{100 * seconds / total:.0f} %{star}"
                back = {"facecolor": "white", "edgecolor": "none", "alpha": 0.8, "pad": 1}
                axes.text(place, low + seconds / 2, text, ha="center", va="center", fontsize=7, bbox=back)
        base += height
    axes.set(title=f"{mark.scene}, {mark.name}: {total:.1f} s", ylabel="seconds", ylim=(0, 1.05 * base.max()))
    axes.tick_params(axis="x", rotation=45)
    return used


def _bar(kind: str) -> dict[str, Any]:
    """How a kind of work looks."""
    number = list(WORK).index(kind)
    hatch = (None, "///", "...")[number // 10]  # there are ten colours
    return {"facecolor": f"C{number % 10}", "edgecolor": "white", "hatch": hatch}


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
            low, high = axis.get_view_interval()
            axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if high < 100 * low else (1.0, 3.0)))
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
