"""Tables that the answer rests on: every method by what moves, by start, grade and latitude."""

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


def decisions(
    field: Field, known: Mapping[str, tuple[Start, ...]], grade: float, *, folded: bool
) -> Table:
    """What to use, and what to expect, by what is known, what moves and the time there is."""
    rows = []
    for (words, starts), (moves, base) in product(known.items(), field.bases.items()):
        cells = [field.best(Cell(starts, base, grade, t)).text for t in TIMES_S]
        rows.append([words, moves, *cells])
    header = ["what is known", "what moves", *(f"{t} s" for t in TIMES_S)]
    note = (
        "Heading error from true north that 90 % of the runs stay below [its 95 % interval]. Of"
        f" {field.draws} draws every other one chose the method and the rest tell its error; two"
        " methods stand where the difference between them may be none. *None*: even the best is off"
        " by more than 10 deg."
    )
    title = f"Gyro bias {grade:g} deg/h"
    return Table(title, header, rows, "Read as the table above." if folded else note, folded)


def by_base(field: Field, starts: tuple[Start, ...], grade: float, time_s: int) -> Table:
    """Every arm on every base."""
    rows = []
    for arm in field.at(grade):
        cells = []
        for base in field.bases.values():
            errors = field.errors(arm, Cell(starts, base, grade, time_s))
            cells.append(f"{angle(reach(errors, MIDDLE))}; {angle(reach(errors))}")
        rows.append([arm, *cells])
    note = "Heading error from true north that half and 90 % of the runs stay below."
    title = f"Every method after {time_s} s, gyro bias {grade:g} deg/h, all initial misalignments"
    return Table(title, ["method", *field.bases], rows, note, folded=True)


def from_floor(field: Field, starts: tuple[Start, ...], grade: float, time_s: int) -> Table:
    """Every arm on every base, less what constant sensor biases leave."""
    rows = []
    for arm in field.at(grade):
        cells = []
        for base in field.bases.values():
            cell = Cell(starts, base, grade, time_s)
            if not np.isfinite(field.column("floor_arcmin", arm, cell)).all():
                cells.append("no limit")
                continue
            errors = field.errors(arm, cell, limit=True)
            cells.append(f"{angle(reach(errors, MIDDLE))}; {angle(reach(errors, NEARLY_ALL))}")
        rows.append([arm, *cells])
    note = (
        "Heading error from the limit of a run's own constant biases that half and 95 % of the runs"
        " stay below. A filter with bias states has none that is known once the base moves."
    )
    title = f"Every method after {time_s} s, gyro bias {grade:g} deg/h, from the limit"
    return Table(title, ["method", *field.bases], rows, note, folded=True)


def by_start(field: Field, base: str, grade: float, time_s: int) -> Table:
    """Every arm from every misalignment."""
    rows = []
    for arm in field.at(grade):
        cells = [Cell((start,), field.bases[base], grade, time_s) for start in field.starts]
        rows.append([arm, *(angle(reach(field.errors(arm, cell))) for cell in cells)])
    header = ["method", *(format_degrees(*start) for start in field.starts)]
    note = "Heading error from true north that 90 % of the runs stay below [95 % interval]."
    title = f"Every method after {time_s} s on {base}, gyro bias {grade:g} deg/h"
    return Table(title, header, rows, note, folded=True)


def settled(field: Field, starts: tuple[Start, ...], base: str, grade: float) -> Table:
    """Settling from the limit, share within the band of truth, and NEES of every arm."""
    rows = []
    for arm in field.at(grade):
        cells = [Cell(starts, field.bases[base], grade, t) for t in TIMES_S]
        within = [shared(field.errors(arm, cell) <= BAND_ARCMIN) for cell in cells]
        settle_s = field.column("settle_10_s", arm, cells[-1])
        each = np.broadcast_to(np.arange(field.draws), settle_s.shape)
        time = format_estimate(quantile(settle_s.ravel(), MIDDLE, each.ravel()), digits=0)
        if not np.isfinite(settle_s).any() and arm.startswith("kalman10"):
            time = "no limit"
        nees = field.column("nees_at_{t}", arm, cells[3])
        known = np.isfinite(nees).all()
        consistency = format_estimate(pooled_mean(nees), digits=1) if known else "-"
        rows.append([arm, *map(format_percent, within), time, consistency])
    header = ["method", *(f"{t} s (%)" for t in TIMES_S), "settles (s)", "NEES at 300 s"]
    note = (
        "Runs within 10' of true north; median time until the heading stays within 10' of its"
        " limit; mean normalised error squared, which is 3 if P tells the truth."
    )
    title = f"Within 10', settled, consistent: {base}, gyro bias {grade:g} deg/h, all misalignments"
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
    note = (
        "Heading error after 300 s that 90 % of the draws stay below, worse of two misalignments;"
        " biases and vibration as in `configs/which_alignment_fair.toml`."
    )
    return Table("From the equator to 75 deg of latitude", ["method", *header], rows, note, True)


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
