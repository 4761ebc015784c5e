"""Figures of statistics over the draws: along one swept key, and whole distributions."""

import math
from collections.abc import Mapping, Sequence
from itertools import islice
from textwrap import fill
from typing import Any

import numpy as np
import pyarrow as pa
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from sinsjax.analysis import Estimate, group_rows, summarise
from sinsjax.analysis.summaries import read_estimate
from sinsjax.analysis.tables import to_arrow_table, to_key_list
from sinsjax.plots.labels import axis_label, describe_axis_point, describe_point, format_value
from sinsjax.plots.style import (
    GREY,
    LETTERS,
    add_legend_below,
    label_line_ends,
    line_colour,
    set_log_scale,
    with_style,
)

MAX_LINES = 7
"""Lines of a figure at most."""

_MARKS = "os^Dv*P"
_DODGE = 0.008  # share of the axis by which the marks of two lines are offset to remain visible
_MOST_STEPS = 1000
_APART = 0.06  # share of the axis needed between marks
_WIDE = 12  # letters of a label that does not fit next to others
_SIMILAR = (
    0.1  # of a panel's largest value: a panel that differs by less from an earlier one is left out
)
_CLEAR = 0.05  # share by which the best line is better than the second
_RANGE = 30.0  # largest over smallest value, beyond which an axis is logarithmic
_LONG = 4.0  # times the median bar of a panel; beyond it a bar leaves the panel


