"""Chart of speed against accuracy: presets, a declared sweep, rivals of the same run, and what is published.

    python train/chart.py --out OUT [--scene [NAME=]FOLDER ...] [--page docs/speed-accuracy.md] [key=value ...]

Without --scene it makes two scenes of known surface, matte and glossy. The presets are files of configs/; the sweep, changes
of `standard`, stands in configs/chart/sweep.yaml; key=value changes all of them. Rivals: the soft hull alone, and the fit of
`standard` by torch operators and autograd, stopped when that one's seconds (times each of --rival-times) are spent. Each row
runs in a process of its own, is scored on held-out views of full size and against gt.ply of its scene, and lies in
OUT/SCENE/KEY: a finished one is not run again, and a command that was stopped or ran out of its minutes goes on where it
was. Writes chart.csv (every number), chart.md, and accuracy, growth and work as .png and .svg into OUT; with --page the
tables go between its markers and the pictures into the folder of its name beside it.

Exit 0: no row failed, though some may be left. 1: a row failed, the tables say why. 2: bad input. 130: interrupted.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from torch_surfcap import config as settings
from torch_surfcap import report
from torch_surfcap.data.files import atomic_write
from torch_surfcap.errors import InputError
from torch_surfcap.studies import chart
from torch_surfcap.studies.ablation import Group, Row, Scene, Table, plan, read_table
from torch_surfcap.studies.chart import PRESETS, RIVALS, Mark
from torch_surfcap.studies.chart_page import COLUMNS, content, score_tables
from torch_surfcap.studies.marked_page import renewed
from torch_surfcap.studies.rows import ROOT, read_result, run

SWEEP = ROOT / "configs" / "chart" / "sweep.yaml"
PUBLISHED = ROOT / "docs" / "published.csv"
STANDARD = "standard"  # the preset that sweeps and rivals differ from
MADE: dict[str, tuple[str, ...]] = {
    "matte": (),
    "glossy": ("--gloss", "2", "--roughness", "0.5"),
}  # scenes, and how they are made


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit status."""
    options = _options(arguments)
    try:
        table = read_table(options.sweep)
        published = chart.read_published(options.published)
        for name in options.groups or ():
            if name not in table.groups:
                raise InputError(f"--groups: found {name}, expected some of {', '.join(table.groups)}")
        end = time.monotonic() + 60 * options.minutes
        scenes = dict(_scene(text) for text in options.scene or ()) or make_scenes(options)
        rows = planned(table, scenes, options)
        uninterrupted = run([row for row, _ in rows], scenes, options.out, end - time.monotonic())
        if uninterrupted and options.rivals:
            against = rivals(rows, options)
            rows += against
            uninterrupted = run([row for row, _ in against], scenes, options.out, end - time.monotonic())
        marks = [chart.mark_of(row, group, options.out) for row, group in rows]
        units = {name: table.scenes.get(name, Scene()).millimetres for name in scenes}
        folder = options.page.with_suffix("") if options.page else options.out
        report.write_history(options.out / "chart.csv", chart.csv_lines(marks))
        draw(folder, marks, published, units)
        base = options.page.parent if options.page else options.out
        there = [Path(os.path.relpath(path, base)).as_posix() for path in (folder, options.published)]
        text = content(marks, published, units, command(scenes, options), *there)
        with atomic_write(options.out / "chart.md") as partial:
            partial.write_text(text, encoding="utf-8")
        if options.page:
            before = (
                options.page.read_text(encoding="utf-8")
                if options.page.exists()
                else "# Speed and accuracy\n"
            )
            report.write_history(folder / "chart.csv", chart.csv_lines(marks))
            with atomic_write(options.page) as partial:
                partial.write_text(renewed(before, text, (chart.BEGIN, chart.END)), encoding="utf-8")
    except InputError as error:
        print(error, file=sys.stderr)
        return 2
    print(score_tables(marks, units))
    failed = any(mark.note and mark.note != chart.LEFT for mark in marks)
    return int(failed) if uninterrupted else 130


def make_scenes(options: argparse.Namespace) -> dict[str, Path]:
    """The scenes of MADE, in processes of their own: a row's peak memory begins at that of this one."""
    scenes = {name: options.out / "scenes" / name for name in MADE}
    size = [f"--views={options.views}", f"--test-views={options.test_views}", f"--size={options.size}"]
    for name, folder in scenes.items():
        command = [sys.executable, "-m", "torch_surfcap.data.sample_scene", str(folder), *size, *MADE[name]]
        environment = os.environ | {"PYTHONPATH": str(ROOT)}
        if subprocess.run(command, env=environment).returncode:
            raise InputError(f"{folder}: the scene could not be made")
    return scenes


def planned(table: Table, scenes: Mapping[str, Path], options: argparse.Namespace) -> list[tuple[Row, str]]:
    """Presets and sweep, with the keys of their groups, scene by scene."""
    words = {name: preset_words(name) for name in options.presets}
    presets = Table("", table.scenes, {PRESETS: Group(PRESETS, words, ["distance"], columns=COLUMNS)})
    names = [name for name in table.groups if options.groups is None or name in options.groups]
    groups = {name: replace(table.groups[name], opacity=["distance"], columns=COLUMNS) for name in names}
    sweep = Table(preset_words(STANDARD), table.scenes, groups)
    rows = []
    for scene, folder in scenes.items():
        for some in (presets, sweep):
            keys = {group.title: key for key, group in some.groups.items()}
            for row in plan(some, {scene: folder}, list(some.groups), options.settings):
                rows.append((_scored(row, table), keys[row.group.title if row.group else ""]))
    return rows


