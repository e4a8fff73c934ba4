"""Score finished runs on the views they never saw and, where it is known, against the true surface.

    python train/evaluate.py --run OUT [--mesh-truth gt.ply] [--points-truth gt_visible.npz] [--concave concave.npz]
    python train/evaluate.py --run OUT/chair OUT/drums ... --protocol nerf --table nerf.md
    python train/evaluate.py --run OUT --protocol dtu --dtu-truth FOLDER --scan 65 [--cull masks]

Reads OUT/config.yaml, OUT/field.npz and OUT/mesh.ply, and OUT/metrics.json for what the fit took. Writes
OUT/evaluation.json and, with --mesh-truth, OUT/error.ply (the mesh coloured by its distance to the truth, green beyond
the cut) and OUT/error.png. Exit 2 for bad input.

Protocols: `default` scores the views as the run was told to read them. The others score pictures of full size, with the
data set's masks over white, whatever scale the run was fitted at, and print a table of the runs with their mean:

    nerf  the whole test split of NeRF-synthetic, transforms_test.json, whatever the run held out
    dtu   the views of the fit, within their masks, and the mesh against the scanner's points, by the rules written in
          torch_surfcap/protocols/dtu.py; by default nothing of the mesh is culled, as in NeuS's tables with masks
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import trimesh

from torch_surfcap import config as settings
from torch_surfcap import devices, report
from torch_surfcap.data.capture import Capture, load_capture
from torch_surfcap.data.geometry import Points, read_mesh, read_points
from torch_surfcap.data.parse import read_json
from torch_surfcap.errors import InputError
from torch_surfcap.fitting.alignment import aligned
from torch_surfcap.metrics import surface_scores
from torch_surfcap.protocols import dtu, table
from torch_surfcap.run import check_run, gains_fitted, motions, read_run

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


def evaluate(options: argparse.Namespace) -> list[dict[str, Any]]:
    """Score the runs named by the options, write the results beside each, print and return them."""
    runs = [Path(run) for run in options.run]
    _check(options, runs)
    found = []
    for i, run in enumerate(runs):
        scan = None if options.protocol != "dtu" else dtu.read_scan(Path(options.dtu_truth), options.scan[i])
        found.append(_score(run, scan, options))
        report.write_json(run / "evaluation.json", found[-1])
        _print(found[-1])
    if options.protocol != "default" or options.table is not None:
        content = table.table(options.protocol, found)
        print(table.markdown(content), end="")
        if options.table is not None:
            table.write(Path(options.table), content)
    return found


def _check(options: argparse.Namespace, runs: list[Path]) -> None:
    """Raise InputError for options that do not go together and for runs that are not finished, before any scoring."""
    protocol, scans = f"--protocol {options.protocol}", len(options.scan or ())
    if options.protocol == "dtu":
        if options.dtu_truth is None or scans != len(runs):
            found = f"--dtu-truth {options.dtu_truth} and {scans} scans for {len(runs)} runs"
            raise InputError(f"{protocol}: {found}, expected the folder of DTU's truth and a scan per run")
        if options.mesh_truth or options.points_truth or options.concave:
            raise InputError(f"{protocol}: a second truth is given, expected --dtu-truth alone")
    elif options.dtu_truth or options.scan or options.cull != "none":
        raise InputError(f"{protocol}: --dtu-truth, --scan or --cull is given, expected --protocol dtu")
    if options.table is not None and Path(options.table).suffix != ".md":
        raise InputError(f"--table {options.table}: expected a name in .md, the same in .json goes beside it")
    devices.resolve(options.device)
    for run in runs:
        check_run(run)


def _score(run: Path, scan: dtu.Scan | None, options: argparse.Namespace) -> dict[str, Any]:
    """The results of one run, as evaluation.json gets them."""
    start = time.perf_counter()
    config, field, mesh = read_run(run, options.device)
    capture = _capture(config, options.protocol, options.scale)
    truth = None if options.mesh_truth is None else read_mesh(Path(options.mesh_truth))
    points = None if options.points_truth is None else read_points(Path(options.points_truth))
    concave = _concave(options)
    results: dict[str, Any] = {"run": str(run), "scene": _scene(config), "protocol": options.protocol}
    if scan is not None:
        results["surface"] = _scan_scores(mesh, scan, capture, options)
    elif truth is not None or points is not None or concave is not None:
        results["surface"] = surface_scores(mesh, truth, points, concave, options.cut, options.cut / 5)
    gains = gains_fitted(run)
    capture = aligned(capture, motions(run))
    splits = {"test": capture.test, "train": capture if options.train or scan is not None else None}
    for name, views in splits.items():
        if views is not None:
            each = [report.score_view(field, mesh, views, i, gains=gains) for i in range(len(views))]
            results[name] = {**report.mean_scores(each), "each": dict(zip(views.names, each, strict=True))}
    results["triangles"] = len(mesh.faces)
    results["fit"] = _cost(run)
    results["seconds"] = time.perf_counter() - start
    if truth is not None:
        painted, top = report.errors_of(mesh, truth, options.cut)
        report.write_mesh(run / "error.ply", painted)
        shown = report.some_views(len(capture), ERROR_VIEWS)
        report.write_errors(run / "error.png", painted, capture.cameras, shown, top)
    return results


def _scene(config: settings.Config) -> str:
    """The name of the capture's folder."""
    path = Path(config.data.path).absolute()
    return (path if path.is_dir() else path.parent).name


