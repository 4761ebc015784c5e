"""Figures of curves over time: heading error, level errors, and attitude."""

import math
from collections.abc import Iterable, Mapping, Sequence
from itertools import islice, product
from textwrap import fill
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from sinsjax.analysis.labels import axis_label, describe_point
from sinsjax.analysis.tables import (
    group_rows,
    numeric_column,
    require_column,
    to_arrow_table,
    to_key_list,
)
from sinsjax.errors import InputError
from sinsjax.plots.style import (
    GREY,
    add_legend_below,
    add_title,
    line_colour,
    set_log_scale,
    with_style,
)

MAX_LINES = 6  # of a figure
_BAND = (0.025, 0.975)  # quantiles over the draws at its edges
_MOST_DRAWS = 256  # in a line's band
_MOST_MOMENTS = 8  # reset times that are marked
_LETTERS = {1: 64, 2: 34}  # of a line of a panel's title, by the number of columns
_LEAST_FLOOR = 0.01  # arcmin; a smaller bias floor is not drawn
_DIPS = 0.01  # quantile of the errors below which an axis of magnitudes ends
_SPIKES = (0.05, 0.95)  # quantiles over time of a band of 1 sigma that an axis covers
_HEADING, _LEVEL = {"phi_u_arcmin": ""}, {"phi_e_arcmin": "east", "phi_n_arcmin": "north"}
_SIGMAS = {
    "pitch_deg": "sigma_e_arcmin",
    "roll_deg": "sigma_n_arcmin",
    "yaw_deg": "sigma_u_arcmin",
}


class Ensemble(NamedTuple):
    """Curves of several runs, drawn as one line with its band: (T,) times, (runs, T) by column.

    The bias floor is the rms of the runs that have one; reset times are marked.
    """

    label: str
    time_s: NDArray
    columns: Mapping[str, NDArray]
    floor_arcmin: float = math.nan
    resets_s: Sequence[float] = ()

    def column(self, name: str) -> NDArray:
        """Return a column, (runs, T); NaN if there is none."""
        return self.columns.get(name, np.full((1, len(self.time_s)), np.nan))


def group_curves(curves: pa.Table, runs_by_line: Mapping[str, Iterable[int]]) -> list[Ensemble]:
    """Arrange curves, ordered by run_id and time, by the runs of each line."""
    grouped = []
    for name, run_ids in runs_by_line.items():
        rows = curves.filter(pc.field("run_id").isin(sorted(run_ids)))
        count = pc.count_distinct(rows["run_id"]).as_py()
        names = [column for column in rows.column_names if column != "run_id"]
        columns = {column: numeric_column(rows, column).reshape(count, -1) for column in names}
        grouped.append(Ensemble(name, columns.pop("time_s")[0], columns))
    return grouped


def select_runs_by_line(summary: pa.Table, by: Sequence[str]) -> dict[str, list[int]]:
    """Return the runs of each line that `plot_curves` draws, by its name, of a summary."""
    keys = list(dict.fromkeys(["run_id", *by]))
    columns = pa.table([require_column(summary, key) for key in keys], names=keys)
    lines = islice(group_rows(columns, by), MAX_LINES)
    return {
        describe_point(key): rows["run_id"].slice(0, _MOST_DRAWS).to_pylist() for key, rows in lines
    }


def draw_mean_and_95_percent_band(
    axes: Axes, label: str, time_s: NDArray, values: NDArray, colour: str
) -> None:
    """Draw the mean over some runs, (runs, T), and the band that contains 95 % of them.

    Times at which a run has no value are omitted.
    """
    known = np.isfinite(values).all(axis=0)
    axes.plot(time_s[known], values[:, known].mean(axis=0), color=colour, label=label)
    _draw_band(axes, time_s, values, colour)


def _draw_band(axes: Axes, time_s: NDArray, values: NDArray, colour: str, label: str = "") -> None:
    """Shade the band that contains 95 % of several runs, (runs, T)."""
    known = np.isfinite(values).all(axis=0)
    if len(values) > 1 and known.any():
        edges = np.quantile(values[:, known], _BAND, axis=0)
        style: Any = {"color": colour, "label": label or None, "alpha": 0.22, "linewidth": 0}
        axes.fill_between(time_s[known], *edges, **style)


