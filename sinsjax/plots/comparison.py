"""Statistics over the draws along one swept key: `sinsjax.plot_compare`."""

import re
from collections.abc import Mapping, Sequence
from itertools import islice
from typing import Any

import numpy as np
import pyarrow as pa
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from sinsjax.analysis import UNKNOWN, estimate_groups, group_rows
from sinsjax.analysis.labels import axis_label, describe_point, format_value
from sinsjax.analysis.tables import to_arrow_table, to_key_list
from sinsjax.plots.style import (
    GREY,
    add_legend_below,
    add_title,
    line_colour,
    set_log_scale,
    with_style,
)

MAX_LINES = 7  # of a figure
_MARKS = "os^Dv*P"
_DODGE = 0.008  # share of the axis by which the marks of two lines are offset to remain visible
_WIDE = 12  # letters of a label that does not fit next to others
_RANGE = 30.0  # largest over smallest value, beyond which an axis is logarithmic


@with_style
def plot_compare(
    runs: Any,
    key: str,
    *,
    by: str | Sequence[str] = (),
    statistics: Mapping[str, str] | None = None,
    title: str = "",
) -> Figure:
    """Draw statistics of the runs along one swept key, with 95 % intervals, one line per variant.

    Infinite estimates are marked at the upper edge as *never*. Panels without finite values are
    left out. Of many lines the first 7 are drawn.

    Args:
        runs: one row per run: a pyarrow Table such as `Results.summary`, or a pandas data frame.
        key: key along the horizontal axis: numbers, or words and lists, placed side by side.
        by: key or keys of the lines; runs that differ in other keys share a line.
        statistics: statistics of `sinsjax.summarise` and the title of the panel of each, with its
            unit (shares become percent); by default the median times to the first band, the
            shares of success and the rms heading error at the end that the columns allow.
        title: title of the figure.

    Raises:
        InputError: no table, no runs, a missing column, or an unknown statistic.

    Examples:
        >>> import pyarrow as pa
        >>> runs = pa.table({
        ...     "q_scale": [1.0, 1.0, 4.0, 4.0],
        ...     "draw_id": [0, 1, 0, 1],
        ...     "status": ["ok"] * 4,
        ...     "phi_u_arcmin": [2.0, -1.0, 9.0, -8.0],
        ... })
        >>> figure = sinsjax.plot_compare(runs, "q_scale")
        >>> [axes.get_title(loc="left") for axes in figure.axes]
        ['heading error at the end, rms (arcmin)']
    """
    table = to_arrow_table(runs)
    titles = _default_statistics(table) if statistics is None else statistics
    lines = {
        describe_point(point): estimate_groups(rows, [key], list(titles)).groups
        for point, rows in islice(group_rows(table, to_key_list(by)), MAX_LINES)
    }
    values: list[Any] = []
    for groups in sorted(lines.values(), key=len, reverse=True):
        values += [point[key] for point, _ in groups if point[key] not in values]
    panels = {name: np.full((len(lines), len(values), 3), UNKNOWN[:3]) for name in titles}
    # A schedule by the law of resets has other times at each value, so no line has all values.
    for line, groups in enumerate(lines.values()):
        for point, found in groups:
            for name, panel in panels.items():
                scale = 100 if name.endswith("_rate") else 1
                panel[line, values.index(point[key])] = np.multiply(scale, found[name][:3])
    known = {name: panel for name, panel in panels.items() if np.isfinite(panel[..., 0]).any()}
    panels = known or panels
    numeric = all(isinstance(v, int | float) and not isinstance(v, bool) for v in values)
    x = np.asarray(values, dtype=float) if numeric else np.arange(len(values))
    figure = Figure(figsize=(9.2, 1.2 + 2.2 * len(panels)))
    add_title(figure, title)
    grid = figure.subplots(len(panels), 1, sharex=True, squeeze=False)[:, 0]
    for axes, (name, panel) in zip(grid, panels.items(), strict=True):
        _draw_panel(axes, list(lines), panel, x, "-" if numeric else "")
        axes.set_title(titles[name], loc="left", size="medium")
        if name.endswith("_rate"):
            axes.set_ylim(-4, 104)
    words = [format_value(value) for value in values]
    if not numeric or np.diff(np.sort(x)).min(initial=np.inf) > 0.06 * np.ptp(x):
        turned = {"rotation": 20, "ha": "right"} if max(map(len, words)) > _WIDE else {}
        grid[-1].set_xticks(x, words, **turned)
    grid[-1].set_xlabel(axis_label(key))
    if any(np.isposinf(panel[..., 0]).any() for panel in panels.values()):
        grid[0].plot([], [], "x", color=GREY, label="never (median)")
    add_legend_below(figure, grid[0])
    return figure


def _default_statistics(table: pa.Table) -> dict[str, str]:
    """Return the statistics that a summary allows, with the titles of their panels."""
    found = {}
    for aim, words, mark in (("floor", "the bias floor", ""), ("truth", "the truth", "_truth")):
        column = re.compile(rf"settle_([\d.]+){mark}_s")
        if match := next(filter(None, map(column.fullmatch, table.column_names)), None):
            found[f"{match[0]}_median"] = f"median time (s) to within {match[1]}' of {words}"
        if f"ok_{aim}" in table.column_names:
            found[f"success_{aim}_rate"] = f"share of successful runs, from {words} (%)"
    return found | {"phi_u_arcmin_rms": "heading error at the end, rms (arcmin)"}


def _draw_panel(
    axes: Axes, lines: Sequence[str], estimates: NDArray, x: NDArray, joined: str
) -> None:
    """Draw the lines of a panel: estimates and ends of their intervals, (lines, values, 3)."""
    value = np.where(np.isfinite(estimates[..., 0]), estimates[..., 0], np.nan)
    ends = np.stack([value - estimates[..., 1], estimates[..., 2] - value])
    bars = np.maximum(np.nan_to_num(ends, posinf=0.0, neginf=0.0), 0.0)
    known = value[np.isfinite(value)]
    if not known.size:
        axes.set_yticks([])
    elif known.min() > 0 and known.max() > _RANGE * known.min():
        set_log_scale(axes.yaxis, float(known.min()), float(known.max()))
    for i, line in enumerate(lines):
        shifted = x + _DODGE * np.ptp(x) * (i - (len(lines) - 1) / 2)
        style: Any = {"color": line_colour(i), "label": line, "capsize": 2.5, "markersize": 5}
        mark = _MARKS[i % len(_MARKS)] + joined
        axes.errorbar(shifted, value[i], yerr=bars[:, i], fmt=mark, **style)
        never = shifted[np.isposinf(estimates[i, :, 0])]
        if never.size:  # at the upper edge
            at: Any = {"transform": axes.get_xaxis_transform()}
            axes.plot(never, np.full(never.size, 0.97), "x", color=line_colour(i), **at)
