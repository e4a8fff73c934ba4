"""Cameras that contradict the others: wrongly calibrated, of another moment, dead.

One such camera carves the visual hull away, and pulls at every colour. Two looks find it. Before the fit, its silhouette
excludes space on which all others agree. After a level, its photograph is far from what the field shows, where those of
the others are near.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torch_surfcap.data.capture import Capture
from torch_surfcap.field.hull import Silhouettes, first_guess
from torch_surfcap.fitting.rays import RayBatch

FEWEST = 5  # cameras: among fewer, nobody can say who is wrong
FEW = 8  # silhouettes: of fewer, each rightly excludes much that the others leave
MOST = 0.15  # share of the cameras that may be wrong
CELLS = 40  # points along the side of the cube that silhouettes are compared in
CARVED = 0.15  # share of what the others leave that a wrong silhouette takes away ...
OFTEN = 5.0  # ... and how many times as much as the median camera
FAR = 4.0  # times the median difference between photograph and rendering
DIFFERENCE = 0.02  # of colours: under this a photograph is right whatever the others do


def by_silhouettes(capture: Capture) -> dict[int, str]:
    """Number -> why, of the cameras whose silhouettes alone exclude much of what all others leave."""
    assert capture.masks is not None
    count = len(capture)
    most = max(1, int(MOST * count))
    if count < FEW:
        return {}
    center, radius = first_guess(capture)
    steps = (torch.arange(CELLS, dtype=torch.float64) + 0.5) / CELLS * 2 - 1
    points = center + radius * torch.stack(torch.meshgrid(steps, steps, steps, indexing="ij"), -1).view(-1, 3)
    excluded = torch.zeros(count, len(points), dtype=torch.bool)
    seen = torch.zeros(len(points), dtype=torch.int32)
    for i, mask in enumerate(capture.masks):
        value, votes = Silhouettes.of_masks([mask], capture.cameras.subset([i])).ask(points)
        excluded[i] = (value <= 0.5) & (votes > 0)
        seen += votes
    against = excluded.sum(0)
    # Where nobody objects is the hull; where some do, but no more than may be wrong, it might be. They share the blame:
    # cameras that look in from where few others do agree with one another.
    looked_at = seen >= 0.5 * seen.max()
    hull = int((looked_at & (against == 0)).sum())
    doubtful = looked_at & (against > 0) & (against <= most)
    carved = (excluded[:, doubtful] / against[doubtful].float()).sum(1)
    usual = max(float(carved.median()), 1.0)
    return {
        i: f"its silhouette excludes {share:.0%} of what the others leave of the subject (wrong calibration or moment?)"
        for i, alone in enumerate(carved.tolist())
        if alone > OFTEN * usual and (share := alone / (alone + hull)) > CARVED
    }


def differences(rays: RayBatch, color: Tensor) -> Tensor:
    """[N] mean absolute difference between renderings [R, 3] and photographs of each camera, within its silhouette; NaN
    for a camera without such rays."""
    within = (rays.mask > 0.5).to(color.dtype)
    off = (color - rays.target).abs().mean(1) * within
    sums = [(off[part].sum(), within[part].sum()) for part in map(rays.of_camera, range(len(rays.cameras)))]
    return torch.stack([total / count for total, count in sums])


def by_photographs(difference: Tensor, gone: int = 0) -> dict[int, str]:
    """Number -> why, of the cameras whose ``differences`` [N] are far above the others'. gone: cameras left out before."""
    known = difference[difference.isfinite()]
    if len(known) < FEWEST:
        return {}
    usual = float(known.median())
    far = [
        i for i, value in enumerate(difference.tolist()) if value > max(FAR * usual, DIFFERENCE)
    ]  # (NaN is not)
    if gone + len(far) > max(1, int(MOST * (gone + len(known)))):
        return {}  # so many cannot all be wrong: the scene is hard for some
    return {
        i: f"its photograph differs by {float(difference[i]):.3f} from what the others show, them by {usual:.3f} (wrong "
        "moment or calibration, a dead frame?)"
        for i in far
    }
