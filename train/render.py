"""Render a finished run from any camera.

    python train/render.py --run OUT [--what volume,raster,...] [--view NAME|number|train|test ...] [--size PIXELS]
                           [--crop 0.3,0.1,0.4,0.4]
    python train/render.py --run OUT --turntable 96 [--elevation 15] [--up z]
    python train/render.py --run OUT --section y=0.1

Writes into OUT/pictures, each file complete or absent: VIEW_KIND.png for every view and kind; with depth also
VIEW_depth16.png (16 bit, along the optical axis) and its unit and camera in VIEW_depth16.json; turntable_KIND.mp4 (.gif
where this OpenCV has no codec); section_AXIS_POSITION.png. Turntables and sections need the run alone, views the capture
as well. Exit 2 for bad input.
"""

from __future__ import annotations

import argparse
import math
import re
import sys
from collections.abc import Collection, Iterable, Sequence
from contextlib import ExitStack
from difflib import get_close_matches
from pathlib import Path
from typing import TypeVar

import numpy as np
import torch
import trimesh
from torch import Tensor
from tqdm import tqdm

from torch_surfcap import config as settings
from torch_surfcap import report
from torch_surfcap.data.cameras import Cameras
from torch_surfcap.data.capture import Capture, load_capture
from torch_surfcap.data.geometry import read_mesh
from torch_surfcap.data.readers import read_views
from torch_surfcap.errors import InputError
from torch_surfcap.figures import write_section
from torch_surfcap.movie import film_suffix, write_film
from torch_surfcap.pictures import KINDS, Subject
from torch_surfcap.run import read_run
from torch_surfcap.surface.render import mesh_depth
from torch_surfcap.surface.section import in_words, middle_plane
from torch_surfcap.surface.turntable import turntable, up_direction

Item = TypeVar("Item")