def _scan_scores(
    mesh: trimesh.Trimesh, scan: dtu.Scan, capture: Capture, options: argparse.Namespace
) -> dict[str, Any]:
    """Scores of a mesh against a scan, and under "cuts" what they leave out."""
    cuts: dict[str, Any] = {"scan": scan.number, **asdict(dtu.Cuts()), "cull": options.cull}
    if options.cull == "masks":
        cuts["dilation"] = options.dilation
        views = [capture] if capture.test is None else [capture, capture.test]
        mesh = dtu.culled(mesh, views, options.dilation)
    return {**dtu.scan_scores(mesh, scan), "cuts": cuts}


def _cost(run: Path) -> dict[str, Any]:
    """What the fit took, by its metrics.json where there is one: "seconds", "peak_memory_bytes"."""
    path = run / "metrics.json"
    if not path.is_file():
        return {}
    metrics = read_json(path)
    try:
        return {"seconds": metrics["seconds"]["total"], "peak_memory_bytes": metrics["peak_memory_bytes"]}
    except (KeyError, TypeError) as error:
        raise InputError(f"{path}: no {error}, expected the metrics.json of a fit") from error


def _concave(options: argparse.Namespace) -> Points | None:
    """The points named, or those in concave.npz beside the truth."""
    if options.concave is not None:
        return read_points(Path(options.concave))
    truth = options.mesh_truth or options.points_truth
    beside = None if truth is None else Path(truth).parent / "concave.npz"
    return read_points(beside) if beside is not None and beside.is_file() else None


def _capture(config: settings.Config, protocol: str, scale: float | None = None) -> Capture:
    """The run's views as the protocol reads them, with a line for each that is left out."""
    arguments = settings.capture_arguments(config)
    if scale is not None:
        arguments["scale"] = scale
    if protocol != "default":
        arguments |= {"scale": 1.0, "masks": True, "plates": False}
    if protocol == "nerf":
        arguments["holdout"] = 0
    capture = load_capture(**arguments)
    if protocol == "nerf" and capture.test is None:
        path = config.data.path
        raise InputError(f"{path}: no transforms_test.json, expected the test split of NeRF-synthetic")
    for warning in capture.warnings:
        print(f"warning: {warning}")
    return capture


def _print(results: dict[str, Any]) -> None:
    print(results["run"])
    for split in ("test", "train"):
        if split in results:
            _table(f"{split} views", {k: v for k, v in results[split].items() if k != "each"})
    if "test" not in results and "train" not in results:
        print("no held-out views: nothing to score pictures on (--train does)")
    if "surface" in results:
        _table("surface, world units", {k: v for k, v in results["surface"].items() if k != "cuts"})
    print(f"{results['triangles']} triangles, {results['seconds']:.1f} s")


def _table(title: str, values: dict[str, float]) -> None:
    print(title)
    for name, value in values.items():
        print(f"  {name:<24}{value:>12d}" if isinstance(value, int) else f"  {name:<24}{value:>12.5g}")


def _options(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--run", required=True, nargs="+", metavar="OUT", help="folders of finished fits")
    parser.add_argument("--mesh-truth", metavar="MESH", help="true surface")
    parser.add_argument(
        "--points-truth", metavar="NPZ", help="points of the true surface that the cameras see"
    )
    parser.add_argument(
        "--concave", metavar="NPZ", help="points within concavities; concave.npz beside the truth"
    )
    parser.add_argument("--cut", type=float, default=0.05, help="longest distance that counts, world units")
    parser.add_argument("--protocol", choices=list(table.COLUMNS), default="default")
    parser.add_argument(
        "--scale",
        type=float,
        metavar="FRACTION",
        help="size of the pictures scored; by default that of the fit's",
    )
    parser.add_argument(
        "--train", action="store_true", help="score the views of the fit as well; dtu always does"
    )
    parser.add_argument(
        "--table", metavar="FILE.md", help="write the table of the runs and their mean, as FILE.json too"
    )
    parser.add_argument(
        "--device", default="auto", metavar="DEVICE", help="of the field: auto, cpu, cuda, cuda:0, ..."
    )
    parser.add_argument("--dtu-truth", metavar="FOLDER", help="with DTU's Points/stl and ObsMask")
    parser.add_argument(
        "--scan", type=int, nargs="+", metavar="N", help="number of DTU's object, one per run"
    )
    parser.add_argument(
        "--cull",
        choices=["none", "masks"],
        default="none",
        help="what of the mesh is left out: nothing, or what lies outside a dilated mask (UNISURF, 2DGS)",
    )
    parser.add_argument(
        "--dilation",
        type=float,
        default=24.0,
        help="of the masks that cull, pixels: 24 as 2DGS; NeuralWarp takes 12, NeuS without masks 50",
    )
    return parser.parse_args(arguments)


if __name__ == "__main__":
    sys.exit(main())
