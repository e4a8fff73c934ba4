"""Names beside the marks of a crowded panel. Matplotlib is imported where it is needed."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

APART = 2.5  # between a text and the marks of others, points
GAPS = (1.5, 7.0, 13.0, 20.0)  # between a mark and its name, points
SIDES = ((1, 0), (1, 1), (1, -1), (-1, 0), (-1, 1), (-1, -1), (0, 1), (0, -1))  # of a mark, right and up


class Spot(NamedTuple):
    """A mark of a panel. area: points²; text: beside it, of so many points; needed: or else left out where there is no room
    for it."""

    x: float
    y: float
    area: float
    text: str
    color: str
    points: float
    needed: bool = True


def write_names(axes: Any, spots: Sequence[Spot]) -> None:
    """Writes the texts of marks beside them, the needed ones first, where they cover neither marks, nor lines, nor texts; a
    line leads to those that are not close."""
    from matplotlib.text import Text
    from matplotlib.transforms import Bbox

    spots = sorted(spots, key=lambda spot: not spot.needed)
    pixels = axes.figure.dpi / 72
    places, taken = [], []
    for spot in spots:
        x, y = axes.transData.transform((spot.x, spot.y))
        reach = (math.sqrt(spot.area) / 2 + APART) * pixels
        places.append(Bbox.from_extents(x - reach, y - reach, x + reach, y + reach))
    for line in axes.lines:
        corners = axes.transData.transform(line.get_xydata())
        for begin, end in itertools.pairwise(corners):
            taken += [Bbox([begin + t * (end - begin)] * 2) for t in np.linspace(0, 1, 30)]
    renderer = axes.figure.canvas.get_renderer()
    for number, spot in enumerate(spots):
        others = [*places[:number], *places[number + 1 :], *taken]
        radius = math.sqrt(spot.area) / 2
        leader = {"arrowstyle": "-", "linewidth": 0.6, "color": spot.color, "shrinkA": 0, "shrinkB": radius}
        look = {"color": spot.color, "fontsize": spot.points, "arrowprops": leader}
        text = axes.annotate(spot.text, (spot.x, spot.y), (0, 0), textcoords="offset points", **look)
        for gap, (right, up) in itertools.product(GAPS if spot.needed else GAPS[:1], SIDES):
            reach = gap + radius * (1.0 if right * up == 0 else 0.7)
            text.set_position((right * reach, up * reach))
            text.set_ha(("right", "center", "left")[right + 1])
            text.set_va(("top", "center", "bottom")[up + 1])
            text.update_positions(renderer)
            box = Text.get_window_extent(text, renderer)  # without the leader
            if axes.bbox.count_contains(box.corners()) == 4 and not box.count_overlaps(others):
                break
        else:
            if not spot.needed:
                text.remove()
                continue
        text.arrow_patch.set_visible(gap > GAPS[0])
        taken.append(box)
