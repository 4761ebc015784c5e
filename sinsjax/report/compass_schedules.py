"""Gain schedules compared: which settles first, and how one compares with the paper's schemes."""

import math
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from sinsjax import analysis, plots
from sinsjax.analysis import Estimate, format_difference, format_estimate, rms
from sinsjax.errors import InputError
from sinsjax.report.base import (
    Block,
    Picture,
    Report,
    Section,
    Source,
    Table,
    Text,
    percent,
    shown_keys,
    value_text,
    yardstick,
)
from sinsjax.report.compass_runs import require_loops
from sinsjax.report.linear import all_loops, heading_of, start_of
from sinsjax.report.schedule_scores import Ranking, Scored, bands_of, rank, rule, scored_of

_MOST_ROWS = 10
_MOST_LINES = 5
_HORIZON = 4  # durations that the linear loops are followed for


def report(source: Source) -> Report:
    """A search (a study with axes) is ranked; cases alone are compared with the first one."""
    require_loops(source.study)
    wide, narrow = bands_of(source)
    if wide == narrow:
        raise InputError(
            f"{source.study.name}: layout compass_schedules needs two settle_bands_arcmin"
        )
    scored = scored_of(source)
    if source.study.axes:
        return _search(source, rank(scored))
    return _comparison(source, scored)


def _search(source: Source, ranking: Ranking) -> Report:
    best = ranking.ordered[0]
    wide, narrow = bands_of(source)
    headline = (
        f"{len(ranking.ordered)} schedules, {source.study.n_draws} draws each. Best by the rule:"
        f" {best.name}; median to {wide:g}' {format_estimate(best.wide, 's', 0)}, to {narrow:g}'"
        f" {format_estimate(best.narrow, 's', 0)}. {ranking.tied} are tied with the fastest to"
        f" {narrow:g}'."
    )
    shown = ranking.ordered[:_MOST_ROWS]
    left = len(ranking.ordered) - len(shown)
    note = f"{left} more schedules are in `summary/`." if left else ""
    title = f"Gain schedules, the first {len(shown)} by the rule"
    blocks: list[Block] = [
        Text(rule(source)),
        _table(source, shown, title, note),
        _survival(source, ranking.ordered[:_MOST_LINES]),
    ]
    return Report([headline], [Section("Which schedule settles first", blocks)])


def _table(source: Source, shown: Sequence[Scored], title: str, note: str = "") -> Table:
    wide, narrow = bands_of(source)
    rows = []
    keys = shown_keys(source.study)
    for s in shown:
        shares = [_settled(times) for times in (s.wide_s, s.narrow_s)]
        rows.append(
            [
                *(value_text(s.key[key]) for key in keys),
                value_text(s.tape_s),
                percent(shares[0]),
                format_estimate(s.wide, digits=0),
                percent(shares[1]),
                format_estimate(s.narrow, digits=0),
                percent(s.last_cycle) if s.last_cycle else "-",
                f"{100 * s.outside:.1f}",
                _rms_text(s.errors),
            ]
        )
    header = [
        *map(plots.label, keys),
        "tape (s)",
        f"settled to {wide:g}' (%)",
        "median (s)",
        f"settled to {narrow:g}' (%)",
        "median (s)",
        "for the last cycle (%)",
        f"bound: outside {narrow:g}' (%)",
        "rms error at the end (arcmin)",
    ]
    text = (
        f"Number [95 % interval] over {source.study.n_draws} draws; update time; *never* counts as"
        " infinite. *Settled*: inside to the end, which near the end takes little; *for the last"
        f" cycle*: inside {narrow:g} arcmin throughout the last two passes. *Bound*: share of draws"
        " that an estimator at the tape's information bound leaves outside"
        f" {narrow:g} arcmin. {note}"
    )
    return Table(title, header, rows, text.rstrip())


def _settled(times: NDArray) -> Estimate:
    return analysis.proportion(int(np.isfinite(times).sum()), times.size)


def _rms_text(errors: NDArray) -> str:
    return format_estimate(rms(errors), digits=2) if np.isfinite(errors).all() else "unknown"


def _survival(source: Source, shown: Sequence[Scored]) -> Picture:
    wide, narrow = bands_of(source)
    panels = {
        f"within {wide:g} arcmin": {s.name: s.wide_s for s in shown},
        f"within {narrow:g} arcmin": {s.name: s.narrow_s for s in shown},
    }
    return Picture(
        "settling",
        "Share of draws that have not settled to the band yet. Dashed: the share that the noise of"
        " that tape alone leaves outside, whatever the method (the bound of an unbiased estimate)."
        f" {yardstick(source.study)}",
        plots.survival(
            panels,
            "Who has not settled yet?",
            end_s=source.study.duration_s,
            levels={f"within {narrow:g} arcmin": {s.name: s.outside for s in shown}},
        ),
    )


