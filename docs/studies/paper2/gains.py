"""The printed gains of [P2] section 3.1 against the formulas that they are said to follow."""

import math
from collections.abc import Callable
from decimal import Decimal
from typing import NamedTuple

from sinsjax.alignment.compass import design as loops
from sinsjax.alignment.compass.design import PAPER_DAMPING, AzimuthGains, LevelGains
from sinsjax.report.base import Table

GRAVITY = 9.8
"""g of the paper's gains, m/s^2."""

RADIUS = 6378165.0
"""R of the paper's gains, m: what the printed digits of K2 fix."""

_OTHER_RADII = (6378160.0, 6378137.0)  # ellipsoids of 1967 and WGS 84


class Loop(NamedTuple):
    """A loop as the paper sets it.

    Attributes:
        name: of the loop.
        adjustment_s: the adjustment time that the paper states, s.
        sigma: what the printed K1 means, 1/s.
        k2: as printed.
        design: gains from sigma and damping.
    """

    name: str
    adjustment_s: float
    sigma: float
    k2: str
    design: Callable[..., LevelGains | AzimuthGains]


class Printed(NamedTuple):
    """A gain as the paper prints it.

    Attributes:
        loop: horizontal or azimuth.
        gain: its name.
        text: as printed.
        formula: [P2] eqs (18) and (23) for xi = sqrt(1/2).
        value: of the formula, by g = 9.8 m/s^2 and R = 6378165 m.
    """

    loop: str
    gain: str
    text: str
    formula: str
    value: float


LEVEL = Loop("horizontal", 150.0, 0.02, "1040.33306122", loops.level_gains)
AZIMUTH = Loop("azimuth", 450.0, 0.01, "259.3332653", loops.azimuth_gains)
LEVEL_K3 = "0.000081632653"
AZIMUTH_K3 = "4.082e-9"


def printed_gains() -> tuple[Printed, ...]:
    """Every gain that [P2] section 3.1 prints, beside its formula."""
    level = loops.level_gains(LEVEL.sigma, PAPER_DAMPING, gravity=GRAVITY, radius=RADIUS)
    azimuth = loops.azimuth_gains(AZIMUTH.sigma, PAPER_DAMPING, gravity=GRAVITY, radius=RADIUS)
    return (
        Printed("horizontal", "K1", "0.06", "3 σ", level.k1),
        Printed("horizontal", "K2", LEVEL.k2, "4 σ² R/g - 1", level.k2),
        Printed("horizontal", "K3", LEVEL_K3, "2 σ³/g", level.k3),
        Printed("azimuth", "K1 = K4", "0.02", "2 σ", azimuth.k1),
        Printed("azimuth", "K2", AZIMUTH.k2, "4 σ² R/g - 1", azimuth.k2),
        Printed("azimuth", "K3", AZIMUTH_K3, "4 σ⁴/g", azimuth.k3),
    )


def printed_digits(text: str) -> int:
    """Significant digits of a number as printed."""
    return len(Decimal(text).as_tuple().digits)


def agreeing_digits(text: str, value: float) -> int:
    """Significant digits of a printed number that a value has, both rounded to that many."""
    printed = Decimal(text)
    counts = range(printed_digits(text), 0, -1)
    agreed = (n for n in counts if f"{Decimal(value):.{n - 1}e}" == f"{printed:.{n - 1}e}")
    return next(agreed, 0)


def gain_blocks() -> list[Table]:
    """The tables: gains, the two values of the horizontal K3, sigma, and the radius."""
    made = _gains_table(), _loops_table(), _sigma_table(), _radius_table()
    return [one._replace(folded=True) for one in made]


def _agreement(text: str, value: float) -> str:
    return f"{agreeing_digits(text, value)} of {printed_digits(text)}"


