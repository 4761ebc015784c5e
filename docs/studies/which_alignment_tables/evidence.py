"""Tables that the answer rests on: every method by vehicle motion, start, grade and latitude."""

from collections.abc import Mapping, Sequence
from itertools import product

import numpy as np

from sinsjax.analysis import format_estimate, quantile
from sinsjax.analysis.formats import format_degrees, format_percent
from sinsjax.execution.source import Source
from sinsjax.plots.labels import format_value
from sinsjax.report.base import Table

from ..common.grids import grid_of, pooled_mean, shared
from .field import TIMES_S, Cell, Field, Start, angle, reach, worst_start

BAND_ARCMIN = 10.0
MIDDLE, NEARLY_ALL = 0.5, 0.95


def decisions(field: Field, known: Mapping[str, tuple[Start, ...]]) -> Table:
    """Best method and its error by sensor grade, prior knowledge, motion and available time."""
    rows = []
    for grade, (words, starts), (motion, base) in product(
        field.grades, known.items(), field.bases.items()
    ):
        cells = [field.best(Cell(starts, base, grade, t)).text for t in TIMES_S]
        rows.append([f"{grade:g}", words, motion, *cells])
    header = ["gyro bias (deg/h)", "prior knowledge", "vehicle motion"]
    note = (
        "Error from true north that 90 % of the runs stay below. Even draws selected the method,"
        " odd ones estimate its error; a second is listed if equally good. *None*: off by more than"
        " 10 deg."
    )
    title = "Best methods"
    return Table(title, [*header, *(f"{t} s" for t in TIMES_S)], rows, note, folded=True)


def by_base(field: Field, starts: tuple[Start, ...], grade: float, time_s: int) -> Table:
    """Every arm on every base."""
    rows = []
    for arm in field.at(grade):
        cells = []
        for base in field.bases.values():
            errors = field.errors(arm, Cell(starts, base, grade, time_s))
            cells.append(f"{angle(reach(errors, MIDDLE))}; {angle(reach(errors))}")
        rows.append([arm, *cells])
    note = "Half and 90 % of the runs."
    title = "All bases"
    return Table(title, ["method", *field.bases], rows, note, folded=True)


def from_floor(field: Field, starts: tuple[Start, ...], grade: float, time_s: int) -> Table:
    """Every arm on every base, heading error from the bias floor."""
    rows = []
    for arm in field.at(grade):
        cells = []
        for base in field.bases.values():
            cell = Cell(starts, base, grade, time_s)
            if not np.isfinite(field.column("floor_arcmin", arm, cell)).all():
                cells.append("no floor")
                continue
            errors = field.errors(arm, cell, from_floor=True)
            cells.append(f"{angle(reach(errors, MIDDLE))}; {angle(reach(errors, NEARLY_ALL))}")
        rows.append([arm, *cells])
    note = "Half and 95 % of the runs."
    title = "All bases, from the bias floor"
    return Table(title, ["method", *field.bases], rows, note, folded=True)


def by_start(field: Field, base: str, grade: float, time_s: int) -> Table:
    """Every arm from every misalignment."""
    rows = []
    for arm in field.at(grade):
        cells = [Cell((start,), field.bases[base], grade, time_s) for start in field.starts]
        rows.append([arm, *(angle(reach(field.errors(arm, cell))) for cell in cells)])
    header = ["method", *(format_degrees(*start) for start in field.starts)]
    title = f"All misalignments, {base}"
    return Table(title, header, rows, folded=True)


def settled(field: Field, starts: tuple[Start, ...], base: str, grade: float) -> Table:
    """Settling from the bias floor, share within the band of truth, and NEES of every arm."""
    rows = []
    for arm in field.at(grade):
        cells = [Cell(starts, field.bases[base], grade, t) for t in TIMES_S]
        within = [shared(field.errors(arm, cell) <= BAND_ARCMIN) for cell in cells]
        settle_s = field.column("settle_10_s", arm, cells[-1])
        each = np.broadcast_to(np.arange(field.draws), settle_s.shape)
        time = format_estimate(quantile(settle_s.ravel(), MIDDLE, each.ravel()), digits=0)
        if not np.isfinite(settle_s).any() and arm.startswith("kalman10"):
            time = "no floor"
        nees = field.column("nees_at_{t}", arm, cells[3])
        known = np.isfinite(nees).all()
        consistency = format_estimate(pooled_mean(nees), digits=1) if known else "-"
        rows.append([arm, *map(format_percent, within), time, consistency])
    header = ["method", *(f"{t} s (%)" for t in TIMES_S), "settles (s)", "NEES at 300 s"]
    note = "Settling is to within 10' of the bias floor; NEES is 3 if P is right."
    title = f"Settling and NEES, {base}"
    return Table(title, header, rows, note, folded=True)


def by_latitude(source: Source) -> Table:
    """Some methods from the equator to 75 deg, on a swaying and on a disturbed base."""
    lever = [float(np.max(one)) for one in source.study.values("lever_arm_m")]
    starts = (source.study.values(f"phi_{axis}0_deg") for axis in "enu")
    grid = grid_of(
        source,
        ["phi_u_at_300_arcmin"],
        case="case",
        latitude="latitude_deg",
        start=[tuple(one) for one in zip(*starts, strict=True)],
        disturbed=[one > 0 for one in lever],
    )
    rows = []
    for arm in grid.axes["case"]:
        cells = []
        for disturbed, latitude in product((False, True), grid.axes["latitude"]):
            errors = grid.at(
                "phi_u_at_300_arcmin", case=arm, latitude=latitude, disturbed=disturbed
            )
            cells.append(angle(worst_start(np.nan_to_num(abs(errors), nan=np.inf))))
        rows.append([arm, *cells])
    header = [
        f"{words}, {latitude:g} deg"
        for words, latitude in product(("sway", "all"), grid.axes["latitude"])
    ]
    note = "Worse of two misalignments."
    return Table("Latitudes of 0 to 75 deg", ["method", *header], rows, note, True)


def settings(sources: Sequence[Source]) -> Table:
    """What each arm sets: keys that its method reads, of one value in all of its runs."""
    rows = []
    for source in sources:
        keys = [key for key in source.study.axis_keys if key != "case"]
        texts = {key: np.asarray(list(map(_text, source.study.values(key)))) for key in keys}
        read = {key: ~source.study.without_effect(key) for key in keys}
        cases = np.asarray(source.study.values("case"))
        for arm in dict.fromkeys(cases):
            of = cases == arm
            told = [
                f"{key} = {text[of][0]}"
                for key, text in texts.items()
                if read[key][of].all() and len(set(text[of])) == 1
            ]
            rows.append([arm, "; ".join(told)])
    return Table("What each method sets", ["method", "keys"], rows, folded=True)


def _text(value: object) -> str:
    return f'"{value}"' if isinstance(value, str) else format_value(value)
