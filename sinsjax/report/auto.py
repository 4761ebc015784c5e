"""The report of any study: statistics of its variants, curves, and figures over its axes."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from sinsjax import analysis, plots
from sinsjax.analysis import Estimate, format_difference, format_estimate
from sinsjax.analysis.references import compare_with_first
from sinsjax.analysis.summaries import NEEDED, estimate_of
from sinsjax.analysis.words import heading, percent
from sinsjax.columns import report_columns
from sinsjax.execution.source import Source
from sinsjax.plots.curves import runs_of_lines
from sinsjax.plots.words import name_of
from sinsjax.report.attitudes import attitude_verdict, attitudes
from sinsjax.report.base import (
    ENOUGH_DRAWS,
    MOST_ROWS,
    Block,
    Picture,
    Report,
    Table,
    Text,
    intervals,
    table_of,
)
from sinsjax.report.groupings import BINS, binned
from sinsjax.report.markup import said
from sinsjax.report.over_axes import over_axes, repeats
from sinsjax.report.spreads import spreads
from sinsjax.report.verdict import verdict
from sinsjax.study.keys import is_condition_key
from sinsjax.study.success import success_columns, success_measures

_END = "phi_u_arcmin"


def report(source: Source, *, full: bool = True, warned: bool = False) -> Report:
    """The verdict and the figures of a study, and all tables if they are wanted.

    Args:
        source: the results.
        full: whether to compute the tables.
        warned: whether the user has seen the study's warnings.

    Raises:
        InputError: runs are missing.
    """
    assert source.draws  # of which none is missing, or that is reported
    yaw = analysis.numbers(source.rows(["phi_u_arcmin"]), "phi_u_arcmin")
    has_truth = bool(np.isfinite(yaw).any())
    blocks = [*over_axes(source), *spreads(source)] if has_truth else []
    parts: dict[str, Sequence[Block]] = {"Figures": [*_curves(source), *blocks]}
    needs_attitude = source.study.is_recorded or not has_truth
    if full:
        tables = [*repeats(source), *_tables(source)] if has_truth else []
        parts["Tables"] = [attitudes(source), *tables] if needs_attitude else tables
    found = attitude_verdict if needs_attitude else verdict
    return Report.of(found(source, warned=warned), parts)


def statistics(source: Source, keys: Sequence[str], title: str, *, note: str = "") -> Table:
    """The statistics of each group of runs, told apart by some keys, as a table."""
    shown = _shown(source)
    table = source.distinct_rows([*keys, *NEEDED, *success_columns(source.study)])
    rows = analysis.summarise(table, keys, [one.name for one in shown]).to_pylist()
    cells = [("runs", lambda row: str(row["n"])), *((one.header, one.cell) for one in shown)]
    return table_of(title, keys, rows, cells, note)


class _Shown(NamedTuple):
    """A statistic in a table: the header of its column, its name, and how it is told."""

    header: str
    name: str
    text: Callable[[Estimate], str]
    of_floor: bool = False  # whether it counts from the bias floor

    def cell(self, row: Mapping[str, Any]) -> str:
        """What a row of `analysis.summarise` tells of it."""
        if self.of_floor and row["no_floor"] == row["n"]:
            return "no bias floor"
        return self.text(estimate_of(row, self.name))


def _shown(source: Source) -> list[_Shown]:
    """How many runs succeed and how soon, from the truth and the bias floor; and the heading."""
    seconds, arcmin = (partial(format_estimate, digits=digits) for digits in (0, 1))
    yards = source.success_measures
    missing = [yard for yard in success_measures(source.study) if yard not in yards]
    aim = "the reference" if source.study.is_recorded else "its bias floor"
    return [
        *(_Shown(f"ok: {y.description} (%)", y.rate_column, percent, not y.truth) for y in yards),
        *(
            _Shown(f"ok: {y.description} (%)", y.rate_column, lambda _: "no bias floor")
            for y in missing
        ),
        *(
            _Shown(
                f"time to {y.description}, median (s)",
                f"{y.settle_column}_median",
                seconds,
                not y.truth,
            )
            for y in yards
        ),
        _Shown("heading error at the end, rms (arcmin)", f"{_END}_rms", heading),
        _Shown(f"signed mean from {aim} (arcmin)", "phi_u_from_floor_arcmin_mean", arcmin, True),
    ]


def heading_errors(source: Source, keys: Sequence[str], title: str) -> Table:
    """How far from the truth the headings are, at each report time and at the end."""
    times_s = source.study.study.report_times_s or ()
    times = {report_columns(time)[0].name: f"{time:g} s" for time in times_s} | {_END: "the end"}
    table = source.distinct_rows([*keys, *NEEDED, *times])
    cells = [
        ("runs", lambda row: str(row["n"])),
        ("at", lambda row: row["at"]),
        ("rms", lambda row: heading(row["rms"])),
        ("90 % of the runs below", lambda row: heading(row["q90"])),
    ]
    rows = list(analysis.heading_errors(table, keys, times))
    unbounded = any(np.isnan(row["q90"].high) for row in rows) and source.draws >= ENOUGH_DRAWS
    few = f" *{analysis.FEW_DRAWS}*: too few to bound it."
    note = f"{intervals(source)}{few if unbounded and not source.study.is_recorded else ''}"
    return table_of(title, keys, rows, cells, note, most=MOST_ROWS * len(times))


def against_first(source: Source) -> Table:
    """How each variant differs from the first one under the same conditions, draw by draw."""
    keys, yards = source.study.keys_shown, source.success_measures
    table = source.distinct_rows([*keys, *NEEDED, *success_columns(source.study)])
    given = [key for key in keys if is_condition_key(key)]
    first, rows = compare_with_first(table, keys, given)
    compared = [each for each in source.study.dimensions if first.keys() & each.keys()]
    swept = [
        (key, values) for each in compared for key, values in each.items() if is_condition_key(key)
    ]
    mixed = [key for key, values in swept if any(one != values[0] for one in values)]
    times = partial(format_difference, digits=0, sides=("it", "the first"))
    shown = [
        *(
            _Shown(f"ok: {y.description} (% points)", f"{y.rate_column}_difference", percent)
            for y in yards
        ),
        *(
            _Shown(
                f"time to {y.description}, median (s)",
                f"{y.settle_column}_median_difference",
                times,
            )
            for y in yards
        ),
        _Shown(
            "distance from its bias floor (arcmin)",
            "phi_u_error_arcmin_difference",
            format_estimate,
        ),
    ]
    shared = "from the same start times" if source.study.is_recorded else "on the same noise"
    same = "" if mixed or not given else f" with the same {' and '.join(given)}"
    pairs = intervals(source, "pairs of runs of a draw", "Difference")
    return table_of(
        f"Against {name_of(first)}{same}, {shared}",
        keys,
        rows,
        [(one.header, one.cell) for one in shown],
        said("against", intervals=pairs, mixed=mixed),
    )


def _tables(source: Source) -> Sequence[Block]:
    study = source.study
    start, end = study.study.window_s
    keys = study.keys_shown
    title = f"Heading error from {'the reference' if study.is_recorded else 'true north'}, arcmin"
    note = f"{intervals(source)} *never*: did not settle. Signed mean: over {start:g} to {end:g} s."
    if study.n_variants <= MOST_ROWS:
        every = statistics(source, keys, "Every variant", note=note)
        tables = [heading_errors(source, keys, title), every, *_over_drawn(source, keys)]
        compared = study.n_variants > 1 and source.draws > 1
        return [*tables, against_first(source)] if compared else tables
    each = f"{study.n_variants:,} variants: each table takes one key and pools the others."
    headings = (heading_errors(source, [key], f"{title}, by {key}") for key in keys)
    by_key = (statistics(source, [key], f"By {key}", note=note) for key in keys)
    return [Text(each), *headings, *by_key, *_over_drawn(source, keys)]


def _over_drawn(source: Source, keys: Sequence[str]) -> Iterator[Table]:
    """The statistics of bins of each drawn number, of every variant if these are few."""
    for key, (own, medians) in binned(source).items():
        few = len(medians) * source.study.n_variants <= MOST_ROWS
        note = "" if few or not keys else " All variants together."
        note = f"{key}: {BINS} {intervals(source)}{note}"
        yield statistics(own, [key, *(keys if few else ())], f"Over {key}, drawn", note=note)


def _curves(source: Source) -> Iterator[Block]:
    """Misalignment, or attitude, over time: the first few variants."""
    if not source.has_curves:
        return
    keys = source.study.keys_shown
    floor = () if source.study.is_recorded else ("floor_arcmin",)  # whose biases are unknown
    table = source.distinct_rows([*keys, "run_id", "reset_times_s", *floor])
    runs = runs_of_lines(table, keys)
    curves = source.curves(run for ids in runs.values() for run in ids)
    if curves.num_rows == 0:
        return
    count = max(map(len, runs.values()))
    caption = f"Mean of {count} runs" if count > 1 else "One run each"
    if left := sum(1 for _ in analysis.groups(table.select(keys), keys)) - len(runs):
        caption += f" (the first {len(runs)} variants; {left} more are not drawn)"
    figure = plots.plot_curves(curves, table, by=keys, zoom_s=source.study.study.window_s)
    has_sigma = bool(np.isfinite(analysis.numbers(curves, "sigma_u_arcmin")).any())
    if not np.isfinite(analysis.numbers(curves, "phi_u_arcmin")).any():
        shading = "; shading: the filter's own 1 sigma" if has_sigma else ""
        yield Picture("attitude", f"{caption}{shading}.", figure)
        return
    band = "; shading: 95 % of them" if count > 1 else ""
    dashed = "; dashed: the filter's own 1 sigma" if has_sigma else ""
    yield Picture("misalignment", f"{caption}{band}{dashed}.", figure)