def _gains_table() -> Table:
    rows = [
        (
            printed.loop,
            printed.gain,
            printed.text,
            printed.formula,
            f"{printed.value:.12g}",
            _agreement(printed.text, printed.value),
            _remark(printed),
        )
        for printed in printed_gains()
    ]
    return Table(
        "Gains of [P2] section 3.1, as printed and by formula",
        ("Loop", "Gain", "Printed", "Formula", "Value", "Digits that agree", "Remark"),
        rows,
        note=(
            f"g = {GRAVITY:g} m/s², R = {RADIUS:.0f} m, ξ = √½, σ = {LEVEL.sigma:g} 1/s"
            f" (horizontal) and {AZIMUTH.sigma:g} 1/s (azimuth)."
        ),
    )


def _remark(printed: Printed) -> str:
    if agreeing_digits(printed.text, printed.value) == printed_digits(printed.text):
        return ""
    ratio = f"printed / formula = {float(printed.text) / printed.value:.6g}"
    squared = 2 * LEVEL.sigma**2 / GRAVITY
    return f"{ratio}; 2 σ²/g = {squared:.8g} has {_agreement(printed.text, squared)} digits"


def _loops_table() -> Table:
    earth = {"gravity": GRAVITY, "radius": RADIUS}
    formula = loops.level_gains(LEVEL.sigma, PAPER_DAMPING, **earth)
    rows = []
    for source, gains in (
        ("printed", formula._replace(k3=float(LEVEL_K3))),
        ("formula", formula),
    ):
        found = loops.roots(loops.level_polynomial(gains, **earth))
        # Equal real parts differ in their last digit, which no order may hang on.
        listed = sorted(found, key=lambda root: (-round(root.real, 6), -root.imag))
        state = "stable" if found.real.max() < 0 else "unstable"
        rows.append((source, f"{gains.k3:.8g}", ", ".join(map(_root_text, listed)), state))
    return Table(
        "Horizontal loop with either K3", ("K3", "Value, rad/(m s)", "Roots, 1/s", "Loop"), rows
    )


def _root_text(root: complex) -> str:
    return f"{root.real:+.4f}" + (f" {root.imag:+.4f}j" if root.imag else "")


def _sigma_table() -> Table:
    rows = []
    for loop in (LEVEL, AZIMUTH):
        exponent = loop.sigma * loop.adjustment_s
        period = loops.sigma_of_period(loop.adjustment_s, PAPER_DAMPING)
        settling = loops.sigma_of_settling(loop.adjustment_s, math.exp(-exponent))
        rows.append(
            (
                loop.name,
                f"{loop.adjustment_s:g}",
                f"{period:.6f}",
                f"{settling:.6f} = {exponent:g}/{loop.adjustment_s:g}",
                f"{100 * math.exp(-exponent):.1f} %",
            )
        )
    return Table(
        "σ (1/s) from the stated adjustment times, by two readings",
        ("Loop", "Adjustment time, s", "Paper's formula", "Printed gains", "Left after it"),
        rows,
        note=(
            "The paper's formula, σ = 2π ξ/(T √(1 - ξ²)), takes the time as one damped period;"
            " the printed gains take it as a settling time, exp(-σ T)."
        ),
    )


def _radius_table() -> Table:
    header = ["R, m"]
    for loop in (LEVEL, AZIMUTH):
        header += [f"{loop.name.capitalize()} K2", "Digits that agree"]
    rows = []
    for radius in (RADIUS, *_OTHER_RADII):
        row = [f"{radius:.0f}"]
        for loop in (LEVEL, AZIMUTH):
            value = loop.design(loop.sigma, PAPER_DAMPING, gravity=GRAVITY, radius=radius).k2
            row += [f"{value:.12g}", _agreement(loop.k2, value)]
        rows.append(row)
    fixed = [
        f"{(float(loop.k2) + 1) * GRAVITY / (4 * loop.sigma**2):.5f} m by the {loop.name} loop's"
        for loop in (LEVEL, AZIMUTH)
    ]
    return Table(
        "The radius behind the printed K2",
        header,
        rows,
        note=f"R = (K2 + 1) g/(4 σ²) is {' and '.join(fixed)} printed K2.",
    )
