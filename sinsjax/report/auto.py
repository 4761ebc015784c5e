"""The report of any study: statistics of its variants, curves, and figures over its axes."""

import math
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import pyarrow as pa

from sinsjax import analysis, plots
from sinsjax.analysis import Estimate, format_estimate
from sinsjax.report.attitudes import MOST_ROWS, attitudes
from sinsjax.report.base import (
    Block,
    Picture,
    Report,
    Section,
    Source,
    Table,
    Text,
    name_of,
    percent,
    shown_keys,
    value_text,
)
from sinsjax.report.over_axes import over_axes

_MOST_LINES = 6
_MOST_DRAWS = 256  # in a line's band
_MOST_MOMENTS = 8

_STATISTICS = (
    ("settled to 10', median (s)", "settle_10_s_median", 0),
    ("phi_u, window mean (arcmin)", "phi_u_mean_arcmin_mean", 1),
    ("... from its limit (arcmin)", "phi_u_from_floor_arcmin_mean", 1),
)


def report(source: Source) -> Report:
    """Tables of the variants, curves where they were stored, and figures over the axes."""
    has_truth = bool(np.isfinite(analysis.numbers(source.summary, "phi_u_arcmin")).any())
    tables = _tables(source) if has_truth else []
    if source.study.is_recorded or not has_truth:
        tables = [attitudes(source), *tables]
    figures = list(_curves(source, has_truth))
    if has_truth:
        blocks = over_axes(source)
        tables += [block for block in blocks if isinstance(block, Table)]
        figures += [block for block in blocks if not isinstance(block, Table)]
    sections = [Section("Figures", figures)] if figures else []
    return Report([_headline(source, has_truth)], [*sections, Section("Tables", tables)])


def statistics(
    table: pa.Table, keys: Sequence[str], title: str, *, note: str = "", pooled: bool = False
) -> Table:
    """The statistics of each group of runs as a table.

    Args:
        table: the summary.
        keys: what tells the groups apart.
        title: of the table.
        note: said below it.
        pooled: whether a group mixes variants, whose runs share draws: no interval is given.
    """
    found = analysis.summarise(table, keys).to_pylist()
    rows = []
    for row in found[:MOST_ROWS]:
        found_here = [(_estimate(row, name), digits) for _, name, digits in _STATISTICS]
        printed = (format_estimate(estimate, digits=digits) for estimate, digits in found_here)
        numbers = [percent(_estimate(row, "success_rate")), *printed]
        if pooled:
            numbers = [number.partition(" [")[0] for number in numbers]
        rows.append([*(value_text(row[key]) for key in keys), str(row["n"]), *numbers])
    if left := len(found) - len(rows):
        note = f"{note} {left} more rows are not shown.".lstrip()
    return Table(title, [*keys, "runs", "ok (%)", *(name for name, *_ in _STATISTICS)], rows, note)


def _estimate(row: dict[str, Any], name: str) -> Estimate:
    ends = (row[f"{name}{end}"] for end in ("", "_low", "_high"))
    value, low, high = (math.nan if end is None else end for end in ends)
    return Estimate(value, low, high, row["n"])


def _headline(source: Source, has_truth: bool) -> str:
    study, n = source.study, source.summary.num_rows
    draws = "start times" if study.is_recorded else "draws"
    text = f"{n:,} runs: {study.n_variants} variants, {study.n_draws} {draws}."
    if not has_truth:
        return f"{text} Without truth or reference, attitude and its 1 sigma is what is known."
    ok = source.summary["status"].to_pylist().count("ok")
    return f"{text} The heading error ends within 10 arcmin of its limit in {ok:,} of them."


def _tables(source: Source) -> list[Block]:
    study = source.study
    start, end = study.study.window_s
    note = f"Window: {start:g} to {end:g} s; *never*: did not settle."
    keys = shown_keys(study)
    if study.n_variants <= MOST_ROWS:
        note = f"Number [95 % interval over the draws]. {note}"
        return [statistics(source.summary, keys, "Every variant", note=note)]
    return [
        Text(f"{study.n_variants} variants: each table takes one key and pools the others."),
        *(statistics(source.summary, [key], f"By {key}", note=note, pooled=True) for key in keys),
    ]


def _curves(source: Source, has_truth: bool) -> Iterator[Block]:
    """Misalignment, or attitude, over time: the first few variants."""
    groups = list(analysis.groups(source.summary, shown_keys(source.study)))
    drawn = {name_of(key): rows.slice(0, _MOST_DRAWS) for key, rows in groups[:_MOST_LINES]}
    runs = {name: rows["run_id"].to_pylist() for name, rows in drawn.items()}
    curves = source.curves(run for ids in runs.values() for run in ids)
    if curves.num_rows == 0:
        return
    shown = plots.ensembles(curves, runs)
    count = max(map(len, runs.values()))
    caption = f"Mean of {count} runs" if count > 1 else "One run each"
    if left := len(groups) - len(runs):
        caption += f" (the first {len(runs)} variants; {left} more are not drawn)"
    has_sigma = bool(np.isfinite(analysis.numbers(curves, "sigma_u_arcmin")).any())
    if not has_truth:
        title = "Attitude with the filter's own 1 sigma" if has_sigma else "Attitude"
        shading = "; shading: the filter's own 1 sigma" if has_sigma else ""
        yield Picture("attitude", f"{caption}{shading}.", plots.attitude(shown, title))
        return
    floors = np.unique(analysis.numbers(source.summary, "floor_arcmin"))
    moments = {time for rows in drawn.values() for time in rows["reset_times_s"][0].as_py()}
    figure = plots.misalignment(
        shown,
        "Misalignment left after correction",
        limits={"u": float(floors[0])} if floors.size == 1 else None,
        resets_s=sorted(moments) if len(moments) <= _MOST_MOMENTS else (),
        zoom_s=source.study.study.window_s,
        with_sigma=has_sigma,
    )
    band = "; shading: 95 % of them" if count > 1 else ""
    dashed = "; dashed: the filter's own 1 sigma" if has_sigma else ""
    yield Picture("misalignment", f"{caption}{band}{dashed}.", figure)
