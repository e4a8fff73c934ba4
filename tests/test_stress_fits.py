"""The stability suite: a reduced set of fits holds what is expected of it, and the command goes on where it was."""

from __future__ import annotations

import json
import math
import signal
import subprocess
import sys
import threading
from dataclasses import replace
from pathlib import Path
from typing import Any

import psutil
import pytest
import trimesh

from tests.test_stress import TINY, condition
from torch_surfcap.studies.stress import page, suite
from torch_surfcap.studies.stress.trial import run_trial
from train import stress

QUICK: dict[str, Any] = {"levels": 2, "sh_degree": 0}


@pytest.fixture(scope="module")
def clean(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, trimesh.Trimesh, dict[str, Any]]:
    """Folder of scenes, mesh and result of the clean run."""
    base = tmp_path_factory.mktemp("stress")
    result = run_trial(TINY, suite.CLEAN, base / "scenes", base, **QUICK)
    return base, trimesh.load_mesh(base / "mesh.ply", process=False), result


def test_the_clean_run(clean: tuple[Path, trimesh.Trimesh, dict[str, Any]]) -> None:
    result = clean[2]
    assert result["outcome"] == "fitted"
    assert result["said"] == []
    assert result["pieces"] == 1
    assert result["chamfer"] < result["hull_chamfer"] < 40
    assert result["psnr"] > 22
    assert 0 < result["concave"] < 50


@pytest.mark.parametrize(
    ("group", "title"),
    [
        ("photometry", "black frame"),
        ("photometry", "noise 0.1"),
        ("calibration", "one camera wrong"),
        ("silhouettes", "eroded 8 px"),
        ("silhouettes", "none, no plates"),
        ("silhouettes", "missing 1 of 3"),
        ("capture", "views 5"),
    ],
)
def test_nothing_ends_in_silence(
    clean: tuple[Path, trimesh.Trimesh, dict[str, Any]], group: str, title: str, tmp_path: Path
) -> None:
    spoilt = condition(group, title)
    result = run_trial(TINY, spoilt, clean[0] / "scenes", tmp_path, examine=stress._examine, **QUICK)
    assert page.as_expected(spoilt, result), page.in_words(result)
    assert result["outcome"] == "refused" or math.isfinite(result["chamfer"])


@pytest.mark.parametrize("title", ["unit mm", "far away 100 km", "rotated", "permuted"])
def test_what_changes_nothing(
    clean: tuple[Path, trimesh.Trimesh, dict[str, Any]], title: str, tmp_path: Path
) -> None:
    spoilt = condition("numbers", title)
    result = run_trial(TINY, spoilt, clean[0] / "scenes", tmp_path, clean[1], **QUICK)
    assert result["moved_voxels"] < page.SAME.get(spoilt.name, 0.1)


def test_the_command_goes_on_where_it_was(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(stress, "_scene", lambda name: replace(TINY, subject=name))
    words = [
        f"--out={tmp_path / 'out'}",
        "--scenes=figure",
        "--only=gain ±20%",
        f"--page={tmp_path / 'p.md'}",
    ]
    assert stress.main([*words, "--limit=0.05"]) == 1  # no process is that fast: both hang
    page_text = (tmp_path / "p.md").read_text()
    assert page_text.count("*hung*") == 2
    assert page.MARKS[1] in page_text
    assert (tmp_path / "p.png").is_file()
    runs = sorted((tmp_path / "out" / "figure").glob("*/run.json"))
    assert len(runs) == 2
    for path in runs:
        known = json.loads(path.read_text())
        path.write_text(json.dumps(known | {"outcome": "fitted", "chamfer": 2.0, "concave": 3.0, "said": []}))
    capsys.readouterr()
    assert stress.main(words) == 0
    printed = capsys.readouterr().out
    assert "[1/" not in printed
    assert "| gain ±20% | figure | 1.1× | 1.00× (2.00 mm) | 1.00× (3.00 mm) |" in printed
    assert stress.main([*words, "--groups=photometri"]) == 2
    assert "expected some of subject" in capsys.readouterr().err


def test_an_interrupted_run_leaves_nothing_behind(tmp_path: Path) -> None:
    options, stopped = stress._options([f"--out={tmp_path}", "--scenes=figure"]), threading.Event()
    threading.Timer(0.5, stopped.set).start()
    with pytest.raises(KeyboardInterrupt):
        stress.run_one("figure", suite.CLEAN, options, stopped)
    assert list(tmp_path.glob("figure/*/run.json")) == []
    assert not any("stress.py" in " ".join(child.cmdline()) for child in psutil.Process().children())


def test_a_stopped_process_does_not_hang() -> None:
    never = threading.Event()
    sleeper = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(1)"])
    sleeper.send_signal(signal.SIGSTOP)
    waker = threading.Timer(2.0, sleeper.send_signal, [signal.SIGCONT])
    waker.start()
    assert stress._wait(sleeper, 1.8, never) == 0
    waker.join()
    endless = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"])
    assert stress._wait(endless, 0.3, never) is None
    endless.kill()
    assert stress._wait(endless, 5.0, never) == -signal.SIGKILL
