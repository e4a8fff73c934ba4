"""A fit that is killed goes on from its last checkpoint and ends with the same bits.

SURFCAP_KILLS sets how often the fit is killed (default 3).
"""

from __future__ import annotations

import json
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.fitting.sphere import ball
from torch_surfcap import InputError, fit
from torch_surfcap.data.sample_scene import make_sample_scene
from torch_surfcap.fitting.checkpoint import Checkpoints
from torch_surfcap.fitting.course import Progress
from train import fit as command

KILLS = int(os.environ.get("SURFCAP_KILLS", "3"))
QUICK: dict[str, Any] = {"sh_degree": 0, "levels": 2, "voxel": 0.05}
# The command, with a journal of its iterations and checkpoints.
WATCHED = """
import sys
from torch_surfcap.fitting.checkpoint import Checkpoints
from train import fit
journal = open(sys.argv[1], "a", buffering=1)
show, save = fit.Bars.__call__, Checkpoints.save
def shown(bars, at):
    show(bars, at)
    if at.row:
        journal.write("i")
        journal.flush()
def saved(self, *rest):
    save(self, *rest)
    journal.write("c")
    journal.flush()
fit.Bars.__call__, Checkpoints.save = shown, saved
sys.exit(fit.main(sys.argv[2:]))
"""


class Killed(Exception):
    pass


@pytest.mark.parametrize(
    "settings",
    [{}, {"opacity": "transparency"}, {"gains": "on"}, {"sh_degree": 1, "view_spacing": 4}],
    ids=str,
)
@pytest.mark.parametrize("moment", [3, 17, 40])
def test_the_same_bits_after_any_iteration(settings: dict[str, Any], moment: int, tmp_path: Path) -> None:
    """Stopped after a checkpoint within a level, whichever it is; nothing is lost and nothing done twice."""
    capture, path = ball(8, 32), tmp_path / "checkpoint.npz"
    settings = QUICK | settings
    whole = fit(capture, **settings)
    seen = 0

    def stop(at: Progress) -> None:
        nonlocal seen
        seen += bool(at.row)
        if seen > moment:
            raise Killed

    with pytest.raises(Killed):
        fit(capture, stop, Checkpoints(path, seconds=0), **settings)
    resumed = fit(capture, None, Checkpoints(path, resume=True), **settings)
    assert resumed.field.voxels.equal(whole.field.voxels)
    assert resumed.field.table.equal(whole.field.table)
    if whole.field.view is not None:
        assert resumed.field.view is not None
        assert resumed.field.view.voxels.equal(whole.field.view.voxels)
    assert np.array_equal(resumed.mesh.vertices, whole.mesh.vertices)
    assert resumed.history == whole.history
    assert resumed.gain.equal(whole.gain)
    assert resumed.chosen == whole.chosen
    assert resumed.iterations_run == len(whole.history) - moment
    before = [row for row in whole.history[:moment] if row["level"] == whole.history[moment]["level"]]
    assert resumed.resumed_from == [int(whole.history[moment]["level"]), len(before)]


def test_a_checkpoint_of_another_device(tmp_path: Path) -> None:
    """Its random numbers cannot go on here: others begin, the same whenever this is done, and the fit ends as well."""
    capture, path = ball(8, 32), tmp_path / "checkpoint.npz"
    whole = fit(capture, **QUICK)

    def stop(at: Progress) -> None:
        if at.number == 1:
            raise Killed

    with pytest.raises(Killed):
        fit(capture, stop, Checkpoints(path, seconds=0), **QUICK)
    with np.load(path) as data:
        arrays = dict(data)
    plain = json.loads(arrays["plain"].tobytes())
    plain["settings"]["device"] = "cuda:1"
    plain["waiting"] = [whole.history[0]]  # of an iteration whose loss came too late for the checkpoint
    text = np.frombuffer(json.dumps(plain).encode(), dtype=np.uint8)
    np.savez(path, **{**arrays, "plain": text, "generator": np.zeros(16, dtype=np.uint8)})
    one, two = (fit(capture, None, Checkpoints(path, resume=True), **QUICK, images="host") for _ in range(2))
    assert one.history == two.history
    first = next(i for i, row in enumerate(whole.history) if row["level"] == 1)
    assert one.history[:first] == whole.history[:first]
    assert {**one.history[first], "level": 0.0} == whole.history[0]
    assert one.history[first + 1]["loss"] != whole.history[first]["loss"]
    assert one.history[-1]["loss"] < 1.2 * whole.history[-1]["loss"]


