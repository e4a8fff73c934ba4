"""Figures with scales and legends. Matplotlib is imported where it is needed: half a second that a fit need not wait for."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from torch import Tensor

from torch_surfcap.data.files import atomic_write
from torch_surfcap.ops import TILE
from torch_surfcap.report import DPI, Path
from torch_surfcap.surface.section import INSIDE_COLOR, OUTSIDE_COLOR, Section, cut, in_words

if TYPE_CHECKING:
    from torch_surfcap.field.field import SurfaceField

DETAIL = 8  # tiles along the side of the magnified detail
SURFACE = "#e8402a"
BORDER = "#4a7ab8"
FRAME = "#e09000"


def write_section(
    path: Path,
    field: SurfaceField,
    axis: int,
    position: float,
    size: int = 1000,
    up: Tensor | None = None,
    level: float | None = None,
) -> None:
    """PNG of a section (arguments of `cut`) with world coordinates, the level set as a line and the borders of the stored
    tiles; beside it, magnified, the square of it with the most surface. size: of its longer side, pixels, about."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch, Rectangle

    whole = cut(field, axis, position, size, up, level)
    width = DETAIL * TILE * field.voxel_size
    middle = _most_surface(whole, width)
    detail = cut(field, axis, position, size, up, level, middle, width)
    rows, columns = whole.value.shape
    height = size / DPI * max(0.4, min(1.0, rows / columns))  # inches
    shape = max(0.4, columns / rows) * height, height
    figure = Figure(figsize=(shape[0] + height, height), dpi=DPI, layout="constrained")
    FigureCanvasAgg(figure)
    left, right = figure.subplots(1, 2, width_ratios=shape)
    _draw(left, whole, 0.3)
    _draw(right, detail, 0.8)
    corner = (middle[0] - width / 2, middle[1] - width / 2)
    left.add_patch(Rectangle(corner, width, width, fill=False, edgecolor=FRAME, linewidth=1.5))
    for side in right.spines.values():
        side.set(edgecolor=FRAME, linewidth=1.5)
    left.set_title(f"{'xyz'[axis]} = {in_words(position, field.voxel_size)}, voxel {field.voxel_size:.3g}")
    right.set_title("detail")
    figure.legend(
        handles=[
            Line2D([], [], color=SURFACE, label="surface (level set)"),
            Patch(facecolor="white", edgecolor=BORDER, label="stored tile: empty"),
            Patch(facecolor="black", edgecolor=BORDER, label="stored tile: opaque"),
            Patch(facecolor=INSIDE_COLOR, label="not stored: inside"),
            Patch(facecolor=OUTSIDE_COLOR, label="not stored: outside"),
        ],
        loc="outside lower center",
        ncols=5,
        frameon=False,
    )
    with atomic_write(path) as partial:
        figure.savefig(partial, bbox_inches="tight")


def _draw(axes: Any, section: Section, line: float) -> None:
    """The section's picture with tile borders and level set, in world coordinates."""
    from matplotlib.collections import PolyCollection

    left, right, bottom, top = section.extent
    axes.imshow(section.picture().numpy(), extent=section.extent, interpolation="nearest", aspect="equal")
    corners = np.array([(0, 0), (1, 0), (1, 1), (0, 1)]) * section.edge
    tiles = section.stored.numpy()[:, None] + corners
    axes.add_collection(PolyCollection(list(tiles), facecolor="none", edgecolor=BORDER, linewidth=line))
    value = section.value.numpy()
    if value.min() < section.level < value.max():
        (u, v), (du, dv) = section.corner, section.pixel
        rows, columns = value.shape
        at = u + (np.arange(columns) + 0.5) * du, v + (np.arange(rows) + 0.5) * dv
        axes.contour(*at, value, [section.level], colors=SURFACE, linewidths=4 * line)
    axes.locator_params(nbins=6)
    axes.set(
        xlabel="xyz"[section.across], ylabel="xyz"[section.upward], xlim=(left, right), ylim=(bottom, top)
    )


def _most_surface(section: Section, width: float) -> tuple[float, float]:
    """Middle, in world units, of the square of this width with the most surface in it, within the section if it fits."""
    size = max(1, round(width / section.pixel[0]))
    amount = cv2.boxFilter(
        section.surface().astype(np.float32),
        -1,
        (size, size),
        normalize=False,
        borderType=cv2.BORDER_CONSTANT,
    )
    rim = [min(size // 2, (n - 1) // 2) for n in amount.shape]
    inner = amount[rim[0] : amount.shape[0] - rim[0], rim[1] : amount.shape[1] - rim[1]]
    row, column = np.unravel_index(int(inner.argmax()), inner.shape)
    (left, top), (dx, dy) = section.corner, section.pixel
    return left + (column + rim[1] + 0.5) * dx, top + (row + rim[0] + 0.5) * dy
