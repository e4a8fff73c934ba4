"""Speed and memory of the fused photometric step against torch autograd, written as a table.

    python train/bench.py --out docs/benchmarks.md

Both do the same work in float32 on the same rays and samples: colours by trilinear interpolation and spherical
harmonics, the ray integral, the photometric, sample and mask losses, and the gradient by every voxel. The torch version
is what one writes without this library: `grid_sample` on the dense volume, `cumprod`, autograd. Results are compared
before anything is timed; the two take turns, and medians count.
"""

from __future__ import annotations

import argparse
import resource
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import grid_sample

from torch_surfcap import ops
from torch_surfcap.data.files import atomic_write
from torch_surfcap.reference import dense, harmonics, huber_norm
from torch_surfcap.studies.provenance import machine

TILES = 12  # along an edge of the cube of stored tiles; the table has one more tile on each side
EDGE = 4 * TILES  # voxels, each one unit of length
HUBER, WEIGHTS = 0.1, [1.0, 1.0, 0.1]
STEP = 3.0**0.5
MARCH: list[Any] = [ops.OPACITY["transparency"], 0.0, STEP, 0.0]  # no early stop: both visit every sample
DEGREES = (0, 1, 2)
Result = tuple[Tensor, Tensor]  # losses [3], gradient [T,4,4,4,P] or, of the dense volume, [C,X,Y,Z]


class Scene(NamedTuple):
    voxels: Tensor
    table: Tensor
    frame: list[float]
    rays: tuple[Tensor, Tensor, Tensor, Tensor]  # origins, directions, shift, background
    seen: tuple[Tensor, Tensor, Tensor]  # target, mask, weight
    gradients: Tensor  # memory of the partial gradients, which a fit keeps from step to step

    def field_and_rays(self) -> list[Any]:
        """What the arguments of the ops begin with."""
        return [self.voxels, self.table, self.frame, *self.rays]


def morton(place: Tensor) -> Tensor:
    """Position [N] of tiles [N,3] on the Z-order curve, the order in which a field stores them."""
    bit = torch.arange(8)
    bits = (place[:, None, :] >> bit[:, None]) & 1  # [N, bit, axis]
    return (bits.flip(-1) << (3 * bit[:, None] + torch.arange(3))).sum((1, 2))


