"""What anybody can have on a CPU without this program's kernels, run and written like a fit by train/fit.py.

    python -m train.rivals --method hull data.path=CAPTURE out=OUT [key=value ...]
    python -m train.rivals --method autograd --seconds 60 data.path=CAPTURE out=OUT [key=value ...]

`hull` is the soft hull of the silhouettes on the finest voxels, meshed and smoothed as a fit is, without colours: of its
scores those of pictures mean nothing. `autograd` is the same fit with the step written in torch operators, float32: the
samples of the same integration ranges, packed, and their gradient by autograd; voxel terms on the dense grid; Adam. Box,
hull, integration ranges, change of level and extraction are this program's, to the rival's advantage. When its seconds
since the start of the process are spent, the levels that are left are passed without an iteration.

Exit 0 when the results are written, 2 for bad input.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from itertools import pairwise
from typing import Any, NamedTuple
from unittest import mock

import psutil
import torch
from torch import Tensor
from torch.nn.functional import softplus

from torch_surfcap import config as settings
from torch_surfcap import ops, reference
from torch_surfcap.data.capture import Capture
from torch_surfcap.data.checks import prepare
from torch_surfcap.errors import InputError
from torch_surfcap.field.field import CLAMP, SurfaceField
from torch_surfcap.field.hull import Silhouettes
from torch_surfcap.field.tiles import TileGrid
from torch_surfcap.fitting.fit import FitResult, fit
from torch_surfcap.fitting.late import Stopwatch
from torch_surfcap.fitting.levels import plan_levels, subject_box
from torch_surfcap.fitting.plateau import Plateau
from torch_surfcap.fitting.settings import FitSettings
from torch_surfcap.reference.rays import shaded
from torch_surfcap.reference.store import corners, dense_index
from train import fit as command

SAMPLES = 1 << 18  # with a graph at a time, so that memory does not grow with the pictures
MARGIN = 2  # voxels around the subject's box


class Samples(NamedTuple):
    """Samples [N] of some rays one after the other: ray, distance t, and whether each opens a stretch of its ray."""

    ray: Tensor
    t: Tensor
    opens: Tensor


def packed(ranges: tuple[Tensor, Tensor], shift: Tensor, step: float) -> Samples:
    """The lattices (k + 1/2 + shift) step of rays within their integration ranges (``ops.integration_ranges``)."""
    offsets, stretches = ranges
    owner = torch.arange(len(shift)).repeat_interleave(offsets.diff())
    first, last = (torch.ceil(stretches / step - 0.5 - shift[owner, None])).long().unbind(1)
    count = (last - first).clamp(min=0)
    begins = count.cumsum(0) - count
    ray = owner.repeat_interleave(count)
    k = torch.arange(len(ray)) + (first - begins).repeat_interleave(count)
    opens = torch.zeros(len(ray), dtype=torch.bool)
    opens[begins[count > 0]] = True
    return Samples(ray, (k + 0.5 + shift[ray]) * step, opens)


def photometric_step(
    voxels: Tensor,
    table: Tensor,
    frame: Sequence[float],
    origins: Tensor,
    directions: Tensor,
    shift: Tensor,
    background: Tensor,
    target: Tensor,
    mask: Tensor,
    weight: Tensor,
    opacity: int,
    slope: float,
    step: float,
    stop: float,
    huber: float,
    weights: Sequence[float],
    ranges: tuple[Tensor, Tensor],
    detach_sample: bool = False,
    rendered_sample: bool = False,
    **unused: Any,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """``ops.photometric_step`` in torch operators and autograd, on the samples within ``ranges`` alone."""
    leaf = voxels.detach().requires_grad_()
    rows = _rows(table, len(voxels))
    losses, found = torch.zeros(3, dtype=torch.float64), []
    for part in _parts(ranges, step):
        offsets = ranges[0][part.start : part.stop + 1]
        own = (offsets - offsets[0], ranges[1][offsets[0] : offsets[-1]])
        samples = packed(own, shift[part], step)
        seen: list[Any] = [x[part] for x in (origins, directions, background, target, mask, weight)]
        how: list[Any] = [opacity, slope, stop, huber, detach_sample, rendered_sample]
        value, color, left, depth = _losses(leaf, rows, frame, samples, *seen, *how)
        total = (value * value.new_tensor(weights)).sum()
        if total.requires_grad:
            total.backward()  # type: ignore[no-untyped-call]
        losses += value.detach().double()
        found.append((color.detach(), left.detach(), depth.detach()))
    gradient = torch.zeros_like(voxels) if leaf.grad is None else leaf.grad
    color, left, depth = (torch.cat(column) for column in zip(*found, strict=True))
    return losses, gradient, color, left, depth


def _losses(
    leaf: Tensor,
    rows: tuple[Tensor, Tensor],
    frame: Sequence[float],
    samples: Samples,
    origins: Tensor,
    directions: Tensor,
    background: Tensor,
    target: Tensor,
    mask: Tensor,
    weight: Tensor,
    opacity: int,
    slope: float,
    stop: float,
    huber: float,
    detach: bool,
    rendered: bool,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Losses [3], colour [R,3], transmittance [R] and depth [R] of some rays."""
    ray, t, opens = samples
    read = shaded(_record(leaf, rows, frame, origins[ray] + t[:, None] * directions[ray]), directions[ray])
    value, color = read[:, 0], read[:, 1:]
    if opacity == reference.TRANSPARENCY:
        log_a = value.clamp(min=1e-12).log()
    else:
        log_e = softplus(-slope * value)
        log_a = (torch.where(opens, 0.0, log_e.roll(1)) - log_e).clamp(max=0)
        color = torch.where(opens[:, None], color, 0.5 * (color.roll(1, 0) + color))
    alive = _light(log_a.detach(), ray).exp() >= stop
    log_a = torch.where(alive, log_a, 0.0)
    before = _light(log_a, ray).exp()
    w = torch.where(alive, -torch.expm1(log_a) * before, 0.0)

    def summed(x: Tensor) -> Tensor:
        return x.new_zeros(len(mask), *x.shape[1:]).index_add(0, ray, x)

    left = summed(log_a).exp()
    seen = summed(w[:, None] * color) + left[:, None] * background
    own_target = (seen.detach() if rendered else target)[ray]
    photo = reference.huber_norm(seen - target, huber).sum(-1)
    sample = summed((w.detach() if detach else w) * reference.huber_norm(color - own_target, huber).sum(-1))
    terms = (photo, sample, (left - (1 - mask)) ** 2)
    total = summed(w.detach())
    depth = torch.where(total > 1e-6, summed(w.detach() * t) / total, math.nan)
    return torch.stack([(weight * term).sum() for term in terms]), seen, left, depth


