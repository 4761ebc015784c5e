"""Compass alignment on a record, forward and over stored tapes, beside a filter on the same data.

What counts is the heading error at the end of each run, from many start times. A case's place in
the report follows from its keys: method, tape, passes and turn. All errors are relative to the
reference that was given, which need not be independent of the record.
"""

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from sinsjax import analysis, plots
from sinsjax.analysis import rms
from sinsjax.plots.starts import by_start, over_passes, strips
from sinsjax.report import reversal_transients
from sinsjax.report.attitudes import attitudes
from sinsjax.report.base import Block, Picture, Report, Section, Source, Table, Text, value_text
from sinsjax.report.compass_cases import Case, cases_of, first_of_kinds_by_tape, partner

_RELATIVE = (
    "Errors are relative to the reference (for the car record a smoother on the same record, whose"
    " pieces agree to 0.5 arcmin), not absolute: what it shares with a method, such as the east"
    " gyro bias, is not seen."
)
_SHORT = "Relative to the reference, not absolute."
_TOGETHER = 0.5  # correlation from which two methods are said to err together
_QUANTITY = "heading error at the end (arcmin)"


def report(source: Source) -> Report:
    """Heading errors of all cases, what limits them, and heading over update time."""
    cases = cases_of(source)
    starts = f"{source.summary.num_rows} runs from {source.study.n_draws} start times."
    attitude = Section("Attitude", [attitudes(source)])
    if not all(np.isfinite(case.errors).all() for case in cases):
        return Report([f"{starts} Without a reference: attitude only."], [attitude])
    made = [
        Section("Heading error", [_table(source, cases), _strips(cases), Text(_overlap(source))]),
        Section("What the turns do", list(reversal_transients.blocks(source, cases))),
        Section("What limits a tape", list(_limits_of_tapes(source, cases))),
        Section("Heading over update time", list(_over_time(source, cases))),
    ]
    headline = [f"{starts} {_RELATIVE}", *_headline(cases)]
    return Report(headline, [*(section for section in made if section.blocks), attitude])


def _headline(cases: Sequence[Case]) -> Iterator[str]:
    """A sentence on every length of data, where there is something to compare."""
    for tape_s in dict.fromkeys(case.tape_s for case in cases):
        shown = [case for case in first_of_kinds_by_tape(cases) if case.tape_s == tape_s]
        parts = [f"{case.name} {rms(case.errors).value:.2f}" for case in shown]
        if len(parts) > 1:
            yield f"{tape_s:g} s of data, rms heading error in arcmin: {'; '.join(parts)}."


def _table(source: Source, cases: Sequence[Case]) -> Table:
    rows = []
    for case in cases:
        other = partner(cases, case)
        sigma = analysis.numbers(case.rows, "sigma_u_arcmin")
        rows.append(
            [
                case.name,
                f"{case.tape_s:g}",
                str(case.passes),
                f"{analysis.quantile(np.abs(case.errors)).value:.2f}",
                f"{np.abs(case.errors).max():.2f}",
                f"{rms(case.errors).value:.2f}",
                f"{case.errors.mean():+.2f}",
                f"{rms(case.errors - other.errors).value:.2f}" if other else "-",
                f"{np.median(sigma):.1f}" if np.isfinite(sigma).all() else "-",
            ]
        )
    return Table(
        f"Heading error phi_u at the end, {source.study.n_draws} start times (arcmin)",
        [
            "",
            "data (s)",
            "passes",
            "median size",
            "worst",
            "rms",
            "mean",
            "from Kalman, rms",
            "its own sigma",
        ],
        rows,
        f"{_SHORT} *From Kalman*: the difference, start time by start time, to the filter that"
        " goes once over the same data. *Its own sigma*: what a filter believes, median.",
    )


def _strips(cases: Sequence[Case]) -> Picture:
    return Picture(
        "heading_error",
        f"A dot is a start time, a line the median. {_SHORT}",
        strips(
            {case.name: case.errors for case in cases},
            "Heading error at the end, from every start time",
            _QUANTITY,
            kinds=[case.kind for case in cases],
        ),
    )


def _overlap(source: Source) -> str:
    """How far the start times are independent of one another."""
    assert source.study.record is not None
    gaps = np.diff(np.sort(source.study.record.start_s))
    if not gaps.size:
        return "One start time: nothing is known of the spread."
    return (
        f"Start times are {value_text(float(gaps.max()))} s or less apart and share most of their"
        f" data with their neighbours. {analysis.NO_INTERVAL}"
    )


