"""Figures of curves over time: heading error, level errors, and attitude."""

import math
from collections.abc import Iterable, Mapping, Sequence
from itertools import islice
from textwrap import fill
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from sinsjax.analysis.tables import (
    group_rows,
    numeric_column,
    require_column,
    to_arrow_table,
    to_key_list,
)
from sinsjax.errors import InputError
from sinsjax.plots.labels import describe_point
from sinsjax.plots.style import GREY, add_legend_below, line_colour, set_log_scale, with_style

MAX_LINES = 6
"""Lines of a figure at most."""

BAND = (0.025, 0.975)
"""Quantiles over the draws at the edges of a band."""

_MOST_DRAWS = 256  # in a line's band
_MOST_MOMENTS = 8  # reset times that are marked
_STACKED = 3  # panels at most in a single column
_LETTERS = {1: 60, 2: 26}  # of a line of a panel's title, by the number of columns
_LEAST_FLOOR = 0.01  # arcmin; a smaller bias floor is not drawn
_DIPS = 0.01  # quantile of the errors below which an axis of magnitudes ends
_SPIKES = (0.05, 0.95)  # quantiles over time of a band of 1 sigma that an axis covers
_FAINT = 0.22  # opacity of a band
_WIDE = 12.0  # times the end of a line; beyond it a linear axis would hide that end
_LEVEL_NAMES = {"e": "level error,\neast (arcmin)", "n": "level error,\nnorth (arcmin)"}
_ANGLES = {"pitch": "e", "roll": "n", "yaw": "u"}


class Ensemble(NamedTuple):
    """Curves of several runs, drawn as one line with its band.

    Attributes:
        label: label in the legend.
        time_s: (T,) record times, s.
        columns: column name to values, (runs, T).
    """

    label: str
    time_s: NDArray
    columns: Mapping[str, NDArray]


class Line(NamedTuple):
    """One line of a figure.

    Attributes:
        label: label in the legend.
        time_s: (T,) times, s.
        values: (runs, T) values.
        colour: colour of the line and its band.
        style: matplotlib line style.
    """

    label: str
    time_s: NDArray
    values: NDArray
    colour: str
    style: str = "-"


def group_curves(curves: pa.Table, runs_by_line: Mapping[str, Iterable[int]]) -> list[Ensemble]:
    """Arrange curves by run and record time.

    Args:
        curves: one row per run and record time, ordered by run_id and time.
        runs_by_line: label to the runs of a line.
    """
    grouped = []
    for name, run_ids in runs_by_line.items():
        rows = curves.filter(pc.field("run_id").isin(sorted(run_ids)))
        count = pc.count_distinct(rows["run_id"]).as_py()
        columns = {
            column: rows[column].cast(pa.float64()).to_numpy().reshape(count, -1)
            for column in rows.column_names
            if column != "run_id"
        }
        grouped.append(Ensemble(name, columns.pop("time_s")[0], columns))
    return grouped


def draw_mean_and_band(axes: Axes, line: Line) -> None:
    """Draw a line's mean over the runs and the band that contains 95 % of them.

    Args:
        axes: axes to draw on.
        line: line to draw; times at which a run has no value are omitted.
    """
    known = np.isfinite(line.values).all(axis=0)
    time, values = line.time_s[known], line.values[:, known]
    axes.plot(time, values.mean(axis=0), line.style, color=line.colour, label=line.label)
    if len(values) > 1 and known.any():
        low, high = np.quantile(values, BAND, axis=0)
        axes.fill_between(time, low, high, color=line.colour, alpha=_FAINT, linewidth=0)


