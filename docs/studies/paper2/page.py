"""Numbers of the page on paper 2: its two schemes, and why its tables do not come out.

An error is estimate minus truth, which is -phi; heading is positive counter-clockwise.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from decimal import Decimal
from functools import cached_property
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from sinsjax import analysis, plots
from sinsjax.analysis import format_estimate
from sinsjax.execution.source import Source
from sinsjax.methods.compass import design
from sinsjax.plots import Line
from sinsjax.report.base import Picture, Table
from sinsjax.report.study_page import Page, Sources
from sinsjax.study.load import select_variant
from sinsjax.study.study import Study
from sinsjax.units import ARCMIN, DEG, MICRO

from ..loops.runs import limits_of
from ..loops.turns import TURNS, cycle_radius
from .lines import over_time

PRINTED_K3 = "K3 as printed"
V_FLIPPED, BOTH_FLIPPED, REFLECTED = "V flipped", "V and azimuth rate flipped", "reflected"
"""Cases of the study, by what is done at a turn."""

GRAVITY, RADIUS = 9.8, 6378165.0
"""g and R of the paper's gains, SI; R is what the printed digits of K2 fix."""

LEVEL_SIGMA, AZIMUTH_SIGMA = 0.02, 0.01
"""Decay rates that the printed K1 mean, 1/s."""

LEVEL_K3 = "0.000081632653"
"""As printed."""

ANGLES = {"pitch": "e", "roll": "n", "heading": "u"}
"""The paper's attitude angles, and the axis of phi that each is an error about."""

PRINTED = {
    1: {"pitch": 0.00261, "roll": -0.00208, "heading": 0.0251},
    2: {"pitch": 0.00234, "roll": -0.00209, "heading": 0.0236},
}
"""Tables 1 and 2 by scheme, deg; the two tables are identical."""

_DIGITS = {"pitch": 5, "roll": 5, "heading": 4}  # decimals of a degree in the paper's tables
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
        return self.study.single_value(key)

    @property
    def drift(self) -> float:
        """Constant gyro drift, deg/h."""
        return float(self["gyro_bias_deg_per_h"])

    @property
    def scheme(self) -> int:
        """1 where the data are gone over once, 2 where a tape is gone over again."""
        return 1 if self["stored_s"] >= self.study.duration_s else 2

    @property
    def name(self) -> str:
        """The label without the scheme."""
        return str(self["case"]).removeprefix(f"Scheme {self.scheme}, ")

    @cached_property
    def limit(self) -> float:
        """What the heading error settles to, deg."""
        return _FROM_PHI * limits_of(self.study).u

    def means(self, angle: str) -> NDArray:
        """Window means of an angle's error by draw, (draws,), deg."""
        return _FROM_PHI * analysis.numeric_column(self.rows, f"phi_{ANGLES[angle]}_mean_arcmin")

    @cached_property
    def heading(self) -> tuple[NDArray, NDArray]:
        """Times (T,), s, and heading errors from the limit (draws, T), deg."""
        columns, ids = ["run_id", "time_s", "phi_u_arcmin"], self.rows["run_id"].to_pylist()
        (phi,) = plots.group_curves(self.source.curves(ids).select(columns), {self.name: ids})
        return phi.time_s, _FROM_PHI * phi.columns["phi_u_arcmin"] - self.limit

    def from_floor(self, time_s: float) -> NDArray:
        """Heading errors from the limit at the record nearest to a time, (draws,), deg."""
        times, errors = self.heading
        return np.asarray(errors[:, int(np.argmin(np.abs(times - time_s)))])


def page(sources: Sources) -> Page:
    """Table 1, and why it does not come out as printed."""
    static, swing = (cases_of(sources[f"paper2_{base}"]) for base in ("static", "swing"))
    shown = [case for case in static if case.name != PRINTED_K3]
    first = [c for c in shown if c.drift == static[0].drift and c["phi_u0_deg"] < 0]
    first = [c for c in first if c["misalignment"] == "vector"]
    named = {case.name: case for case in static if case.drift == static[0].drift}
    tables = {
        "expected": _expected(first),
        "table_1": _table_1(shown),
    }
    return Page.merge(
        Page({}, tables),
        _limit(static[0]),
        _unsettled([case for case in shown if case.scheme == 1]),
        _turns(named),
        _gains(named[PRINTED_K3]),
        _bases(first, swing),
    )


