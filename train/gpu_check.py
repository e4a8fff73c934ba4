"""Build, test, fit and profile on a machine with an NVIDIA GPU, in one go of at most nine minutes and without a network.

    python -m train.gpu_check --data DATA --results RESULTS        (make gpu-check DATA=... RESULTS=...)

Needs nvcc and a torch with CUDA. DATA holds captures in folders: lego* is fitted at SH degree 2 with either opacity, human*
on the GPU and on the CPU, any other as it comes; DATA/wheels holds the Python packages that the machine lacks (setuptools,
pytest and, for speed, pytest-xdist too). RESULTS gets gpu.json, all numbers; benchmarks-gpu.md, the same as tables;
build.log, tests.log and fits.log. A step that fails or runs out of its time is recorded, and the next one runs. Exit 0 if
none failed, 1 if one did, 2 where there is no GPU to check; make itself says 2 for both.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from train.gpu_numbers import KERNELS, METRICS, junit_counts, kernels_of_ncu, registers_of, run_numbers
from train.gpu_page import page
from train.gpu_steps import Steps

ROOT = Path(__file__).resolve().parents[1]
SECONDS = 530.0  # for all steps; the rest of nine minutes is for what is around them
WHEELS = "wheels"  # folder within DATA
TESTS = {
    "tests of ops": ("tests/ops", "tests/test_autograd.py", "tests/field"),
    "tests of fits": ("tests/fitting", "tests/surface"),
}
CPU = "_cpu"  # how the names of the fits on the CPU end
PROFILED = 2  # so many fits
HOLDOUT = 8  # every so many-th view is kept for scoring where a capture names none
PROBE = """
import json, torch
there = torch.cuda.is_available()
print(json.dumps({"torch": torch.__version__, "cuda": torch.version.cuda, "there": there,
    "gpu": torch.cuda.get_device_name() if there else None,
    "arch": ".".join(map(str, torch.cuda.get_device_capability())) if there else None}))
