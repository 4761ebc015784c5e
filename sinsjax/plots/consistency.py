"""A filter's covariance against its actual errors: `sinsjax.plot_belief`."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from scipy import special

from sinsjax import analysis
from sinsjax.analysis.labels import describe_point
from sinsjax.analysis.tables import to_arrow_table, to_key_list
from sinsjax.errors import InputError
from sinsjax.plots.style import (
    GREY,
    add_legend_below,
    add_title,
    line_colour,
    set_log_scale,
    with_style,
)

NEES_COLUMNS = ("nees", "nis_u")
"""Columns of NEES: of the attitude from the truth, and of the heading from the bias floor."""

SHARE_COLUMNS = {
    "from truth": "p_above_error_share",
    "from the bias floor": "p_above_floor_error_share",
}
"""Columns of the shares of records with P above the squared error."""

NEES_FREEDOM = 3  # of ``nees``: three angles
_WITHIN_SIGMA = float(special.erf(0.5**0.5))  # share of a normal variable within 1 sigma
_MARKS = ("o", "s")  # from truth, from the bias floor


@with_style
def plot_belief(
    runs: Any, *, by: str | Sequence[str] = (), title: str = "", from_floor: bool = False
) -> Figure:
    """Draw whether filters know their own error: NEES and P against the true error, line by line.

    On the left the distribution of NEES, the squared attitude error at the end in units of the
    filter's covariance (no unit), against chi-square of 3 degrees of freedom. On the right the mean
    share of records in which the heading variance exceeds the squared heading error, from the truth
    and from the bias floor, with 95 % intervals, against the 68 % of a consistent filter.

    A filter without states for constant sensor biases cannot know the error that they cause. With
    ``from_floor`` both sides show the heading error from the bias floor alone, and the left one
    ``nis_u``, its square in units of the filter's heading variance, of 1 degree of freedom.

    Args:
        runs: one row per run, with ``nees``, ``p_above_error_share`` and
            ``p_above_floor_error_share`` (``nis_u`` and the last one with ``from_floor``): a
            pyarrow Table such as `Results.summary`, or a pandas data frame. Lines without any
            finite NEES are left out.
        by: key or keys of the lines; without keys all runs make one.
        title: title of the figure; by default it states the mean NEES.
        from_floor: whether errors count from the bias floor only.

    Raises:
        InputError: no table, a missing column, or no run with a finite NEES.

    Examples:
        >>> import pyarrow as pa
        >>> runs = pa.table({
        ...     "nees": [1.0, 3.0, 5.0],
        ...     "p_above_error_share": [0.6, 0.7, 0.75],
        ...     "p_above_floor_error_share": [0.6, 0.7, 0.8],
        ... })
        >>> sinsjax.plot_belief(runs).get_suptitle()
        'Mean NEES 3, where a consistent filter has 3'
    """
    column, freedom = NEES_COLUMNS[from_floor], 1 if from_floor else NEES_FREEDOM
    shares = dict([*SHARE_COLUMNS.items()][from_floor:])
    lines = {
        describe_point(point): (rows, np.sort(analysis.numeric_column(rows, column)))
        for point, rows in analysis.group_rows(to_arrow_table(runs), to_key_list(by))
    }
    lines = {name: line for name, line in lines.items() if np.isfinite(line[1]).any()}
    if not lines:
        raise InputError(
            f"plot_belief: no run has a finite {column} (only filters have a covariance)"
        )
    figure = Figure(figsize=(9.2, 4.4 + 0.3 * max(len(lines) - 3, 0)))
    left, right = figure.subplots(1, 2, width_ratios=[3, 2])
    every = []
    for i, (label, (rows, nees)) in enumerate(lines.items()):
        colour, known = line_colour(i), nees[np.isfinite(nees)]
        every.append(known)
        below = np.arange(known.size + 1) / nees.size  # one that is not finite counts
        style: Any = {"where": "post", "color": colour, "linewidth": max(3.2 - 0.35 * i, 0.8)}
        left.step(np.append(known[:1], known), below, label=label, **style)
        right.text(0.0, i - 0.2, label, color=colour, fontsize=8.5, va="center")
        for j, (mark, name) in enumerate(zip(_MARKS, shares.values(), strict=False)):
            records, clusters = analysis.numeric_column(rows, name), analysis.draw_id_clusters(rows)
            value, low, high, _ = analysis.mean(records, clusters, limits=(0.0, 1.0))
            bar = np.maximum(np.nan_to_num([[value - low], [high - value]]), 0.0)
            place = i + 0.2 + 0.12 * (2 * j - len(shares) + 1)
            style = {"color": colour, "capsize": 2.5, "markersize": 6, "fmt": mark}
            right.errorbar([value], [place], xerr=bar, **style)
    means = [float(nees.mean()) for nees in every]
    words = (f"{m:,.0f}" if m >= 10 else f"{m:.2g}" for m in (min(means), max(means)))
    mean = "Mean NEES of the heading, from the bias floor:" if from_floor else "Mean NEES"
    mean += f" {' to '.join(dict.fromkeys(words))}, where a consistent filter has {freedom}"
    add_title(figure, title or mean)
    low, high = np.quantile(np.concatenate(every), [0.002, 0.998])
    low, high = float(np.clip(low, 1e-4, 0.05)), float(np.clip(2 * high, 30.0, 1e7))
    at = np.geomspace(low, high, 400)
    name = f"chi-square, {freedom} degree{'s' * (freedom > 1)} of freedom"
    left.plot(at, special.chdtr(freedom, at), "--", color="black", label=name)
    for mark, of in zip(_MARKS, shares, strict=False):
        left.plot([], [], mark, color=GREY, label=f"share {of}")
    set_log_scale(left.xaxis, low, high)
    error = "heading from the bias floor" if from_floor else "attitude from truth"
    left.set(xlim=(low, high), ylim=(0, 1.02), xlabel=f"NEES at the end, {error}")
    left.set_ylabel("share of runs")
    right.axvline(_WITHIN_SIGMA, color="black", linestyle="--")
    right.set(xlim=(-0.03, 1.03), yticks=[])
    right.set_ylim(len(lines) - 0.4, -0.6)  # room for the marks of the last, the name of the first
    right.set_xlabel("share of records with the variance\nabove the squared heading error")
    add_legend_below(figure, left)
    return figure
