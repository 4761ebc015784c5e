"""Statistics over the draws along one swept key: `sinsjax.plot_compare`."""

import math
from collections.abc import Mapping, Sequence
from itertools import islice
from textwrap import fill
from typing import Any

import numpy as np
import pyarrow as pa
from matplotlib.figure import Figure

from sinsjax.analysis import Estimate, group_rows, summarise
from sinsjax.analysis.summaries import read_estimate
from sinsjax.analysis.tables import to_arrow_table, to_key_list
from sinsjax.plots.labels import axis_label, describe_axis_point, describe_point, format_value
from sinsjax.plots.style import (
    GREY,
    LETTERS,
    add_legend_below,
    line_colour,
    set_log_scale,
    with_style,
)

MAX_LINES = 7
"""Lines of a figure at most."""

Panel = Mapping[str, Sequence[Estimate]]
"""Estimates of a panel by the label of the line, one per value of the key."""

_MARKS = "os^Dv*P"
_DODGE = 0.008  # share of the axis by which the marks of two lines are offset to remain visible
_WIDE = 12  # letters of a label that does not fit next to others
_SIMILAR = 0.1  # of a panel's largest value: a panel that differs by less is left out
_RANGE = 30.0  # largest over smallest value, beyond which an axis is logarithmic
_NO_ESTIMATE = Estimate(math.nan, math.nan, math.nan, 0)


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
        key: key along the horizontal axis: numbers, or words and lists, which stand side by side.
        by: key or keys of the lines; runs that differ in other keys share a line.
        statistics: statistics of `sinsjax.summarise` and the title of the panel of each, with its
            unit (shares become percent); by default the median settling times, the shares of
            success and the rms of the heading error at the end that the columns allow.
        condition: whether the key is a condition of the runs such as the initial heading error, of
            which no value is the best.
        title: title of the figure; by default it names the best value, or the range of a condition.

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
    values, panels = build_comparison_panels(runs, key, to_key_list(by), statistics)
    return draw_along_axis(key, values, panels, title=title, condition=condition)


def build_comparison_panels(
    runs: Any, key: str, by: Sequence[str], statistics: Mapping[str, str] | None = None
) -> tuple[list[Any], dict[str, Panel]]:
    """The values of a key and the panels of `plot_compare`, with the same arguments."""
    table = to_arrow_table(runs)
    titles = _default_statistics(table) if statistics is None else dict(statistics)
    rows_by_line = {
        describe_point(point): summarise(rows, [key], list(titles)).to_pylist()
        for point, rows in islice(group_rows(table, by), MAX_LINES)
    }
    values: list[Any] = []
    for rows in sorted(rows_by_line.values(), key=lambda rows: -len(rows)):
        values += [row[key] for row in rows if row[key] not in values]
    panels: dict[str, Panel] = {}
    for statistic, words in titles.items():
        lines = {}
        for name, rows in rows_by_line.items():
            at = {values.index(row[key]): _read_estimate(row, statistic) for row in rows}
            # A schedule by the law of resets has other times at each value: a line for each.
            lines[name] = [at.get(place, _NO_ESTIMATE) for place in range(len(values))]
        panels[words] = lines
    return values, _select_informative(panels) or dict(list(panels.items())[-1:])


def has_significant_effect(panels: Mapping[str, Panel]) -> bool:
    """Return whether the key of some panels has an effect: two values of a line differ clearly.

    Bars of twice the length are compared, since there are many pairs of values.
    """
    for line in (line for panel in panels.values() for line in panel.values()):
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


def _select_informative(panels: Mapping[str, Panel]) -> dict[str, Panel]:
    """The panels that show something that no earlier one of the same unit does."""
    found: dict[str, Panel] = {}
    seen: list[tuple[str, np.ndarray, float]] = []
    for name, panel in panels.items():
        values, unit = _values(panel), name.partition("(")[2].partition(")")[0]
        reach = _SIMILAR * float(np.abs(values[np.isfinite(values)]).max(initial=0.0))
        repeated = any(
            unit == other and np.allclose(values, before, rtol=0.0, atol=least, equal_nan=True)
            for other, before, least in seen
        )
        if reach > 0 and not repeated and not (unit == "%" and np.ptp(values) == 0):
            found[name] = panel
            seen.append((unit, values, reach))
    return found


def _values(panel: Panel) -> np.ndarray:
    """The values of a panel, (lines, values of the key)."""
    return np.array([[estimate.value for estimate in line] for line in panel.values()])


