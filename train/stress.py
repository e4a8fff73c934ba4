"""Stability: what a fit makes of inputs that are spoilt one way at a time.

    python train/stress.py --out OUT [--scenes figure,bowl] [--groups NAME,...] [--only TEXT] [--minutes 60] [--jobs 2]
                           [--page MD]

Every condition (torch_surfcap/studies/stress) on every scene is a process of its own with a limit of time: a crash or a
hang is a result like any other. --jobs of them run at a time and share the threads: a good part of a run has only one. A
run lies in OUT/SCENE/KEY, KEY standing for the condition and the program: a finished one is not run again, and a command
that was stopped or ran out of its minutes goes on where it was. Scenes are made on the way. Writes OUT/stability.csv, and
table, bounds and heat map between the marks of the page, the picture beside it.

Exit 0: nothing crashed, hung or ended in silence without a surface. 1: something did. 2: bad input. 130: interrupted.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import psutil
import torch
import trimesh

from torch_surfcap import report
from torch_surfcap.data.capture import Capture
from torch_surfcap.data.geometry import read_mesh
from torch_surfcap.errors import InputError
from torch_surfcap.studies.rows import ROOT, in_time
from torch_surfcap.studies.stress import page
from torch_surfcap.studies.stress.condition import Condition
from torch_surfcap.studies.stress.scene import SUBJECTS, Scene
from torch_surfcap.studies.stress.suite import CLEAN, GROUPS, all_conditions
from torch_surfcap.studies.stress.trial import key_of, run_trial

PAGE = Path("docs/stability.md")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit status."""
    options = _options(arguments)
    try:
        if options.jobs < 1:
            raise InputError(f"--jobs: found {options.jobs}, expected a number from 1 on")
        chosen = _chosen(options)
        if options.trial:
            return _trial(options, chosen[1] if len(chosen) > 1 else CLEAN)
        interrupted = not run(chosen, options)
        results = {
            (scene, condition): read_result(scene, condition, options.out)
            for scene, condition in _rows(options, chosen)
        }
        report.write_history(options.out / "stability.csv", page.lines(results))
        page.write(options.page, results, _command(options), options.jobs)
    except InputError as error:
        print(error, file=sys.stderr)
        return 2
    print(page.bounds_table(results))
    return 130 if interrupted else int(any(page.failed(result) for result in results.values()))


def run(conditions: Sequence[Condition], options: argparse.Namespace) -> bool:
    """Run what is not finished, as long as another run is likely to end in time; False when interrupted."""
    todo = [row for row in _rows(options, conditions) if not read_result(*row, options.out)]
    clean, spoilt = [row for row in todo if row[1] is CLEAN], [row for row in todo if row[1] is not CLEAN]
    end = time.monotonic() + 60 * options.minutes
    # The clean ones are done before any that is compared with them begins.
    return all(_run_part(part, options, end - time.monotonic()) for part in (clean, spoilt))


def _run_part(todo: Sequence[tuple[str, Condition]], options: argparse.Namespace, seconds: float) -> bool:
    """Runs, `options.jobs` at a time; False when interrupted."""
    began, lock, stopped = in_time(todo, seconds, "runs"), threading.Lock(), threading.Event()

    def work() -> None:
        while True:
            with lock:
                number, row = next(began, (-1, None))
            if row is None:
                return
            result = run_one(*row, options, stopped)
            words = page.in_words(result)
            print(f"[{number + 1}/{len(todo)}] {row[0]}, {row[1].title}: {words}", flush=True)

    with ThreadPoolExecutor(options.jobs) as pool:
        workers = [pool.submit(work) for _ in range(options.jobs)]
        try:
            for worker in workers:
                worker.result()
        except KeyboardInterrupt:
            stopped.set()
            print("interrupted")
            return False
    return True


def _rows(options: argparse.Namespace, conditions: Sequence[Condition]) -> list[tuple[str, Condition]]:
    """Scenes and the conditions that mean something on them."""
    return [(s, c) for s in options.scenes for c in conditions if not c.scenes or s in c.scenes]


