"""Contour lines over heat maps with logarithmic axes."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patheffects import withStroke
from numpy.typing import NDArray

from sinsjax.plots import COLOURS

_CONTOUR = COLOURS[1]


class Contours(NamedTuple):
    """Contour lines over heat maps.

    Attributes:
        name: name of the quantity in the legend.
        levels: ascending levels.
        values: (n, m) values for each panel, evenly spaced from edge to edge, see `spread`.
    """

    name: str
    levels: Sequence[float]
    values: Sequence[NDArray]


def spread(values: Sequence[float], count: int) -> NDArray:
    """Positive values of an axis, evenly spaced on the figure from edge to edge of its cells.

    Args:
        values: values at the centres of two or more cells, ascending.
        count: number of values.

    Returns:
        (count,) values, geometric between the centres and beyond the outer ones.
    """
    logs, last = np.log(values), len(values) - 1
    middles = np.arange(-1, last + 2)
    ends = (2 * logs[0] - logs[1], 2 * logs[-1] - logs[-2])
    places = np.linspace(-0.5, last + 0.5, count)
    return np.exp(np.interp(places, middles, [ends[0], *logs, ends[1]]))


def legend(contours: Contours) -> list[Line2D]:
    """The entries of the legend."""
    styles = zip(contours.levels, _level_styles(contours.levels), strict=True)
    handles = []
    for i, (level, style) in enumerate(styles):
        name = f"{contours.name} {level:g}" if i == 0 else f"{level:g}"
        handles.append(Line2D([], [], color=_CONTOUR, linestyle=style, label=name))
    return handles


def draw_contours(axes: Axes, levels: Sequence[float], values: NDArray) -> None:
    """Draw the lines of a panel over its cells."""
    sides = zip((axes.get_ylim(), axes.get_xlim()), values.shape, strict=True)
    down, right = (np.linspace(min(side), max(side), count) for side, count in sides)
    styles = _level_styles(levels)
    lines = axes.contour(
        right, down, values, levels, colors=_CONTOUR, linewidths=1.3, linestyles=styles
    )
    lines.set_path_effects([withStroke(linewidth=2.2, foreground="white", alpha=0.6)])


def _level_styles(levels: Sequence[float]) -> list[Any]:
    """A line style for each level, from the sparsest to solid."""
    return [*((0, (1 + 2 * i, 1.5)) for i in range(len(levels) - 1)), "-"]