def blocks(pixels: Tensor) -> Tensor:
    """Pixels [H,W,C], H and W multiples of 8, block of 8 x 8 by block as a fit takes them: [H W, C]."""
    height, width, channels = pixels.shape
    return pixels.view(height // 8, 8, width // 8, 8, channels).transpose(1, 2).reshape(-1, channels)


def make_scene(degree: int, pixels: int, cameras: int) -> Scene:
    """A cube full of tiles, almost transparent, and cameras that see its faces; each ray crosses it face to face."""
    g = torch.Generator().manual_seed(0)
    count = ops.coefficients(degree)
    voxels = torch.zeros(TILES**3, 4, 4, 4, ops.pitch(degree))
    voxels[..., 0] = 0.9 + 0.1 * torch.rand(voxels.shape[:4], generator=g)
    voxels[..., 1:count] = torch.rand((*voxels.shape[:4], count - 1), generator=g)
    table = torch.full((TILES + 2,) * 3, ops.OUTSIDE, dtype=torch.int32)
    place = torch.cartesian_prod(*[torch.arange(TILES)] * 3)
    table[(place + 1).unbind(-1)] = morton(place).argsort().argsort().int()
    frame = [-4.0 - EDGE / 2] * 3 + [1.0, 1.0, 0.0]

    line = torch.linspace(-0.36, 0.36, pixels) * EDGE
    face = blocks(torch.stack(torch.meshgrid(line, line, indexing="ij"), -1))
    origins, targets = [], []
    for i in range(cameras):
        axis, side = i % 3, 1.0 if i % 2 else -1.0
        eye = torch.randn(3, generator=g) * 2
        eye[axis] = side * 4.0 * EDGE
        on_face = torch.zeros(len(face), 3)
        on_face[:, [a for a in range(3) if a != axis]] = face
        on_face[:, axis] = side * EDGE / 2
        origins.append(eye.expand_as(on_face))
        targets.append(on_face)
    start, toward = torch.cat(origins), torch.cat(targets)
    rays = len(start)
    uniform = (
        torch.rand(rays, 3, generator=g),
        torch.rand(rays, 3, generator=g),
        torch.rand(rays, generator=g),
    )
    directions = torch.nn.functional.normalize(toward - start, dim=-1)
    return Scene(
        voxels,
        table,
        frame,
        (start, directions, torch.zeros(rays), uniform[0]),
        (uniform[1], uniform[2], torch.ones(rays)),
        voxels.new_empty(ops.GROUPS, *voxels.shape),
    )


def fused_forward(scene: Scene) -> Tensor:
    return ops.march_forward(*scene.field_and_rays(), *MARCH)[0]


def fused_step(scene: Scene) -> Result:
    """This library's step."""
    terms: list[Any] = [HUBER, WEIGHTS, False, ops.GROUPS, None, scene.gradients]
    arguments = [*scene.field_and_rays(), *scene.seen, *MARCH, *terms]
    losses, gradient, *_ = ops.photometric_step(*arguments)
    return losses, gradient


class TorchStep:
    """The same step in torch operators and autograd."""

    def __init__(self, scene: Scene, degree: int) -> None:
        self.origins, self.directions, _, self.background = scene.rays
        self.target, self.mask, self.weight = scene.seen
        self.low, self.high = scene.frame[0], scene.frame[0] + 4.0 * (TILES + 2)
        self.basis = (degree + 1) ** 2
        volume = dense(scene.voxels, scene.table, scene.frame)[..., : 1 + 3 * self.basis]
        self.volume = volume.permute(3, 0, 1, 2).contiguous().requires_grad_()

    def samples(self) -> tuple[Tensor, Tensor]:
        """Positions [R,K,3] of the samples and which of them count [R,K]: those whose base voxel lies in a cell that is
        not empty, u = x - low - 1/2 between 0 and 4 TILES + 4."""
        near, far = ((x - self.origins) / self.directions for x in (self.low + 0.5, self.high - 3.5))
        enter, leave = torch.minimum(near, far).amax(-1), torch.maximum(near, far).amin(-1)
        first = torch.ceil(enter / STEP - 0.5)
        count = torch.ceil(leave / STEP - 0.5) - first
        k = torch.arange(int(count.max()))
        t = (first[:, None] + k + 0.5) * STEP
        return self.origins[:, None] + t[..., None] * self.directions[:, None], k < count[:, None]

    def render(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Colours, transmittances, and colour and weight of each sample."""
        position, inside = self.samples()
        grid = ((position - self.low) / (self.high - self.low) * 2 - 1).flip(
            -1
        )  # z, y, x of the volume [C,X,Y,Z]
        read = grid_sample(self.volume[None], grid[None, None], align_corners=False)[0, :, 0]  # [C,R,K]
        a = torch.where(inside, read[0], 1.0)
        coefficients = read[1:].unflatten(0, (self.basis, 3))
        color = torch.einsum("rl,lcrk->rkc", harmonics(self.directions, self.basis), coefficients)
        before = torch.cumprod(torch.cat([torch.ones_like(a[:, :1]), a], 1), 1)
        weight, left = (1 - a) * before[:, :-1], before[:, -1]
        return (weight[..., None] * color).sum(1) + left[:, None] * self.background, left, color, weight

    def forward(self) -> Tensor:
        with torch.no_grad():
            return self.render()[0]

    def step(self) -> Result:
        rendered, left, color, w = self.render()
        photo = huber_norm(rendered - self.target, HUBER).sum(-1)
        sample = (w * huber_norm(color - self.target[:, None], HUBER).sum(-1)).sum(1)
        mask = (left - 1 + self.mask) ** 2
        losses = torch.stack([(self.weight * term).sum() for term in (photo, sample, mask)])
        (gradient,) = torch.autograd.grad(losses @ losses.new_tensor(WEIGHTS), self.volume)
        return losses.detach(), gradient


def agree(scene: Scene, rival: TorchStep) -> None:
    """Raise RuntimeError unless both give the same losses and the same gradient."""
    losses, gradient = fused_step(scene)
    expected_losses, volume = rival.step()
    mine = dense(gradient, scene.table, [*scene.frame[:4], 0.0, 0.0])[..., : len(volume)].permute(3, 0, 1, 2)
    stored = (slice(None), *[slice(4, -4)] * 3)
    error = float((mine - volume)[stored].norm() / volume[stored].norm())
    off = float(((losses - expected_losses) / expected_losses).abs().max())
    if error > 1e-3 or off > 1e-4:
        raise RuntimeError(f"results differ: gradient by {error:.1e}, losses by {off:.1e}; nothing was timed")


def medians(calls: dict[str, Callable[[], object]], rounds: int) -> dict[str, float]:
    """Median seconds of each call; the calls take turns, after one round that does not count."""
    times: dict[str, list[float]] = {name: [] for name in calls}
    for i in range(rounds + 1):
        for name, call in calls.items():
            begin = time.perf_counter()
            call()
            if i > 0:
                times[name].append(time.perf_counter() - begin)
    return {name: statistics.median(seconds) for name, seconds in times.items()}


def speed_rows(pixels: int, cameras: int, rounds: int) -> list[str]:
    rows = []
    for degree in DEGREES:
        scene = make_scene(degree, pixels, cameras)
        rival = TorchStep(scene, degree)
        agree(scene, rival)
        samples = int(rival.samples()[1].sum())
        for threads in (1, 2):
            torch.set_num_threads(threads)
            seconds = medians(
                {
                    "forward": partial(fused_forward, scene),
                    "step": partial(fused_step, scene),
                    "torch forward": rival.forward,
                    "torch step": rival.step,
                },
                rounds,
            )
            ns = {name: 1e9 * value / samples for name, value in seconds.items()}
            ratios = ns["torch forward"] / ns["forward"], ns["torch step"] / ns["step"]
            rows.append(
                f"| {degree} | {threads} | {ns['forward']:.1f} | {ns['step']:.1f} | {ns['torch forward']:.0f} "
                f"| {ns['torch step']:.0f} | {ratios[0]:.0f}x | {ratios[1]:.0f}x |"
            )
            print(rows[-1], flush=True)
    return rows


def memory_rows(arguments: argparse.Namespace) -> list[str]:
    """Peak memory of one step above that of a process that only prepares the rays and the field."""
    rows = []
    for degree in DEGREES:
        peaks = {}
        for what in ("nothing", "fused", "torch"):
            command = [sys.executable, __file__, "--peak", what, "--degree", str(degree)]
            command += ["--pixels", str(arguments.pixels), "--cameras", str(arguments.cameras)]
            peaks[what] = int(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
        ours, theirs = ((peaks[what] - peaks["nothing"]) / 1024 for what in ("fused", "torch"))
        rows.append(f"| {degree} | {ours:.0f} | {theirs:.0f} | {ours / theirs:.3f} |")
        print(rows[-1], flush=True)
    return rows


def print_peak(arguments: argparse.Namespace) -> None:
    torch.set_num_threads(2)
    scene = make_scene(arguments.degree, arguments.pixels, arguments.cameras)
    if arguments.peak == "fused":
        fused_step(scene)
    elif arguments.peak == "torch":
        TorchStep(scene, arguments.degree).step()
    print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)  # KiB


PAGE = """# Benchmarks

Written by `make bench` (`python train/bench.py --out docs/benchmarks.md`), which checks that both sides agree on losses
and gradient before it times them. On {machine};
float32; {rays} rays through a cube of {edge}³ voxels, about {samples} samples each, one full batch. "Step" is value and
gradient of the photometric, sample and mask losses by every voxel; "torch" is the same with `grid_sample` on the dense
volume and autograd, on the same samples and threads. The calls take turns; medians of {rounds} rounds.

## Nanoseconds per sample

| SH degree | threads | forward | step | torch forward | torch step | ratio forward | ratio step |
|---|---|---|---|---|---|---|---|
{speed}

## Peak memory of one step, MiB

Beyond what rays and field take; each in a process of its own, two threads.

| SH degree | step | torch step | fraction |
|---|---|---|---|
{memory}
"""


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, help="markdown file to write")
    parser.add_argument("--pixels", type=int, default=48, help="along an edge of each camera's picture")
    parser.add_argument("--cameras", type=int, default=60)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--degree", type=int, default=1, help=argparse.SUPPRESS)
    parser.add_argument("--peak", choices=("nothing", "fused", "torch"), help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.peak:
        print_peak(arguments)
        return
    memory = memory_rows(arguments)  # first: on Linux a child's peak begins at its parent's size
    speed = speed_rows(arguments.pixels, arguments.cameras, arguments.rounds)
    page = PAGE.format(
        machine=machine(),
        rays=arguments.cameras * arguments.pixels**2,
        edge=EDGE,
        samples=round((EDGE + 4) / STEP),
        rounds=arguments.rounds,
        speed="\n".join(speed),
        memory="\n".join(memory),
    )
    if arguments.out:
        with atomic_write(arguments.out) as partial:
            partial.write_text(page, encoding="utf-8")


if __name__ == "__main__":
    main()
