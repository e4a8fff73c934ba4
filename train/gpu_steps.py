"""Steps that share a span of time: each is a process with a limit of its own, and what fails does not stop the others."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

LEAST = 5.0  # seconds without which a step is not begun
GRACE = 3.0  # of a step's seconds, from its interruption to its end: pytest then says what it knows
DONE = "done"


class Steps:
    """Runs them one after the other; ``told`` has a row for each: name, seconds, limit, result, failed."""

    def __init__(self, seconds: float, environment: Mapping[str, str], folder: Path) -> None:
        self.total, self.environment, self.folder = seconds, dict(environment), folder
        self.began = time.monotonic()
        self.told: list[dict[str, Any]] = []

    @property
    def spent(self) -> float:
        """Seconds since the first step."""
        return time.monotonic() - self.began

    @property
    def status(self) -> int:
        """1 if a step failed or ran out of time, else 0; what was left out on its own account does not count."""
        return int(any(step["failed"] for step in self.told))

    def limit(self, most: float, keep: float = 0.0) -> float:
        """Seconds that a step may take: at most ``most``, and so that ``keep`` are left for later ones."""
        return max(0.0, min(most, self.total - self.spent - keep))

    def command(
        self,
        name: str,
        command: Sequence[str],
        log: Path,
        most: float,
        keep: float = 0.0,
        needs: Sequence[str] = (),
    ) -> bool:
        """Runs a command, what it prints goes to the end of ``log``; returns whether it ended with 0. It is left out where
        a step that it ``needs`` is not done or there is no time."""
        limit = self.limit(most, keep)
        if not self._may_run(name, limit, needs):
            return False
        with open(log, "a", encoding="utf-8") as file:
            file.write(f"\n== {name}\n")
            file.flush()
            return self._process(name, command, limit, file)

    def optional(
        self, name: str, command: Sequence[str], most: float, needs: Sequence[str] = ()
    ) -> str | None:
        """What a command prints, None where it fails, which is only told."""
        limit = self.limit(most)
        if not self._may_run(name, limit, needs):
            return None
        with tempfile.TemporaryFile("w+", encoding="utf-8", errors="replace") as file:
            good = self._process(name, command, limit, file)
            file.seek(0)
            text = file.read()
        self.told[-1]["failed"] = False
        if not good:
            self.told[-1]["result"] += f": {(text.strip().splitlines() or ['it said nothing'])[-1][:200]}"
        return text if good else None

    def left_out(self, name: str, why: str) -> None:
        """Tells of a step that there was no occasion for."""
        self._tell(name, None, None, f"left out, {why}", failed=False)

    @contextlib.contextmanager
    def guarded(self, name: str) -> Iterator[None]:
        """Tells of an exception as of a step that failed, and goes on after it."""
        try:
            yield
        except Exception as error:  # whatever a file of results may hold
            self._tell(name, None, None, f"failed, {type(error).__name__}: {error}", failed=True)

    def _may_run(self, name: str, limit: float, needs: Sequence[str]) -> bool:
        done = {step["name"] for step in self.told if step["result"] == DONE}
        missing = [need for need in needs if need not in done]
        if missing or limit < LEAST:
            why = f"needs {missing[0]}" if missing else "no time"
            self._tell(name, None, None, f"left out, {why}", failed=False)
            return False
        return True

    def _process(self, name: str, command: Sequence[str], limit: float, file: Any) -> bool:
        """Runs a command, with all that it starts, for at most ``limit`` seconds."""
        start = time.monotonic()
        try:
            child = subprocess.Popen(
                command,
                cwd=self.folder,
                env=self.environment,
                stdin=subprocess.DEVNULL,
                stdout=file,
                stderr=subprocess.STDOUT,
                start_new_session=True,
            )
        except OSError as error:
            self._tell(name, 0.0, limit, f"failed, {error}", failed=True)
            return False
        try:
            result = DONE if child.wait(limit - GRACE) == 0 else f"failed, exit {child.returncode}"
        except subprocess.TimeoutExpired:
            result = "out of time"
            child.send_signal(signal.SIGINT)
            with contextlib.suppress(subprocess.TimeoutExpired):
                child.wait(GRACE)
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(child.pid, signal.SIGKILL)
            child.wait()
        self._tell(name, time.monotonic() - start, limit, result, failed=result != DONE)
        return result == DONE

    def _tell(self, name: str, seconds: float | None, limit: float | None, result: str, failed: bool) -> None:
        row = {"name": name, "seconds": seconds, "limit": limit, "result": result, "failed": failed}
        self.told.append(row)
        took = "" if seconds is None else f" ({seconds:.1f} s of {limit:.0f})"
        print(f"{name}: {result}{took}", flush=True)
