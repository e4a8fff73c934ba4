"""Gain and bias per camera (paper, eq. 13 and 14): what brings a camera's pictures to the common exposure.

The field is seen by all cameras, so where it is opaque its colour is what they agree on. With F = sum w c the field's
own part of a ray and T its transmittance, camera i's gain g and bias b are those that minimise

    sum over rays  (P - T B - (F - b (1 - T))/g)^2                   P photograph, B plate

per channel, linear in 1/g and b/g, over rays that end in the field and pixels that are not saturated. Against the full
rendering instead of F the background would vote for the gain that it was made with. Of all solutions that one is taken
which has mean g = 1 and mean b = 0: else the field and all gains could darken together.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from kornia.enhance import denormalize
from torch import Tensor

SATURATED = 0.01  # values nearer than this to 0 or 1 are clipped, or averages of clipped ones
OPAQUE = 0.5  # a ray of less transmittance shows the field
# What is known beforehand of 1/g and b/g: 1 and 0 to within these deviations, and a ray to within its own.
GAIN_DEVIATION, BIAS_DEVIATION, RAY_DEVIATION = 0.3, 0.05, 0.05
FARTHEST = 2.0  # factor between a camera's exposure and the common one, held to


@dataclass(frozen=True)
class Exposure:
    """gain, bias: [N, 3] float32, the common exposure = gain * picture + bias."""

    gain: Tensor
    bias: Tensor

    @staticmethod
    def equal(cameras: int, device: torch.device | str = "cpu") -> Exposure:
        """All pictures as they are."""
        return Exposure(torch.ones(cameras, 3, device=device), torch.zeros(cameras, 3, device=device))

    def cpu(self) -> Exposure:
        return Exposure(self.gain.cpu(), self.bias.cpu())

    def common(self, camera: int, colors: Tensor) -> Tensor:
        """Colours [M, 3] of a camera's pictures in the common exposure."""
        return denormalize(colors, self.bias[camera], self.gain[camera])

    def own(self, camera: int, colors: Tensor, opacity: Tensor) -> Tensor:
        """The field's part of rays, colours [M, 3] with the opacities [M] behind them, in the camera's own exposure."""
        return (colors - opacity[:, None] * self.bias[camera]) / self.gain[camera]

    def spread(self) -> float:
        """The median over cameras of how far they change a colour of medium brightness."""
        return float((self.gain * 0.5 + self.bias - 0.5).abs().mean(1).median())


@dataclass(frozen=True)
class Equations:
    """Normal equations of P - T B = F/g - (b/g) (1 - T), per camera and channel: matrix [N, 3, 2, 2], right side
    [N, 3, 2]; float64.

    The photograph is explained by the field, not the field by the photograph: it is the photographs that are noisy, and
    noise in what explains flattens the slope.
    """

    matrix: Tensor
    right: Tensor

    @staticmethod
    def of(
        photograph: Tensor,
        field: Tensor,
        transmittance: Tensor | None = None,
        plate: Tensor | None = None,
        counted: Tensor | None = None,
    ) -> Equations:
        """The equations of one camera's rays.

        Args:
            photograph, field: [M, 3] the picture's colours P, and F. transmittance: [M]. plate: [M, 3]; without it the
                rays are those that show the subject alone, T = 0. counted: [M] bool, which rays are taken; all by default.
        """
        if (
            counted is not None and photograph.device.type == "cpu"
        ):  # elsewhere they would have to be numbered first
            photograph, field, counted = photograph[counted], field[counted], None
        through = torch.zeros_like(photograph[:, :1]) if transmittance is None else transmittance[:, None]
        behind = torch.zeros_like(photograph) if plate is None else plate
        usable = (through < OPAQUE) & (photograph > SATURATED) & (photograph < 1 - SATURATED)
        if counted is not None:
            usable &= counted[:, None]
        by = torch.stack([field, (1 - through).expand_as(field)], -1)
        by = (by * usable[:, :, None]).double()
        matrix = torch.einsum("mci,mcj->cij", by, by)
        seen = (photograph - through * behind).double() * usable
        right = torch.einsum("mci,mc->ci", by, seen)
        return Equations(matrix[None], right[None])

    @staticmethod
    def joined(cameras: list[Equations]) -> Equations:
        parts = ([getattr(e, name) for e in cameras] for name in ("matrix", "right"))
        return Equations(*(torch.cat(part) for part in parts))

    def solve(self, per_channel: bool = True, gauge: bool = True) -> Exposure:
        """The least-squares gains and biases.

        Args:
            per_channel: a gain and bias for each channel; else the three channels share them.
            gauge: hold the means over the cameras at gain 1 and bias 0; else every camera is solved on its own, for
                views that had no part in the field.
        """
        matrix, right = self.matrix.clone(), self.right.clone()
        if not per_channel:
            matrix, right = matrix.sum(1, keepdim=True), right.sum(1, keepdim=True)
        # Numbers, not tensors, and no look at the result: a device would have to be waited for.
        for entry, deviation in enumerate((GAIN_DEVIATION, BIAS_DEVIATION)):
            matrix[..., entry, entry] += RAY_DEVIATION**2 / deviation**2
        right[..., 0] += RAY_DEVIATION**2 / GAIN_DEVIATION**2
        slope, offset = torch.linalg.solve_ex(matrix, right)[0].expand(-1, 3, -1).unbind(-1)
        gain = 1 / slope.clamp(1 / FARTHEST, FARTHEST)
        bias = -offset * gain
        if gauge:
            scale = 1 / gain.mean(0)
            gain, bias = scale * gain, scale * bias
            bias = bias - bias.mean(0)
        return Exposure(gain.float().contiguous(), bias.float().contiguous())