def _limit(case: Case) -> Page:
    """The limit of the heading error, and the biases that the printed means would follow from."""
    limit, random = case.limit, case["gyro_noise_deg_per_h"]
    printed = [of_scheme["heading"] for of_scheme in PRINTED.values()]
    parts = limits_of(case.study)  # the first is linear in the drift
    drifts = [
        case.drift * (-heading * DEG / ARCMIN - parts.accel) / parts.gyro for heading in printed
    ]
    levels = [abs(p[a]) * DEG / MICRO for p in PRINTED.values() for a in ("pitch", "roll")]
    values = {
        "drift": f"{case.drift:g} deg/h",
        "heading": f"{limit:.4f} deg",
        "implied": " and ".join(f"{drift:.4f}" for drift in drifts) + " deg/h",
        "random": f"{random:g} deg/h",
        "printed": " and ".join(f"{heading:.4f}" for heading in printed) + " deg",
        "levels": f"{min(levels):.0f} to {max(levels):.0f}",
        "accel": f"{case['accel_bias_ug']:g} ug",
    }
    claims = {
        "the stated drift cannot settle to the printed headings": limit > 2 * max(printed),
        "the printed headings are limits of a drift of the size of the stated random one": all(
            abs(drift / random - 1) < 0.1 for drift in drifts
        ),
    }
    return Page({"limit": values}, claims=claims)


def _unsettled(cases: Sequence[Case]) -> Page:
    """How far from its limit the heading of Scheme 1 is in the window, and how it moves there."""
    first, printed = cases[0], PRINTED[1]["heading"]
    start, end = first.source.study.study.window_s
    means = {case: analysis.mean(case.means("heading")) for case in cases}
    stated = [case for case in cases if case.drift == first.drift]
    moves = [abs(np.mean(case.from_floor(end) - case.from_floor(start))) for case in stated]
    centres = [means[case].value for case in stated]
    near = min(means.values(), key=lambda mean: abs(mean.value - printed))
    left = analysis.mean(first.from_floor(start))
    values = {
        "window": _window(first),
        "start": f"{start:g} s",
        "moves": f"{min(moves):.3f} to {max(moves):.3f} deg",
        "means": f"{min(centres):.4f} to {max(centres):.4f} deg",
        "nearest": format_estimate(near, "deg", 4),
        "readings": len(cases),
        "left": format_estimate(left, "deg", 4),
    }
    claims = {
        "Scheme 1 has not settled in the window": min(moves) > 0.05,
        "it has not settled in the mean over the draws": abs(left.value)
        > 50 * (left.high - left.low),
        "no reading comes to the printed heading": not near.low <= printed <= near.high,
    }
    return Page({"unsettled": values}, claims=claims)


def _bases(static: Sequence[Case], swing: Sequence[Case]) -> Page:
    """How far the mean headings of two bases are apart on the same noise."""
    moved = {(case["case"], case.drift): case.means("heading") for case in swing}
    apart = [
        analysis.mean_difference(moved[case["case"], case.drift], case.means("heading"))
        for case in static
    ]
    sizes = sorted(abs(one.value) for one in apart)
    values = {"least": f"{sizes[0]:.4f}", "most": f"{sizes[-1]:.4f} deg"}
    unlike = all(one.low > 0 or one.high < 0 for one in apart)
    return Page({"bases": values}, claims={"the bases are not the same": unlike})


def _turns(cases: Mapping[str, Case]) -> Page:
    """What each turn leaves of the heading error from cycle to cycle, with one gyro drift."""
    shown = [cases[name] for name in (V_FLIPPED, BOTH_FLIPPED, REFLECTED)]
    stored_s = shown[0]["stored_s"]
    radii = [float(cycle_radius(c.study, c["turn"], AZIMUTH_SIGMA, stored_s)) for c in shown]
    lines = [
        Line(TURNS[case["turn"]], *case.heading, plots.line_colour(number))
        for number, case in enumerate(shown)
    ]
    begins = float(np.mean(shown[0].from_floor(0.0)))
    ends = [float(np.mean(case.means("heading"))) - case.limit for case in shown]
    values = {
        "begins": f"{begins:.1f} deg",
        "grows": f"{ends[0]:.1f} deg",
        "ends": f"{abs(ends[2]):.2f} deg",
        "paper": f"{radii[0]:.3f}",
        "rates": f"{radii[1]:.3f}",
        "reflected": f"{radii[2]:.2f}",
        "exact": f"{math.exp(-2 * AZIMUTH_SIGMA * stored_s):.2f}",
        "tape": f"{stored_s:g} s",
    }
    claims = {
        "with the paper's turn the heading error grows and stays": (
            ends[0] > 1.5 * begins and 0.98 < radii[0] < 1
        ),
        "reversing the azimuth rate too makes it grow": radii[1] > 1,
        "reflecting the tilt makes the tape converge": radii[2] < 0.5 and abs(ends[2]) < 0.1,
    }
    figure = over_time(
        {"": lines},
        "Heading error of Scheme 2 from its bias floor, by its turn",
        quantity="heading error from its bias floor (deg)",
    )
    caption = f"Static base; mean and 95 % of {shown[0].source.draws} Monte Carlo runs."
    picture = Picture("turns", caption, figure, shown[0].source.sample_size_text)
    return Page({"turns": values}, figures={"turns": picture}, claims=claims)


