"""The raw operators ``torch.ops.torch_surfcap.*``: what each computes, its shapes, and its shape function.

Every op exists once in ``csrc/core`` (mathematics), ``csrc/drivers`` (from tensors to plain views), ``csrc/cpu`` and
``csrc/cuda`` (the loops), :mod:`torch_surfcap.reference` (oracle) and ``tests/ops``, under the same name. Gradients are of
:mod:`torch_surfcap.autograd`; nothing here is differentiable. All tensors of a call are on one device; what they hold is
checked on the CPU only, where that needs no waiting.

The field arguments, the same for every op:

* ``voxels [T, 4, 4, 4, P]``: a record of P = 4, 16, 32 numbers (SH degree 0, 1, 2) per voxel of a tile [x, y, z]:
  the opacity value, then ``beta[lm, rgb]``, then zero padding.
* ``table [X, Y, Z]`` int32: tile index, ``INSIDE``, or ``OUTSIDE - d``, which promises that every cell nearer than d
  cells is empty as well. (Cell t is empty if the 8 tiles t .. t + 1 are outside.) The outermost tiles are outside.
* ``frame``: [x, y, z of the table's low corner, voxel size, opacity value outside, opacity value inside].

A fit's iteration (``photometric_step``, ``integration_ranges``, ``visibility``, ``voxel_terms``, ``adam_step``) also takes
``voxels`` in uint8 or uint16, see :mod:`torch_surfcap.codes`, with everything else in float32 but for what is said below.

The ray arguments: ``origins, directions [R, 3]`` (unit), ``shift [R]`` of the lattice t_k = (k + 1/2 + shift) * step in
steps, ``background [R, 3]``, ``opacity`` 0 (the value is a transparency) or 1 (a signed distance in voxels with logistic
``slope``), ``step`` in world units, ``stop``: a ray ends once its transmittance is lower (0: never).

``groups`` is the number of partial gradients that are summed in a fixed order: results depend on it in the last bits,
and never on the number of threads.
"""

from __future__ import annotations

import torch_surfcap._C  # (loads the library, which registers the ops)
import torch_surfcap.shapes  # noqa: F401  (registers what they return)

from .iteration import adam_step, gather_gradient, photometric_lattice, photometric_step, voxel_terms
from .rays import integration_ranges, march_backward, march_forward, visibility
from .reading import (
    rasterize,
    sample_backward,
    sample_forward,
    shade_backward,
    shade_forward,
    soft_hull,
    upscale,
)
from .records import (
    GROUPS,
    HALF_SCALE,
    INSIDE,
    OPACITY,
    OUTSIDE,
    TILE,
    coefficients,
    degree_of,
    padded,
    pitch,
)

__all__ = [
    "GROUPS",
    "HALF_SCALE",
    "INSIDE",
    "OPACITY",
    "OUTSIDE",
    "TILE",
    "adam_step",
    "coefficients",
    "degree_of",
    "gather_gradient",
    "integration_ranges",
    "march_backward",
    "march_forward",
    "padded",
    "photometric_lattice",
    "photometric_step",
    "pitch",
    "rasterize",
    "sample_backward",
    "sample_forward",
    "shade_backward",
    "shade_forward",
    "soft_hull",
    "upscale",
    "visibility",
    "voxel_terms",
]
