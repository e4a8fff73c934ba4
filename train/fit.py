"""Fit a coloured mesh to calibrated photographs.

    python train/fit.py [--config configs/NAME.yaml] data.path=CAPTURE out=OUT [key=value ...]

Keys and their meaning stand in torch_surfcap/config.py. Writes into OUT mesh.ply, mesh.glb, field.npz, config.yaml (with
the defaults that were used), preview.png, history.csv (a line per iteration) and metrics.json: all of them, once the fit
is done, or none. Meanwhile there is OUT/checkpoint.npz: resume=true goes on from it after whatever ended the run. Exit 0
when the results are written, 2 for bad input, 130 when interrupted.
"""

from __future__ import annotations

import os

# Large memory pages for torch's own buffers, decided when torch is loaded: rays and voxels are read all over the memory, so
# that the march is bound by address translation (measured: a step of SH degree 1 falls from 1.5 to 1.1 us per ray).
os.environ["THP_MEM_ALLOC_ENABLE"] = os.environ.get("THP_MEM_ALLOC_ENABLE", "1")

import argparse
import resource
import shutil
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import psutil
import torch
from tqdm import tqdm

from torch_surfcap import config as settings
from torch_surfcap import devices, report
from torch_surfcap.config import Config
from torch_surfcap.data.capture import Capture, load_capture
from torch_surfcap.errors import InputError
from torch_surfcap.fitting.alignment import aligned
from torch_surfcap.fitting.checkpoint import FREE, Checkpoints
from torch_surfcap.fitting.course import Progress
from torch_surfcap.fitting.fit import FitResult, fit

RESULTS = ("mesh.ply", "mesh.glb", "field.npz", "config.yaml", "preview.png", "history.csv", "metrics.json")
EVALUATED = (
    "evaluation.json",
    "error.ply",
    "error.png",
)  # by evaluate.py; they, and the pictures of render.py, go with the results they are of
CHECKPOINT = "checkpoint.npz"
# May differ between a run and its resumption.
FREE_KEYS = {"out", "overwrite", "resume", "checkpoint", *FREE}
SHOWN = {"psnr_volume": "PSNR volume", "psnr_raster": "PSNR raster", "psnr_masked": "PSNR masked"}