def plot_curves(
    curves: Any,
    runs: Any = None,
    *,
    by: str | Sequence[str] = (),
    title: str = "",
    level: bool = False,
) -> Figure:
    """Draw the heading error over time, the level errors, or the attitude of runs without a truth.

    Heading errors have a panel for each line, with a logarithmic axis: rms over the runs, the band
    of 95 % of them and the filter's own 1 sigma. Level errors are drawn about zero: mean and band
    of each line, dashed the filter's own 1 sigma; so are those of runs that all have no heading.
    Only the first 6 lines and the first 256 runs of a line are drawn.

    Args:
        curves: one row per run and record time, ordered by run and time, with ``run_id``,
            ``time_s`` and the columns of `Results.curves` (arcmin, and deg for the attitude): a
            pyarrow Table or a pandas data frame.
        runs: the runs to draw, one row each, such as `Results.summary`, with the keys of ``by``;
            reset times and a bias floor in it are marked. None draws every run as its own line.
        by: key or keys of the lines; without keys all runs make one.
        title: title of the figure; by default it states the heading error at the end.
        level: whether to draw the level errors.

    Raises:
        InputError: no table, a missing column, or no curves of these runs.

    Examples:
        >>> import pyarrow as pa
        >>> phi = {f"phi_{axis}_arcmin": [30.0, 2.0] for axis in "enu"}
        >>> curves = pa.table({"run_id": [0, 0], "time_s": [1.0, 2.0], **phi})
        >>> sinsjax.plot_curves(curves).get_suptitle()
        'Heading error after 2 s: 2 arcmin'
    """
    table = to_arrow_table(curves)
    errors = [f"phi_{axis}_arcmin" for axis in "enu" if f"phi_{axis}_arcmin" in table.column_names]
    has_truth = any(np.isfinite(numeric_column(table, name)).any() for name in errors)
    attitude = [f"{angle}_deg" for angle in _ANGLES] + [f"sigma_{a}_arcmin" for a in "enu"]
    for name in ("run_id", "time_s", *(errors if has_truth else attitude)):
        require_column(table, name)
    every = table["run_id"].unique()
    summary = pa.table({"run_id": every}) if runs is None else to_arrow_table(runs)
    lines = select_runs_by_line(summary, ["run_id"] if runs is None else to_key_list(by))
    run_ids = {*every.to_pylist()}
    lines = {name: ids for name, ids in lines.items() if run_ids.intersection(ids)}
    if not lines:
        raise InputError("plot_curves: there are no curves of these runs")
    ensembles = group_curves(table, lines)
    if not has_truth:
        return draw_attitude(ensembles, title or _attitude_title(ensembles))
    rows = {
        name: summary.filter(pc.is_in(summary["run_id"], pa.array(ids)))
        for name, ids in lines.items()
    }
    if level or not _has_values(ensembles, "phi_u_arcmin"):
        resets_s = _reset_times_to_mark(pa.concat_tables(rows.values()))
        return draw_level_errors(ensembles, title or _error_title(ensembles, "en"), resets_s)
    return draw_heading_errors(
        ensembles,
        title or _error_title(ensembles, "u"),
        floors={name: _bias_floor_rms(found) for name, found in rows.items()},
        resets_s={name: _reset_times_to_mark(found) for name, found in rows.items()},
    )


def select_runs_by_line(summary: pa.Table, by: Sequence[str]) -> dict[str, list[int]]:
    """The runs of each line that `plot_curves` draws, by its name.

    Args:
        summary: one row per run, with ``run_id`` and the keys.
        by: keys of the lines.
    """
    keys = dict.fromkeys(["run_id", *by])
    lines = islice(group_rows(summary.select(list(keys)), by), MAX_LINES)
    return {
        describe_point(key): rows["run_id"].slice(0, _MOST_DRAWS).to_pylist() for key, rows in lines
    }


def _bias_floor_rms(summary: pa.Table) -> float:
    """The rms bias floor of the runs that have one, arcmin; NaN if none does."""
    if "floor_arcmin" not in summary.column_names:
        return math.nan
    floors = numeric_column(summary, "floor_arcmin")
    return float(_rms(floors[np.isfinite(floors)])) if np.isfinite(floors).any() else math.nan


def _reset_times_to_mark(summary: pa.Table) -> list[float]:
    """The reset times of the runs in ascending order, s; none if there are too many to mark."""
    if "reset_times_s" not in summary.column_names:
        return []
    moments = {time for times in summary["reset_times_s"].to_pylist() for time in times or ()}
    return sorted(moments) if len(moments) <= _MOST_MOMENTS else []


def _attitude_title(ensembles: Sequence[Ensemble]) -> str:
    """The yaw at the end of each line that has one, in words."""
    last = [float(ensemble.columns["yaw_deg"][:, -1].mean()) for ensemble in ensembles]
    last = [yaw for yaw in last if np.isfinite(yaw)]
    if not last:
        return f"Pitch and roll over {ensembles[0].time_s[-1]:g} s"
    ends = dict.fromkeys(f"{yaw:.2f}" for yaw in (min(last), max(last)))
    return f"Yaw after {ensembles[0].time_s[-1]:g} s: {' to '.join(ends)} deg"


