"""The loops of paper 2 that do not do as printed: the turn between passes, and the gains."""

import math
from collections.abc import Mapping
from decimal import Decimal

import numpy as np

from sinsjax import analysis, plots
from sinsjax.alignment.compass import design
from sinsjax.analysis import format_estimate
from sinsjax.plots import Line
from sinsjax.report.base import Picture, Table
from sinsjax.report.folder import Page

from ..loops.linear import cycle_radius, heading_from_limit
from .cases import Case

V_FLIPPED, BOTH_FLIPPED, REFLECTED = "V flipped", "V and azimuth rate flipped", "reflected"
"""Cases of the study, by what is done at a turn."""

GRAVITY, RADIUS = 9.8, 6378165.0
"""g and R of the paper's gains, SI; R is what the printed digits of K2 fix."""

LEVEL_SIGMA, AZIMUTH_SIGMA = 0.02, 0.01
"""Decay rates that the printed K1 mean, 1/s."""

ADJUSTMENT_S = 150.0, 450.0
"""Adjustment times that the paper states, levelling and azimuth, s."""

LEVEL_K3 = "0.000081632653"
"""As printed."""


def turns(cases: Mapping[str, Case]) -> Page:
    """What each turn leaves of the heading error from cycle to cycle, predicted and simulated.

    Args:
        cases: of one gyro drift, by name.
    """
    rows, lines, radii = [], [], {}
    tape_s, duration_s = cases[REFLECTED].loops.tape_s, cases[REFLECTED].study.duration_s
    ends = np.arange(tape_s, duration_s, 2 * tape_s)[-2:]  # of forward passes, a cycle between
    for number, name in enumerate((V_FLIPPED, BOTH_FLIPPED, REFLECTED)):
        case, model, times = cases[name], cases[name].loops, cases[name].curves.time_s
        radius = radii[name] = float(
            cycle_radius(
                model.sigma,
                tape_s,
                model.params.turn,
                damping=case["azimuth_damping"],
                smoothing_s=model.smoothing_s,
            )
        )
        before, after = map(case.from_limit, ends)
        simulated = format_estimate(analysis.mean(after / before), digits=4)
        linear = heading_from_limit(case.study, ends)
        rows.append([name, f"{radius:.4f}", simulated, f"{linear[1] / linear[0]:.4f}"])
        errors = case.curves.columns["heading"] - case.limits["heading"]
        lines.append(Line(name, times, errors, plots.colour(number)))
        predicted = heading_from_limit(case.study, times)[None]
        lines.append(Line("" if number else "linear loops", times, predicted, "black", ":"))
    span = f"{ends[0]:g} to {ends[1]:g} s"
    table = Table(
        "What a cycle of one reversed and one forward pass leaves of the heading error",
        ["turn", "in the long run", f"simulated, {span}", "linear loops, same cycle"],
        rows,
        "Number [95 % interval]; errors from the limit. *In the long run*: spectral radius of the"
        " linear azimuth loop over a cycle; so early, faster modes are still there.",
    )
    figure = plots.over_time(
        {"": lines},
        "Scheme 2 by what is done at a turn, heading from its limit",
        quantity="heading error from its limit (deg)",
    )
    values = {
        "paper": f"{radii[V_FLIPPED]:.3f}",
        "rates": f"{radii[BOTH_FLIPPED]:.3f}",
        "reflected": f"{radii[REFLECTED]:.2f}",
        "exact": f"{math.exp(-2 * AZIMUTH_SIGMA * tape_s):.2f}",
        "tape": f"{tape_s:g} s",
    }
    claims = {
        "flipping the velocity leaves nearly all of the heading error": radii[V_FLIPPED] > 0.98,
        "flipping the azimuth rate too makes it grow": radii[BOTH_FLIPPED] > 1,
        "reflecting the tilt makes the tape converge": radii[REFLECTED] < 0.5,
    }
    shown = Picture("turns", "Shading: 95 % of the draws; dotted: without noise, linear.", figure)
    return Page({"turns": values}, {"turns": table}, {"turns": shown}, claims)


