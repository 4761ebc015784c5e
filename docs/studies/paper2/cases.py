"""Paper 2's simulation, section 3.2: its schemes as the study reads them, beside what it prints.

An error is estimate minus truth, which is -phi; heading is positive counter-clockwise.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from sinsjax import analysis, plots
from sinsjax.analysis import format_estimate
from sinsjax.plots import Line, Mark
from sinsjax.report.base import Picture, Source, Table, only
from sinsjax.report.output import counted
from sinsjax.study.load import one_variant
from sinsjax.study.study import Study
from sinsjax.units import ARCMIN, DEG

from ..loops.runs import limits_of

ANGLES = {"pitch": "e", "roll": "n", "heading": "u"}
"""The paper's attitude angles, and the axis of phi that each is an error about."""

PRINTED = {
    1: {"pitch": 0.00261, "roll": -0.00208, "heading": 0.0251},
    2: {"pitch": 0.00234, "roll": -0.00209, "heading": 0.0236},
}
"""Tables 1 and 2 by scheme, deg; the two tables are identical."""

_DIGITS = {"pitch": 5, "roll": 5, "heading": 4}  # decimals of a degree in the paper's tables
_STYLES = ("-", "--")  # of the gyro drifts
_REACH_DEG = 0.5  # of an enlargement; a run further off would flatten all others
_FROM_PHI = -ARCMIN / DEG


@dataclass(frozen=True, eq=False)
class Case:
    """One variant of a study: a scheme, how it is read, and a gyro drift.

    Attributes:
        source: what it is of.
        study: of this variant alone.
        rows: its runs, one a draw.
    """

    source: Source
    study: Study
    rows: pa.Table

    def __getitem__(self, key: str) -> Any:
        """The value of a key of the study."""
        return only(self.study, key)

    @property
    def drift(self) -> float:
        """Constant gyro drift, deg/h."""
        return float(self["gyro_bias_deg_per_h"])

    @property
    def scheme(self) -> int:
        """1 where the data are gone over once, 2 where a tape is gone over again."""
        return 1 if self["tape_s"] >= self.study.duration_s else 2

    @property
    def name(self) -> str:
        """The label without the scheme."""
        return str(self["case"]).removeprefix(f"Scheme {self.scheme}, ")

    @cached_property
    def limits(self) -> dict[str, float]:
        """What the errors settle to by angle, deg."""
        found = limits_of(self.study)
        return {angle: _FROM_PHI * getattr(found, axis) for angle, axis in ANGLES.items()}

    def means(self, angle: str) -> NDArray:
        """Window means of an angle's error by draw, (draws,), deg."""
        return _FROM_PHI * analysis.numbers(self.rows, f"phi_{ANGLES[angle]}_mean_arcmin")

    @cached_property
    def curves(self) -> plots.Ensemble:
        """Errors over time by angle, (draws, T), deg."""
        columns = ["run_id", "time_s", *(f"phi_{axis}_arcmin" for axis in ANGLES.values())]
        ids = self.rows["run_id"].to_pylist()
        (phi,) = plots.ensembles(self.source.curves(ids).select(columns), {self.name: ids})
        errors = {a: _FROM_PHI * phi.columns[f"phi_{axis}_arcmin"] for a, axis in ANGLES.items()}
        return phi._replace(columns=errors)

    def from_limit(self, time_s: float) -> NDArray:
        """Heading errors from the limit at the record nearest to a time, (draws,), deg."""
        nearest = int(np.argmin(np.abs(self.curves.time_s - time_s)))
        return self.curves.columns["heading"][:, nearest] - self.limits["heading"]


def cases_of(source: Source) -> list[Case]:
    """The variants of a study, in its order."""
    groups = analysis.groups(source.summary, ["variant_id"])
    return [Case(source, one_variant(source.study, k["variant_id"]), rows) for k, rows in groups]


def figure(cases: Sequence[Case], number: int) -> Picture:
    """The attitude errors of one scheme, as a figure of the paper.

    A colour for each reading, a style for each drift.
    """
    first, source = cases[0], cases[0].source
    start, end = source.study.study.window_s
    names = list(dict.fromkeys(case.name for case in cases))
    drifts = {case.drift: case.limits for case in cases}
    styles = dict(zip(drifts, _STYLES, strict=True))
    lines: dict[str, list[Line]] = {angle: [] for angle in ANGLES}
    for case in cases:
        look = plots.colour(names.index(case.name)), styles[case.drift]
        label = f"{case.name}, drift {case.drift:g} deg/h"
        for angle, here in lines.items():
            here.append(Line(label, case.curves.time_s, case.curves.columns[angle], *look))
    marks = [Mark(f"limit, drift {d:g} deg/h", at, styles[d]) for d, at in drifts.items()]
    drawn = plots.attitude_errors(
        lines,
        f"Static base, Scheme {first.scheme}: attitude error from truth",
        marks=[*marks, Mark("printed", PRINTED[first.scheme], "-.", "black")],
        zoom_s=(max(0.0, 2 * start - end), end),
        reach=_REACH_DEG,
    )
    caption = (
        f"After the paper's Fig. {number}. Mean over {source.draws} Monte Carlo runs; shading: 95 %"
        f" of them. The enlargement leaves out lines {_REACH_DEG:g} deg and more from a limit."
    )
    return Picture(f"fig{number}", caption, drawn, counted(source))


def table(cases: Sequence[Case], title: str, *, folded: bool = True) -> Table:
    """Window means, those that the paper prints above those of each scheme."""
    rows = []
    for scheme, printed in PRINTED.items():
        numbers = (f"{printed[angle]:.{digits}f}" for angle, digits in _DIGITS.items())
        rows.append([f"Scheme {scheme}, as printed", "", *numbers, ""])
        rows += [_row(case) for case in cases if case.scheme == scheme]
    start, end = cases[0].source.study.study.window_s
    header = ["", "gyro drift (deg/h)", *(f"{angle} (deg)" for angle in ANGLES), "its limit (deg)"]
    note = (
        f"Mean error from {start:g} to {end:g} s [95 % interval over {cases[0].source.draws}"
        " draws], the last column: where the heading would settle."
    )
    return Table(title, header, rows, note, folded=folded)


def _row(case: Case) -> list[str]:
    means = (
        format_estimate(analysis.mean(case.means(angle)), digits=digits)
        for angle, digits in _DIGITS.items()
    )
    return [str(case["case"]), f"{case.drift:g}", *means, f"{case.limits['heading']:.4f}"]