def _light(log_a: Tensor, ray: Tensor) -> Tensor:
    """Logarithm of what is left before each sample of its ray; summed in double, since the sum runs over all rays."""
    before = log_a.double().cumsum(0) - log_a
    first = torch.searchsorted(ray, ray)  # of the same ray
    return (before - before[first]).to(log_a.dtype)


def _rows(table: Tensor, tiles: int) -> tuple[Tensor, Tensor]:
    """The table, and the row of every voxel [4X,4Y,4Z] in a list of all stored ones, one outside and one inside."""
    index = dense_index(table)
    missing = tiles * ops.TILE**3 + (table == ops.INSIDE).long()
    for axis in range(3):
        missing = missing.repeat_interleave(ops.TILE, axis)
    return table, torch.where(index >= 0, index, missing)


def _record(leaf: Tensor, rows: tuple[Tensor, Tensor], frame: Sequence[float], points: Tensor) -> Tensor:
    """Trilinear read [N,P] at points [N,3]."""
    table, row = rows
    missing = leaf.new_zeros(2, leaf.shape[-1])
    missing[0, 0], missing[1, 0] = frame[4], frame[5]
    index, weight, _ = corners(points, table, frame)
    return (
        torch.cat([leaf.view(-1, leaf.shape[-1]), missing])[row[index.unbind(-1)]] * weight[..., None]
    ).sum(-2)


def _parts(ranges: tuple[Tensor, Tensor], step: float) -> Iterator[slice]:
    """Consecutive rays with about SAMPLES samples."""
    offsets, stretches = ranges
    length = torch.cat([stretches.new_zeros(1), (stretches[:, 1] - stretches[:, 0]).cumsum(0)])[offsets]
    part = (length[:-1] / step / SAMPLES).long()
    bounds = [0, *(part.diff().nonzero()[:, 0] + 1).tolist(), len(part)]
    for begin, end in pairwise(bounds):
        yield slice(begin, end)