def main(arguments: Sequence[str] | None = None, started: float = 0.0) -> int:
    """Run the command; returns its exit status. started: seconds that it took to come here."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--config", metavar="YAML", help="settings that differ from the defaults")
    parser.add_argument("settings", nargs="*", metavar="key=value", help="come after the file's")
    options = parser.parse_intermixed_args(arguments)
    try:
        config = settings.resolved(settings.load(options.config, options.settings))
        run(config, started)
    except InputError as error:
        print(error, file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        left = Path(config.out) / CHECKPOINT
        rest = f"resume=true goes on from {left}" if left.exists() else "nothing was written"
        print(f"interrupted, {rest}", file=sys.stderr)
        return 130
    return 0


def run(config: Config, started: float = 0.0, method: Callable[..., FitResult] = fit) -> None:
    """Load, fit, score and write. Raises InputError before any work where the results could not be written.

    method: another one to fit by, with the arguments of :func:`torch_surfcap.fit`.
    """
    start = time.perf_counter()
    out = Path(config.out)
    if not config.data.path:
        raise InputError("data.path is not given, expected data.path=FOLDER of a capture")
    device = devices.resolve(config.device)
    _check_out(out, config)
    devices.reset_peak(device)
    capture = _load(config)
    seconds: dict[str, Any] = {"total": 0.0, "start": started, "load": time.perf_counter() - start}
    with closing(Bars(device)) as bars:
        label = settings.to_yaml(config)
        checkpoints = Checkpoints(out / CHECKPOINT, config.checkpoint, config.resume, label)
        result = method(capture, bars, checkpoints, device=str(device), **settings.fit_arguments(config))
    seen = aligned(capture, result.motion)
    for warning in result.warnings[len(capture.warnings) :]:
        print(f"warning: {warning}")
    seconds |= result.seconds
    metrics = _metrics(result, seen, seconds, device)
    _write(out, config, result, seen, metrics, start - started)
    _summary(metrics, out)


class Bars:
    """The estimate before the first level, then a progress bar per level."""

    def __init__(self, device: torch.device = devices.CPU) -> None:
        self.device = device
        self.bar: tqdm[Any] | None = None
        self.number = -1

    def __call__(self, at: Progress) -> None:
        if at.budget is not None:
            memory = max(at.budget.level_bytes) / 2**30
            levels = f"{at.levels} level" + "s" * (at.levels > 1)
            threads = f"{torch.get_num_threads()} thread" + "s" * (torch.get_num_threads() > 1)
            where, seconds = devices.name(self.device), at.budget.seconds
            cost = where if seconds is None else f"about {seconds:.0f} s on {threads}"
            print(f"{levels}, {cost}, {memory:.1f} GiB", flush=True)
            return
        if at.number != self.number or self.bar is None:
            self.close()
            self.number = at.number
            self.bar = tqdm(
                desc=f"level {at.number + 1} of {at.levels}",
                total=3 * at.level.iterations,  # the limit; most levels end earlier
                bar_format="{desc} |{bar:20}| {n_fmt} iterations, {elapsed_s:.1f} s{postfix}",
                mininterval=0.2 if sys.stderr.isatty() else 3600.0,  # a log gets the end of each bar only
            )
        self.bar.set_postfix_str(f"loss {at.row['loss']:.4g}, {at.voxels} voxels", refresh=False)
        self.bar.update()

    def close(self) -> None:
        if self.bar is not None:
            self.bar.total = self.bar.n
            self.bar.close()
            self.bar = None


def _check_out(out: Path, config: Config) -> None:
    """Raise InputError where `out` cannot be written to or holds results that are to be kept. Creates nothing."""
    try:
        nearest = next(folder for folder in (out, *out.absolute().parents) if folder.exists())
        with tempfile.TemporaryFile(dir=nearest):
            pass
        found = [name for name in (*RESULTS, CHECKPOINT) if (out / name).exists()]
    except OSError as error:
        raise InputError(f"out: {out} cannot be written to ({error.strerror}), expected a folder") from error
    if found and not (config.overwrite or config.resume):
        expected = "expected another folder, overwrite=true or resume=true"
        what = "a checkpoint" if found == [CHECKPOINT] else "the results"
        raise InputError(f"out: {out} holds {what} of an earlier run ({found[0]}), {expected}")
    if config.resume:
        saved = Checkpoints(out / CHECKPOINT, resume=True).load(arrays=False)
        if saved is not None:
            earlier = settings.of_yaml(saved.label, str(out / CHECKPOINT))
            _check_same(out / CHECKPOINT, earlier, config)
            level, iteration = saved.place
            print(f"{out}: resumed at iteration {iteration} of level {level + 1}")
            return
        if "config.yaml" in found and not config.overwrite:
            _check_same(out / "config.yaml", settings.load(out / "config.yaml"), config)
        print(f"{out}: no checkpoint there, the fit starts afresh")


def _check_same(path: Path, earlier: Config, config: Config) -> None:
    for key, (then, now) in settings.differences(earlier, config).items():
        if key not in FREE_KEYS:
            raise InputError(
                f"{path}: {key} is {then} there and {now} now, expected the same for resume=true"
            )


def _load(config: Config) -> Capture:
    """The capture, with a line that says what it is and one per warning."""
    capture = load_capture(**settings.capture_arguments(config))
    sizes = sorted({(int(w), int(h)) for w, h in capture.cameras.size})
    size = " to ".join(f"{w} x {h}" for w, h in dict.fromkeys((sizes[0], sizes[-1])))
    held_out = f", {len(capture.test)} held out" if capture.test is not None else ""
    plates = ", with plates" if capture.plates is not None else ""
    print(
        f"{config.data.path}: {len(capture)} views of {size}{held_out}, masks by {capture.mask_source}{plates}"
    )
    for warning in capture.warnings:
        print(f"warning: {warning}")
    sys.stdout.flush()
    return capture


def _metrics(
    result: FitResult, capture: Capture, seconds: dict[str, Any], device: torch.device
) -> dict[str, Any]:
    """The content of metrics.json, but for the seconds that writing takes. Scores at most 8 views of either kind."""
    begin = time.perf_counter()
    scores: dict[str, Any] = {"train": None, "test": None}
    for split, views in (("train", capture), ("test", capture.test)):
        if views is not None:
            chosen = report.some_views(len(views), report.SCORED)
            scores[split] = report.score_views(result.field, result.mesh, views, chosen, gains=result.gains)
    seconds["score"] = time.perf_counter() - begin
    return {
        **scores,
        "seconds": seconds,
        "peak_memory_bytes": 0,
        "device": {
            "word": str(device),
            "name": devices.name(device),
            "torch": torch.__version__,
            "peak_memory_bytes": devices.peak_bytes(device),
        },
        "views": len(capture),
        "pixels": float(capture.cameras.size.double().prod(1).mean()),  # of a view
        "voxels": result.field.voxels[..., 0].numel(),
        "tiles": len(result.field.voxels),
        "triangles": len(result.mesh.faces),
        "chosen": result.chosen,
        "warnings": result.warnings,
        "resumed_from": result.resumed_from,
        "iterations_run": result.iterations_run,
    }


def _write(
    out: Path, config: Config, result: FitResult, capture: Capture, metrics: dict[str, Any], start: float
) -> None:
    """All results, written beside and moved in place together; the total time and peak memory join the metrics."""
    begin = time.perf_counter()
    existed = out.exists()
    try:
        out.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=out, prefix=".unfinished-") as folder:
            aside = Path(folder)
            report.write_mesh(aside / "mesh.ply", result.mesh)
            report.write_mesh(aside / "mesh.glb", result.mesh)
            result.field.save(aside / "field.npz")
            settings.save(config, aside / "config.yaml")
            report.write_preview(
                aside / "preview.png", result.field, result.mesh, capture, gains=result.gains
            )
            report.write_history(aside / "history.csv", result.history)
            now = time.perf_counter()
            metrics["seconds"] |= {"total": now - start, "write": now - begin}
            unit = 1 if sys.platform == "darwin" else 1024  # of ru_maxrss, bytes
            metrics["peak_memory_bytes"] = unit * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
            report.write_json(aside / "metrics.json", metrics)
            for name in EVALUATED:
                (out / name).unlink(missing_ok=True)
            shutil.rmtree(out / report.PICTURES, ignore_errors=True)
            for name in RESULTS:
                os.replace(aside / name, out / name)
            (out / CHECKPOINT).unlink(missing_ok=True)
    except OSError as error:
        raise InputError(f"out: {out} cannot be written to ({error.strerror or error})") from error
    finally:
        if not existed and out.is_dir() and not any(out.iterdir()):
            out.rmdir()


def _summary(metrics: dict[str, Any], out: Path) -> None:
    splits = [split for split in ("train", "test") if metrics[split]]
    print(f"{'':<14}" + "".join(f"{split:>8}" for split in splits))
    for name, title in SHOWN.items():
        if name in metrics[splits[0]]:
            print(f"{title:<14}" + "".join(f"{metrics[split][name]:>8.4g}" for split in splits))
    seconds = metrics["seconds"]
    stages = [f"{name} {value:.1f}" for name, value in seconds.items() if name not in ("total", "levels")]
    print(f"triangles      {metrics['triangles']}")
    print(f"seconds        {seconds['total']:.1f} ({', '.join(stages)})")
    device = metrics["device"]
    print(f"memory         {metrics['peak_memory_bytes'] / 2**30:.2f} GiB")
    there = device["peak_memory_bytes"]
    peak = "" if there is None else f", at most {there / 2**30:.2f} GiB of its memory"
    print(f"device         {device['name']}{peak}")
    print(f"files          {out}: {', '.join(RESULTS)}")


if __name__ == "__main__":
    sys.exit(main(started=time.time() - psutil.Process().create_time()))
