"""Lines over update time."""

from collections.abc import Mapping, Sequence

from matplotlib.figure import Figure

from sinsjax.plots.curves import Line, draw_mean_and_band
from sinsjax.plots.style import add_legend_below, with_style


@with_style
def over_time(
    panels: Mapping[str, Sequence[Line]],
    title: str,
    *,
    quantity: str,
    floor: float | None = None,
) -> Figure:
    """Lines over update time, panels side by side.

    Args:
        panels: panel title to lines, all in the same unit.
        title: title of the figure.
        quantity: label of the vertical axis, with its unit.
        floor: lower end of a logarithmic axis; None for a linear one.
    """
    figure = Figure(figsize=(9.2, 4.6))
    figure.suptitle(title)
    grid = figure.subplots(1, len(panels), sharey=True, squeeze=False)[0]
    for axes, (name, lines) in zip(grid, panels.items(), strict=True):
        extents = [draw_mean_and_band(axes, line) for line in lines]
        axes.set_xlim(0, max(extent.time_s[-1] for extent in extents))
        if floor is not None:
            axes.set_yscale("log")
            axes.set_ylim(bottom=floor)
        axes.set_title(name)
        axes.set_xlabel("update time (s)")
    grid[0].set_ylabel(quantity)
    add_legend_below(figure, grid[0])
    return figure