def _error_title(ensembles: Sequence[Ensemble], axes: str) -> str:
    """The error at the end of each line about one or two axes, in words."""
    last = [e.columns[f"phi_{axis}_arcmin"][:, -1] for e in ensembles for axis in axes]
    errors = [float(_rms(values)) for values in last if np.isfinite(values).all()]
    if not errors:
        return "Misalignment"
    end = max(float(e.time_s[-1]) for e in ensembles)
    ends = dict.fromkeys(f"{error:.3g}" for error in (min(errors), max(errors)))
    rms = ", rms" if max(map(len, last)) > 1 else ""
    name = "Heading error" if axes == "u" else "Level errors"
    return f"{name} after {end:g} s: {' to '.join(ends)} arcmin{rms}"


def _rms(values: NDArray) -> NDArray:
    """The root mean square over the runs, the first axis."""
    return np.asarray(np.sqrt(np.mean(values**2, axis=0)))


def _has_values(ensembles: Sequence[Ensemble], column: str) -> bool:
    return any(np.isfinite(ensemble.columns[column]).any() for ensemble in ensembles)


def _name_band(axes: Axes) -> None:
    """Name the bands of some axes in their legend."""
    axes.fill_between([], [], color=GREY, alpha=_FAINT, linewidth=0, label="95 % of the runs")


def _mark_resets(axes: Axes, times_s: Sequence[float]) -> None:
    for i, time in enumerate(times_s):
        name = "reset" if i == 0 else None
        axes.axvline(time, color=GREY, linestyle=":", linewidth=1.1, label=name)