def _gains(printed_k3: Case) -> Page:
    """The printed gains beside the formulas of [P2] eqs (18) and (23), and what their K3 does."""
    earth = {"gravity": GRAVITY, "radius": RADIUS}
    level = design.level_gains(LEVEL_SIGMA, design.PAPER_DAMPING, **earth)
    azimuth = design.azimuth_gains(AZIMUTH_SIGMA, design.PAPER_DAMPING, **earth)
    printed = {
        "0.06": level.k1,
        "1040.33306122": level.k2,
        LEVEL_K3: level.k3,
        "0.02": azimuth.k1,
        "259.3332653": azimuth.k2,
        "4.082e-9": azimuth.k3,
    }
    as_printed = level._replace(k3=np.float64(LEVEL_K3))
    root = design.roots(design.level_polynomial(as_printed, **earth))[0]
    period_s = 2 * math.pi / abs(root.imag)
    ratio = float(LEVEL_K3) / level.k3
    values = {
        "ratio": f"{ratio:.0f}",
        "root": f"{root.real:+.4f} ± {abs(root.imag):.4f}j 1/s",
        "factor": f"{math.exp(root.real * period_s):.2f}",
        "period": f"{period_s:.1f} s",
    }
    claims = {
        "all printed gains but K3 of levelling follow their formulas to the last digit": (
            [text for text, value in printed.items() if not agrees(text, value)] == [LEVEL_K3]
        ),
        "the printed K3 is fifty times that of its formula": round(ratio) == 50,
        "the printed K3 lacks one factor sigma": agrees(LEVEL_K3, level.k3 / LEVEL_SIGMA),
        "with the printed K3 the levelling loop is unstable": root.real > 0,
        "every draw with the printed K3 diverges": (
            analysis.status_mask(printed_k3.rows, "diverged").all()
        ),
    }
    return Page({"gains": values}, claims=claims)


def agrees(text: str, value: float) -> bool:
    """Whether a value, rounded to the significant digits of a printed number, is that number."""
    printed = Decimal(text)
    digits = len(printed.as_tuple().digits) - 1
    return f"{Decimal(value):.{digits}e}" == f"{printed:.{digits}e}"


def cases_of(source: Source) -> list[Case]:
    """The variants of a study, in its order."""
    groups = analysis.group_rows(source.summary, ["variant_id"])
    return [Case(source, select_variant(source.study, k["variant_id"]), rows) for k, rows in groups]


def _window(case: Case) -> str:
    start, end = case.source.study.study.window_s
    return f"{start:g} to {end:g} s"


def _by_scheme(cases: Sequence[Case]) -> list[tuple[str, dict[str, float], list[Case]]]:
    """Return the label and means of each printed row, and the cases of its scheme."""
    return [
        (f"Scheme {scheme}, as printed", printed, [case for case in cases if case.scheme == scheme])
        for scheme, printed in PRINTED.items()
    ]


def _label(case: Case) -> str:
    if case.scheme == 1:
        return str(case["case"])
    return ", ".join(["Scheme 2", TURNS[case["turn"]], *case.name.split(", ")[1:]])


def _mean(case: Case, angle: str) -> str:
    return format_estimate(analysis.mean(case.means(angle)), digits=_DIGITS[angle])


def _printed(means: Mapping[str, float]) -> list[str]:
    return [f"{means[angle]:.{digits}f}" for angle, digits in _DIGITS.items()]


def _expected(cases: Sequence[Case]) -> Table:
    """Return the window means of the heading with one gyro drift next to the printed ones."""
    rows = []
    for label, printed, of_scheme in _by_scheme(cases):
        rows.append([label, _printed(printed)[-1]])
        rows += [[_label(case), _mean(case, "heading")] for case in of_scheme]
    first = cases[0]
    note = (
        f"Mean error from {_window(first)} [95 % interval] with {first.drift:g} deg/h of drift;"
        f" floor {first.limit:.4f} deg."
    )
    return Table("Expected and printed", ["", "heading (deg)"], rows, note)


def _table_1(cases: Sequence[Case]) -> Table:
    """Return the window means of every case next to the printed ones."""
    rows = []
    for label, printed, of_scheme in _by_scheme(cases):
        rows.append([label, "", *_printed(printed), ""])
        for case in of_scheme:
            means = (_mean(case, angle) for angle in ANGLES)
            rows.append([_label(case), f"{case.drift:g}", *means, f"{case.limit:.4f}"])
    header = ["", "gyro drift (deg/h)", *(f"{angle} (deg)" for angle in ANGLES), "bias floor (deg)"]
    note = "With pitch, roll and floors."
    return Table("Table 1, static base: every interpretation", header, rows, note, folded=True)
