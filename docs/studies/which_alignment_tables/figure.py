"""The page's first figure: what 90 % of the runs stay below, over the available time."""

from collections.abc import Sequence

from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator

from sinsjax.plots.style import add_legend_below, line_colour, with_style

from .field import TIMES_S, Cell, Field, Start, reach


@with_style
def reached(
    field: Field, arms: Sequence[str], starts: tuple[Start, ...], grade: float, title: str
) -> Figure:
    """A panel for each base, a line with its interval for each arm."""
    figure = Figure(figsize=(9.6, 6.6))
    figure.suptitle(title)
    grid = figure.subplots(2, 3, sharex=True, sharey=True)
    for axes, (name, base) in zip(grid.flat, field.bases.items(), strict=True):
        for number, arm in enumerate(arms):
            told = [reach(field.errors(arm, Cell(starts, base, grade, t))) for t in TIMES_S]
            line = line_colour(number), ("-", "--")[number // 7]
            axes.plot(TIMES_S, [one.value for one in told], line[1], color=line[0], label=arm)
            low, high = ([one[end] for one in told] for end in (1, 2))
            axes.fill_between(TIMES_S, low, high, color=line[0], alpha=0.25, linewidth=0)
        axes.set_title(f"vehicle motion: {name}")
        axes.set_xscale("log")
        axes.set_yscale("log")
        axes.set_ylim(1, 10_800)
        axes.xaxis.set_major_locator(FixedLocator(TIMES_S))
        axes.xaxis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:g}"))
        axes.xaxis.set_minor_locator(NullLocator())
        axes.yaxis.set_major_locator(FixedLocator([1, 10, 60, 600, 5400]))
        axes.yaxis.set_major_formatter(FuncFormatter(_angle))
        axes.yaxis.set_minor_locator(NullLocator())
    for axes in grid[-1]:
        axes.set_xlabel("time from the first sample (s)")
    figure.supylabel("heading error that 90 % of the runs stay below")
    add_legend_below(figure, grid[-1, -1])
    return figure


def _angle(arcmin: float, _: int | None = None) -> str:
    """An angle in arcmin, or in degrees from one on."""
    return f"{arcmin / 60:g}\N{DEGREE SIGN}" if arcmin >= 60 else f"{arcmin:g}'"
