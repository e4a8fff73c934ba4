"""Adam over the tiles of one level."""

from __future__ import annotations

import torch
from torch import Tensor

from torch_surfcap import ops
from torch_surfcap.field.field import CLAMP, ETA
from torch_surfcap.fitting.settings import Descent

# Bounds of the opacity value, the constant colour and the view-dependent coefficients.
BOUNDS = {"transparency": (ETA, 1.0), "distance": (-CLAMP, CLAMP)}


class TileAdam:
    """Adam with a rate and bounds per coefficient, on padded records [T, 4, 4, 4, P], in place."""

    def __init__(self, store: Tensor, opacity: str, descent: Descent) -> None:
        self.store = store
        self.first, self.second = torch.zeros_like(store), torch.zeros_like(store)
        self.t = 0
        count = ops.coefficients(ops.degree_of(store.shape[-1]))
        self.rate, self.low, self.high = (store.new_zeros(store.shape[-1]) for _ in range(3))
        bounds = (
            (slice(0, 1), descent.rate_opacity, BOUNDS[opacity]),
            (slice(1, 4), descent.rate_color, (0.0, 1.0)),
        )
        for part, rate, (low, high) in (*bounds, (slice(4, count), descent.rate_view, (-1.0, 1.0))):
            self.rate[part], self.low[part], self.high[part] = rate, low, high

    def step(self, gradient: Tensor, scale: float = 1.0) -> None:
        """One step with the settings' rates times ``scale``."""
        self.t += 1
        ops.adam_step(
            self.store, gradient, self.first, self.second, self.rate * scale, self.low, self.high, self.t
        )