def plot_compare(
    runs: Any,
    key: str,
    *,
    by: str | Sequence[str] = (),
    statistics: Mapping[str, str] | None = None,
    condition: bool = False,
    title: str = "",
) -> Figure:
    """Draw statistics of the runs along one swept key, with 95 % intervals, one line per variant.

    Uninformative panels are left out: without finite values, with shares that are all equal, or
    hardly different from an earlier panel of the same unit. Of many lines the first 7 are drawn.

    Args:
        runs: one row per run: a pyarrow Table such as `Results.summary`, or a pandas data frame.
        key: key along the horizontal axis, numbers or lists such as reset times.
        by: key or keys of the lines; runs that differ in other keys share a line.
        statistics: statistics of `sinsjax.summarise` and the title of the panel of each, with its
            unit (shares become percent); by default the median settling times, the shares of
            success and the rms of the heading error at the end that the columns allow.
        condition: whether the key is a condition of the runs such as the initial heading error, so
            that the title names the best line over all of its values; else it names the best value.
        title: title of the figure; by default it names the best value or line.

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
    keys = to_key_list(by)
    values, panels = build_comparison_panels(runs, key, keys, statistics)
    return draw_along_axis(key, values, panels, title=title, condition=condition)


_NO_ESTIMATE = Estimate(math.nan, math.nan, math.nan, 0)


def build_comparison_panels(
    runs: Any, key: str, by: Sequence[str], statistics: Mapping[str, str] | None = None
) -> tuple[list[Any], dict[str, Mapping[str, Sequence[Estimate]]]]:
    """The values of a key and the panels of `plot_compare`, with the same arguments."""
    table = to_arrow_table(runs)
    titles = _default_statistics(table) if statistics is None else dict(statistics)
    lines = {
        describe_point(point): rows for point, rows in islice(group_rows(table, by), MAX_LINES)
    }
    rows = {
        name: summarise(line_rows, [key], list(titles)).to_pylist()
        for name, line_rows in lines.items()
    }
    values: list[Any] = []
    for line_rows in sorted(rows.values(), key=lambda line_rows: -len(line_rows)):
        values += [row[key] for row in line_rows if row[key] not in values]

    def estimates(line_rows: list[dict[str, Any]], statistic: str) -> list[Estimate]:
        at = {values.index(row[key]): _read_estimate(row, statistic) for row in line_rows}
        # A schedule by the law of resets has other times at each value, and so a line for each.
        return [at.get(place, _NO_ESTIMATE) for place in range(len(values))]

    panels = {
        words: {name: estimates(line_rows, statistic) for name, line_rows in rows.items()}
        for statistic, words in titles.items()
    }
    return values, drop_uninformative_panels(panels) or dict(list(panels.items())[-1:])


def has_significant_effect(panels: Mapping[str, Mapping[str, Sequence[Estimate]]]) -> bool:
    """Return whether the key of some panels has an effect: two values of a line differ clearly.

    Bars of twice the length are compared, since there are many pairs of values.
    """
    for panel in panels.values():
        for line in panel.values():
            value, low, high = np.array([e[:3] for e in line], dtype=float).T
            with np.errstate(invalid="ignore"):
                lowest = np.where(np.isfinite(value), 2 * high - value, np.inf)
                highest = np.where(np.isfinite(value), 2 * low - value, value)
            if np.nanmax(highest, initial=-np.inf) > np.nanmin(lowest, initial=np.inf):
                return True
    return False


def _default_statistics(table: pa.Table) -> dict[str, str]:
    """The statistics that a summary allows, with the titles of their panels."""
    found = {}
    for name in table.column_names:
        if name.startswith("settle_") and not name.endswith("_data_s"):
            band, _, truth = name.removeprefix("settle_").removesuffix("_s").partition("_")
            aim = "the truth" if truth else "the bias floor"
            found[f"{name}_median"] = f"median time (s) to within {band}' of {aim}"
    for flag, aim in {"ok_floor": "the bias floor", "ok_truth": "the truth"}.items():
        if flag in table.column_names:
            rate = f"{flag.replace('ok', 'success')}_rate"
            found[rate] = f"share of successful runs, from {aim} (%)"
    return found | {"phi_u_arcmin_rms": "heading error at the end, rms (arcmin)"}


def _read_estimate(row: Mapping[str, Any], statistic: str) -> Estimate:
    """A statistic in a row of `summarise`, shares in percent."""
    found = read_estimate(row, statistic)
    if not statistic.endswith("_rate"):
        return found
    value, low, high = (100 * number for number in found[:3])
    return Estimate(value, low, high, found.n)


def drop_uninformative_panels(
    panels: Mapping[str, Mapping[str, Sequence[Estimate]]],
) -> dict[str, Mapping[str, Sequence[Estimate]]]:
    """The panels of `draw_along_axis` that show something that no earlier one does."""
    found: dict[str, Mapping[str, Sequence[Estimate]]] = {}
    seen: list[tuple[str, NDArray]] = []
    for name, panel in panels.items():
        values = np.array([e.value for line in panel.values() for e in line])
        same = "(%)" in name and np.ptp(values) == 0
        unit = name.partition("(")[2].partition(")")[0]
        is_repeated = any(
            unit == seen_unit and _nearly_equal(values, before) for seen_unit, before in seen
        )
        if is_informative(panel) and not same and not is_repeated:
            found[name] = panel
            seen.append((unit, values))
    return found


def _nearly_equal(values: NDArray, reference: NDArray) -> bool:
    """Return whether a panel hardly differs from another one, in values and in *never*."""
    reach = _SIMILAR * np.abs(reference[np.isfinite(reference)]).max(initial=0.0)
    return np.allclose(values, reference, rtol=0.0, atol=reach, equal_nan=True)


@with_style
def draw_along_axis(
    key: str,
    values: Sequence[Any],
    panels: Mapping[str, Mapping[str, Sequence[Estimate]]],
    *,
    title: str = "",
    condition: bool = False,
) -> Figure:
    """Estimates with their 95 % intervals along one swept key.

    Args:
        key: leaf key, with the unit in its name.
        values: values of the key; lists are placed side by side, as text.
        panels: quantity, with its unit, to line label to one estimate per value; infinite ones are
            marked at the upper edge as *never*; a bar far longer than the others ends outside.
        title: title of the figure; by default it names the best of the first panel.
        condition: whether the key is a condition, see `plot_compare`.
    """
    figure = Figure(figsize=(9.2, 1.2 + 2.2 * len(panels)))
    title = title or _best_value_title(key, values, panels, condition=condition)
    figure.suptitle(fill(title, int(LETTERS * figure.get_figwidth())))
    grid = figure.subplots(len(panels), 1, sharex=True, squeeze=False)[:, 0]
    words = [format_value(value) for value in values if isinstance(value, list | tuple)]
    x = np.arange(len(values)) if words else np.asarray(values, dtype=float)
    for axes, (name, lines) in zip(grid, panels.items(), strict=True):
        all_estimates = [e for estimates in lines.values() for e in estimates]
        if _needs_log_axis(all_estimates):
            shown = [e.value for e in all_estimates if 0 < e.value < np.inf] or [1.0]
            set_log_scale(axes, min(shown), max(shown))
        for i, (line, estimates) in enumerate(lines.items()):
            value, spread = _values_and_bars(estimates)
            style = {"color": line_colour(i), "label": line, "capsize": 2.5, "markersize": 5}
            beside = x + _DODGE * np.ptp(x) * (i - (len(lines) - 1) / 2)
            mark = _MARKS[i % len(_MARKS)] + ("" if words else "-")  # lists have no distance
            axes.errorbar(beside, value, yerr=spread, fmt=mark, **style)
            never = beside[np.isposinf([e.value for e in estimates])]
            if never.size:
                height = np.full(never.size, 0.97)  # of the axes: their upper edge
                edge = axes.get_xaxis_transform()
                axes.plot(never, height, "x", color=line_colour(i), transform=edge)
        if "(%)" in name:
            axes.set_ylim(-4, 104)
        elif axes.get_yscale() == "linear":
            _clip_axis_to_typical_bars(axes, all_estimates)
        axes.set_title(name, loc="left", size="medium")
        if not any(np.isfinite(e.value) for e in all_estimates):
            axes.set_yticks([])
    if words:
        turned = {"rotation": 20, "ha": "right"} if max(map(len, words)) > _WIDE else {}
        grid[-1].set_xticks(x, words, **turned)
    elif np.diff(np.sort(x)).min(initial=np.inf) > _APART * np.ptp(x):
        grid[-1].set_xticks(x, [f"{value:g}" for value in x])
    grid[-1].set_xlabel(axis_label(key))
    if any(np.isposinf(e.value) for p in panels.values() for line in p.values() for e in line):
        grid[0].plot([], [], "x", color=GREY, label="never (median)")
    for axes, lines in zip(grid, panels.values(), strict=True):
        ends = [
            (name, estimates_of_line[-1].value, line_colour(i))
            for i, (name, estimates_of_line) in enumerate(lines.items())
        ]
        if not words and label_line_ends(axes, ends):
            break
    else:
        ends = []
    add_legend_below(figure, grid[0], {name for name, *_ in ends})
    return figure


def _needs_log_axis(estimates: Sequence[Estimate]) -> bool:
    """Return whether values differ so much that a linear axis would hide the small ones."""
    values = np.array([e.value for e in estimates])
    values = values[np.isfinite(values)]
    return bool(values.size and values.min() > 0 and values.max() > _RANGE * values.min())


def _best_value_title(
    key: str,
    values: Sequence[Any],
    panels: Mapping[str, Mapping[str, Sequence[Estimate]]],
    *,
    condition: bool,
) -> str:
    """Return a title that names the best of the first panel."""
    name, lines = next(iter(panels.items()))
    quantity, _, unit = name.partition(" (")
    unit = unit.partition(")")[0]
    title, names = f"{quantity[:1].upper()}{quantity[1:]}", list(lines)
    table = np.array([[e.value for e in line] for line in lines.values()])
    known = np.isfinite(table)
    if not known.any():
        return title
    never = np.count_nonzero(~known)
    if condition and len(lines) == 1:
        missing = f", never at {never} of {len(values)} values" if never else ""
        return f"{title}: {table[known].min():.3g} to {table[known].max():.3g} {unit}{missing}"
    sign, best = (-1, "Largest") if "(%)" in name else (1, "Smallest")
    order = np.where(known, sign * table, np.inf)
    if not condition:
        line, place = np.unravel_index(np.argmin(order), table.shape)
        words = describe_axis_point({key: values[int(place)]})
        words += f", {names[line]}" if len(lines) > 1 else ""
        return f"{best} {quantity}: {words} ({table[line, place]:.3g} {unit})"
    counts = known.sum(axis=1)
    means = np.where(known, table, 0.0).sum(axis=1) / np.maximum(counts, 1)
    line, second = np.lexsort((sign * means, -counts))[:2]
    if counts[line] == counts[second] and abs(means[line] / means[second] - 1) < _CLEAR:
        return f"{title}: no line is clearly the best"
    missing = "" if known[line].all() else f", at {counts[line]} of {len(values)} values"
    return f"{best} {quantity}: {names[line]} ({means[line]:.3g} {unit} on average{missing})"


def _values_and_bars(estimates: Sequence[Estimate]) -> tuple[NDArray, NDArray]:
    """(n,) finite values, others NaN, and the lengths (2, n) of their bars down and up."""
    value, low, high = np.array([e[:3] for e in estimates], dtype=float).T
    value[~np.isfinite(value)] = np.nan
    spread = np.nan_to_num([value - low, high - value], posinf=0.0, neginf=0.0)
    return value, np.maximum(spread, 0.0)


def _clip_axis_to_typical_bars(axes: Axes, estimates: Sequence[Estimate]) -> None:
    """Let a bar that is far longer than the others leave the panel, instead of squashing it."""
    value, bars = _values_and_bars(estimates)
    known = np.isfinite(value)
    value, bars = value[known], bars[:, known]
    if not bars.any():
        return
    room = max(_LONG * np.median(bars[bars > 0]), np.ptp(value) / 2)
    if (bars > room).any():
        down, up = np.minimum(bars, room)
        ends = [*(value - down), *(value + up)]
        margin = 0.05 * np.ptp(ends)
        axes.set_ylim(min(ends) - margin, max(ends) + margin)


def is_informative(panel: Mapping[str, Sequence[Estimate]]) -> bool:
    """Return whether a panel of `draw_along_axis` has anything but *never*, unknown and zeros."""
    return any(e.value and np.isfinite(e.value) for line in panel.values() for e in line)


def cumulative_distribution_steps(values: NDArray) -> tuple[NDArray, NDArray]:
    """The cumulative distribution of some values as points of a step function.

    Args:
        values: (n,) values; non-finite ones count but have no position.

    Returns:
        Ascending positions and the share of the values up to each, thinned out for many values
        without a visible change.
    """
    known = np.sort(values[np.isfinite(values)])
    if known.size == 0:
        return known, known
    ranks = np.arange(known.size + 1)
    if known.size > _MOST_STEPS:
        ranks = np.unique(np.linspace(0, known.size, _MOST_STEPS).round().astype(int))
    return known[np.maximum(ranks - 1, 0)], ranks / values.size