def plot_curves(
    curves: Any,
    runs: Any = None,
    *,
    by: str | Sequence[str] = (),
    title: str = "",
    level: bool = False,
) -> Figure:
    """Draw the heading error over time, the level errors, or the attitude of runs without a truth.

    Errors have a panel for each line, with a logarithmic axis: rms over the runs, the band of 95 %
    of them and the filter's own 1 sigma. Level errors are those of runs that all have no heading,
    too. The attitude is drawn as mean and band of each line, dashed the filter's own 1 sigma about
    it. Only the first 6 lines and the first 256 runs of a line are drawn.

    Args:
        curves: one row per run and record time, ordered by run and time, with ``run_id``,
            ``time_s`` and the columns of `Results.curves` (arcmin, and deg for the attitude): a
            pyarrow Table or a pandas data frame.
        runs: the runs to draw, one row each, such as `Results.summary`, with the keys of ``by``;
            reset times and a bias floor in it are marked. None draws every run as its own line.
        by: key or keys of the lines; without keys all runs make one.
        title: title of the figure; by default what is drawn.
        level: whether to draw the level errors.

    Raises:
        InputError: no table, a missing column, or no curves of these runs.

    Examples:
        >>> import pyarrow as pa
        >>> phi = {f"phi_{axis}_arcmin": [30.0, 2.0] for axis in "enu"}
        >>> curves = pa.table({"run_id": [0, 0], "time_s": [1.0, 2.0], **phi})
        >>> sinsjax.plot_curves(curves).get_suptitle()
        'Heading error'
    """
    table = to_arrow_table(curves)
    errors = [name for name in (*_LEVEL, *_HEADING) if name in table.column_names]
    known = [name for name in errors if np.isfinite(numeric_column(table, name)).any()]
    for name in ("run_id", "time_s", *(errors if known else (*_SIGMAS, *_SIGMAS.values()))):
        require_column(table, name)
    every = table["run_id"].unique()
    summary = pa.table({"run_id": every}) if runs is None else to_arrow_table(runs)
    lines = select_runs_by_line(summary, ["run_id"] if runs is None else to_key_list(by))
    run_ids = {*every.to_pylist()}
    lines = {name: ids for name, ids in lines.items() if run_ids.intersection(ids)}
    if not lines:
        raise InputError("plot_curves: there are no curves of these runs")
    ensembles = [
        _with_rms_floor_and_resets(one, summary.filter(pc.field("run_id").isin(lines[one.label])))
        for one in group_curves(table, lines)
    ]
    if not known:
        return _draw_estimated_attitude(ensembles, title or "Attitude")
    has_heading = any(np.isfinite(e.column("phi_u_arcmin")).any() for e in ensembles)
    if level or not has_heading:
        return _draw_rms_and_sigma(ensembles, _LEVEL, "level error", title)
    return _draw_rms_and_sigma(ensembles, _HEADING, "heading error", title)


def _with_rms_floor_and_resets(ensemble: Ensemble, rows: pa.Table) -> Ensemble:
    """Return a line with the bias floor and the reset times of its runs, if they are known."""
    floor, resets = math.nan, set()
    if "floor_arcmin" in rows.column_names:
        floors = numeric_column(rows, "floor_arcmin")
        if np.isfinite(floors).any():
            floor = float(_rms(floors[np.isfinite(floors)]))
    if "reset_times_s" in rows.column_names:
        resets = {time for times in rows["reset_times_s"].to_pylist() for time in times or ()}
    shown = sorted(resets) if len(resets) <= _MOST_MOMENTS else []
    return ensemble._replace(floor_arcmin=floor, resets_s=shown)


def _rms(values: NDArray) -> NDArray:
    """The root mean square over the runs, the first axis."""
    return np.asarray(np.sqrt(np.mean(values**2, axis=0)))


def _mark_resets(axes: Axes, times_s: Iterable[float]) -> None:
    for i, time in enumerate(times_s):
        name = "reset" if i == 0 else None
        axes.axvline(time, color=GREY, linestyle=":", linewidth=1.1, label=name)


