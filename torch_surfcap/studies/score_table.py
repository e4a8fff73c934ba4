"""Scores of several runs as a markdown table: the best of a column bold, differences to a baseline in parentheses."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple


class Column(NamedTuple):
    """How a score is shown. better: 1 more, -1 less, 0 neither; unit: what a shown 1 is worth; length: in the capture's
    unit; difference: with the difference to the baseline."""

    title: str
    better: int
    form: str
    unit: float = 1.0
    length: bool = False
    difference: bool = False


COLUMNS = {
    "chamfer": Column("Chamfer", -1, ".4g", length=True, difference=True),
    "normal_error_deg": Column("normals, °", -1, ".1f"),
    "concave": Column("concave part", -1, ".4g", length=True, difference=True),
    "pieces": Column("pieces", 0, ".0f"),
    "silhouette_iou": Column("IoU", 1, ".4f"),
    "psnr_volume": Column("PSNR volume, dB", 1, ".2f", difference=True),
    "psnr_masked": Column("PSNR within the mask, dB", 1, ".2f", difference=True),
    "psnr_raster": Column("PSNR raster, dB", 1, ".2f", difference=True),
    "samples": Column("samples of an iteration, 10⁶", 0, ".2f", unit=1e6),
    "tiles": Column("tiles", 0, ".0f"),
    "iterations": Column("iterations", 0, ".0f"),
    "seconds": Column("seconds", -1, ".0f"),
    "cpu_seconds": Column("CPU seconds", -1, ".0f"),
    "memory": Column("peak memory, MiB", -1, ".0f", unit=2.0**20),
}


class Line(NamedTuple):
    """A row of the table. scores may lack columns; note: why it does; group: a heading where it changes."""

    name: str
    settings: str
    scores: Mapping[str, float]
    note: str = ""
    group: str = ""
    baseline: bool = False


def markdown(lines: Sequence[Line], columns: Iterable[str], millimetres: float | None = None) -> str:
    """The table, without those columns that no line has.

    Args:
        columns: keys of COLUMNS.
        millimetres: of the capture's unit of length; None: not known, lengths are shown in that unit.

    >>> lines = [Line("a", "x=1", {"seconds": 3.0}), Line("b", "x=2", {"seconds": 4.0}), Line("c", "y=3", {}, "no key y")]
    >>> print(markdown(lines, ["seconds", "tiles"]))
    |  | settings | seconds |
    |---|---|---|
    | a | `x=1` | **3** |
    | b | `x=2` | 4 |
    | c | `y=3`: no key y |  |
    """
    shown = {name: COLUMNS[name] for name in columns if any(name in line.scores for line in lines)}
    for name, column in shown.items():
        if column.length and millimetres:
            shown[name] = column._replace(title=f"{column.title}, mm", unit=1 / millimetres, form=".3f")
    filled = [_cells(name, column, lines) for name, column in shown.items()]
    text = [
        _row("", "settings", *(column.title for column in shown.values())),
        "|---" * (2 + len(shown)) + "|",
    ]
    group = ""
    for line, *values in zip(lines, *filled, strict=True):
        if line.group != group:
            group = line.group
            text.append(_row(f"*{group}*", "", *[""] * len(shown)))
        parts = [f"`{line.settings}`"] * bool(line.settings) + [line.note.replace("|", "\\|")] * bool(
            line.note
        )
        text.append(_row(line.name, ": ".join(parts), *values))
    return "\n".join(text)


def _cells(name: str, column: Column, lines: Sequence[Line]) -> list[str]:
    """The column's text for each line."""
    values = [line.scores[name] / column.unit if name in line.scores else None for line in lines]
    known = [value for value in values if value is not None]
    texts = ["" if value is None else format(value, column.form) for value in values]
    best = format((max if column.better > 0 else min)(known), column.form)
    bold = column.better != 0 and len({*texts} - {""}) > 1
    base = next((value for line, value in zip(lines, values, strict=True) if line.baseline), None)
    cells = []
    for line, value, text in zip(lines, values, texts, strict=True):
        cell = f"**{text}**" if bold and text == best else text
        if column.difference and not line.baseline and value is not None and base is not None:
            cell += f" ({value - base:+{column.form}})"
        cells.append(cell)
    return cells


def _row(*cells: str) -> str:
    return f"| {' | '.join(cells)} |"
