"""The reference of the z-buffer."""

from __future__ import annotations

import torch
from torch import Tensor


def rasterize(corners: Tensor, faces: Tensor, height: int, width: int) -> Tensor:
    """See `ops.rasterize`: every face on every pixel, in the order of the faces."""
    y, x = torch.meshgrid(
        torch.arange(height, dtype=corners.dtype) + 0.5,
        torch.arange(width, dtype=corners.dtype) + 0.5,
        indexing="ij",
    )
    nearest = torch.zeros(height, width, dtype=torch.float32)
    seen = torch.full((height, width), -1, dtype=torch.int32)
    for number, (a, b, c) in enumerate(corners[faces.long()]):
        if min(a[2], b[2], c[2]) <= 0:
            continue

        def twice(p: Tensor, q: Tensor) -> Tensor:
            return (q[0] - p[0]) * (y - p[1]) - (q[1] - p[1]) * (x - p[0])

        weights = torch.stack([twice(b, c), twice(c, a), twice(a, b)])
        area = weights.sum(0)
        share = weights / area
        nearness = (share / torch.stack([a[2], b[2], c[2]])[:, None, None]).sum(0).float()
        closer = (share >= 0).all(0) & (nearness > nearest)
        nearest, seen = torch.where(closer, nearness, nearest), torch.where(closer, number, seen)
    return seen