def _limits_of_tapes(source: Source, cases: Sequence[Case]) -> Iterator[Block]:
    """Whether the compass errs where the filter does: then it is the data."""
    stored = [case for case in first_of_kinds_by_tape(cases) if case.turn]
    pairs = [(case, other) for case in stored if (other := partner(cases, case)) is not None]
    if not pairs or source.study.n_draws < 3:
        return
    rows, together = [], []
    panels: dict[str, dict[str, NDArray]] = {}
    for case, other in pairs:
        together.append(float(np.corrcoef(case.errors, other.errors)[0, 1]))
        numbers = [rms(e).value for e in (case.errors, other.errors, case.errors - other.errors)]
        rows.append([case.name, *(f"{x:.2f}" for x in numbers), f"{together[-1]:.2f}"])
        panel = panels.setdefault(f"{case.tape_s:g} s of data", {"Kalman": other.errors})
        panel[case.kind] = case.errors
    yield Text(" ".join([*_of_repeating(cases), *_in_common(together)]))
    yield Table(
        "Stored tapes beside the filter that goes once over the same data (arcmin, rms)",
        ["", "heading error", "Kalman", "difference", "correlation"],
        rows,
    )
    assert source.study.record is not None
    yield Picture(
        "by_start",
        f"Two methods on the same data. {_SHORT}",
        by_start(
            source.study.record.start_s,
            panels,
            "What two methods make of the same data",
            _QUANTITY,
        ),
    )


def _of_repeating(cases: Sequence[Case]) -> Iterator[str]:
    """What going over the data again does, in sentences, as far as there are cases to tell it."""
    for many in first_of_kinds_by_tape(cases):
        for once in cases:
            if many.turn and once.is_compass and (once.tape_s, once.passes) == (many.tape_s, 1):
                yield (
                    f"{many.name}: {many.passes} passes leave {rms(many.errors).value:.1f} arcmin"
                    f" (rms) where one leaves {rms(once.errors).value:.1f}."
                )
    for many in cases:
        single = partner(cases, many)
        if single is not None and not many.is_compass:
            before, after = (
                float(np.median(analysis.numbers(case.rows, "sigma_u_arcmin")))
                for case in (single, many)
            )
            yield (
                f"A Kalman filter comes from {rms(single.errors).value:.2f} to"
                f" {rms(many.errors).value:.2f} arcmin by {many.passes} passes, while its sigma"
                f" falls from {before:.1f} to {after:.1f}: it takes each pass for new data."
            )


def _in_common(correlations: Sequence[float]) -> Iterator[str]:
    """Whether what is left lies in the data."""
    least, most = min(correlations), max(correlations)
    told = f"correlation {least:.2f} to {most:.2f}"
    if least > _TOGETHER:
        yield (
            "Repetition takes away what is left of the initial error; it brings no information."
            " The Kalman filter, once over the same data, errs at the same start times and in the"
            f" same direction ({told}): what is left lies in the data, and only more data lower it."
        )
    else:
        yield f"The Kalman filter, once over the same data, errs otherwise ({told})."


def _over_time(source: Source, cases: Sequence[Case]) -> Iterator[Block]:
    """Heading error over update time from the first start time, by length of data."""
    kinds = list(dict.fromkeys(case.kind for case in cases))
    curves = source.curves([case.runs[0] for case in cases])
    if curves.num_rows == 0:
        return
    panels: dict[str, list[plots.Line]] = {}
    turns: dict[str, list[float]] = {}
    for tape_s in dict.fromkeys(case.tape_s for case in cases if case.is_compass):
        here = [case for case in cases if case.tape_s == tape_s]
        repeated = max(case.passes for case in here)
        # A run of one pass is the beginning of one of many.
        first = first_of_kinds_by_tape(here)
        shown = [c for c in first if c.passes == repeated or not c.is_compass]
        panel = f"{tape_s:g} s of data"
        drawn: list[plots.Line] = []
        for case in shown if repeated > 1 else here:
            (curve,) = plots.ensembles(curves, {case.name: case.runs[:1]})
            shade = plots.colour(kinds.index(case.kind))
            style = "--" if any(line.colour == shade for line in drawn) else "-"
            values = curve.columns["phi_u_arcmin"]
            drawn.append(plots.Line(case.name, curve.time_s, values, shade, style))
        panels[panel] = drawn
        turns[panel] = [number * tape_s for number in range(1, repeated)]
    at = value_text(source.summary["start_s"][0].as_py())
    yield Picture(
        "over_time",
        f"From {at} s in the record; dotted: turns of the tape. {_SHORT}",
        over_passes(
            panels,
            "Heading error while the data are gone over",
            quantity="phi_u (arcmin)",
            turns_s=turns,
        ),
    )
