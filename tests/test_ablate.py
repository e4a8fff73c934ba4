"""train/ablate.py from rows to tables: on a tiny sample scene, in processes, stopped and gone on with."""

from __future__ import annotations

import csv
import json
import subprocess
from pathlib import Path
from typing import Any

import pytest

from torch_surfcap.data.sample_scene import make_sample_scene
from torch_surfcap.studies import rows as processes
from torch_surfcap.studies.ablation import Row, plan, read_table
from train import ablate

ROWS = """
baseline: sh_degree=0 levels=1
scenes:
  figure: {settings: data.scale=0.5, millimetres: 1000}
groups:
  terms:
    title: Terms
    opacity: [distance]
    rows:
      B = 0: sh_degree=0
      no mask loss: losses.mask=0
  wrong:
    title: Wrong
    opacity: [distance]
    rows:
      typo: losses.maks=0
      far away: data.box=[9,9,9,10,10,10]
  sizes:
    title: Sizes
    opacity: [distance]
    columns: [samples, tiles, seconds]
    rows:
      coarse: voxel=0.1
"""


class Folders:
    def __init__(self, base: Path) -> None:
        self.scene = make_sample_scene(base / "scene", views=10, test_views=2, size=64)
        self.out, self.table = base / "out", base / "rows.yaml"
        self.table.write_text(ROWS, encoding="utf-8")

    def run(self, *more: str, out: Path | None = None) -> int:
        folders = [f"--scene=figure={self.scene}", f"--out={out or self.out}", f"--table={self.table}"]
        return ablate.main([*folders, *more])


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Folders:
    """All rows are run; two of them fail."""
    folders = Folders(tmp_path_factory.mktemp("ablate"))
    assert folders.run() == 1
    return folders


def line(page: str, name: str) -> list[str]:
    """The cells of the row of this name."""
    rows = [text for text in page.splitlines() if text.startswith(f"| {name} |")]
    assert len(rows) == 1
    return [cell.strip() for cell in rows[0].strip("|").split("|")]


def test_page(finished: Folders) -> None:
    page = (finished.out / "ablation.md").read_text(encoding="utf-8")
    assert "python train/ablate.py --scene figure=DATA/figure --out OUT\n" in page
    assert "4 rows are done, 2 failed, 0 are still to be run" in page
    assert str(finished.scene) not in page
    titles = [text for text in page.splitlines() if text.startswith("#")]
    assert titles == ["# Ablation", "## figure", "### opacity=distance", "### Sizes, opacity=distance"]
    header = [
        cell.strip() for cell in next(text for text in page.splitlines() if "settings |" in text).split("|")
    ]
    baseline, mask = line(page, "baseline"), line(page, "no mask loss")
    assert header[3:5] == ["Chamfer, mm", "normals, °"]
    assert {"pieces", "PSNR volume, dB", "PSNR raster, dB", "seconds", "peak memory, MiB"} <= {*header}
    assert "(" not in "".join(baseline)
    assert "(" in mask[2]
    assert line(page, "B = 0 (the baseline)")[2:] == baseline[2:]
    assert line(page, "typo")[1] == (
        "`losses.maks=0`: losses.maks=0: unknown key losses.maks, nearest known key: losses.mask"
    )
    assert "the visual hull is empty inside the box" in line(page, "far away")[1]
    assert float(line(page, "coarse")[2]) > 0  # samples of an iteration


def test_csv_has_what_the_row_was_scored_with(finished: Folders) -> None:
    with (finished.out / "ablation.csv").open(encoding="utf-8") as file:
        rows = {row["row"]: row for row in csv.DictReader(file)}
    assert list(rows) == ["baseline", "B = 0", "no mask loss", "typo", "far away", "coarse"]
    folder = finished.out / "figure" / rows["no mask loss"]["key"]
    metrics, evaluation = (
        json.loads((folder / f"{name}.json").read_text()) for name in ("metrics", "evaluation")
    )
    assert float(rows["no mask loss"]["chamfer"]) == evaluation["surface"]["chamfer"] < 0.05
    assert float(rows["no mask loss"]["psnr_raster"]) == evaluation["test"]["psnr_raster"]
    assert float(rows["no mask loss"]["memory"]) == metrics["peak_memory_bytes"]
    assert float(rows["no mask loss"]["cpu_seconds"]) > 0
    assert "mask: 0.0" in (folder / "config.yaml").read_text()
    assert not (folder / "field.npz").exists()


def test_a_finished_row_is_not_run_again(
    finished: Folders, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Only the one that failed in its process is, and what a changed setting makes another row."""
    started: list[str] = []

    def start(row: Row, *_: object) -> dict[str, Any]:
        started.append(row.name)
        return {"error": "not run here"}

    monkeypatch.setattr(processes, "run_row", start)
    assert finished.run() == 1
    assert started == ["far away"]
    started.clear()
    assert finished.run("--groups=terms") == 0
    assert started == []
    assert finished.run("--groups=terms", "seed=1") == 0
    assert started == ["baseline", "no mask loss"]


def test_a_row_that_failed_is_run_afresh(finished: Folders, tmp_path: Path) -> None:
    rows = plan(read_table(finished.table), {"figure": finished.scene}, ["wrong"])
    row = next(row for row in rows if row.name == "far away")
    folder = tmp_path / "figure" / str(row.key)
    folder.mkdir(parents=True)
    (folder / "mesh.ply").write_text("left by an interrupted fit")
    assert "the visual hull is empty" in processes.run_row(row, finished.scene, tmp_path)["error"]
    assert sorted(path.name for path in folder.iterdir()) == ["log.txt", "row.json"]


def test_no_row_starts_when_time_is_out(
    finished: Folders, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert finished.run("--minutes=0", "--groups=terms,sizes", out=tmp_path) == 0
    assert "3 rows are left" in capsys.readouterr().out
    page = (tmp_path / "ablation.md").read_text(encoding="utf-8")
    assert "0 rows are done, 0 failed, 4 are still to be run" in page
    assert line(page, "no mask loss")[1] == "`losses.mask=0`: still to be run"


def test_interrupted(finished: Folders, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The row at work is not finished; the tables are written."""

    real = subprocess.run

    def interrupt(command: list[str], **options: Any) -> Any:
        if command[0] == "git":  # the page's commit
            return real(command, **options)
        raise KeyboardInterrupt

    monkeypatch.setattr(subprocess, "run", interrupt)
    assert finished.run("--groups=terms", f"--page={tmp_path / 'page.md'}", out=tmp_path) == 130
    assert "3 are still to be run" in (tmp_path / "page.md").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--groups=terns"], "--groups: found terns, expected some of terms, wrong, sizes"),
        (["--scene=lego"], "--scene: found lego, expected NAME=FOLDER of a capture"),
        (["--scene=lego=nowhere"], "--scene: found lego=nowhere"),
        (["--table=nowhere.yaml"], "nowhere.yaml: cannot read this file"),
    ],
)
def test_bad_input_is_one_line(
    finished: Folders, arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert finished.run(*arguments) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