def preset_words(name: str) -> str:
    """The settings of configs/NAME.yaml that differ from the defaults, as key=value.

    Raises InputError for a preset that there is not.
    """
    config = settings.load(ROOT / "configs" / f"{name}.yaml")
    changed = settings.differences(settings.load(None), config)
    return " ".join(f"{key}={value}" for key, (_, value) in changed.items())


def _scored(row: Row, table: Table) -> Row:
    """The row, scored on pictures of the scene's size whatever its own scale."""
    given = [word for word in table.scenes.get(row.scene, Scene()).settings.split() if "data.scale=" in word]
    scale = given[-1].partition("=")[2] if given else "1"
    return replace(row, scored=(f"--scale={scale}",), key=row.key and f"{row.key}-{scale}")


def rivals(rows: Sequence[tuple[Row, str]], options: argparse.Namespace) -> list[tuple[Row, str]]:
    """The rivals of each scene's standard preset that is done, by name "hull" and "autograd"."""
    found = []
    program = hashlib.sha256((ROOT / "train" / "rivals.py").read_bytes()).hexdigest()[:8]
    for row, group in rows:
        seconds = read_result(row, options.out).get("scores", {}).get("seconds")
        if group != PRESETS or row.name != STANDARD or seconds is None:
            continue
        given: dict[str, tuple[str, ...]] = {}
        if "hull" in options.rivals:
            given["soft hull alone"] = ("--method=hull",)
        if "autograd" in options.rivals:
            for times in options.rival_times:
                name = "torch autograd" + f", {times:g} times the seconds" * (times != 1)
                given[name] = ("--method=autograd", f"--seconds={times * seconds:.1f}")
        for name, words in given.items():
            key = "-".join([str(row.key), *(word.rpartition("=")[2] for word in words), program])
            rival = replace(row, group=Group(RIVALS), name=name, changes=" ".join(words), key=key)
            found.append((replace(rival, script="rivals.py", arguments=(*words, *row.arguments)), RIVALS))
    return found


def draw(
    folder: Path,
    marks: Sequence[Mark],
    published: Sequence[chart.Published],
    units: Mapping[str, float | None],
) -> None:
    """The three pictures."""
    from torch_surfcap.studies import (
        chart_figures,  # after the rows: their peak memory begins at that of this process
    )

    chart_figures.write_accuracy(folder / "accuracy", marks, published, units)
    chart_figures.write_growth(folder / "growth", marks, units)
    chart_figures.write_work(folder / "work", marks)


def command(scenes: Mapping[str, Path], options: argparse.Namespace) -> str:
    """The command as somebody else would give it: DATA and OUT stand for their folders."""
    words = [f"--scene {name}=DATA/{name}" for name in scenes if options.scene]
    for name, default in DEFAULTS.items():
        value = getattr(options, name)
        if value != default:
            text = ",".join(f"{x}" for x in value) if isinstance(value, list) else f"{value:g}"
            words.append(f"--{name.replace('_', '-')} {text}")
    words += ["--out OUT", *options.settings]
    words += [f"--page {options.page}"] * bool(options.page and not options.page.is_absolute())
    return f"python train/chart.py {' '.join(words)}"


def _scene(text: str) -> tuple[str, Path]:
    name, _, path = text.rpartition("=")
    if not path or not Path(path).is_dir():
        raise InputError(f"--scene: found {text}, expected [NAME=]FOLDER of a capture")
    return name or Path(path).resolve().name, Path(path)


DEFAULTS = {
    "presets": ["draft", STANDARD, "fine"],
    "groups": None,
    "rivals": ["hull", "autograd"],
    "rival_times": [1.0],
    "views": 36,
    "test_views": 6,
    "size": 384,
}


def _options(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )

    def names(text: str) -> list[str]:
        return [name for name in text.split(",") if name]

    def numbers(text: str) -> list[float]:
        return [float(number) for number in names(text)]

    parser.add_argument("--out", type=Path, required=True, help="folder of the rows, tables and pictures")
    parser.add_argument("--scene", action="append", metavar="[NAME=]FOLDER", help="repeatable")
    parser.add_argument("--presets", type=names, metavar="NAME,...", help="files of configs/")
    parser.add_argument("--groups", type=names, metavar="NAME,...", help="of the sweep; all by default")
    parser.add_argument("--sweep", type=Path, default=SWEEP, metavar="YAML")
    parser.add_argument("--published", type=Path, default=PUBLISHED, metavar="CSV")
    parser.add_argument("--rivals", type=names, metavar="NAME,...", help="of hull, autograd; '' for none")
    parser.add_argument("--rival-times", type=numbers, metavar="X,...", help="the seconds of autograd")
    parser.add_argument("--views", type=int, help="of the scenes made")
    parser.add_argument("--test-views", type=int, help="of the scenes made")
    parser.add_argument("--size", type=int, help="of the scenes made, pixels")
    parser.add_argument("--minutes", type=float, default=60.0, help="start no row that would end later")
    parser.add_argument("--page", type=Path, metavar="MD", help="whose part between the markers is renewed")
    parser.add_argument("settings", nargs="*", metavar="key=value", help="of every row")
    parser.set_defaults(**DEFAULTS)
    return parser.parse_intermixed_args(arguments)


if __name__ == "__main__":
    sys.exit(main())