def test_checkpoints_of_something_else(tmp_path: Path) -> None:
    capture, path = ball(6, 32), tmp_path / "checkpoint.npz"
    fit(capture, None, Checkpoints(path, seconds=0), **QUICK)

    def refused(*, message: str, **settings: Any) -> None:
        with pytest.raises(InputError, match=message) as caught:
            fit(capture, None, Checkpoints(path, resume=True), **{**QUICK, **settings})
        assert str(path) in str(caught.value)

    refused(message="sh_degree is 0 there and 1 now", sh_degree=1)
    with np.load(path) as data:
        arrays = dict(data)
    plain = json.loads(arrays["plain"].tobytes())
    for key, value, message in (("version", "0.0", "version 0.0"), ("cameras", ["a"], "other cameras")):
        text = np.frombuffer(json.dumps(plain | {key: value}).encode(), dtype=np.uint8)
        np.savez(path, **{**arrays, "plain": text})
        refused(message=message)
    path.write_bytes(path.read_bytes()[:-1000])
    refused(message="a damaged checkpoint")


def test_kills(tmp_path: Path) -> None:
    """SIGKILL at random moments: the mesh is byte for byte the undisturbed run's, and of the work only what was done
    since the last checkpoints is done again."""
    scene = make_sample_scene(tmp_path / "scene", 12, 2, 64 if KILLS < 10 else 256)
    arguments = [f"data.path={scene}", "levels=3", "sh_degree=1", "checkpoint=0.2"]
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).parents[1])}

    def start(out: Path, journal: Path, *more: str) -> subprocess.Popen[bytes]:
        program = [sys.executable, "-c", WATCHED, str(journal)]
        return subprocess.Popen(
            [*program, *arguments, f"out={out}", *more],
            env=environment,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )

    quiet, whole = tmp_path / "quiet", tmp_path / "whole.txt"
    whole.touch()
    begin = time.monotonic()
    process = start(quiet, whole)
    while not whole.read_text() and process.poll() is None:
        time.sleep(0.01)
    starts = time.monotonic() - begin
    assert process.wait(600) == 0
    works = time.monotonic() - begin - starts
    alone = whole.read_text().count("i")

    disturbed, journal = tmp_path / "disturbed", tmp_path / "killed.txt"
    journal.touch()
    rng, lost, kills = random.Random(0), 0, 0
    while kills < KILLS and not (disturbed / "metrics.json").exists():
        kills += 1
        process = start(disturbed, journal, "resume=true")
        time.sleep(rng.uniform(0.5 * starts, starts + 1.5 * works / KILLS))
        process.send_signal(signal.SIGKILL)
        process.wait(60)
        done = journal.read_text()
        lost += len(done.rpartition("c")[2].rpartition("k")[2].replace("k", ""))
        journal.write_text(done + "k")
    if not (disturbed / "metrics.json").exists():
        assert start(disturbed, journal, "resume=true").wait(300) == 0
    assert (disturbed / "mesh.ply").read_bytes() == (quiet / "mesh.ply").read_bytes()
    assert (disturbed / "field.npz").read_bytes() == (quiet / "field.npz").read_bytes()
    assert (disturbed / "history.csv").read_bytes() == (quiet / "history.csv").read_bytes()
    total = journal.read_text().count("i")
    print(f"{kills} kills, {total} iterations instead of {alone}, {lost} of them lost")
    assert alone <= total <= alone + lost
    metrics = json.loads((disturbed / "metrics.json").read_text())
    assert metrics["iterations_run"] <= alone
    if metrics["resumed_from"] is None:
        assert metrics["iterations_run"] == alone


def test_a_checkpoint_is_kept_from_a_fresh_run(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    scene, out = make_sample_scene(tmp_path / "scene", 8, 0, 48), tmp_path / "out"
    arguments = [f"data.path={scene}", f"out={out}", "levels=2", "sh_degree=0", "checkpoint=0"]

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("torch_surfcap.report.write_history", interrupt)
        assert command.main(arguments) == 130
    kept = out / command.CHECKPOINT
    assert f"resume=true goes on from {kept}" in capsys.readouterr().err
    assert [p.name for p in out.iterdir()] == [kept.name]
    assert command.main(arguments) == 2
    assert "holds a checkpoint of an earlier run" in capsys.readouterr().err
    assert command.main([*arguments, "resume=true", "losses.mask=0.7"]) == 2
    assert f"{kept}: losses.mask is None there and 0.7 now" in capsys.readouterr().err
    assert command.main([*arguments, "resume=true"]) == 0
    assert "resumed at iteration" in capsys.readouterr().out
    assert sorted(p.name for p in out.iterdir()) == sorted(command.RESULTS)
