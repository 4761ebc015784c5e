"""Numbers of compass alignment of a recorded car."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sinsjax import analysis
from sinsjax.execution.source import Source
from sinsjax.report.base import Picture, Table
from sinsjax.report.study_page import Page, Sources

from ..common.grids import grid_of
from ..loops.turns import TURNS
from .starts import strips

HEADING, SIGMA = "phi_u_arcmin", "sigma_u_arcmin"


class Case(NamedTuple):
    """The runs of one variant, one a start time.

    Attributes:
        name: in words.
        is_compass: whether the compass loops align; a Kalman filter otherwise.
        data_s: length of the data, s.
        passes: over the data; the last one may be part of one.
        turn: what compass loops do at a turn; empty where there is none.
        errors: (starts,) heading error phi_u at the end, arcmin; NaN if unknown.
        sigma: (starts,) what a filter believes of it, arcmin; NaN of compass loops.
    """

    name: str
    is_compass: bool
    data_s: float
    passes: int
    turn: str
    errors: NDArray
    sigma: NDArray

    @property
    def kind(self) -> str:
        """What figures tell cases apart by."""
        turn = TURNS.get(self.turn, "one pass")
        return f"compass, {turn}" if self.is_compass else "Kalman filter"

    @property
    def rms(self) -> float:
        """Rms heading error over the start times, arcmin."""
        return analysis.rms(self.errors).value


def cases_of(source: Source) -> list[Case]:
    """The runs by variant, in the study's order."""
    study = source.study
    grid = grid_of(source, (HEADING, SIGMA), case="case")
    found = []
    for variant, (name, span) in enumerate(zip(grid.axes["case"], study.spans, strict=True)):
        is_compass = study.values("method")[variant] == "compass"
        data_s = span.pass_records * study.record_every / study.rate_hz
        passes = -(-span.records // span.pass_records)
        turn = study.values("turn")[variant] if is_compass and passes > 1 else ""
        ends = (grid.at(column, case=name) for column in (HEADING, SIGMA))
        found.append(Case(name, is_compass, data_s, passes, turn, *ends))
    return found


def partner(cases: Sequence[Case], case: Case) -> Case:
    """The filter that goes once over the same data."""
    return next(c for c in cases if not c.is_compass and c.passes == 1 and c.data_s == case.data_s)


def first_of_kinds(cases: Sequence[Case]) -> list[Case]:
    """The first case of each kind and number of passes over each length of data."""
    keys = [(case.data_s, case.kind, case.passes) for case in cases]
    return [case for i, case in enumerate(cases) if keys.index(keys[i]) == i]


def page(sources: Sources) -> Page:
    """Heading errors of all cases, and what limits them."""
    source = sources["compass_car"]
    cases = cases_of(source)
    first = first_of_kinds(cases)
    stored = {(case.turn, case.data_s): case for case in first if case.turn}
    short = min(data_s for _, data_s in stored)
    reflected = stored["reflect", short]
    once = next(c for c in first if c.is_compass and (c.data_s, c.passes) == (short, 1))
    many = next(c for c in first if not c.is_compass and c.passes > 1)
    longest = max((c for c in cases if c.is_compass), key=lambda c: c.data_s)
    single, filtered = partner(cases, many), partner(cases, longest)
    sigma, sigma_many = (float(np.median(c.sigma)) for c in (single, many))
    pairs = [(case.errors, partner(cases, case).errors) for case in stored.values()]
    together = [float(np.corrcoef(*pair)[0, 1]) for pair in pairs]
    by_name = {c.name: c.rms for c in cases}
    values = {
        "starts": source.draws,
        "once": f"{once.rms:.1f} arcmin",
        "reflected": f"{reflected.rms:.1f} arcmin",
        "delay": f"{source.study.values('turn_smoothing_s')[cases.index(reflected)]:g} s",
        "filter": f"{many.rms:.2f} arcmin",
        "sigma": {"once": f"{sigma:.1f}", "many": f"{sigma_many:.1f} arcmin"},
        "long": {"compass": f"{longest.rms:.2f}", "filter": f"{filtered.rms:.2f} arcmin"},
        "together": f"{min(together):.2f} to {max(together):.2f}",
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
        "the filter with the most data is within what the reference can tell": filtered.rms < 0.5,
        "the filter takes each pass for new data": sigma_many < sigma / 2,
        "the reflecting turn is best on the shortest record only": all(
            (case.rms < stored["velocity", data_s].rms) == (data_s == short)
            for (turn, data_s), case in stored.items()
            if turn == "reflect"
        ),
    }
    tables, figures = {"car": _expected(first)}, {"car": _strips(source, first)}
    return Page({"car": values}, tables, figures, claims)


def _expected(cases: Sequence[Case]) -> Table:
    """Return the rms heading error of each length of data with repeated passes of the compass."""
    rms = {(c.data_s, c.kind): f"{c.rms:.2f}" for c in reversed(cases)}  # the first of each stays
    repeated = [case for case in cases if case.turn]
    kinds = [*dict.fromkeys(case.kind for case in repeated), partner(cases, repeated[0]).kind]
    lengths = sorted({case.data_s for case in repeated})
    rows = [[f"{data_s:g} s", *(rms[data_s, kind] for kind in kinds)] for data_s in lengths]
    header = ["data", *(kind.removeprefix("compass, ") for kind in kinds[:-1]), f"{kinds[-1]} once"]
    return Table("Rms heading error (arcmin)", header, rows)


def _strips(source: Source, cases: Sequence[Case]) -> Picture:
    """Every start time of each kind, by length of the data."""
    rows = sorted(cases, key=lambda case: (case.data_s, not case.is_compass, case.passes))
    figure = strips(
        {f"{c.data_s:g} s × {c.passes}, {c.kind}": c.errors for c in rows},
        "Heading error at the end, from the reference",
        "heading error (arcmin)",
        kinds=[case.kind for case in rows],
    )
    caption = f"Dots: {source.draws} start times; bars: their medians."
    return Picture("car", caption, figure, source.sample_size_text)
