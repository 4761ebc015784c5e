"""Numbers of the page on compass alignment of a recorded car."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from sinsjax import analysis, plots
from sinsjax.analysis import rms
from sinsjax.plots.starts import by_start, over_passes, strips
from sinsjax.report.base import Picture, Source, Table
from sinsjax.report.folder import Page, Sources
from sinsjax.report.output import counted

from .cases import Case, cases_of, first_of_kinds_by_tape, partner
from .transients import Turned, delays, gain, table, turned_cases

_QUANTITY = "heading error at the end (arcmin)"


def page(sources: Sources) -> Page:
    """Heading errors of all cases, what limits them, and what the turns do."""
    source = sources["compass_car"]
    cases = cases_of(source)
    turned = turned_cases(source, cases)
    stored = [case for case in first_of_kinds_by_tape(cases) if case.turn]
    assert source.study.record is not None
    gaps = np.diff(np.sort(source.study.record.start_s))
    told, claims = _told(source, cases, stored, turned)
    values: dict[str, Any] = {
        "starts": str(source.draws),
        "apart": f"{gaps.max():g} s",
        "no_interval": analysis.NO_INTERVAL,
        **told,
    }
    return Page(
        values,
        {"expected": _expected(cases), "all": _all(cases), "turns": table(turned)},
        {
            "errors": _strips(source, cases),
            "by_start": _by_start(source, cases, stored),
            "delay": delays(source, cases, turned),
            "over_time": _over_time(source, cases),
        },
        claims,
    )


def _told(
    source: Source, cases: Sequence[Case], stored: Sequence[Case], turned: Sequence[Turned]
) -> tuple[dict[str, Any], dict[str, bool]]:
    by_name = {case.name: case for case in cases}
    error = {name: float(rms(case.errors).value) for name, case in by_name.items()}
    pairs = [(case, other) for case in stored if (other := partner(cases, case)) is not None]
    together = [float(np.corrcoef(a.errors, b.errors)[0, 1]) for a, b in pairs]
    short = min(case.tape_s for case in stored)
    once = next(c for c in cases if c.is_compass and (c.tape_s, c.passes) == (short, 1))
    many = next(c for c in cases if not c.is_compass and c.passes > 1)
    single = partner(cases, many)
    assert single is not None
    sigmas = [float(np.median(analysis.numbers(c.rows, "sigma_u_arcmin"))) for c in (single, many)]
    here = {c.turn: c for c in stored if c.tape_s == short}
    longest = max((c for c in cases if c.is_compass), key=lambda c: c.tape_s)
    filtered = partner(cases, longest)
    assert filtered is not None
    gains = {c.tape_s: gain(source, c) for c in (one.case for one in turned)}
    rest = [rms(one.rest).value for one in turned if one.case.tape_s == short]
    values = {
        "tape": f"{short:g} s",
        "once": f"{error[once.name]:.1f} arcmin",
        "reflected": f"{error[here['reflect'].name]:.1f} arcmin",
        "flipped": f"{error[here['velocity'].name]:.1f} arcmin",
        "passes": str(many.passes),
        "filter": {
            "once": f"{error[single.name]:.2f} arcmin",
            "many": f"{error[many.name]:.2f} arcmin",
            "sigma": f"{sigmas[0]:.1f}",
            "sigma_many": f"{sigmas[1]:.1f} arcmin",
        },
        "long": {
            "compass": f"{error[longest.name]:.2f} arcmin",
            "filter": f"{error[filtered.name]:.2f} arcmin",
            "data": f"{longest.tape_s:g} s",
        },
        "together": f"{min(together):.2f} to {max(together):.2f}",
        "gains": ", ".join(f"{g:.0f} arcmin ({tape:g} s tape)" for tape, g in gains.items()),
        "rest": f"{min(rest):.1f} to {max(rest):.1f} arcmin",
    }
    claims = {
        "going over a tape takes away what one pass leaves": (
            error[here["reflect"].name] < error[once.name] / 4
        ),
        "on the short tape the compass does as well as the filter": (
            abs(error[here["reflect"].name] / error[single.name] - 1) < 0.15
        ),
        "more data lower the error, repetition does not": (
            error[filtered.name] < error[single.name] / 3
            and abs(error[many.name] / error[single.name] - 1) < 0.1
        ),
        "compass and filter err together": min(together) > 0.5,
        "the filter takes each pass for new data": sigmas[1] < sigmas[0] / 2,
        "without the kicks the turns are alike": max(rest) < 1.5 * min(rest),
        "the reflecting turn is best on the shortest tape only": (
            error[here["reflect"].name] < error[here["velocity"].name]
            and all(
                error[c.name] > error[d.name]
                for c in stored
                for d in stored
                if c.tape_s == d.tape_s > short and (c.turn, d.turn) == ("reflect", "velocity")
            )
        ),
    }
    return values, claims


def _expected(cases: Sequence[Case]) -> Table:
    """Rms heading error by length of data and method."""
    kinds = {
        "Kalman, once": lambda c: not c.is_compass and c.passes == 1,
        "compass, once": lambda c: c.is_compass and c.passes == 1,
        "compass, tilt reflected": lambda c: c.turn == "reflect",
        "compass, velocity flipped": lambda c: c.turn == "velocity",
    }
    first = first_of_kinds_by_tape(cases)
    rows = []
    for tape_s in sorted({case.tape_s for case in cases}):
        cells = []
        for fits in kinds.values():
            here = [case for case in first if case.tape_s == tape_s and fits(case)]
            cells.append(f"{rms(here[0].errors).value:.2f}" if here else "-")
        rows.append([f"{tape_s:g} s", *cells])
    note = "Rms over the start times, arcmin from the reference."
    return Table("What to expect", ["data", *kinds], rows, note)


def _all(cases: Sequence[Case]) -> Table:
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
    header = ["", "data (s)", "passes", "median size", "worst", "rms", "mean", "from Kalman, rms"]
    note = (
        "*From Kalman*: the difference, start time by start time, to the filter that goes once over"
        " the same data. *Its own sigma*: what a filter believes, median."
    )
    title = "Heading error from the reference at the end, every case (arcmin)"
    return Table(title, [*header, "its own sigma"], rows, note, folded=True)


def _strips(source: Source, cases: Sequence[Case]) -> Picture:
    figure = strips(
        {case.name: case.errors for case in cases},
        "Heading error from the reference at the end, from every start time",
        _QUANTITY,
        kinds=[case.kind for case in cases],
    )
    return Picture(
        "heading_error", "A dot is a start time, a line the median.", figure, counted(source)
    )


def _by_start(source: Source, cases: Sequence[Case], stored: Sequence[Case]) -> Picture:
    panels: dict[str, dict[str, Any]] = {}
    for case in stored:
        if (other := partner(cases, case)) is not None:
            panel = panels.setdefault(f"{case.tape_s:g} s of data", {"Kalman": other.errors})
            panel[case.kind] = case.errors
    assert source.study.record is not None
    title = "What two methods make of the same data, from the reference"
    figure = by_start(source.study.record.start_s, panels, title, _QUANTITY)
    caption = "Lines that go together: what is left lies in the data."
    return Picture("by_start", caption, figure, counted(source))


def _over_time(source: Source, cases: Sequence[Case]) -> Picture:
    """Heading error over update time from the first start time, by length of data."""
    kinds = list(dict.fromkeys(case.kind for case in cases))
    curves = source.curves([case.runs[0] for case in cases])
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
    title = "Heading error from the reference while the data are gone over"
    figure = over_passes(panels, title, quantity="heading error (arcmin)", turns_s=turns)
    caption = "One start time, the record's first; dotted: turns of the tape."
    return Picture("over_time", caption, figure, counted(source))
