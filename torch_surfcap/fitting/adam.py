"""Adam over the tiles of one level, on floats or on codes."""

from __future__ import annotations

import torch
from torch import Tensor

from torch_surfcap import codes, ops
from torch_surfcap.field.field import MISSING
from torch_surfcap.fitting.settings import Descent


class TileAdam:
    """Adam with a rate and bounds per coefficient, on padded records [T, 4, 4, 4, P], in place.

    Args:
        seed, stochastic: of the rounding, where the records are codes.
    """

    def __init__(
        self, store: Tensor, opacity: str, descent: Descent, seed: int = 0, stochastic: bool = True
    ) -> None:
        self.store, self.seed, self.stochastic = store, seed, stochastic
        kept = codes.MOMENTS.get(store.dtype, store.dtype)
        self.first, self.second = (torch.zeros_like(store, dtype=kept) for _ in range(2))
        self.t = 0
        count = ops.coefficients(ops.degree_of(store.shape[-1]))
        bounds = codes.bounds(store.shape[-1], *MISSING[opacity], device=store.device)
        self.low, self.high = (bound.to(codes.real(store.dtype)) for bound in bounds)
        self.rate = torch.zeros_like(self.low)
        self.rate[0], self.rate[1:4], self.rate[4:count] = (
            descent.rate_opacity,
            descent.rate_color,
            descent.rate_view,
        )

    def step(self, gradient: Tensor, scale: float = 1.0) -> None:
        """One step with the settings' rates times ``scale``."""
        self.t += 1
        moments, bounds = (self.first, self.second), (self.rate * scale, self.low, self.high)
        ops.adam_step(
            self.store, gradient, *moments, *bounds, self.t, seed=self.seed, stochastic=self.stochastic
        )
