"""Say in seconds whether a capture is sound, before any fit.

    python train/check.py DATA [key=value ...]

DATA is a capture's folder or calibration file; the keys are those of train/fit.py (data.scale=0.5, data.format=rig,
cameras.skip=[left], out=FOLDER, ...). Prints, per camera, how much of its silhouette the visual hull of all cameras
fills and how bright the subject is against the other cameras, then what is wrong, with the usual wrong conventions
tried and named. Writes check.png (cameras, box, hull), hull.ply and check.json into out/check, or into `out` where given.

Exit 0: sound. 1: something found that a fit will suffer from. 2: bad input, one line says what.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh
from torch import Tensor

from torch_surfcap import config as settings
from torch_surfcap import report, soundness
from torch_surfcap.data.capture import Capture, load_capture
from torch_surfcap.data.files import atomic_write
from torch_surfcap.errors import InputError
from torch_surfcap.field.hull import find_box
from torch_surfcap.surface.section import in_words

FILLED = 0.95  # less than this share of the silhouettes filled on average is a finding
FILLED_ONE = 0.85  # ... and less than this of one camera's
UNEVEN = 1.4  # so many times brighter or darker than the median camera is worth a note
EXPOSURE = 4.0  # ... and so many times is a finding
AXES = 0.06  # length of the drawn frusta, relative to the distance between cameras and box


@dataclass
class Check:
    """What was measured. findings: what a fit will suffer from; notes: what is good to know."""

    capture: Capture
    box: tuple[Tensor, Tensor] | None = None
    agreement: soundness.Agreement | None = None
    hull: trimesh.Trimesh | None = None
    brightness: Tensor = field(default_factory=lambda: torch.zeros(0))
    findings: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    @property
    def exposure(self) -> Tensor:
        """[N] brightness relative to the median camera's."""
        return self.brightness / self.brightness.median().clamp(min=1e-6)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit status."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("data", metavar="DATA", help="folder or calibration file of the capture")
    parser.add_argument("settings", metavar="key=value", nargs="*")
    options = parser.parse_args(arguments)
    try:
        config = settings.load(None, ["out=out/check", *options.settings])
        config.data.path = options.data
        capture = load_capture(**settings.capture_arguments(config))
        box = (
            None if config.data.box is None else torch.tensor(config.data.box, dtype=torch.float64).view(2, 3)
        )
        check = examine(capture, None if box is None else (box[0], box[1]))
        write(check, Path(config.out))
    except InputError as error:
        print(error, file=sys.stderr)
        return 2
    show(check)
    print(f"written: {config.out}/check.png, check.json" + (", hull.ply" if check.hull is not None else ""))
    return 1 if check.findings else 0


def examine(capture: Capture, box: tuple[Tensor, Tensor] | None = None) -> Check:
    """Measure the capture and find what is wrong with it; `box` (low, high) is found where not given."""
    check = Check(capture, box, brightness=soundness.brightness(capture), notes=list(capture.warnings))
    check.notes.append(f"silhouettes come from: {capture.mask_source}")
    try:
        check.box = find_box(capture) if box is None else box
        check.agreement = soundness.agreement(capture, check.box)
    except InputError as error:
        check.findings.append(str(error))
    filled = check.agreement.mean if check.agreement else 0.0
    if filled < FILLED:
        _explain(check, filled)
    if check.agreement is not None and check.box is not None:
        centre = soundness.wrong_pixel_centre(capture, check.agreement, check.box)
        if centre:
            check.findings.append(centre)
        worst = int(check.agreement.filled.argmin())
        share = float(check.agreement.filled[worst])
        if filled >= FILLED and share < FILLED_ONE:
            check.findings.append(
                f"camera {capture.names[worst]}: the hull fills {share:.2f} of its silhouette"
            )
        check.hull = soundness.hull_mesh(capture, check.box)
    _compare_brightness(check)
    cut = [
        name for name, mask in zip(capture.names, capture.masks or [], strict=True) if _touches_border(mask)
    ]
    if cut:
        check.notes.append(
            f"{len(cut)} of {len(capture)} silhouettes touch the picture's border (first: {cut[0]})"
        )
    return check


def _compare_brightness(check: Check) -> None:
    """A note where pictures differ in brightness, a finding where one differs by more than lamps explain."""
    names, ratios = check.capture.names, check.exposure
    dark, bright = int(ratios.argmin()), int(ratios.argmax())
    if ratios[bright] > UNEVEN or ratios[dark] < 1 / UNEVEN:
        check.notes.append(
            f"the subject is {float(ratios[dark]):.2f} (camera {names[dark]}) to {float(ratios[bright]):.2f} "
            f"(camera {names[bright]}) times as bright as in the median camera: exposures differ, or its sides do"
        )
    for name, ratio in zip(names, ratios.tolist(), strict=True):
        if not 1 / EXPOSURE <= ratio <= EXPOSURE:
            check.findings.append(
                f"camera {name}: its subject is {ratio:.2f} times as bright as the median camera's"
            )


def _explain(check: Check, filled: float) -> None:
    """Look for the reason why the silhouettes do not agree: a convention, or one camera."""
    better = soundness.wrong_convention(check.capture, filled)
    if better:
        what, score = better
        check.findings.append(
            f"{what} (the silhouettes are then filled to {score:.2f} instead of {filled:.2f})"
        )
        return
    check.findings.append(
        f"the hull fills {filled:.2f} of the silhouettes on average, expected at least {FILLED}"
    )
    blamed = soundness.culprit(check.capture, check.box) if check.box is not None else None
    if blamed:
        name, share = check.capture.names[blamed[0]], blamed[1]
        check.findings.append(
            f"camera {name} alone keeps {100 * share:.0f} % of the rest empty: its pose or mask is off"
        )


