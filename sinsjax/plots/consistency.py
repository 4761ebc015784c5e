"""A filter's covariance against its actual errors: `sinsjax.plot_belief`."""

from collections.abc import Mapping, Sequence
from textwrap import fill
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy import special

from sinsjax import analysis
from sinsjax.analysis import NEES_FREEDOM, Estimate
from sinsjax.analysis.tables import to_arrow_table, to_key_list
from sinsjax.errors import InputError
from sinsjax.plots.labels import describe_point
from sinsjax.plots.style import GREY, LETTERS, add_legend_below, line_colour, with_style

_FROM_FLOOR = "from the bias floor"

NEES_COLUMNS = ("nees", "nis_u")
"""Columns of NEES: of the attitude from the truth, and of the heading from the bias floor."""

SHARE_COLUMNS = {
    "from truth": "p_above_error_share",
    _FROM_FLOOR: "p_above_floor_error_share",
}
"""Columns of the shares of records with P above the squared error."""

_WITHIN_SIGMA = float(special.erf(0.5**0.5))  # share of a normal variable within 1 sigma
_FAR = (1e-4, 1e7)  # widest range of the NEES axis
_MARKS = ("o", "s", "^")
_BELOW = 0.2  # distance of name and marks from the middle of their line, in lines


class ConsistencyLine(NamedTuple):
    """Runs of one line.

    Attributes:
        label: label in the legend.
        nees: (runs,) NEES, of the attitude from the truth or of the heading from the bias floor.
        shares: share of records with P above the squared error, by reference of the error.
    """

    label: str
    nees: NDArray
    shares: Mapping[str, Estimate]

    @classmethod
    def from_runs(
        cls, label: str, rows: pa.Table, *, from_floor: bool = False
    ) -> "ConsistencyLine":
        """Return the line of some runs of a summary with `SHARE_COLUMNS`.

        Args:
            label: label in the legend.
            rows: the runs, with ``nees``, or ``nis_u`` if errors count from the bias floor.
            from_floor: whether errors count from the bias floor only.
        """
        shares = {
            of: analysis.mean(
                analysis.numeric_column(rows, column), analysis.cluster_ids(rows), limits=(0.0, 1.0)
            )
            for of, column in SHARE_COLUMNS.items()
            if of == _FROM_FLOOR or not from_floor
        }
        return cls(label, analysis.numeric_column(rows, NEES_COLUMNS[from_floor]), shares)


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
    groups = analysis.group_rows(to_arrow_table(runs), to_key_list(by))
    lines = [
        ConsistencyLine.from_runs(describe_point(point), rows, from_floor=from_floor)
        for point, rows in groups
    ]
    lines = [line for line in lines if np.isfinite(line.nees).any()]
    if not lines:
        column = NEES_COLUMNS[from_floor]
        raise InputError(
            f"plot_belief: no run has a finite {column} (only filters have a covariance)"
        )
    title = title or _mean_nees_title(lines, from_floor=from_floor)
    return draw_consistency(lines, title, from_floor=from_floor)


def _mean_nees_title(lines: Sequence[ConsistencyLine], *, from_floor: bool) -> str:
    """The mean NEES of the lines, in words."""
    means = [float(np.mean(line.nees[np.isfinite(line.nees)])) for line in lines]
    ends = dict.fromkeys(
        f"{mean:,.0f}" if mean >= 10 else f"{mean:.2g}" for mean in (min(means), max(means))
    )
    error, freedom = (
        (" of the heading, from the bias floor:", 1) if from_floor else ("", NEES_FREEDOM)
    )
    return f"Mean NEES{error} {' to '.join(ends)}, where a consistent filter has {freedom}"


@with_style
def draw_consistency(
    lines: Sequence[ConsistencyLine], title: str, *, from_floor: bool = False
) -> Figure:
    """Draw the distribution of NEES against chi-square, and how often P exceeds the squared error.

    Args:
        lines: one line each; all with shares of the same names.
        title: title of the figure.
        from_floor: whether the NEES are those of the heading from the bias floor.
    """
    figure = Figure(figsize=(9.2, 4.4 + 0.3 * max(len(lines) - 3, 0)))
    figure.suptitle(fill(title, int(LETTERS * figure.get_figwidth())))
    left, right = figure.subplots(1, 2, width_ratios=[3, 2])
    _draw_nees(left, lines, from_floor=from_floor)
    _draw_shares(right, lines)
    add_legend_below(figure, left)
    return figure


def _draw_nees(axes: Axes, lines: Sequence[ConsistencyLine], *, from_floor: bool) -> None:
    freedom = 1 if from_floor else NEES_FREEDOM
    known = [line.nees[np.isfinite(line.nees) & (line.nees > 0)] for line in lines]
    found = np.concatenate(known)
    low, high = np.quantile(found, [0.002, 0.998]) if found.size else (1.0, 1.0)
    low, high = max(min(low, 0.05), _FAR[0]), min(max(2 * high, 30.0), _FAR[1])
    for i, line in enumerate(lines):
        nees = np.sort(line.nees[np.isfinite(line.nees)])
        share = np.arange(nees.size + 1) / line.nees.size  # one that is not finite counts
        style: Any = {"color": line_colour(i), "linewidth": 3.2 - 0.35 * i, "label": line.label}
        axes.plot(np.append(nees[:1], nees), share, drawstyle="steps-post", **style)
    at = np.geomspace(low, high, 400)
    name = f"chi-square, {freedom} degree{'s' * (freedom > 1)} of freedom"
    axes.plot(at, special.chdtr(freedom, at), "--", color="black", label=name)
    for mark, of in zip(_MARKS, lines[0].shares, strict=False):
        axes.plot([], [], mark, color=GREY, label=f"share {of}")
    axes.set(xscale="log", xlim=(low, high), ylim=(0, 1.02), ylabel="share of runs")
    axes.xaxis.set_major_formatter("{x:g}")
    error = f"of the heading at the end, {_FROM_FLOOR}"
    axes.set_xlabel(f"NEES {error if from_floor else 'at the end, error from truth'}")


def _draw_shares(axes: Axes, lines: Sequence[ConsistencyLine]) -> None:
    for i, belief in enumerate(lines):
        for j, (value, low, high, _) in enumerate(belief.shares.values()):
            spread = [[np.nan_to_num(value - low)], [np.nan_to_num(high - value)]]
            place = i + _BELOW + 0.12 * (2 * j - len(belief.shares) + 1)
            style: Any = {"color": line_colour(i), "capsize": 2.5, "markersize": 6}
            axes.errorbar([value], [place], xerr=np.maximum(spread, 0.0), fmt=_MARKS[j], **style)
        axes.text(0.0, i - _BELOW, belief.label, color=line_colour(i), fontsize=8.5, va="center")
    axes.axvline(_WITHIN_SIGMA, color="black", linestyle="--")
    axes.set_xlim(-0.03, 1.03)
    axes.set_ylim(len(lines) - 0.4, -0.6)  # room for the marks of the last, the name of the first
    axes.set_yticks([])
    axes.set_xlabel("share of records with the variance\nabove the squared heading error")
