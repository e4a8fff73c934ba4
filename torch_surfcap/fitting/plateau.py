"""When a level has converged."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from torch_surfcap.fitting.settings import Descent


@dataclass
class Plateau:
    """When to lower the rates and when to end a level.

    Each time the loss fell, over ``window`` iterations, by no more than ``gain`` of itself and no more than ``share`` of
    its way since the top (photographs leave a rest that no field explains), the rates fall by ``factor``; the last of
    ``drops`` times ends the level, as do ``limit`` iterations. The top is where the loss was highest in the first two
    windows: after a change of level Adam's first steps overshoot.

    >>> rule = Plateau(limit=100)
    >>> sum(rule.goes_on(1.0) for _ in range(100))
    11
    """

    limit: int
    gain: float = 0.02
    share: float = 0.03
    window: int = 5
    factor: float = 0.3
    drops: int = 2
    scale: float = 1.0
    count: int = 0
    top: float = -math.inf
    losses: list[float] = field(default_factory=list)

    @staticmethod
    def of(limit: int, descent: Descent) -> Plateau:
        """With the settings' patience; the share of the way since the top moves with the gain."""
        share = Plateau.share / Plateau.gain * descent.fall
        return Plateau(limit, gain=descent.fall, share=share, drops=descent.drops)

    @property
    def ended(self) -> bool:
        return self.drops <= 0 or self.count >= self.limit

    def goes_on(self, loss: float) -> bool:
        """Takes the loss of an iteration; whether another one follows."""
        self.count += 1
        if loss > self.top and self.count <= 2 * self.window:
            self.top = loss
            self.losses.clear()
        self.losses.append(loss)
        if len(self.losses) > self.window:
            least = max(0.0, min(self.gain * loss, self.share * (self.top - loss)))
            if self.losses[-1 - self.window] - loss <= least:
                self.drops -= 1
                self.scale *= self.factor
                self.losses.clear()
        return not self.ended