@with_style
def draw_heading_errors(
    ensembles: Sequence[Ensemble],
    title: str,
    *,
    floors: Mapping[str, float],
    resets_s: Mapping[str, Sequence[float]],
) -> Figure:
    """Draw the magnitude of the heading error next to the filter's 1 sigma, one panel per line.

    Each is the rms over the runs, on a logarithmic axis that all panels share; shaded: the
    magnitudes of 95 % of the runs. Lines without a heading are left out.

    Args:
        ensembles: the lines, with ``phi_u_arcmin``, and ``sigma_u_arcmin`` if it is known.
        title: title of the figure.
        floors: magnitude of the bias floor by line, arcmin; NaN for none.
        resets_s: reset times by line, s.
    """
    shown = [e for e in ensembles if np.isfinite(e.columns["phi_u_arcmin"]).any()]
    width = 1 if len(shown) <= _STACKED else 2
    height = -(-len(shown) // width)
    figure = Figure(figsize=(9.2, 1.4 + (2.6 if len(shown) > 1 else 4.0) * height))
    figure.suptitle(title)
    grid = figure.subplots(height, width, sharex=True, sharey=True, squeeze=False)
    panels = list(grid.flat)[: len(shown)]
    values = []
    for number, (axes, ensemble) in enumerate(zip(panels, shown, strict=True)):
        values += _draw_heading_error(axes, ensemble, line_colour(number))
        _mark_resets(axes, resets_s[ensemble.label])
        if (floor := floors[ensemble.label]) > _LEAST_FLOOR:
            axes.axhline(floor, color=GREY, linestyle="-.", linewidth=1.2, label="bias floor")
            values.append(np.array([floor]))
        axes.set_title(fill(ensemble.label, _LETTERS[width]))
    found = np.concatenate(values)
    low = float(np.quantile(found[found > 0], _DIPS)) if (found > 0).any() else 1.0
    low, high = 0.5 * low, 1.5 * max(float(found.max()), low)
    set_log_scale(panels[0], low, high)
    panels[0].set(xlim=(0, max(e.time_s[-1] for e in shown)), ylim=(low, high))
    for axes in list(grid.flat)[len(shown) :]:
        axes.set_visible(False)
    for axes in grid[:, 0]:
        axes.set_ylabel("|heading error|\n(arcmin)")
    for axes in panels[-width:]:
        axes.set_xlabel("time (s)")
        axes.tick_params(labelbottom=True)
    add_legend_below(figure, max(panels, key=lambda axes: len(axes.get_legend_handles_labels()[1])))
    return figure


def _draw_heading_error(axes: Axes, ensemble: Ensemble, colour: str) -> list[NDArray]:
    """Draw the heading error of a line and the filter's 1 sigma; return the rms of both, (T,)."""
    found = []
    for name, column, shade, style in (
        ("heading error", "phi_u_arcmin", colour, "-"),
        ("filter's 1 sigma", "sigma_u_arcmin", "black", "--"),
    ):
        values = np.abs(ensemble.columns.get(column, np.full((1, ensemble.time_s.size), np.nan)))
        known = np.isfinite(values).all(axis=0)
        if not known.any():
            continue  # a method without a covariance
        time, values = ensemble.time_s[known], values[:, known]
        if column == "phi_u_arcmin" and len(values) > 1:
            low, high = np.quantile(values, BAND, axis=0)
            axes.fill_between(time, low, high, color=colour, alpha=_FAINT, linewidth=0)
            _name_band(axes)
        found.append(_rms(values))
        axes.plot(time, found[-1], style, color=shade, label=name)
    return found


@with_style
def draw_level_errors(
    ensembles: Sequence[Ensemble], title: str, resets_s: Sequence[float] = ()
) -> Figure:
    """Draw the errors about east and north over time, dashed the filter's own 1 sigma.

    Args:
        ensembles: one line each, with the columns of phi, and of sigma if it is known.
        title: title of the figure.
        resets_s: dotted lines at reset times, s.
    """
    figure = Figure(figsize=(9.2, 5.6))
    figure.suptitle(title)
    panels = figure.subplots(2, 1, sharex=True)
    for axes, (axis, name) in zip(panels, _LEVEL_NAMES.items(), strict=True):
        top, end = 0.0, math.inf
        for i, ensemble in enumerate(ensembles):
            values = ensemble.columns[f"phi_{axis}_arcmin"]
            draw_mean_and_band(axes, Line(ensemble.label, ensemble.time_s, values, line_colour(i)))
            top = max(top, float(np.nanmax(np.abs(values), initial=0.0)))
            end = min(end, float(np.abs(values[:, -1]).max()))
            sigma = ensemble.columns.get(f"sigma_{axis}_arcmin", np.full((1, 1), np.nan))
            sigma = sigma.mean(axis=0)
            top = max(top, float(np.nanmax(sigma, initial=0.0)))
            for side in (sigma, -sigma) if np.isfinite(sigma).any() else ():
                style: Any = {"color": line_colour(i), "linewidth": 0.9, "alpha": 0.8}
                axes.plot(ensemble.time_s, side, "--", **style)
        if any(e.columns[f"phi_{axis}_arcmin"].shape[0] > 1 for e in ensembles):
            _name_band(axes)
        if any(line.get_linestyle() == "--" for line in axes.get_lines()):
            axes.plot([], [], "--", color=GREY, linewidth=0.9, label="±1 sigma of the filter")
        _mark_resets(axes, resets_s)
        if top > _WIDE * max(end, 0.1):  # a linear axis would hide the end
            axes.set_yscale("symlog", linthresh=10.0 ** np.ceil(np.log10(max(end, 0.1))))
            axes.yaxis.set_major_formatter("{x:g}")
        axes.set_ylabel(name)
    panels[-1].set(xlabel="time (s)", xlim=(0, max(e.time_s[-1] for e in ensembles)))
    add_legend_below(figure, panels[-1])
    return figure


@with_style
def draw_attitude(ensembles: Sequence[Ensemble], title: str) -> Figure:
    """Pitch, roll and yaw with the filter's 1 sigma shaded, for runs without a truth.

    Args:
        ensembles: one line each: the mean over its runs, and their mean sigma.
        title: title of the figure.
    """
    angles = [angle for angle in _ANGLES if _has_values(ensembles, f"{angle}_deg")]
    figure = Figure(figsize=(9.2, 7.2 * len(angles) / 3))
    figure.suptitle(title)
    panels = figure.subplots(len(angles), 1, sharex=True, squeeze=False)[:, 0]
    for axes, angle in zip(panels, angles, strict=True):
        edges = []
        for i, ensemble in enumerate(ensembles):
            values = ensemble.columns[f"{angle}_deg"].mean(axis=0)
            sigma = ensemble.columns[f"sigma_{_ANGLES[angle]}_arcmin"].mean(axis=0) / 60
            axes.plot(ensemble.time_s, values, color=line_colour(i), label=ensemble.label)
            low, high = values - sigma, values + sigma
            axes.fill_between(
                ensemble.time_s, low, high, color=line_colour(i), alpha=0.18, linewidth=0
            )
            edges.append(values)
            if (there := np.isfinite(sigma)).any():
                edges += [np.quantile(edge[there], _SPIKES) for edge in (low, high)]
        known = np.concatenate(edges)
        known = known[np.isfinite(known)]
        if known.size:  # without the spikes of sigma at resets, which would flatten the rest
            margin = 0.05 * max(float(np.ptp(known)), 0.01)
            axes.set_ylim(known.min() - margin, known.max() + margin)
        axes.set_ylabel(f"{angle} (deg)")
    panels[-1].set_xlabel("time (s)")
    add_legend_below(figure, panels[0])
    return figure