def run_one(
    scene: str, condition: Condition, options: argparse.Namespace, stopped: threading.Event
) -> dict[str, Any]:
    """One run in a process of its own; what its folder says of it from now on. Raises KeyboardInterrupt once stopped."""
    folder = _folder(scene, condition, options.out)
    shutil.rmtree(folder, ignore_errors=True)  # what an interrupted run has left
    folder.mkdir(parents=True)
    command = [sys.executable, str(Path(__file__).resolve()), f"--out={options.out}", f"--scenes={scene}"]
    command += [f"--trial={condition.group}/{condition.title}", f"--folder={folder}"]
    threads = max(1, torch.get_num_threads() // options.jobs)
    environment = os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": str(threads)}
    with (folder / "log.txt").open("w", encoding="utf-8") as log:
        child = subprocess.Popen(command, env=environment, stdout=log, stderr=log, start_new_session=True)
        try:
            status = _wait(child, options.limit, stopped)
        finally:
            if child.poll() is None:
                os.killpg(child.pid, signal.SIGKILL)
                child.wait()
    path = folder / "trial.json"
    if status == 0 and path.is_file():
        result = json.loads(path.read_text(encoding="utf-8"))
    elif status is None:
        result = {"outcome": "hung", "said": [f"still running after {options.limit:g} s"]}
    else:
        last = (folder / "log.txt").read_text(encoding="utf-8").strip().splitlines()[-1:]
        result = {"outcome": "crashed", "said": [*last, f"exit status {status}"]}
    result |= {"status": status, "group": condition.group, "condition": condition.title, "scene": scene}
    report.write_json(folder / "run.json", result)
    return result


def _wait(child: subprocess.Popen[bytes], limit: float, stopped: threading.Event) -> int | None:
    """Exit status, None after `limit` seconds; those in which a process of ours was stopped from outside do not count."""
    spent, step = 0.0, min(0.5, limit)
    while spent < limit:
        if stopped.is_set():
            raise KeyboardInterrupt
        begin = time.monotonic()
        try:
            return child.wait(step)
        except subprocess.TimeoutExpired:
            if psutil.Process(child.pid).status() != psutil.STATUS_STOPPED:
                spent += min(
                    time.monotonic() - begin, 2 * step
                )  # it takes longer where this process was stopped
    return None


def read_result(scene: str, condition: Condition, out: Path) -> dict[str, Any]:
    """Of a run; empty where it has not been."""
    try:
        return json.loads((_folder(scene, condition, out) / "run.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}


def _trial(options: argparse.Namespace, condition: Condition) -> int:
    """The work of a run's process."""
    scene = options.scenes[0]
    path = _folder(scene, CLEAN, options.out) / "mesh.ply"
    clean: trimesh.Trimesh | None = (
        read_mesh(path) if condition.expected == "same" and path.is_file() else None
    )
    cache = options.out / "scenes"
    result = run_trial(_scene(scene), condition, cache, options.folder, clean, _examine)
    report.write_json(options.folder / "trial.json", result)
    return 0


def _examine(capture: Capture) -> list[str]:
    from train.check import examine

    return examine(capture).findings


def _scene(name: str) -> Scene:
    return Scene(name)


def _folder(scene: str, condition: Condition, out: Path) -> Path:
    return out / scene / key_of(_scene(scene), condition)


def _chosen(options: argparse.Namespace) -> list[Condition]:
    """The clean run and the conditions that were asked for."""
    known = [group.GROUP for group in GROUPS]
    for what, words, expected in (("groups", options.groups, known), ("scenes", options.scenes, SUBJECTS)):
        for word in words:
            if word not in expected:
                raise InputError(f"--{what}: found {word}, expected some of {', '.join(expected)}")
    if options.trial:
        _, _, title = options.trial.partition("/")
        return [CLEAN, *(c for c in all_conditions() if f"{c.group}/{c.title}" == options.trial and title)][
            :2
        ]
    chosen = [c for c in all_conditions()[1:] if not options.groups or c.group in options.groups]
    return [CLEAN, *(c for c in chosen if options.only in c.title)]


def _command(options: argparse.Namespace) -> str:
    words = ["python train/stress.py --out OUT"]
    words += [f"--groups {','.join(options.groups)}"] * bool(options.groups)
    words += [f"--only {options.only!r}"] * bool(options.only)
    return " ".join(words)


def _options(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, required=True, help="folder of the runs")

    def names(text: str) -> list[str]:
        return text.split(",")

    parser.add_argument("--scenes", type=names, default=list(SUBJECTS), metavar="NAME,...")
    parser.add_argument("--groups", type=names, default=[], metavar="NAME,...", help="all by default")
    parser.add_argument("--only", default="", metavar="TEXT", help="conditions with this in their title")
    parser.add_argument("--minutes", type=float, default=60.0, help="start no run that would end later")
    parser.add_argument("--jobs", type=int, default=2, help="runs at a time")
    parser.add_argument("--limit", type=float, default=180.0, help="of one run, seconds: beyond it hangs")
    parser.add_argument("--page", type=Path, default=PAGE, metavar="MD", help="with marks for the tables")
    parser.add_argument("--trial", default="", help=argparse.SUPPRESS)  # one run, in this process
    parser.add_argument("--folder", type=Path, help=argparse.SUPPRESS)  # of that run
    return parser.parse_args(arguments)


if __name__ == "__main__":
    sys.exit(main())
