"""Paper 2's simulation, section 3.2: Figs 3 to 6 and Tables 1 and 2, beside what it prints.

An error is estimate minus truth, which is -phi; heading is positive counter-clockwise.
"""

from collections.abc import Sequence
from itertools import cycle
from typing import NamedTuple

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from sinsjax import analysis, plots
from sinsjax.analysis import Estimate, format_estimate
from sinsjax.plots import Line, Mark
from sinsjax.report.base import Picture, Source, Table, only, value_text
from sinsjax.report.output import counted
from sinsjax.study.load import one_variant
from sinsjax.study.study import Study
from sinsjax.units import ARCMIN, DEG

from ..loops.linear import Limits, limits_of

ANGLES = {"pitch": "e", "roll": "n", "heading": "u"}
"""The paper's attitude angles, and the axis of phi that each is an error about."""

DIGITS = {"pitch": 5, "roll": 5, "heading": 4}
"""Decimals of a degree in the paper's tables."""

PRINTED = {
    1: {"pitch": 0.00261, "roll": -0.00208, "heading": 0.0251},
    2: {"pitch": 0.00234, "roll": -0.00209, "heading": 0.0236},
}
"""Tables 1 and 2 by scheme, deg; the two tables are identical."""

_STYLES = ("-", "--", ":")
_REACH_DEG = 0.5  # of an enlargement; a run further off would flatten all others


class Case(NamedTuple):
    """One variant of a study: a scheme, how it is read, and a gyro drift.

    Attributes:
        label: of the case.
        drift: constant gyro drift, deg/h.
        scheme: 1 where the data are gone over once, 2 where a tape is gone over again.
        study: of this variant alone.
        limits: of its attitude errors.
        rows: its runs, one a draw.
    """

    label: str
    drift: float
    scheme: int
    study: Study
    limits: Limits
    rows: pa.Table

    @property
    def name(self) -> str:
        """The label without the scheme."""
        return self.label.removeprefix(f"Scheme {self.scheme}, ")

    @property
    def is_stable(self) -> bool:
        """Whether its loops are; an unstable one has `allow_unstable` set."""
        return not only(self.study, "allow_unstable")

    @property
    def starts_as_stated(self) -> bool:
        """Whether the heading error begins at the paper's sign."""
        return only(self.study, "phi_u0_deg") <= 0

    def mean_errors(self, angle: str) -> NDArray:
        """Window means of an angle's error, (draws,), deg, by draw."""
        return self._in_window(angle, "mean") * -1

    def window_stds(self, angle: str) -> NDArray:
        """Standard deviations of an angle's error inside the window, (draws,), deg."""
        return self._in_window(angle, "std")

    def _in_window(self, angle: str, statistic: str) -> NDArray:
        column = f"phi_{ANGLES[angle]}_{statistic}_arcmin"
        return analysis.numbers(self.rows, column) * ARCMIN / DEG


class Curves(NamedTuple):
    """Attitude errors of a case over time.

    Attributes:
        time_s: (T,) update times, s.
        errors: (draws, T) by angle, deg.
    """

    time_s: NDArray
    errors: dict[str, NDArray]

    def at(self, angle: str, time_s: float) -> NDArray:
        """Errors at the record nearest to a time, (draws,), deg."""
        return self.errors[angle][:, int(np.argmin(np.abs(self.time_s - time_s)))]


def cases_of(source: Source, misalignment: str = "vector") -> list[Case]:
    """The variants of a study that read the initial errors in one way, in its order.

    Args:
        source: of the results.
        misalignment: ``vector``, as all tables and figures do, or ``euler``.
    """
    study = source.study
    cases = []
    for key, rows in analysis.groups(source.summary, ["variant_id"]):
        one = one_variant(study, key["variant_id"])
        if only(one, "misalignment") != misalignment:
            continue
        tape = only(one, "tape_s")
        cases.append(
            Case(
                label=only(one, "case"),
                drift=only(one, "gyro_bias_deg_per_h"),
                scheme=1 if tape is None or tape >= study.duration_s else 2,
                study=one,
                limits=limits_of(one),
                rows=rows,
            )
        )
    return cases


def curves_of(source: Source, cases: Sequence[Case]) -> list[Curves]:
    """The attitude errors of some cases over time."""
    columns = [f"phi_{axis}_arcmin" for axis in ANGLES.values()]
    ids = {str(i): case.rows["run_id"].to_pylist() for i, case in enumerate(cases)}
    table = source.curves(run for runs in ids.values() for run in runs)
    made = plots.ensembles(table.select(["run_id", "time_s", *columns]), ids)
    factor = -ARCMIN / DEG
    return [
        Curves(
            one.time_s,
            {a: factor * one.columns[f"phi_{axis}_arcmin"] for a, axis in ANGLES.items()},
        )
        for one in made
    ]