@with_style
def draw_along_axis(
    key: str,
    values: Sequence[Any],
    panels: Mapping[str, Panel],
    *,
    title: str = "",
    condition: bool = False,
) -> Figure:
    """Draw estimates with their 95 % intervals along one swept key.

    Args:
        key: leaf key, with the unit in its name.
        values: values of the key; words and lists are placed side by side.
        panels: by quantity, with its unit; infinite estimates are marked at the upper edge as
            *never*.
        title: title of the figure; by default it names the best of the first panel.
        condition: whether the key is a condition, see `plot_compare`.
    """
    figure = Figure(figsize=(9.2, 1.2 + 2.2 * len(panels)))
    title = title or _best_value_title(key, values, panels, condition=condition)
    figure.suptitle(fill(title, int(LETTERS * figure.get_figwidth())))
    grid = figure.subplots(len(panels), 1, sharex=True, squeeze=False)[:, 0]
    numeric = all(isinstance(v, int | float) and not isinstance(v, bool) for v in values)
    x = np.asarray(values, dtype=float) if numeric else np.arange(len(values))
    for axes, (name, lines) in zip(grid, panels.items(), strict=True):
        _draw_panel(axes, lines, x, "-" if numeric else "")
        axes.set_title(name, loc="left", size="medium")
        if "(%)" in name:
            axes.set_ylim(-4, 104)
    if not numeric:  # such values have no distance
        words = [format_value(value) for value in values]
        turned = {"rotation": 20, "ha": "right"} if max(map(len, words)) > _WIDE else {}
        grid[-1].set_xticks(x, words, **turned)
    elif np.diff(np.sort(x)).min(initial=np.inf) > 0.06 * np.ptp(x):
        grid[-1].set_xticks(x, [f"{value:g}" for value in x])
    grid[-1].set_xlabel(axis_label(key))
    if any(np.isposinf(_values(panel)).any() for panel in panels.values()):
        grid[0].plot([], [], "x", color=GREY, label="never (median)")
    add_legend_below(figure, grid[0])
    return figure


def _draw_panel(axes: Any, lines: Panel, x: np.ndarray, joined: str) -> None:
    """Draw the lines of a panel."""
    estimates = np.array([[e[:3] for e in line] for line in lines.values()], dtype=float)
    value = np.where(np.isfinite(estimates[..., 0]), estimates[..., 0], np.nan)
    ends = np.stack([value - estimates[..., 1], estimates[..., 2] - value])
    bars = np.maximum(np.nan_to_num(ends, posinf=0.0, neginf=0.0), 0.0)
    known = value[np.isfinite(value)]
    if known.size and known.min() > 0 and known.max() > _RANGE * known.min():
        set_log_scale(axes.yaxis, float(known.min()), float(known.max()))
    for i, line in enumerate(lines):
        shifted = x + _DODGE * np.ptp(x) * (i - (len(lines) - 1) / 2)
        style = {"color": line_colour(i), "label": line, "capsize": 2.5, "markersize": 5}
        mark = _MARKS[i % len(_MARKS)] + joined
        axes.errorbar(shifted, value[i], yerr=bars[:, i], fmt=mark, **style)
        never = shifted[np.isposinf(estimates[i, :, 0])]
        if never.size:  # at the upper edge
            at = {"transform": axes.get_xaxis_transform()}
            axes.plot(never, np.full(never.size, 0.97), "x", color=line_colour(i), **at)
    if not known.size:
        axes.set_yticks([])


def _best_value_title(
    key: str, values: Sequence[Any], panels: Mapping[str, Panel], *, condition: bool
) -> str:
    """Return a title that names the best value, or the range, of the first panel."""
    name, lines = next(iter(panels.items()))
    quantity, _, unit = name.partition(" (")
    unit = unit.partition(")")[0]
    title, names, table = f"{quantity[:1].upper()}{quantity[1:]}", list(lines), _values(lines)
    known = np.isfinite(table)
    if not known.any():
        return title
    if condition:
        return f"{title}: {table[known].min():.3g} to {table[known].max():.3g} {unit}"
    sign, best = (-1, "Largest") if unit == "%" else (1, "Smallest")
    line, place = np.unravel_index(np.argmin(np.where(known, sign * table, np.inf)), table.shape)
    words = describe_axis_point({key: values[int(place)]})
    words += f", {names[line]}" if len(lines) > 1 else ""
    return f"{best} {quantity}: {words} ({table[line, place]:.3g} {unit})"