def gains(printed_k3: Case) -> Page:
    """The printed gains beside the formulas of [P2] eqs (18) and (23), and what their K3 does."""
    earth = {"gravity": GRAVITY, "radius": RADIUS}
    level = design.level_gains(LEVEL_SIGMA, design.PAPER_DAMPING, **earth)
    azimuth = design.azimuth_gains(AZIMUTH_SIGMA, design.PAPER_DAMPING, **earth)
    printed = [
        ("horizontal K1", "0.06", "3 σ", level.k1),
        ("horizontal K2", "1040.33306122", "4 σ² R/g - 1", level.k2),
        ("horizontal K3", LEVEL_K3, "2 σ³/g", level.k3),
        ("azimuth K1 = K4", "0.02", "2 σ", azimuth.k1),
        ("azimuth K2", "259.3332653", "4 σ² R/g - 1", azimuth.k2),
        ("azimuth K3", "4.082e-9", "4 σ⁴/g", azimuth.k3),
    ]
    table = Table(
        "Gains of [P2] section 3.1, as printed and by formula",
        ["gain", "printed", "formula", "value"],
        [[gain, text, rule, f"{value:.12g}"] for gain, text, rule, value in printed],
        f"g = {GRAVITY:g} m/s², R = {RADIUS:.0f} m, ξ = √½, σ = {LEVEL_SIGMA:g} 1/s (horizontal)"
        f" and {AZIMUTH_SIGMA:g} 1/s (azimuth).",
        folded=True,
    )
    model = printed_k3.loops
    root = design.roots(design.level_polynomial(model.params.level, **model.earth))[0]
    period_s = 2 * math.pi / abs(root.imag)
    predicted = math.exp(root.real * period_s)
    growths = {angle: _growth(printed_k3, angle, period_s) for angle in ("pitch", "roll")}
    by_period = (design.sigma_of_period(time, design.PAPER_DAMPING) for time in ADJUSTMENT_S)
    ratio = float(LEVEL_K3) / level.k3
    values = {
        "ratio": f"{ratio:.0f}",
        "by_period": " and ".join(f"{sigma:.4f}" for sigma in by_period),
        "root": f"{root.real:+.4f} ± {abs(root.imag):.4f}j 1/s",
        "factor": f"{predicted:.2f}",
        "period": f"{period_s:.1f} s",
        **{angle: f"{growth:.2f}" for angle, growth in growths.items()},
    }
    claims = {
        "all printed gains but K3 of levelling follow their formulas to the last digit": (
            [gain for gain, text, _, value in printed if not agrees(text, value)]
            == ["horizontal K3"]
        ),
        "the printed K3 is fifty times that of its formula": round(ratio) == 50,
        "the printed K3 lacks one factor sigma": agrees(LEVEL_K3, level.k3 / LEVEL_SIGMA),
        "with the printed K3 the levelling loop is unstable": bool(root.real > 0),
        "the simulated growth is the predicted one": all(
            abs(growth / predicted - 1) < 0.05 for growth in growths.values()
        ),
        "every draw with the printed K3 diverges": bool(
            analysis.has_status(printed_k3.rows, "diverged").all()
        ),
    }
    return Page({"gains": values}, {"gains": table}, claims=claims)


def agrees(text: str, value: float) -> bool:
    """Whether a value, rounded to the significant digits of a printed number, is that number."""
    printed = Decimal(text)
    digits = len(printed.as_tuple().digits) - 1
    return f"{Decimal(value):.{digits}e}" == f"{printed:.{digits}e}"


def _growth(case: Case, angle: str, period_s: float) -> float:
    """The factor by which an error grows in a period of its oscillation, while it is small."""
    mean = case.curves.columns[angle].mean(axis=0) - case.limits[angle]
    # After a third of a period the fast root is gone.
    since = np.linspace(period_s / 3, case["level_time_s"] - period_s, 100)
    first, later = (np.interp(t, case.curves.time_s, mean) for t in (since, since + period_s))
    return float(np.sum(first * later) / np.sum(first**2))
