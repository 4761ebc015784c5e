"""Numbers of the page on compass alignment of a recorded car."""

from collections.abc import Sequence

import numpy as np

from sinsjax import analysis
from sinsjax.plots.starts import by_start, strips
from sinsjax.report.base import Picture, Source, Table
from sinsjax.report.folder import Page, Sources
from sinsjax.report.output import counted

from .cases import Case, cases_of, first_of_kinds, partner
from .transients import gain, without_kicks

_QUANTITY = "heading error at the end (arcmin)"


def page(sources: Sources) -> Page:
    """Heading errors of all cases, what limits them, and what the turns do."""
    source = sources["compass_car"]
    cases = cases_of(source)
    first = first_of_kinds(cases)
    stored = {(case.turn, case.data_s): case for case in first if case.turn}
    short = min(data_s for _, data_s in stored)
    reflected, flipped = stored["reflect", short], stored["velocity", short]
    once = next(c for c in first if c.is_compass and (c.data_s, c.passes) == (short, 1))
    many = next(c for c in first if not c.is_compass and c.passes > 1)
    longest = max((c for c in cases if c.is_compass), key=lambda c: c.data_s)
    single, filtered = partner(cases, many), partner(cases, longest)
    sigma, sigma_many = (float(np.median(c.sigma)) for c in (single, many))
    pairs = [(case.errors, partner(cases, case).errors) for case in stored.values()]
    together = [float(np.corrcoef(*pair)[0, 1]) for pair in pairs]
    gains = {data_s: gain(source, case) for (turn, data_s), case in stored.items()}
    rest = without_kicks(source, [case for case in cases if case.data_s == short])
    left, by_name = [analysis.rms(e).value for e in rest.values()], {c.name: c.rms for c in cases}
    values = {
        "starts": str(source.draws),
        "once": f"{once.rms:.1f} arcmin",
        "reflected": f"{reflected.rms:.1f} arcmin",
        "flipped": f"{flipped.rms:.1f} arcmin",
        "filter": {"once": f"{single.rms:.2f} arcmin", "many": f"{many.rms:.2f} arcmin"},
        "sigma": {"once": f"{sigma:.1f}", "many": f"{sigma_many:.1f} arcmin"},
        "long": {"compass": f"{longest.rms:.2f} arcmin", "filter": f"{filtered.rms:.2f} arcmin"},
        "together": f"{min(together):.2f} to {max(together):.2f}",
        "gains": ", ".join(f"{g:.0f} arcmin (record of {d:g} s)" for d, g in gains.items()),
        "rest": f"{max(left):.1f} arcmin",
        "by_2": f"{by_name['80 s tape, reflected, delay 2 s']:.1f}",
        "by_10": f"{by_name['80 s tape, reflected, delay 10 s']:.1f}",
    }
    claims = {
        "going over a record takes away what one pass leaves": reflected.rms < once.rms / 4,
        "on the short record the compass does as well as the filter": (
            abs(reflected.rms / single.rms - 1) < 0.15
        ),
        "more data lower the error, repetition does not": (
            filtered.rms < single.rms / 3 and abs(many.rms / single.rms - 1) < 0.1
        ),
        "compass and filter err together": min(together) > 0.5,
        "the filter takes each pass for new data": sigma_many < sigma / 2,
        "without the kicks the turns are alike": max(left) < 1.5 * min(left),
        "the reflecting turn is best on the shortest record only": all(
            (case.rms < stored["velocity", data_s].rms) == (data_s == short)
            for (turn, data_s), case in stored.items()
            if turn == "reflect"
        ),
    }
    figures = {"errors": _strips(source, cases), "by_start": _by_start(source, cases)}
    return Page(values, {"expected": _expected(cases)}, figures, claims)


def _expected(cases: Sequence[Case]) -> Table:
    """Rms heading error by length of data and kind."""
    kinds = dict.fromkeys(case.kind for case in cases)
    rms = {(c.data_s, c.kind): f"{c.rms:.2f}" for c in reversed(cases)}  # the first of each stays
    lengths = sorted({case.data_s for case in cases})
    rows = [
        [f"{data_s:g} s", *(rms.get((data_s, kind), "-") for kind in kinds)] for data_s in lengths
    ]
    note = (
        "Rms over the start times, arcmin from the reference; the filter goes once over the data."
        f" {analysis.NO_INTERVAL}"
    )
    return Table("What to expect", ["data", *kinds], rows, note)


def _strips(source: Source, cases: Sequence[Case]) -> Picture:
    figure = strips(
        {case.name: case.errors for case in cases},
        "Heading error from the reference at the end, from every start time",
        _QUANTITY,
        kinds=[case.kind for case in cases],
    )
    caption = "A dot is a start time, a line the median. A *tape* is a stored record."
    return Picture("heading_error", caption, figure, counted(source))


def _by_start(source: Source, cases: Sequence[Case]) -> Picture:
    panels: dict[str, dict[str, np.ndarray]] = {}
    for case in first_of_kinds(cases):
        if case.turn:
            panel = panels.setdefault(f"{case.data_s:g} s of data", {})
            panel |= {"Kalman": partner(cases, case).errors, case.kind: case.errors}
    assert source.study.record is not None
    title = "What two methods make of the same data, from the reference"
    figure = by_start(source.study.record.start_s, panels, title, _QUANTITY)
    caption = "Lines that go together: what is left lies in the data."
    return Picture("by_start", caption, figure, counted(source))
