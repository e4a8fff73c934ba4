"""Rows of tables: each fitted and scored in processes of its own, kept in a folder by its key, and so never run twice."""

from __future__ import annotations

import csv
import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

from torch_surfcap import report
from torch_surfcap.studies.ablation import PACKAGE, Row, program_digest
from torch_surfcap.studies.score_table import COLUMNS

Item = TypeVar("Item")
ROOT = PACKAGE.parent
TRUTHS = {"--mesh-truth": "gt.ply", "--points-truth": "gt_visible.npz", "--concave": "concave.npz"}
LARGE = ("field.npz", "mesh.glb", "error.ply")  # not kept of a row: hundreds of them fill a disk
Results = dict[Row, dict[str, Any]]  # "scores", or "error", or nothing where a row is still to be run


def run(rows: Sequence[Row], scenes: Mapping[str, Path], out: Path, seconds: float) -> bool:
    """Run what is not finished, as long as another row is likely to end in time; False when interrupted."""
    unique: dict[Path, Row] = {}
    for row in rows:
        if row.key and "scores" not in read_result(row, out):
            unique.setdefault(folder_of(row, out), row)
    todo = list(unique.values())
    for number, row in in_time(todo, seconds, "rows"):
        where = f"{row.scene}, opacity={row.opacity}, {row.name}"
        print(f"[{number + 1}/{len(todo)}] {where}: ", end="", flush=True)
        try:
            result = run_row(row, scenes[row.scene], out)
        except KeyboardInterrupt:
            print("interrupted")
            return False
        scores = result.get("scores", {})
        print(
            result.get("error")
            or ", ".join(f"{name} {scores[name]:.4g}" for name in COLUMNS if name in scores)
        )
    return True


def in_time(todo: Sequence[Item], seconds: float, what: str) -> Iterator[tuple[int, Item]]:
    """Numbers and items as long as another one is likely to end in time: none took longer; says how many are left."""
    start, longest = time.monotonic(), 0.0
    for number, item in enumerate(todo):
        begin = time.monotonic()
        if begin - start + longest >= seconds:
            print(f"out of time, {len(todo) - number} {what} are left: the same command goes on with them")
            return
        yield number, item
        longest = max(longest, time.monotonic() - begin)


def run_row(row: Row, capture: Path, out: Path) -> dict[str, Any]:
    """Fit and score; what the row's folder says of it from now on."""
    folder = folder_of(row, out)
    shutil.rmtree(folder, ignore_errors=True)  # what an interrupted or failed run has left
    folder.mkdir(parents=True)
    truths = [(flag, str(capture / name)) for flag, name in TRUTHS.items() if (capture / name).is_file()]
    commands = (
        [row.script, *row.arguments, f"out={folder}"],
        [
            "evaluate.py",
            f"--run={folder}",
            f"--device={row.device}",
            *row.scored,
            *(f"{flag}={path}" for flag, path in truths),
        ],
    )
    # On Linux a child's peak memory begins at its parent's: this process loads nothing that a fit does not.
    pages = os.environ.get("THP_MEM_ALLOC_ENABLE", "1")  # as train/fit.py has it, for every script
    environment = os.environ | {
        "PYTHONPATH": str(PACKAGE.parent),
        "PYTHONUNBUFFERED": "1",
        "THP_MEM_ALLOC_ENABLE": pages,
    }
    log = folder / "log.txt"
    result: dict[str, Any] = {"settings": row.arguments, "program": program_digest()}
    spent = []
    for script, *words in commands:
        command = [sys.executable, str(ROOT / "train" / script), *words]
        before = os.times()
        with log.open("a", encoding="utf-8") as file:
            status = subprocess.run(command, env=environment, stdout=file, stderr=file).returncode
        after = os.times()
        spent.append(
            after.children_user + after.children_system - before.children_user - before.children_system
        )
        if status:
            said = log.read_text(encoding="utf-8").strip().splitlines()[-1:] if status > 0 else []
            error = said[0] if said else f"{script} ended with status {status}"
            result["error"] = error.replace(str(capture.resolve()), row.scene).replace(str(folder), "OUT")
            break
    else:
        result["scores"] = read_scores(folder) | {"cpu_seconds": spent[0]}
        for name in LARGE:
            (folder / name).unlink(missing_ok=True)
    report.write_json(folder / "row.json", result)
    return result


def read_result(row: Row, out: Path) -> dict[str, Any]:
    """See Results."""
    if row.key is None:
        return {"error": row.error}
    try:
        return json.loads((folder_of(row, out) / "row.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}


def read_scores(folder: Path) -> dict[str, float]:
    """Scores of the surface and of the held-out views, and what the fit took."""
    metrics, evaluation = (
        json.loads((folder / f"{name}.json").read_text(encoding="utf-8"))
        for name in ("metrics", "evaluation")
    )
    with (folder / "history.csv").open(encoding="utf-8") as file:
        *_, last = csv.DictReader(file)
    scores = {
        **evaluation.get("surface", {}),
        **evaluation.get("test", {}),
        "samples": float(last["samples"]),
        "tiles": metrics["tiles"],
        "iterations": metrics["iterations_run"],
        "seconds": metrics["seconds"]["total"],
        "memory": metrics["peak_memory_bytes"],
    }
    return {name: value for name, value in scores.items() if isinstance(value, (int, float))}


def folder_of(row: Row, out: Path) -> Path:
    """Where the row's results lie."""
    assert row.key is not None
    return out / row.scene / row.key
