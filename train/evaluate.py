"""Score a finished run on the views it never saw and, where it is known, against the true surface.

    python train/evaluate.py --run OUT [--mesh-truth gt.ply] [--points-truth gt_visible.npz] [--concave concave.npz]

Reads OUT/config.yaml, OUT/field.npz and OUT/mesh.ply. Writes OUT/evaluation.json and, with --mesh-truth, OUT/error.ply
(the mesh coloured by its distance to the truth, green beyond the cut) and OUT/error.png. Exit 2 for bad input.

Protocols: `default` scores the views as the run was told to read them; `nerf` the whole test split at full size over
white, whatever scale the run was fitted at.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray

from torch_surfcap import config as settings
from torch_surfcap import report
from torch_surfcap.data.capture import Capture, load_capture
from torch_surfcap.errors import InputError
from torch_surfcap.metrics import surface_scores
from torch_surfcap.run import read_mesh, read_run

Points = NDArray[np.float64]

ERROR_VIEWS = 4


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit status."""
    options = _options(arguments)
    try:
        evaluate(options)
    except InputError as error:
        print(error, file=sys.stderr)
        return 2
    return 0


def evaluate(options: argparse.Namespace) -> dict[str, Any]:
    """Score the run named by the options, write the results beside it, print and return them."""
    start = time.perf_counter()
    run = Path(options.run)
    config, field, mesh = read_run(run)
    capture = _capture(config, options.protocol)
    truth = None if options.mesh_truth is None else read_mesh(Path(options.mesh_truth))
    points = None if options.points_truth is None else read_points(Path(options.points_truth))
    concave = _concave(options)
    results: dict[str, Any] = {"run": str(run), "protocol": options.protocol}
    splits = {"test": capture.test, "train": capture if options.train else None}
    for name, views in splits.items():
        if views is not None:
            each = [report.score_view(field, mesh, views, i) for i in range(len(views))]
            results[name] = {**report.mean_scores(each), "each": dict(zip(views.names, each, strict=True))}
    if truth is not None or points is not None or concave is not None:
        results["surface"] = surface_scores(mesh, truth, points, concave, options.cut, options.cut / 5)
    results["triangles"] = len(mesh.faces)
    results["seconds"] = time.perf_counter() - start
    if truth is not None:
        painted, top = report.errors_of(mesh, truth, options.cut)
        report.write_mesh(run / "error.ply", painted)
        shown = report.some_views(len(capture), ERROR_VIEWS)
        report.write_errors(run / "error.png", painted, capture.cameras, shown, top)
    report.write_json(run / "evaluation.json", results)
    _print(results)
    return results


def read_points(path: Path) -> Points:
    """Points [P, 3]: "points", or the only table of numbers, of an .npz; the vertices of anything else trimesh reads."""
    try:
        if path.suffix == ".npz":
            with np.load(path, allow_pickle=False) as file:
                names = [name for name in file.files if file[name].ndim == 2 and file[name].dtype.kind == "f"]
                points = file["points" if "points" in names or len(names) != 1 else names[0]]
        else:
            points = np.asarray(getattr(trimesh.load(path, process=False), "vertices", ()))
    except Exception as error:  # trimesh's readers raise whatever their parsing trips over
        raise InputError(f"{path}: {error}, expected points") from error
    if points.ndim != 2 or points.shape[1] != 3 or len(points) == 0 or not np.isfinite(points).all():
        raise InputError(f"{path}: an array of shape {list(points.shape)}, expected finite points [P, 3]")
    return np.asarray(points, dtype=np.float64)


def _concave(options: argparse.Namespace) -> Points | None:
    """The points named, or those in concave.npz beside the truth."""
    if options.concave is not None:
        return read_points(Path(options.concave))
    truth = options.mesh_truth or options.points_truth
    beside = None if truth is None else Path(truth).parent / "concave.npz"
    return read_points(beside) if beside is not None and beside.is_file() else None


def _capture(config: settings.Config, protocol: str) -> Capture:
    data, skip = config.data, config.cameras.skip
    if protocol == "default":
        return load_capture(data.path, data.format, data.scale, data.holdout, data.masks, data.plates, skip)
    capture = load_capture(data.path, data.format, 1.0, data.holdout, True, False, skip)
    if capture.test is None:
        raise InputError(f"{data.path}: no held-out views, expected a test split for the protocol nerf")
    return capture


def _print(results: dict[str, Any]) -> None:
    for split in ("test", "train"):
        if split in results:
            _table(f"{split} views", {k: v for k, v in results[split].items() if k != "each"})
    if "test" not in results:
        print(
            "no held-out views: nothing to score pictures on"
            + ("" if "train" in results else " (--train does)")
        )
    if "surface" in results:
        _table("surface, world units", results["surface"])
    print(f"{results['triangles']} triangles, {results['seconds']:.1f} s")


def _table(title: str, values: dict[str, float]) -> None:
    print(title)
    for name, value in values.items():
        print(f"  {name:<24}{value:>12d}" if isinstance(value, int) else f"  {name:<24}{value:>12.5g}")


def _options(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--run", required=True, metavar="OUT", help="folder of a finished fit")
    parser.add_argument("--mesh-truth", metavar="MESH", help="true surface")
    parser.add_argument(
        "--points-truth", metavar="NPZ", help="points of the true surface that the cameras see"
    )
    parser.add_argument(
        "--concave", metavar="NPZ", help="points within concavities; concave.npz beside the truth"
    )
    parser.add_argument("--cut", type=float, default=0.05, help="longest distance that counts, world units")
    parser.add_argument("--protocol", choices=["default", "nerf"], default="default")
    parser.add_argument("--train", action="store_true", help="score the views of the fit as well")
    return parser.parse_args(arguments)


if __name__ == "__main__":
    sys.exit(main())