@with_style
def _draw_rms_and_sigma(
    ensembles: Sequence[Ensemble], columns: Mapping[str, str], name: str, title: str
) -> Figure:
    """Draw the rms of errors next to the filter's 1 sigma, a panel per line that has them."""
    shown = [e for e in ensembles if np.isfinite(e.column(next(iter(columns)))).any()]
    if not shown:
        raise InputError(f"plot_curves: no {name} of these runs is known")
    width = 2 if len(columns) > 1 or len(shown) > 3 else 1
    count = len(shown) * len(columns)
    height = -(-count // width)
    figure = Figure(figsize=(9.2, 1.4 + (2.6 if height > 1 else 4.0) * height))
    add_title(figure, title or name.capitalize())
    grid = figure.subplots(height, width, sharex=True, sharey=True, squeeze=False)
    panels, drawn = list(grid.flat)[:count], []
    for axes, (line, column) in zip(panels, product(enumerate(shown), columns), strict=True):
        number, ensemble = line
        drawn += _draw_rms_error_and_sigma(axes, ensemble, column, line_colour(number), name)
        label = ", ".join(filter(None, (ensemble.label, columns[column])))
        axes.set_title(fill(label, _LETTERS[width]))
    found = np.concatenate(drawn)
    low = float(np.quantile(found[found > 0], _DIPS)) if (found > 0).any() else 1.0
    low, high = 0.5 * low, 1.5 * max(float(found.max()), low)
    set_log_scale(panels[0].yaxis, low, high)
    panels[0].set(xlim=(0, max(e.time_s[-1] for e in shown)), ylim=(low, high))
    for axes in grid.flat[count:]:
        axes.set_visible(False)
    for axes in grid[:, 0]:
        axes.set_ylabel(f"|{name}|\n(arcmin)")
    for axes in panels[-width:]:
        axes.set_xlabel("time (s)")
        axes.tick_params(labelbottom=True)
    add_legend_below(figure, max(panels, key=lambda axes: len(axes.get_legend_handles_labels()[1])))
    return figure


def _draw_rms_error_and_sigma(
    axes: Axes, ensemble: Ensemble, column: str, colour: str, name: str
) -> list[NDArray]:
    """Draw the magnitude of an error, and return the values of all lines."""
    runs, drawn = ensemble.column(column), []
    _draw_band(axes, ensemble.time_s, np.abs(runs), colour, "95 % of the runs")
    sigma = ensemble.column(column.replace("phi", "sigma"))
    lines = ((name, runs, colour, "-"), ("filter's 1 sigma", sigma, "black", "--"))
    for label, values, line, style in lines:
        rms = _rms(values)
        if np.isfinite(rms).any():  # else a method without a covariance
            axes.plot(ensemble.time_s, rms, style, color=line, label=label)
            drawn.append(rms[np.isfinite(rms)])
    _mark_resets(axes, ensemble.resets_s)
    floor = ensemble.floor_arcmin
    if column in _HEADING and floor > _LEAST_FLOOR:
        axes.axhline(floor, color=GREY, linestyle="-.", linewidth=1.2, label="bias floor")
        drawn.append(np.array([floor]))
    return drawn


@with_style
def _draw_estimated_attitude(ensembles: Sequence[Ensemble], title: str) -> Figure:
    """Draw the mean attitude over time, a panel per angle, dashed the filter's own 1 sigma."""
    columns = [c for c in _SIGMAS if any(np.isfinite(e.column(c)).any() for e in ensembles)]
    figure = Figure(figsize=(9.2, 1.0 + 2.2 * len(columns)))
    add_title(figure, title)
    panels = figure.subplots(len(columns), 1, sharex=True, squeeze=False)[:, 0]
    for axes, column in zip(panels, columns, strict=True):
        covered = []
        for i, ensemble in enumerate(ensembles):
            time, values = ensemble.time_s, ensemble.column(column)
            draw_mean_and_95_percent_band(axes, ensemble.label, time, values, line_colour(i))
            middle, sigma = values.mean(axis=0), ensemble.column(_SIGMAS[column]).mean(axis=0) / 60
            for side in (sigma, -sigma) if np.isfinite(middle + sigma).any() else ():
                style: Any = {"color": line_colour(i), "linewidth": 0.9, "alpha": 0.8}
                axes.plot(time, middle + side, "--", **style)
                covered.append(np.nanquantile(middle + side, _SPIKES))  # not the spikes at resets
            covered.append(values[np.isfinite(values)])
        axes.plot([], [], "--", color=GREY, linewidth=0.9, label="±1 sigma of the filter")
        _mark_resets(axes, sorted({time for e in ensembles for time in e.resets_s}))
        known = np.concatenate(covered)
        margin = 0.05 * max(float(np.ptp(known)), 0.01)
        axes.set_ylim(known.min() - margin, known.max() + margin)
        axes.set_ylabel(axis_label(column))
    panels[-1].set(xlabel="time (s)", xlim=(0, max(e.time_s[-1] for e in ensembles)))
    add_legend_below(figure, panels[-1])
    return figure