USUAL = ("volume", "raster", "shaded", "normals", "depth", "constant", "view_dependent")
TURNED = ("raster", "shaded")  # what a turntable shows where nothing else is asked for
VIEWS = 4  # views shown where none is asked for
TURNTABLE_SIZE, SECTION_SIZE = 720, 1000  # pixels of the longer side
SHOWN = 8  # files named at the end
AXES = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit status."""
    options = _options(arguments)
    try:
        written = render(options)
    except InputError as error:
        print(error, file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return 130
    print(
        f"{len(written)} files in {written[0].parent}: {', '.join(path.name for path in written[:SHOWN])}"
        + (", ..." if len(written) > SHOWN else "")
    )
    return 0


def render(options: argparse.Namespace) -> list[Path]:
    """Write the pictures that the options name, and return their files."""
    run = Path(options.run)
    config, field, mesh = read_run(run, options.device)
    kinds = _kinds(options, max(field.sh_degree, field.view.sh_degree if field.view else 0))
    _check_numbers(options)
    (axis, position), poses = _section(options.section, mesh), _poses(config)
    up, crop = _up(options.up, poses), options.crop and _crop(options.crop)
    shown = [kind for kind in kinds if kind != "section"]
    still = shown and (options.view or not options.turntable)
    views = _views(_load(config), options.view) if still else None
    subject, top = Subject(field, mesh), 0.0
    if options.mesh_truth is not None and "error" in kinds:
        subject.errors, top = report.errors_of(mesh, read_mesh(Path(options.mesh_truth)), options.cut)
    out, written = run / report.PICTURES, []
    if "section" in kinds:
        where = in_words(position, field.voxel_size)
        written.append(out / f"section_{'xyz'[axis]}_{where}.png")
        size = options.size or SECTION_SIZE
        write_section(written[-1], field, axis, position, size, up, config.mesh.threshold)
    if views is not None:
        names, cameras = views
        if crop is not None:
            cameras = cameras.cropped(*crop)
        cameras = cameras if options.size is None else cameras.scaled_to(options.size)
        written += _write_views(subject, top, shown, names, cameras, options.samples, out)
    if shown and options.turntable:
        if up is None:
            print("turntable: the capture's calibration is gone and --up not given, z is taken to be up")
            up = torch.tensor(AXES["z"])
        front = None if poses is None else -poses[0, :3, :3].T @ poses[0, :3, 3]
        size = options.size or TURNTABLE_SIZE
        cameras = turntable(mesh, up, options.turntable, options.elevation, size, front)
        written += _write_films(subject, shown, cameras, options.samples, out)
    return written


def _write_views(
    subject: Subject,
    top: float,
    kinds: list[str],
    names: list[str],
    cameras: Cameras,
    samples: int,
    out: Path,
) -> list[Path]:
    """All kinds of pictures from all cameras."""
    written = []
    for i, name in enumerate(_progress(names, "views")):
        stem, depths = re.sub(r"[^\w.=-]+", "_", name), subject.depth_range(cameras.subset([i]))
        for kind, picture in subject.pictures(kinds, cameras, i, depths, samples).items():
            path = out / f"{stem}_{kind}.png"
            written.append(path)
            if kind == "error":
                report.write_error_pictures(path, [picture], top, max(report.CELL, picture.shape[0]))
            else:
                report.write_picture(path, picture)
        if "depth" in kinds:
            written.append(out / f"{stem}_depth16.png")
            report.write_depth(written[-1], mesh_depth(subject.mesh, cameras, i), cameras, i)
    return written


def _write_films(subject: Subject, kinds: list[str], cameras: Cameras, samples: int, out: Path) -> list[Path]:
    """A film of each kind with a frame from each camera; all cameras have one size."""
    width, height = (int(n) for n in cameras.size[0])
    suffix, depths = film_suffix((width, height)), subject.depth_range(cameras)
    paths = [out / f"turntable_{kind}{suffix}" for kind in kinds]
    with ExitStack() as films:
        add = [films.enter_context(write_film(path, (width, height))) for path in paths]
        for i in _progress(range(len(cameras)), "turntable"):
            frames = subject.pictures(kinds, cameras, i, depths, samples)
            for add_frame, kind in zip(add, kinds, strict=True):
                add_frame(frames[kind])
    return paths


def _progress(items: Collection[Item], what: str) -> Iterable[Item]:
    """The items, with a bar; a log gets its beginning and end only."""
    return tqdm(items, desc=what, mininterval=0.2 if sys.stderr.isatty() else 3600.0)


def _kinds(options: argparse.Namespace, sh_degree: int) -> list[str]:
    """The kinds of pictures asked for, or the usual ones of what is asked for."""
    if options.what is None:
        special = options.turntable or options.section
        usual = USUAL if options.view or not special else TURNED if options.turntable else ()
        kinds = [kind for kind in usual if sh_degree or kind != "view_dependent"]
        kinds += ["section"] * (options.section is not None or not special)
        return kinds + ["error"] * (options.mesh_truth is not None)
    kinds = list(dict.fromkeys([*options.what.split(","), *["section"] * (options.section is not None)]))
    for kind in kinds:
        if kind not in (*KINDS, "section"):
            raise InputError(f"--what: no kind {kind!r}, expected of {', '.join(KINDS)}, section")
        if kind.startswith("view_dependent") and sh_degree == 0:
            raise InputError(f"--what: {kind} of a run of sh_degree=0, expected one of sh_degree=1 or 2")
        if kind == "error" and options.mesh_truth is None:
            raise InputError("--what: error without a true surface, expected --mesh-truth MESH")
    return kinds


def _check_numbers(options: argparse.Namespace) -> None:
    for name, low in (("size", 16), ("turntable", 1), ("samples", 1)):
        value = getattr(options, name)
        if value is not None and value < low:
            raise InputError(f"--{name} is {value}, expected {low} or more")
    if not options.cut > 0:
        raise InputError(f"--cut is {options.cut:g}, expected more than 0")


def _load(config: settings.Config) -> Capture:
    data = config.data
    return load_capture(
        data.path, data.format, data.scale, data.holdout, data.masks, data.plates, config.cameras.skip
    )


def _poses(config: settings.Config) -> Tensor | None:
    """World-to-camera [N, 4, 4] as the capture's calibration states them; None where it is gone."""
    try:
        views = read_views(Path(config.data.path), config.data.format)[1]
    except InputError:
        return None
    return torch.from_numpy(np.stack([view.world_to_camera for view in views]))


def _up(given: str | None, poses: Tensor | None) -> Tensor | None:
    """The direction given, as [-]x, y or z or as three numbers, else that of the cameras, if any."""
    if given is None:
        return None if poses is None else up_direction(poses)
    try:
        name = given.lstrip("+-")
        vector = AXES[name] if name in AXES else [float(x) for x in given.split(",")]
        up = torch.tensor(vector, dtype=torch.float64) * (-1 if name in AXES and given[0] == "-" else 1)
    except ValueError:
        up = torch.zeros(3)
    if up.shape != (3,) or not 0 < float(up.norm()) < math.inf:
        raise InputError(f"--up is {given!r}, expected x, y, z, -x, -y, -z or three numbers such as 0,0.1,1")
    return up