"""
LIBRARY = "import sys; from torch_surfcap import devices; sys.exit(not devices.has_kernels())"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit status."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", required=True, type=Path, help="folder of captures and wheels")
    parser.add_argument("--results", required=True, type=Path, help="folder to write into")
    parser.add_argument("--seconds", type=float, default=SECONDS, help="for all steps together")
    options = parser.parse_args(arguments)
    machine, lack = machine_found()
    if lack is None and not options.data.is_dir():
        lack = f"{options.data}: not there, expected a folder of captures"
    if lack is not None:
        print(f"gpu-check: {lack}; nothing was done", file=sys.stderr)
        return 2
    results = options.results.resolve()
    results.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="gpu-check-") as work:
        return Check(options.data.resolve(), results, Path(work), machine, options.seconds).run()


def machine_found() -> tuple[dict[str, Any], str | None]:
    """What the machine is, and what it lacks to be checked."""
    done = subprocess.run([sys.executable, "-c", PROBE], capture_output=True, text=True)
    if done.returncode != 0:
        return {}, f"no torch that loads ({(done.stderr.strip().splitlines() or ['it was killed'])[-1]})"
    machine = json.loads(done.stdout.splitlines()[-1])
    if not machine["there"]:
        return machine, f"no GPU that torch {machine['torch']} can use, expected one of NVIDIA's"
    nvcc = nvcc_found()
    if nvcc is None:
        return machine, "no nvcc, expected it on the PATH or in CUDA_HOME/bin"
    smi = ["nvidia-smi", "--query-gpu=driver_version", "--format=csv,noheader"]
    machine |= {
        "cores": len(os.sched_getaffinity(0)),
        "nvcc": str(nvcc),
        "driver": _said(smi),
        "commit": _said(["git", "-C", str(ROOT), "rev-parse", "--short", "HEAD"]),
    }
    return machine, None


def nvcc_found() -> Path | None:
    """The compiler, by CUDA_HOME, on the PATH, or where CUDA is by default."""
    homes = [Path(os.environ[name]) for name in ("CUDA_HOME", "CUDA_PATH") if os.environ.get(name)]
    on_path = shutil.which("nvcc")
    places = [*(home / "bin/nvcc" for home in homes), *([Path(on_path)] if on_path else [])]
    return next((p for p in [*places, Path("/usr/local/cuda/bin/nvcc")] if p.is_file()), None)


def _said(command: Sequence[str]) -> str | None:
    """The first line of what a command prints, None where it cannot be run."""
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=20)
    except (OSError, subprocess.TimeoutExpired):
        return None
    lines = done.stdout.splitlines()
    return lines[0] if lines and done.returncode == 0 else None


def fits_of(data: Path) -> dict[str, list[str]]:
    """The settings of each fit, by its name, the most wanted first."""
    found: dict[str, list[str]] = {}
    captures = [p for p in sorted(data.iterdir()) if p.is_dir() and p.name[0] != "." and p.name != WHEELS]
    for path in sorted(captures, key=lambda p: not p.name.startswith("lego")):
        given = [f"data.path={path}"]
        if (path / "transforms_train.json").is_file() and not (path / "transforms_test.json").is_file():
            given.append(f"data.holdout={HOLDOUT}")
        if path.name.startswith("lego"):
            for opacity in ("transparency", "distance"):
                found[f"{path.name}_{opacity}"] = [*given, "sh_degree=2", f"opacity={opacity}", "device=cuda"]
        else:
            found[f"{path.name}_cuda"] = [*given, "device=cuda"]
    for path in captures:
        if path.name.startswith("human"):
            found[f"{path.name}{CPU}"] = [*found[f"{path.name}_cuda"][:-1], "device=cpu"]
    return found


class Check:
    """All steps, and what they found."""

    def __init__(
        self, data: Path, results: Path, work: Path, machine: dict[str, Any], seconds: float
    ) -> None:
        self.data, self.results, self.work, self.machine = data, results, work, machine
        home = Path(machine["nvcc"]).resolve().parents[1]
        path = [str(work / "packages"), str(ROOT), os.environ.get("PYTHONPATH", "")]
        environment = {
            "PYTHONPATH": os.pathsep.join(filter(None, path)),
            "TORCH_SURFCAP_CUDA": "1",
            "TORCH_CUDA_ARCH_LIST": machine["arch"],
            "CUDA_HOME": str(home),
            "MAX_JOBS": str(machine["cores"]),
        }
        self.steps = Steps(seconds, os.environ | environment, ROOT)
        self.numbers: dict[str, Any] = {"machine": machine, "tests": {}, "fits": {}, "profiles": {}}

    def run(self) -> int:
        """Every step and the files of results; returns the exit status."""
        print(f"{self.machine['gpu']}, torch {self.machine['torch']}; results in {self.results}", flush=True)
        self._build()
        self._test()
        self._write()
        fits = fits_of(self.data)
        for i, name in enumerate(name for name in fits if not name.endswith(CPU)):
            self._fit(name, fits[name], 120, keep=0.0 if i else 60.0)
            if i < PROFILED:
                self._profile(name)
            self._write()  # as far as it is known, lest something ends it all
        self._kernels()
        for name in fits:
            if name.endswith(CPU):  # last, because they take what time is left
                self._fit(name, fits[name], 300, keep=60.0)
                self._compare(name.removesuffix(CPU))
        self._write()
        return self.steps.status

    def _build(self) -> None:
        log, wheels = self.results / "build.log", sorted(map(str, (self.data / WHEELS).glob("*.whl")))
        if wheels:
            pip = ["-m", "pip", "install", "-q", "--no-index", "--no-deps"]
            self._python("wheels", [*pip, "--target", str(self.work / "packages"), *wheels], log, 60)
        self._python("build", ["setup.py", "build_ext", "--inplace"], log, 240, keep=120)
        self._python("library", ["-c", LIBRARY], log, 90, needs=["build"])

    def _test(self) -> None:
        cores = self.machine["cores"]
        workers = min(8, max(1, cores // 2))
        asked = [sys.executable, "-c", "import xdist"]
        parallel = subprocess.run(asked, env=self.steps.environment, capture_output=True).returncode == 0
        threads = f"OMP_NUM_THREADS={max(1, cores // workers)}"  # or the workers stand in each other's way
        for name, paths in TESTS.items():
            junit, log = self.work / f"{name}.xml", self.results / "tests.log"
            command = ["-m", "pytest", "-q", "-p", "no:cacheprovider", "-k", "cuda or gpu", "--durations=5"]
            command = [sys.executable, *command, f"--junitxml={junit}", *paths]
            if parallel:
                command = ["env", threads, *command, "-n", str(workers)]
            self.steps.command(name, command, log, 100, keep=150, needs=["library"])
            if junit.is_file():
                with self.steps.guarded(f"numbers of {name}"):
                    self.numbers["tests"][name] = junit_counts(junit)

    def _fit(self, name: str, given: list[str], most: float, keep: float) -> None:
        out, log, device = self.work / name, self.results / "fits.log", given[-1].partition("=")[2]
        fit = ["train/fit.py", *given, f"out={out}", "overwrite=true"]
        self._python(f"fit {name}", fit, log, most, keep=keep, needs=["library"])
        capture = self.data / name.rpartition("_")[0]
        score = ["train/evaluate.py", "--run", str(out), "--device", device]
        for option, file in (("--mesh-truth", "gt.ply"), ("--points-truth", "gt_visible.npz")):
            score += [option, str(capture / file)] if (capture / file).is_file() else []
        self._python(f"score {name}", score, log, 60, keep=keep / 2, needs=[f"fit {name}"])
        if (self.work / name / "metrics.json").is_file():  # scored or not
            with self.steps.guarded(f"numbers of {name}"):
                self.numbers["fits"][name] = run_numbers(self.work / name)

    def _compare(self, capture: str) -> None:
        """How far the two devices' meshes are from each other."""
        there, here = (self.work / f"{capture}_{device}" for device in ("cuda", "cpu"))
        step = f"{capture}: cuda against cpu"
        command = ["train/evaluate.py", "--run", str(there), "--mesh-truth", str(here / "mesh.ply")]
        needs = [f"fit {capture}_cuda", f"fit {capture}{CPU}"]
        if self._python(step, command, self.results / "fits.log", 60, needs=needs):
            with self.steps.guarded(f"numbers of {step}"):
                found = run_numbers(there)["surface"]
                self.numbers["fits"][f"{capture}_cuda"]["to_cpu"] = found

    def _profile(self, name: str) -> None:
        out = self.work / f"{name}.json"
        command = ["-m", "train.gpu_profile", "--run", str(self.work / name), "--out", str(out)]
        log, needs = self.results / "fits.log", [f"fit {name}"]
        if self._python(f"profile {name}", [*command, "--device", "cuda"], log, 60, needs=needs):
            self.numbers["profiles"][name] = json.loads(out.read_text(encoding="utf-8"))

    def _kernels(self) -> None:
        """What is known of the kernels without running them, and by ncu, whose absence is no failure."""
        library, path = ROOT / "torch_surfcap/_C.abi3.so", Path(self.machine["nvcc"]).parent
        resources = [str(path / "cuobjdump"), "--dump-resource-usage", str(library)]
        text = self.steps.optional("registers", resources, 30, needs=["library"])
        self.numbers["registers"] = registers_of(text) if text else None
        ncu = shutil.which("ncu")
        run = next((name for name in self.numbers["fits"] if not name.endswith(CPU)), None)
        if ncu is None or run is None:
            self.steps.left_out("ncu", "no ncu on the PATH" if ncu is None else "no fit to run on")
            return
        command = [ncu, "--csv", "--print-units", "base", "--metrics", ",".join(METRICS)]
        command += ["--kernel-name", f"regex:{'|'.join(KERNELS)}", "--launch-count", "2", sys.executable]
        command += ["-m", "train.gpu_profile", "--run", str(self.work / run), "--once", "--device", "cuda"]
        text = self.steps.optional("ncu", command, 60)
        with self.steps.guarded("numbers of ncu"):
            self.numbers["ncu"] = kernels_of_ncu(text) if text else None

    def _python(
        self,
        name: str,
        arguments: list[str],
        log: Path,
        most: float,
        keep: float = 0,
        needs: Sequence[str] = (),
    ) -> bool:
        return self.steps.command(name, [sys.executable, *arguments], log, most, keep, needs)

    def _write(self) -> None:
        self.numbers |= {"seconds": self.steps.spent, "steps": self.steps.told}
        text = json.dumps(self.numbers, indent=1) + "\n"
        (self.results / "gpu.json").write_text(text, encoding="utf-8")
        with self.steps.guarded("page"):
            (self.results / "benchmarks-gpu.md").write_text(page(self.numbers), encoding="utf-8")


if __name__ == "__main__":
    sys.exit(main())