@contextmanager
def plain_torch(until: float = math.inf) -> Iterator[None]:
    """Steps of a fit are taken in torch operators; none but a level's first begins later than ``until``, by
    ``time.time()``."""
    over = property(
        lambda rule: (time.time() >= until and rule.count > 0) or rule.drops <= 0 or rule.count >= rule.limit
    )
    steps: dict[str, Any] = {
        "photometric_step": photometric_step,
        "voxel_terms": reference.voxel_terms,
        "adam_step": reference.adam_step,
    }
    with mock.patch.multiple(ops, **steps), mock.patch.object(Plateau, "ended", over):
        yield


def autograd(until: float, *arguments: Any, **given: Any) -> FitResult:
    """A fit of which no step begins later than ``until``, but for each level's first."""
    with plain_torch(until):
        return fit(*arguments, **given)


def hull(capture: Capture, *_: Any, **given: Any) -> FitResult:
    """The soft hull on the finest voxels of a fit with these settings; grey."""
    seconds: dict[str, Any] = {}
    watch = Stopwatch(seconds)
    s = FitSettings.of(**given)
    capture = prepare(capture)
    low, high = subject_box(capture, s.box)
    voxel = plan_levels(capture, (low, high), s.voxel, s.levels, s.voxel_pixels)[-1].voxel_size
    watch.lap("box")
    corner = low - MARGIN * voxel
    size = [int(n) for n in torch.ceil((high - low + 2 * MARGIN * voxel) / (ops.TILE * voxel))]
    axes = [corner[a] + (torch.arange(n * ops.TILE) + 0.5).double() * voxel for a, n in enumerate(size)]
    silhouettes = Silhouettes.of(capture)
    slabs = (torch.stack(torch.meshgrid(x, *axes[1:], indexing="ij"), -1) for x in axes[0].split(ops.TILE))
    value = CLAMP * (1 - 2 * torch.cat([silhouettes.hull(slab) for slab in slabs]))
    x, y, z = size
    tiles = value.reshape(x, 4, y, 4, z, 4).permute(0, 2, 4, 1, 3, 5).flatten(3)
    deep, empty = (tiles <= -CLAMP).all(-1), (tiles >= CLAMP).all(-1)
    grid = TileGrid.build(~deep & ~empty, deep, (float(corner[0]), float(corner[1]), float(corner[2])), voxel)
    store = torch.zeros(len(grid.coords), 4, 4, 4, ops.pitch(0))
    store[..., 0] = tiles[grid.coords.long().unbind(1)].view(-1, 4, 4, 4)
    store[..., 1:4] = 0.5
    field = SurfaceField(store, grid, "distance", s.descent.step_of(True))
    watch.lap("hull")
    mesh = field.extract_mesh(0.0, s.smooth, s.specks)
    watch.lap("mesh")
    if len(mesh.faces) == 0:
        raise InputError("silhouettes: the visual hull is empty inside the box, expected a subject there")
    seconds["levels"] = []
    chosen = {"voxel": {"value": voxel}, "levels": {"value": 1}, "gains": {"value": "off"}}
    equal = torch.ones(len(capture), 3)
    return FitResult(field, mesh, [{"samples": 0.0}], equal, equal - 1, chosen, seconds)


def main(arguments: Sequence[str] | None = None, began: float | None = None) -> int:
    """Run the command; returns its exit status. began: when, by ``time.time()``."""
    began = time.time() if began is None else began
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--method", choices=("hull", "autograd"), required=True)
    parser.add_argument(
        "--seconds", type=float, default=math.inf, help="after which no step but a level's first begins"
    )
    parser.add_argument("settings", nargs="*", metavar="key=value", help="as of train/fit.py")
    options = parser.parse_intermixed_args(arguments)
    try:
        config = settings.resolved(settings.load(None, [*options.settings, "device=cpu"]))
        plain = config.gradient == "scatter" and config.storage == 32 and config.descent.visit == "ranges"
        if not plain or config.descent.bundle != 1:
            raise InputError("--method: expected gradient=scatter, storage=32 and ranges of single rays")
        method = hull if options.method == "hull" else partial(autograd, began + options.seconds)
        command.run(config, time.time() - began, method)
    except InputError as error:
        print(error, file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main(began=psutil.Process().create_time()))