def _touches_border(mask: Tensor) -> bool:
    return bool(max(float(line.max()) for line in (mask[0], mask[-1], mask[:, 0], mask[:, -1])) > 0.5)


def show(check: Check) -> None:
    """Print the table and the findings."""
    width = max(len("camera"), *(len(name) for name in check.capture.names))
    print(
        f"{'camera':<{width}}  {'pixels':>11}  {'subject':>7}  {'filled':>6}  {'brightness':>10}  {'relative':>8}"
    )
    for row in _rows(check):
        filled = "-" if row["filled"] is None else f"{row['filled']:.3f}"
        pixels = f"{row['size'][0]} x {row['size'][1]}"
        print(
            f"{row['name']:<{width}}  {pixels:>11}  {row['subject']:>7.3f}  {filled:>6}  "
            f"{row['brightness']:>10.3f}  {row['exposure']:>8.2f}"
        )
    if check.box is not None:
        length = 1e-2 * float((check.box[1] - check.box[0]).max())
        low, high = (" ".join(in_words(x, length) for x in corner.tolist()) for corner in check.box)
        print(f"box: {low} to {high}")
    if check.agreement is not None:
        print(f"the hull fills {check.agreement.mean:.4f} of the silhouettes")
    for note in check.notes:
        print(f"note: {note}")
    for finding in check.findings:
        print(f"finding: {finding}")
    if not check.findings:
        print("sound")


def _rows(check: Check) -> list[dict[str, Any]]:
    capture, exposure = check.capture, check.exposure
    return [
        {
            "name": name,
            "size": capture.cameras.size[i].tolist(),
            "subject": float(capture.masks[i].mean()) if capture.masks else 0.0,
            "filled": float(check.agreement.filled[i]) if check.agreement else None,
            "brightness": float(check.brightness[i]),
            "exposure": float(exposure[i]),
        }
        for i, name in enumerate(capture.names)
    ]


def write(check: Check, out: Path) -> None:
    """Write check.json, check.png and, where there is one, hull.ply."""
    box = None if check.box is None else [corner.tolist() for corner in check.box]
    content = {"sound": not check.findings, "findings": check.findings, "notes": check.notes, "box": box}
    if check.hull is not None:
        report.write_mesh(out / "hull.ply", check.hull)
    _draw(check, out / "check.png")
    report.write_json(out / "check.json", {**content, "cameras": _rows(check)})


def _draw(check: Check, path: Path) -> None:
    """Cameras, box and hull in space; what is filled and how bright it is, per camera."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure = plt.figure(figsize=(14, 8), layout="constrained")
    grid = figure.add_gridspec(2, 2, width_ratios=(3, 2))
    space: Any = figure.add_subplot(grid[:, 0], projection="3d")
    centers = check.capture.cameras.centers
    middle = centers.mean(dim=0) if check.box is None else (check.box[0] + check.box[1]) / 2
    length = AXES * float((centers - middle).norm(dim=1).median())
    for i, name in enumerate(check.capture.names):
        for line in _frustum(check.capture, i, 2 * length):
            space.plot(*line.T, color="tab:blue", linewidth=0.6)
        space.text(*centers[i].tolist(), name, fontsize=5)
    if check.box is not None:
        corners = torch.cartesian_prod(*torch.stack(check.box, dim=1)).numpy()
        for a in range(8):
            for bit in (1, 2, 4):
                if not a & bit:
                    space.plot(*corners[[a, a | bit]].T, color="tab:red", linewidth=0.8)
    if check.hull is not None and len(check.hull.faces):
        points = check.hull.vertices[:: max(1, len(check.hull.vertices) // 6000)]
        space.scatter(*points.T, s=0.6, color="0.35")
    space.set_aspect("equal")
    space.set_title("cameras, box and visual hull")
    names, place = check.capture.names, np.arange(len(check.capture))
    filled = check.agreement.filled.tolist() if check.agreement else [0.0] * len(names)
    charts = {"silhouette filled by the hull": filled, "relative brightness": check.exposure.tolist()}
    for row, (title, values) in enumerate(charts.items()):
        axes = figure.add_subplot(grid[row, 1])
        axes.bar(place, values, color="tab:blue")
        axes.set_title(title)
        axes.axhline(FILLED if row == 0 else 1.0, color="tab:red", linewidth=0.8)
        axes.set_xticks(place, names, rotation=90, fontsize=5)
    with atomic_write(path) as partial:
        figure.savefig(partial, dpi=110)
    plt.close(figure)


def _frustum(capture: Capture, i: int, depth: float) -> list[np.ndarray]:
    """Lines [P,3] that draw camera i: its centre to the picture's corners, and the picture's border."""
    width, height = (float(s) for s in capture.cameras.size[i])
    corners = torch.tensor([[0.0, 0.0], [width, 0.0], [width, height], [0.0, height]])
    origins, directions = capture.cameras.rays(i, corners)
    ends = (origins + depth * directions).numpy()
    centre = origins[0].numpy()
    return [np.stack([centre, end]) for end in ends] + [ends[[0, 1, 2, 3, 0]]]


if __name__ == "__main__":
    sys.exit(main())
