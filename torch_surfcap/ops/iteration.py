"""The ops of a fit's iteration: value and gradient of the losses, and the step. See :mod:`torch_surfcap.ops`."""

from __future__ import annotations

from typing import cast

import torch
from torch import Tensor

from torch_surfcap.ops.records import GROUPS

_ops = torch.ops.torch_surfcap


def photometric_step(
    voxels: Tensor,
    table: Tensor,
    frame: list[float],
    origins: Tensor,
    directions: Tensor,
    shift: Tensor,
    background: Tensor,
    target: Tensor,
    mask: Tensor,
    weight: Tensor,
    opacity: int,
    slope: float,
    step: float,
    stop: float,
    huber: float,
    weights: list[float],
    detach_sample: bool = False,
    groups: int = GROUPS,
    ranges: tuple[Tensor, Tensor] | None = None,
    gradients: Tensor | None = None,
    rendered_sample: bool = False,
    bundle: int = 1,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Value and gradient of the ray losses in one call.

    Args:
        target: [R, 3] the photograph's colours. mask: [R], 1 = subject. weight: [R] of the ray in every loss.
        huber: where Huber's norm (x^2/2 below) turns linear.
        weights: of the photometric loss sum Huber(C - target) (eq. 8), of the sample loss
            sum_k w_k Huber(c_k - target) (eq. 10, observed colour) and of the mask loss (T - (1 - mask))^2.
        detach_sample: the sample loss's w_k carry no gradient.
        rendered_sample: samples are held against the ray's own rendered colour, taken for a constant, not the target.
        ranges: of the rays, as :func:`integration_ranges` gives them; they save the search for non-empty cells.
        bundle: consecutive rays that share a list of ranges; the last bundle may have fewer.
        gradients: [groups, T, 4, 4, 4, P], memory for the partial gradients; the first one receives the sum, which is what
            is returned. Allocated where not given. For codes they may be float16: the gradient times ``HALF_SCALE``, each
            addition rounded to the nearest.

    Returns:
        losses [3] float64, not yet times ``weights``; the gradient of ``weights . losses`` [T, 4, 4, 4, P]; colours [R, 3],
        transmittances [R] and depths [R] of the rays, as :func:`march_forward` gives them.
    """
    field, rays, seen = (
        (voxels, table, frame),
        (origins, directions, shift, background),
        (target, mask, weight),
    )
    march, loss = (opacity, slope, step, stop), (huber, weights, detach_sample, rendered_sample)
    stretches = ranges or (None, None)
    if gradients is None:
        gradients = origins.new_empty(groups, *voxels.shape)
    losses, *rendering = _ops.photometric_step(
        *field, *rays, *seen, *stretches, bundle, *march, *loss, gradients
    )
    return losses, gradients[0], *rendering


def photometric_lattice(
    voxels: Tensor,
    table: Tensor,
    frame: list[float],
    origins: Tensor,
    directions: Tensor,
    shift: Tensor,
    background: Tensor,
    target: Tensor,
    mask: Tensor,
    weight: Tensor,
    opacity: int,
    slope: float,
    step: float,
    stop: float,
    huber: float,
    weights: list[float],
    detach_sample: bool,
    starts: Tensor,
    first: Tensor,
    exponent: int,
    slots: Tensor,
    ranges: tuple[Tensor, Tensor] | None = None,
    rendered_sample: bool = False,
    bundle: int = 1,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """:func:`photometric_step` with the gradient left at the samples, for :func:`gather_gradient` to read.

    Args:
        starts: [R + 1] int64. first: [R] int32. Slot i of ray r, ``slots[starts[r] + i]``, belongs to its sample with the
            index k = first[r] + i. Samples beyond their ray's slots are left out, slots without a sample become 0.
        exponent: a slot holds 2^exponent times the gradient.
        slots: [S, 4], written in place: the gradient of ``weights . losses`` by the opacity value, r, g, b that the sample
            read from the voxels. The field's dtype, or uint8 for the 8-bit float 1-5-2 (``torch.float8_e5m2``; nearest,
            too large becomes the largest).

    Returns:
        losses [3] float64, not yet times ``weights``; colours [R, 3], transmittances [R] and depths [R] of the rays.
    """
    field, rays, seen = (
        (voxels, table, frame),
        (origins, directions, shift, background),
        (target, mask, weight),
    )
    march, loss = (opacity, slope, step, stop), (huber, weights, detach_sample, rendered_sample)
    rows, stretches = (starts, first, exponent, slots), ranges or (None, None)
    return cast(
        "tuple[Tensor, Tensor, Tensor, Tensor]",
        _ops.photometric_lattice(*field, *rays, *seen, *stretches, bundle, *march, *loss, *rows),
    )


def gather_gradient(
    voxels: Tensor,
    table: Tensor,
    frame: list[float],
    coordinates: Tensor,
    matrices: Tensor,
    centers: Tensor,
    windows: Tensor,
    window_rays: Tensor,
    shift: Tensor,
    step: float,
    starts: Tensor,
    first: Tensor,
    exponent: int,
    slots: Tensor,
    gradient: Tensor,
) -> None:
    """The gradient by the voxels as every voxel reads it from the slots of all cameras (paper, eq. 19).

    dL/db_lm = sum over cameras of Y_lm(camera -> voxel) (det(K) voxel^3 d / (z^3 step)) lerp(dL/dc), d the voxel's distance
    and z its depth; the factor is the number of samples per voxel, the lerp goes over 4 pixels x 2 samples. The same
    without Y for the opacity value. An approximation of :func:`photometric_step`'s gradient, without sums in memory that
    threads share: it never depends on their number.

    Args:
        voxels: only their shape and type count. coordinates: [T, 3] int32, where each tile stands in the table.
        matrices: [V, 3, 3] K R of each camera. centers: [V, 3] world.
        windows: [V, 4] int64 left, top, width, height of the pixels that have rays, and a border of pixels that have none;
            width = height = 0 for a camera without rays. window_rays: int32, the windows end to end in row-major order: the
            number of each pixel's ray, -1 where there is none.
        shift: [V], of each camera's lattice in steps, as its rays had it. step: between samples, world units.
        starts, first, exponent, slots: as in :func:`photometric_lattice`.
        gradient: [T, 4, 4, 4, P], overwritten.
    """
    cameras, rows = (matrices, centers, windows, window_rays), (starts, first, exponent, slots)
    _ops.gather_gradient(voxels, table, frame, coordinates, *cameras, shift, step, *rows, gradient)


def voxel_terms(
    voxels: Tensor,
    table: Tensor,
    frame: list[float],
    coordinates: Tensor,
    weights: list[float],
    huber: float,
    bend: float,
    gradient: Tensor,
) -> Tensor:
    """Losses of the voxels themselves; the gradient of ``weights . losses`` is added to ``gradient``.

    Args:
        coordinates: [T, 3] int32, where each tile stands in the table.
        weights: of the total variation of the opacity value and of the colour coefficients (sum over 6-neighbour pairs
            of the squared difference, eq. 9; missing neighbours count with their boundary value for the opacity, not
            for colour), of the parsimony (eq. 11, Huber over ``huber``, l > 0), of the ballooning (eq. 12) and of the
            curvature (Huber over ``bend`` of the 7-point Laplacian of the opacity value at the voxels that lie, with their
            6 neighbours, strictly between the boundary values; 0 and not computed where its weight is 0).
        gradient: [T, 4, 4, 4, P], written in place; beside codes also in float16, times ``HALF_SCALE``.

    Returns:
        losses [5] float64 in the order of ``weights``, not yet times them.
    """
    return cast(Tensor, _ops.voxel_terms(voxels, table, frame, coordinates, weights, huber, bend, gradient))


def adam_step(
    voxels: Tensor,
    gradient: Tensor,
    first: Tensor,
    second: Tensor,
    rate: Tensor,
    low: Tensor,
    high: Tensor,
    t: int,
    beta1: float = 0.9,
    beta2: float = 0.99,
    epsilon: float = 1e-8,
    seed: int = 0,
    stochastic: bool = True,
) -> None:
    """Step t = 1, 2, ... of Adam in place on ``voxels``, moments ``first`` and ``second``, then clamp to [low, high].

    ``rate, low, high [P]`` are given per coefficient of a record. Codes span [low, high]; beside them ``first`` is the
    first moment and ``second`` the root of the second one, both times ``HALF_SCALE``: float16 beside uint16, and beside
    uint8 the bits of e5m2 and of an unsigned 5-3 float, rounded stochastically. ``stochastic``: the codes are too, by a
    hash of ``seed``, t and place, and otherwise to the nearest. ``gradient``: float32, or float16 times ``HALF_SCALE``.
    """
    moments, bounds = (first, second), (rate, low, high)
    _ops.adam_step(voxels, gradient, *moments, *bounds, beta1, beta2, epsilon, t, seed, stochastic)