def _views(capture: Capture, wanted: Sequence[str] | None) -> tuple[list[str], Cameras]:
    """Names and cameras of the views wanted: by name or number (held-out views count on after those of the fit), or all
    of train or test; by default a few held-out ones, or a few of the fit where none is held out."""
    splits = [views for views in (capture, capture.test) if views is not None]
    names = [name for views in splits for name in views.names]
    fitted, held_out = range(len(capture)), range(len(capture), len(names))
    chosen: list[int] = []
    for item in wanted or ():
        if item in ("train", "test"):
            chosen += fitted if item == "train" else held_out
        elif item in names or (item.isdecimal() and int(item) < len(names)):
            chosen.append(names.index(item) if item in names else int(item))
        else:
            near = get_close_matches(item, names, 1)
            hint = f"did you mean {near[0]}" if near else f"expected a name such as {names[0]} or a number"
            raise InputError(f"--view: no view {item} among {len(names)}, {hint}")
    if not wanted:
        pool = held_out or fitted
        chosen = [pool[i] for i in report.some_views(len(pool), VIEWS)]
    if not chosen:
        raise InputError("--view test: this run holds no view out, expected train, a name or a number")
    return [names[i] for i in chosen], Cameras.joined([views.cameras for views in splits]).subset(chosen)


def _section(given: str | None, mesh: trimesh.Trimesh) -> tuple[int, float]:
    """Axis and position of "y=0.1"; the middle of "y"; where most is to be seen if nothing is given."""
    if given is None:
        return middle_plane(mesh)
    name, equals, position = given.partition("=")
    try:
        axis = [*AXES].index(name)
        place = float(position) if equals else float(np.median(mesh.vertices[:, axis]))
        if not math.isfinite(place):
            raise ValueError
    except ValueError:
        raise InputError(f"--section is {given!r}, expected x, y or z, or one such as y=0.1") from None
    return axis, place


def _crop(given: str) -> tuple[float, float, float, float]:
    """Left, top, width and height of a window within the picture."""
    try:
        left, top, width, height = (float(x) for x in given.split(","))
        within = 0 <= left < left + width <= 1 and 0 <= top < top + height <= 1
    except ValueError:
        within = False
    if not within:
        raise InputError(
            f"--crop is {given!r}, expected left,top,width,height as shares such as 0.3,0.1,0.4,0.4"
        )
    return left, top, width, height


def _options(arguments: Sequence[str] | None) -> argparse.Namespace:
    kinds = {**KINDS, "section": "a plane through the field with its tiles and the level set"}
    parser = argparse.ArgumentParser(
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        epilog="kinds:\n" + "\n".join(f"  {kind:<22}{meaning}" for kind, meaning in kinds.items()),
    )
    parser.add_argument("--run", required=True, metavar="OUT", help="folder of a finished fit")
    parser.add_argument("--what", metavar="KIND,...", help="which pictures, of the kinds below")
    parser.add_argument(
        "--view", nargs="+", metavar="VIEW", help="names, numbers, train or test; a few by default"
    )
    parser.add_argument(
        "--size", type=int, help="pixels of the longer side; a view's own, 720, or 1000 for sections"
    )
    parser.add_argument(
        "--crop", metavar="X,Y,W,H", help="a window of each view, as shares of its width and height"
    )
    parser.add_argument(
        "--samples", type=int, default=2, help="rays per pixel and side where the mesh is shown"
    )
    parser.add_argument("--turntable", type=int, metavar="N", help="a film of N frames once around the mesh")
    parser.add_argument("--elevation", type=float, default=15.0, help="of the turntable's cameras, degrees")
    parser.add_argument(
        "--up", help="of turntable and sections: z, -y, 0,0.1,1; by default what the cameras take to be up"
    )
    parser.add_argument(
        "--section", metavar="AXIS[=POSITION]", help="plane to cut, world units, such as y=0.1"
    )
    parser.add_argument(
        "--device", default="auto", metavar="DEVICE", help="of the field: auto, cpu, cuda, cuda:0, ..."
    )
    parser.add_argument("--mesh-truth", metavar="MESH", help="true surface, for the kind error")
    parser.add_argument("--cut", type=float, default=0.05, help="longest distance that counts, world units")
    return parser.parse_args(arguments)


if __name__ == "__main__":
    sys.exit(main())