def _comparison(source: Source, scored: Sequence[Scored]) -> Report:
    linear = _run_on(source, scored)
    title = f"Every case over {source.study.duration_s:g} s of updates"
    blocks = [_table(source, scored, title), _times_table(source, scored, linear)]
    return Report(
        list(_headlines(source, scored, linear)),
        [
            Section(
                "The best schedule beside the paper's schemes",
                [*blocks, _survival(source, scored)],
            )
        ],
    )


def _run_on(source: Source, scored: Sequence[Scored]) -> list[tuple[float, float]]:
    """When the linear loops, run on beyond the end, are within each band for good, s.

    A tape that the duration goes over once is one that goes on.
    """
    study = source.study
    duration, step = study.duration_s, study.study.record_interval_s
    times = np.arange(1, round(_HORIZON * duration / step) + 1) * step
    start = start_of(study)
    found = []
    for s, model in zip(scored, all_loops(study), strict=True):
        if s.tape_s >= study.run_s:
            model = model._replace(tape_s=math.inf)
        error = np.abs(heading_of(model, start, times)) * 60
        outside = [times[error > band] for band in bands_of(source)]
        ends = [float(t[-1]) if t.size else 0.0 for t in outside]
        found.append(tuple(math.inf if end == times[-1] else end for end in ends))
    return found  # type: ignore[return-value]


def _times_table(
    source: Source, scored: Sequence[Scored], linear: Sequence[tuple[float, float]]
) -> Table:
    """Medians in update time and in data, differences from the first case, and the linear loops."""
    wide, narrow = bands_of(source)
    rows = []
    for s, (linear_wide, linear_narrow) in zip(scored, linear, strict=True):
        cells, sides = [s.name], (_short(s), _short(scored[0]))
        for times, first, without_noise in (
            (s.wide_s, scored[0].wide_s, linear_wide),
            (s.narrow_s, scored[0].narrow_s, linear_narrow),
        ):
            data = np.minimum(times, np.where(np.isfinite(times), s.tape_s, np.inf))
            apart = analysis.quantile_difference(times, first)
            cells += [
                format_estimate(analysis.quantile(data), digits=0),
                "-" if s is scored[0] else format_difference(apart, digits=0, sides=sides),
                "never" if math.isinf(without_noise) else f"{without_noise:.0f}",
            ]
        rows.append(cells)
    header = [""]
    for band in (wide, narrow):
        header += [
            f"data at {band:g}', median (s)",
            f"updates, from {_short(scored[0])}'s (s)",
            "linear loops, run on (s)",
        ]
    return Table(
        "Settling in data, beside the first case, and without noise",
        header,
        rows,
        "*Data*: how much of the tape had been recorded when the heading settled. *From the"
        " first's*: difference of the medians on the same noise. *Run on*: when the linear loops"
        f" without noise are within the band for good, if the runs went on to"
        f" {_HORIZON * source.study.duration_s:g} s: a loop that crosses its floor just"
        " before the end counts as settled in the runs, and leaves the band again after it.",
    )


def _short(s: Scored) -> str:
    return s.name.partition(":")[0]


def _headlines(
    source: Source, scored: Sequence[Scored], linear: Sequence[tuple[float, float]]
) -> Iterator[str]:
    """A line a case: who settles, when, how that compares with the first case, and how long."""
    bands, duration = bands_of(source), source.study.duration_s
    for s, ends in zip(scored, linear, strict=True):
        found = [
            f"to {band:g}' settle {percent(_settled(times))} % of the draws, median"
            f" {format_estimate(analysis.quantile(times), 's', 0)}"
            for band, times in zip(bands, (s.wide_s, s.narrow_s), strict=True)
        ]
        if s.last_cycle:
            found.append(f"{percent(s.last_cycle)} % are within it for the last cycle of passes")
        text = (
            f"{s.name}: {'; '.join(found)} (the bound of its {value_text(s.tape_s)} s of data"
            f" leaves at least {100 * s.outside:.1f} % outside {bands[1]:g}')."
            f"{_earlier(s, scored[0])}"
        )
        medians = (s.wide.value, s.narrow.value)
        for band, end, median in zip(bands, ends, medians, strict=True):
            if math.isfinite(median) and duration < end < math.inf:
                text += (
                    f" It crosses the {band:g}' band at the end: run on, the linear loops leave it"
                    f" again, and are within it for good from {end:.0f} s."
                )
        yield text


def _earlier(s: Scored, first: Scored) -> str:
    """How much earlier than the first case a case settles, in words; nothing if either never."""
    gains = [
        analysis.quantile_difference(other, own).value
        for own, other in ((s.wide_s, first.wide_s), (s.narrow_s, first.narrow_s))
    ]
    if s is first or not np.isfinite([*gains, s.wide.value, s.narrow.value]).all():
        return ""
    return f" That is {gains[0]:.0f} and {gains[1]:.0f} s of updates before {_short(first)}."
