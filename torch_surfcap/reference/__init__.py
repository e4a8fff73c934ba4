"""The operators of torch_surfcap in plain torch: slow, readable, kept as the oracle of the compiled ones.

Same names, arguments and results as in `torch_surfcap.ops`. Everything that is differentiable in the
mathematics is differentiable here by autograd, which is how the hand-written backward operators are checked.
Rays are marched on a dense lattice that spans the whole table, so keep their number and the table small.

Store: `voxels` [T,4,4,4,P] as [tile, x, y, z, coefficient], P = 4, 16, 32 for SH degree 0, 1, 2; `table`
[X,Y,Z] int32 with a tile's index, INSIDE, or OUTSIDE and below; `frame` = [ox, oy, oz, voxel size, outside
value, inside value].
"""

from .codes import decoded
from .raster import rasterize
from .rays import (
    BASIS_OF_PITCH,
    DISTANCE,
    TRANSPARENCY,
    harmonics,
    integration_ranges,
    march,
    march_backward,
    march_forward,
    photometric_step,
    shade_backward,
    shade_forward,
    visibility,
)
from .slots import coded, gather_gradient, photometric_lattice
from .store import (
    INSIDE,
    OUTSIDE,
    TILE,
    corners,
    dense,
    nonempty_cells,
    sample_backward,
    sample_forward,
    upscale,
)
from .voxels import adam_step, huber_norm, soft_hull, voxel_terms

__all__ = [
    "BASIS_OF_PITCH",
    "DISTANCE",
    "INSIDE",
    "OUTSIDE",
    "TILE",
    "TRANSPARENCY",
    "adam_step",
    "coded",
    "corners",
    "decoded",
    "dense",
    "gather_gradient",
    "harmonics",
    "huber_norm",
    "integration_ranges",
    "march",
    "march_backward",
    "march_forward",
    "nonempty_cells",
    "photometric_lattice",
    "photometric_step",
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
