"""Ablation: what each choice is worth, as tables of fits that differ in it alone.

    python train/ablate.py --scene NAME=CAPTURE [--scene ...] --out OUT [--groups NAME,...] [--minutes 60] [key=value ...]

configs/ablation/table.yaml holds the rows; key=value changes all of them. Each runs train/fit.py and train/evaluate.py in
processes of their own, scored on the held-out views and against what CAPTURE holds of gt.ply, gt_visible.npz and
concave.npz. It lies in OUT/SCENE/KEY, KEY standing for its resolved settings and the program: a finished row is not run
again, and a command that was stopped or ran out of its minutes goes on where it was. Writes OUT/ablation.csv and the page
OUT/ablation.md.

Exit 0: no row failed, though some may be left. 1: a row failed, the tables say why. 2: bad input. 130: interrupted.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from itertools import groupby
from pathlib import Path

from torch_surfcap import report
from torch_surfcap.data.files import atomic_write
from torch_surfcap.errors import InputError
from torch_surfcap.studies.ablation import Row, Scene, Table, plan, read_table
from torch_surfcap.studies.provenance import machine, program
from torch_surfcap.studies.rows import Results, read_result, run
from torch_surfcap.studies.score_table import COLUMNS, Line, markdown

TABLE = Path(__file__).resolve().parents[1] / "configs" / "ablation" / "table.yaml"
APART = {"psnr_masked", "samples", "tiles", "iterations"}  # columns for groups with a table of their own


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit status."""
    options = _options(arguments)
    try:
        table = read_table(options.table)
        names = options.groups or list(table.groups)
        for name in names:
            if name not in table.groups:
                raise InputError(f"--groups: found {name}, expected some of {', '.join(table.groups)}")
        scenes = dict(_scene(text) for text in options.scene)
        rows = plan(table, scenes, names, options.settings)
        interrupted = not run(rows, scenes, options.out, 60 * options.minutes)
        results = {row: read_result(row, options.out) for row in rows}
        write_csv(results, options.out / "ablation.csv")
        tables = score_tables(results, table)
        with atomic_write(options.page or options.out / "ablation.md") as partial:
            partial.write_text(frame(results, table, options) + tables, encoding="utf-8")
    except InputError as error:
        print(error, file=sys.stderr)
        return 2
    print(tables)
    return 130 if interrupted else int(any("error" in result for result in results.values()))


def write_csv(results: Results, path: Path) -> None:
    """A line per row, with all scores; lengths in the capture's unit, memory in bytes."""
    lines = []
    for row, result in results.items():
        group = row.group.title if row.group else ""
        line = {
            "scene": row.scene,
            "opacity": row.opacity,
            "group": group,
            "row": row.name,
            "changes": row.changes,
        }
        lines.append(line | {"key": row.key, "error": result.get("error", "")} | result.get("scores", {}))
    report.write_history(path, lines)


def score_tables(results: Results, table: Table) -> str:
    """Per scene and opacity a table, and one for each group that has its own."""
    text = []
    for name, of_scene in groupby(results, key=lambda row: row.scene):
        scene = table.scenes.get(name, Scene())
        text.append(f"## {name}\n\n`{scene.settings}`\n")
        for opacity, here in groupby(of_scene, key=lambda row: row.opacity):
            together: dict[str, list[Row]] = {}
            for row in here:
                together.setdefault(row.group.title if row.group and row.group.columns else "", []).append(
                    row
                )
            for title, rows in together.items():
                group = rows[0].group
                columns = (
                    group.columns
                    if group and title
                    else [column for column in COLUMNS if column not in APART]
                )
                lines = [_line(row, results, rows[0]) for row in rows]
                text.append(f"### {title + ', ' if title else ''}opacity={opacity}\n")
                text.append(markdown(lines, columns, scene.millimetres) + "\n")
    return "\n".join(text)


def _line(row: Row, results: Results, first: Row) -> Line:
    """The row in a table whose first row is `first`."""
    result = results[row]
    is_baseline = first.group is None and row.key == first.key and row.key is not None
    name = f"{row.name} (the baseline)" if is_baseline and row is not first else row.name
    group = row.group.title if row.group and first.group is None else ""
    note = result.get("error") or ("" if "scores" in result else "still to be run")
    return Line(name, row.changes, result.get("scores", {}), note, group, is_baseline)


FRAME = """# Ablation

Written by

    {command}

Each row is a fit that differs from the baseline, `{baseline}` over the defaults, in the settings named, and in nothing
else; the rows stand in [{table}]({where}). {done} rows are done, {failed} failed, {left} are still to be run.

Chamfer, normals, the concave part and pieces are of the mesh against the true surface, where that is known. PSNR, of the
whole picture by ray integral and by the mesh, and the IoU of silhouettes are of views that no fit saw. Seconds go from start
to written files, CPU seconds count all threads, peak memory is the process's. The best of a column is bold, differences to
the baseline stand in parentheses; one run a row, so that what differs by no more than another seed does means nothing.

{program} on {machine}.

"""


def frame(results: Results, table: Table, options: argparse.Namespace) -> str:
    """What stands above the tables: the command, how to read them, the machine."""
    scenes = dict.fromkeys(row.scene for row in results)
    words = [f"--scene {name}=DATA/{name}" for name in scenes]
    page = options.page or options.out / "ablation.md"
    words += [
        "--out OUT",
        *[f"--groups {','.join(options.groups or ())}"] * bool(options.groups),
        *options.settings,
    ]
    words += [f"--page {page}"] * bool(options.page and not page.is_absolute())
    done, failed = (sum(kind in result for result in results.values()) for kind in ("scores", "error"))
    return FRAME.format(
        command=f"python train/ablate.py {' '.join(words)}",
        baseline=table.baseline,
        table=options.table.name,
        where=Path(os.path.relpath(options.table, page.parent)).as_posix(),
        done=done,
        failed=failed,
        left=len(results) - done - failed,
        program=program(),
        machine=machine(),
    )


def _scene(text: str) -> tuple[str, Path]:
    name, _, path = text.partition("=")
    if not name or not Path(path).is_dir() or not path:
        raise InputError(f"--scene: found {text}, expected NAME=FOLDER of a capture")
    return name, Path(path)


def _options(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--scene", action="append", required=True, metavar="NAME=CAPTURE", help="repeatable")
    parser.add_argument("--out", type=Path, required=True, help="folder of the rows and tables")
    parser.add_argument("--table", type=Path, default=TABLE, metavar="YAML", help="the rows")
    parser.add_argument(
        "--groups", type=lambda text: text.split(","), metavar="NAME,...", help="of the table; all by default"
    )
    parser.add_argument("--minutes", type=float, default=60.0, help="start no row that would end later")
    parser.add_argument("--page", type=Path, metavar="MD", help="write the page there instead of into OUT")
    parser.add_argument("--device", metavar="DEVICE", help="of every row: auto, cpu, cuda, cuda:0, ...")
    parser.add_argument("settings", nargs="*", metavar="key=value", help="of every row")
    options = parser.parse_intermixed_args(arguments)
    options.settings += [f"device={options.device}"] * bool(options.device)
    return options


if __name__ == "__main__":
    sys.exit(main())
