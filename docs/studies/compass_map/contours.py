"""Contour maps of heading errors over sigma and the length of a stored record."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.contour import ContourSet
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patheffects import withStroke
from numpy.typing import NDArray

from sinsjax.plots import COLOURS, GridAxis
from sinsjax.plots.labels import axis_label, format_value
from sinsjax.plots.style import with_style

ERROR_LEVELS_ARCMIN = (0.3, 1.0, 3.0, 10.0, 100.0)
RADIUS_LEVELS = (0.5, 1.0)
_RADIUS = COLOURS[1]
_CLEAR = 1.3  # least ratio of two labelled ticks


class Panel(NamedTuple):
    """A map of heading errors.

    Attributes:
        title: its title.
        errors: (rows, columns) rms heading errors, arcmin.
        radii: (n, m) spectral radii of a cycle, at `spaced` values of the rows and columns.
    """

    title: str
    errors: NDArray
    radii: NDArray


def spaced(values: Sequence[float], count: int) -> NDArray:
    """Return values from the first to the last one, evenly spaced on a logarithmic axis."""
    return np.geomspace(values[0], values[-1], count)


@with_style
def contour_maps(
    panels: Sequence[Panel], title: str, *, rows: GridAxis, columns: GridAxis
) -> Figure:
    """Draw labelled contours of rms heading errors, two panels side by side.

    Args:
        panels: maps over the same rows and columns.
        title: title of the figure.
        rows: key and values from bottom to top, on a logarithmic axis.
        columns: key and values from left to right, on a logarithmic axis.
    """
    height = -(-len(panels) // 2)
    figure = Figure(figsize=(9.2, 1.3 + 2.9 * height))
    figure.suptitle(title)
    grid = figure.subplots(height, 2, sharex=True, sharey=True, squeeze=False)
    for axes, panel in zip(grid.flat, panels, strict=False):
        _prepare_axes(axes, rows, columns)
        filled = _draw_errors(axes, panel.errors, rows, columns)
        _draw_radii(axes, panel.radii, rows, columns)
        axes.set_title(panel.title)
    for axes in list(grid.flat)[len(panels) :]:
        axes.set_visible(False)
    for axes in grid[:, 0]:
        axes.set_ylabel(axis_label(rows.key))
    for axes in grid[-1]:
        axes.set_xlabel(axis_label(columns.key))
    bar = figure.colorbar(filled, ax=grid, label="rms heading error (arcmin)", aspect=35)
    places = np.log10(ERROR_LEVELS_ARCMIN).tolist()
    bar.set_ticks(places, labels=[f"{x:g}" for x in ERROR_LEVELS_ARCMIN])
    name = "share of the error that a cycle of two passes leaves (linear loops)"
    line = Line2D([], [], color=_RADIUS, linewidth=2.0, label=name)
    figure.legend(handles=[line], loc="outside lower center")
    return figure


def _prepare_axes(axes: Axes, rows: GridAxis, columns: GridAxis) -> None:
    """Set ticks at the values; the axes are linear in their logarithms, as are the contours."""
    axes.grid(visible=False)
    axes.set_xticks(np.log10(columns.values), _tick_labels(columns.values))
    axes.set_yticks(np.log10(rows.values), _tick_labels(rows.values))


def _tick_labels(values: Sequence[float]) -> list[str]:
    """Return the labels of ascending values, empty if the last label is too near."""
    labels, last = [], 0.0
    for value in values:
        is_clear = value > _CLEAR * last
        labels.append(format_value(value) if is_clear else "")
        last = value if is_clear else last
    return labels


def _draw_errors(axes: Axes, errors: NDArray, rows: GridAxis, columns: GridAxis) -> ContourSet:
    """Draw filled contours of the logarithm, with a label on each line and a dot per point."""
    levels = np.log10(ERROR_LEVELS_ARCMIN)
    places = np.meshgrid(np.log10(columns.values), np.log10(rows.values))
    filled = axes.contourf(*places, np.log10(errors), levels, cmap="viridis_r", extend="both")
    lines = axes.contour(*places, np.log10(errors), levels, colors="black", linewidths=0.8)
    names = {level: f"{x:g}" for level, x in zip(levels, ERROR_LEVELS_ARCMIN, strict=True)}
    _label_lines(axes, lines, names, "black")
    axes.plot(*map(np.ravel, places), ".", color="white", markersize=2)
    return filled


def _draw_radii(axes: Axes, radii: NDArray, rows: GridAxis, columns: GridAxis) -> None:
    down, right = (
        np.log10(spaced(axis.values, count))
        for axis, count in zip((rows, columns), radii.shape, strict=True)
    )
    lines = axes.contour(right, down, radii, RADIUS_LEVELS, colors=_RADIUS, linewidths=2.0)
    _label_lines(axes, lines, {level: f"{level:g}" for level in RADIUS_LEVELS}, _RADIUS)


def _label_lines(axes: Axes, lines: ContourSet, names: dict[float, str], colour: str) -> None:
    for text in axes.clabel(lines, fmt=names, fontsize=9.5, colors=colour):
        text.set_path_effects([withStroke(linewidth=2.5, foreground="white")])
