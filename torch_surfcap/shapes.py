"""Shape functions of the ops, so that torch.compile and opcheck know what they return."""
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

import torch

import torch_surfcap._C  # noqa: F401  (loads the library, which registers the ops)

fake = torch.library.register_fake


def _rendering(origins):
    """Colour, transmittance and depth of rays."""
    rays = origins.shape[0]
    return origins.new_empty(rays, 3), origins.new_empty(rays), origins.new_empty(rays)


@fake("torch_surfcap::sample_forward")
def _(voxels, table, frame, points):
    return voxels.new_empty(points.shape[0], voxels.shape[-1])


@fake("torch_surfcap::sample_backward")
def _(grad_values, voxels, table, frame, points, groups):
    return voxels.new_empty(voxels.shape)


@fake("torch_surfcap::shade_forward")
def _(voxels, table, frame, points, directions):
    return voxels.new_empty(points.shape[0], 4)


@fake("torch_surfcap::shade_backward")
def _(grad_values, voxels, *rest):
    return voxels.new_empty(voxels.shape)


@fake("torch_surfcap::march_forward")
def _(voxels, table, frame, origins, *rest):
    return _rendering(origins)


@fake("torch_surfcap::march_backward")
def _(grad_color, grad_transmittance, grad_depth, voxels, *rest):
    return voxels.new_empty(voxels.shape)


@fake("torch_surfcap::photometric_step")
def _(voxels, table, frame, origins, *rest):
    return origins.new_empty(3, dtype=torch.float64), *_rendering(origins)


@fake("torch_surfcap::photometric_lattice")
def _(voxels, table, frame, origins, *rest):
    return origins.new_empty(3, dtype=torch.float64), *_rendering(origins)


@fake("torch_surfcap::gather_gradient")
def _(*arguments):
    return None


@fake("torch_surfcap::integration_ranges")
def _(voxels, table, frame, origins, *rest):
    count = torch.library.get_ctx().new_dynamic_size()
    return origins.new_empty(origins.shape[0] + 1, dtype=torch.int64), origins.new_empty(count, 2)


@fake("torch_surfcap::visibility")
def _(voxels, table, frame, origins, *rest):
    return origins.new_empty(*voxels.shape[:4], 2)


@fake("torch_surfcap::voxel_terms")
def _(voxels, *rest):
    return voxels.new_empty(5, dtype=torch.float64)


@fake("torch_surfcap::adam_step")
def _(*arguments):
    return None


@fake("torch_surfcap::soft_hull")
def _(points, *rest):
    return points.new_empty(points.shape[0]), points.new_empty(points.shape[0], dtype=torch.int32)


@fake("torch_surfcap::rasterize")
def _(corners, faces, height, width):
    return corners.new_empty(height, width, dtype=torch.int32)


@fake("torch_surfcap::upscale")
def _(voxels, table, frame, fine_coordinates, fine_frame):
    return voxels.new_empty(fine_coordinates.shape[0], *voxels.shape[1:])