def drift_text(drift: float) -> str:
    """A gyro drift in words."""
    return f"{value_text(drift)} deg/h"


def figure(source: Source, cases: Sequence[Case], number: int, base: str) -> Picture:
    """The attitude errors of one scheme, as a figure of the paper."""
    start, end = source.study.study.window_s
    scheme = cases[0].scheme
    drawn = plots.attitude_errors(
        _lines(cases, curves_of(source, cases)),
        f"{base} base, Scheme {scheme}: attitude error from truth",
        marks=[*_marks(cases), Mark("printed", PRINTED[scheme], "-.", "black")],
        zoom_s=(max(0.0, 2 * start - end), end),
        reach=_REACH_DEG,
    )
    caption = (
        f"After the paper's Fig. {number}. Mean over {source.study.n_draws} draws; shading: 95 %"
        " of them. Error: estimate minus truth, heading counter-clockwise."
    )
    from_limits = (np.mean(case.mean_errors("heading")) - case.limits.heading for case in cases)
    if any(abs(error) > _REACH_DEG for error in from_limits):
        caption += f" The enlargement leaves out lines {_REACH_DEG:g} deg and more from a limit."
    return Picture(f"fig{number}", caption, drawn, counted(source))


def _lines(cases: Sequence[Case], curves: Sequence[Curves]) -> dict[str, list[Line]]:
    """Lines by angle: a colour for each reading, a style for each drift."""
    names = list(dict.fromkeys(case.name for case in cases))
    styles = _styles(cases)
    lines: dict[str, list[Line]] = {angle: [] for angle in ANGLES}
    for case, one in zip(cases, curves, strict=True):
        look = plots.colour(names.index(case.name)), styles[case.drift]
        label = f"{case.name}, drift {drift_text(case.drift)}"
        for angle, here in lines.items():
            here.append(Line(label, one.time_s, one.errors[angle], *look))
    return lines


def _marks(cases: Sequence[Case]) -> list[Mark]:
    """The limits of each drift."""
    styles = _styles(cases)
    return [
        Mark(
            f"limit, drift {drift_text(drift)}",
            {angle: getattr(limits, angle) for angle in ANGLES},
            styles[drift],
        )
        for drift, limits in {case.drift: case.limits for case in cases}.items()
    ]


def _styles(cases: Sequence[Case]) -> dict[float, str]:
    drifts = dict.fromkeys(case.drift for case in cases)
    return dict(zip(drifts, cycle(_STYLES), strict=False))


def table(source: Source, cases: Sequence[Case], number: int) -> Table:
    """Window means beside the paper's table."""
    start, end = source.study.study.window_s
    rows = []
    for scheme in (1, 2):
        printed = [f"{PRINTED[scheme][angle]:.{DIGITS[angle]}f}" for angle in ANGLES]
        rows.append([f"Scheme {scheme}, as printed", "", *printed, "", "", ""])
        rows += [_row(case) for case in cases if case.scheme == scheme]
    return Table(
        f"Table {number}: mean error from {start:g} to {end:g} s, {source.study.n_draws} draws",
        [
            "",
            "gyro drift (deg/h)",
            *(f"{angle} (deg)" for angle in ANGLES),
            "heading's limit (deg)",
            "heading: std inside the window (deg)",
            "heading: std over draws (deg)",
        ],
        rows,
        "Number [95 % interval]. Error: estimate minus truth, heading counter-clockwise.",
        folded=number == 2,
    )


def _row(case: Case) -> list[str]:
    means = {angle: analysis.mean(case.mean_errors(angle)) for angle in ANGLES}
    return [
        case.label,
        value_text(case.drift),
        *(format_estimate(means[angle], digits=DIGITS[angle]) for angle in ANGLES),
        f"{case.limits.heading:.4f}",
        _deg(analysis.mean(case.window_stds("heading"))),
        _spread(case),
    ]


def _spread(case: Case) -> str:
    """The standard deviation over the draws; of runs that ended in several ways, two quantiles."""
    heading = case.mean_errors("heading")
    if len(case.rows["status"].unique()) == 1:
        return _deg(analysis.std(heading, is_normal=True))  # noise alone, through linear loops
    low, high = (analysis.quantile(heading, q).value for q in (0.1, 0.9))
    return f"10 to 90 %: {low:.4f} to {high:.4f}"


def _deg(estimate: Estimate) -> str:
    return format_estimate(estimate, digits=4)
