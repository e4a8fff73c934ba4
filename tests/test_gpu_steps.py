"""The steps of make gpu-check: what fails, what is left out, and that time limits hold."""

from __future__ import annotations

import json
import os
import sys
import time
from pathlib import Path

from train.gpu_steps import Steps


def steps(folder: Path, seconds: float = 60.0) -> Steps:
    return Steps(seconds, os.environ, folder)


def python(code: str) -> list[str]:
    return [sys.executable, "-c", code]


def results(of: Steps) -> dict[str, str]:
    return {step["name"]: step["result"] for step in of.told}


def test_a_failed_step_stops_those_alone_that_need_it(tmp_path: Path) -> None:
    run, log = steps(tmp_path), tmp_path / "log"
    assert run.command("one", python("print('hello')"), log, 30)
    assert run.status == 0
    assert not run.command("two", python("raise SystemExit(3)"), log, 30)
    assert not run.command("three", python("pass"), log, 30, needs=["one", "two"])
    assert run.command("four", python("pass"), log, 30, needs=["one"])
    assert not run.command("five", ["/no/such/program"], log, 30)
    found = results(run)
    assert found.pop("five").startswith("failed, ")
    assert found == {"one": "done", "two": "failed, exit 3", "three": "left out, needs two", "four": "done"}
    assert log.read_text().split("\n")[1:3] == ["== one", "hello"]
    assert run.status == 1


def test_a_step_and_its_children_end_with_its_time(tmp_path: Path) -> None:
    mark = tmp_path / "mark"
    child = f"import time; time.sleep(7); open({str(mark)!r}, 'w')"
    code = f"import subprocess, sys; subprocess.run([sys.executable, '-c', {child!r}])"
    run, start = steps(tmp_path), time.monotonic()
    assert not run.command("slow", python(code), tmp_path / "log", 5.0)
    assert time.monotonic() - start < 7
    assert results(run) == {"slow": "out of time"}
    time.sleep(max(0.0, start + 8.5 - time.monotonic()))
    assert not mark.exists()


def test_a_step_may_say_what_it_knows(tmp_path: Path) -> None:
    code = """
import signal, time
signal.signal(signal.SIGINT, signal.default_int_handler)
try:
    time.sleep(60)
except KeyboardInterrupt:
    print("so far")
"""
    run, start = steps(tmp_path), time.monotonic()
    assert not run.command("slow", python(code), tmp_path / "log", 5.0)
    assert time.monotonic() - start < 6
    assert results(run) == {"slow": "out of time"}
    assert (tmp_path / "log").read_text().endswith("so far\n")


def test_time_is_shared(tmp_path: Path) -> None:
    run = steps(tmp_path, seconds=100.0)
    assert run.limit(30.0) == 30.0
    assert 59.0 < run.limit(90.0, keep=40.0) <= 60.0
    assert run.limit(90.0, keep=200.0) == 0.0
    assert not run.command("late", python("pass"), tmp_path / "log", 90.0, keep=98.0)
    assert (results(run), run.status) == ({"late": "left out, no time"}, 0)


def test_what_is_optional_is_no_failure(tmp_path: Path) -> None:
    run = steps(tmp_path)
    assert run.optional("good", python("print('7')"), 30) == "7\n"
    assert run.optional("bad", python("print('no permission'); raise SystemExit(1)"), 30) is None
    assert run.optional("absent", ["/no/such/program"], 30) is None
    run.left_out("other", "none there")
    assert results(run)["bad"] == "failed, exit 1: no permission"
    assert results(run)["other"] == "left out, none there"
    assert run.status == 0
    with run.guarded("numbers"):
        json.loads("{")
    assert (run.told[-1]["result"].split(":")[0], run.status) == ("failed, JSONDecodeError", 1)
