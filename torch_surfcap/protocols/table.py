"""The table that papers print: a row per scene and their mean."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from torch_surfcap.data.files import atomic_write
from torch_surfcap.report import write_json


@dataclass(frozen=True)
class Column:
    """Where a column's figure stands in the results of a run, and how it is printed."""

    title: str
    part: str | None  # of the results; None: the results themselves
    key: str
    style: str
    unit: float = 1.0  # that the printed figure counts


COST = (
    Column("seconds", "fit", "seconds", ".1f"),
    Column("GiB", "fit", "peak_memory_bytes", ".2f", 2**30),
    Column("triangles", None, "triangles", ".0f"),
)
PICTURES = (
    Column("PSNR volume", "test", "psnr_volume", ".2f"),
    Column("PSNR raster", "test", "psnr_raster", ".2f"),
    Column("SSIM", "test", "ssim", ".3f"),
)
SURFACE = (
    Column("accuracy mm", "surface", "accuracy", ".3f"),
    Column("completeness mm", "surface", "completeness", ".3f"),
    Column("overall mm", "surface", "overall", ".3f"),
    Column("PSNR volume, mask", "train", "psnr_masked", ".2f"),
    Column("PSNR raster, mask", "train", "psnr_raster_masked", ".2f"),
)
COLUMNS = {"default": (*PICTURES, *COST), "nerf": (*PICTURES, *COST), "dtu": (*SURFACE, *COST)}


def table(protocol: str, scenes: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """The table of scenes, each given by its results, the content of its evaluation.json.

    Returns:
        "protocol"; "scenes", a list of rows with "scene", "run" and a figure per column, NaN where the results have
        none; "mean" with the same figures, NaN where one is NaN.
    """
    columns = COLUMNS[protocol]
    rows: list[dict[str, Any]] = []
    for results in scenes:
        row = {"scene": results["scene"], "run": results["run"]}
        for c in columns:
            value = (results if c.part is None else results.get(c.part, {})).get(c.key)
            row[c.key] = float("nan") if value is None else value
        rows.append(row)
    mean = {c.key: float(np.mean([row[c.key] for row in rows])) for c in columns}
    return {"protocol": protocol, "scenes": rows, "mean": mean}


def markdown(content: Mapping[str, Any]) -> str:
    """A `table` as Markdown, its columns aligned."""
    columns = COLUMNS[content["protocol"]]
    named = [(row["scene"], row) for row in content["scenes"]] + [("mean", content["mean"])]
    cells = [["scene", *(c.title for c in columns)]]
    for name, row in named:
        figures = (format(row[c.key] / c.unit, c.style) for c in columns)
        cells.append([name, *("–" if figure == "nan" else figure for figure in figures)])
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    lines = [
        "| " + " | ".join(cell.rjust(width) for cell, width in zip(line, widths, strict=True)) + " |"
        for line in cells
    ]
    lines.insert(1, "|" + "|".join("-" * (width + 1) + ":" for width in widths) + "|")
    return "\n".join(lines) + "\n"


def write(path: Path, content: Mapping[str, Any]) -> None:
    """A `table` as Markdown at `path` and with all digits as JSON beside it."""
    with atomic_write(path) as partial:
        partial.write_text(markdown(content), encoding="utf-8")
    write_json(path.with_suffix(".json"), content)
