"""Two of paper 2's loops that do not converge: its turn, and levelling with its printed K3."""

import math
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from sinsjax import analysis, plots
from sinsjax.alignment.compass import design as loops
from sinsjax.analysis import format_estimate
from sinsjax.columns import DIVERGED_DEG
from sinsjax.plots import Line
from sinsjax.report.base import Picture, Table, only, percent
from sinsjax.report.folder import Page

from ..loops.linear import cycle_radius, heading_from_limit, loops_of
from .cases import Case, Curves

PAPER_TURN, BOTH_TURN, REFLECTED = "V flipped", "V and azimuth rate flipped", "reflected"
"""Cases of the study, by what is done at a turn."""

_LEVEL_ANGLES = ("pitch", "roll")
_NAMES = {True: "K3 by its formula", False: "K3 as printed"}
_SMALLEST_DEG = 1e-4  # that a figure of growing errors shows
_ALIKE = ("tape_s", "level_time_s", "phi_e0_deg", "phi_n0_deg", "phi_u0_deg")


def turns(cases: Sequence[Case], curves: Mapping[str, Curves]) -> Page:
    """What each turn leaves of the heading error from cycle to cycle, predicted and simulated.

    Args:
        cases: of one gyro drift.
        curves: of the cases, by label.
    """
    turning = [case for case in cases if case.scheme == 2 and len(_ends(case)) > 1]
    rows, lines, radii = [], [], {}
    for number, case in enumerate(turning):
        model, here = loops_of(case.study), curves[case.label]
        ideal, radius = _radii(case)
        radii[case.name] = radius
        cells = [f"{ideal:.4f}", f"{radius:.4f}", _long_run(radius, 2 * model.tape_s)]
        rows.append([case.name, *cells, *_cycles(case, here)])
        errors = here.errors["heading"] - case.limits.heading
        smooth = heading_from_limit(case.study, here.time_s)[None]
        lines.append(Line(case.name, here.time_s, errors, plots.colour(number)))
        lines.append(Line("linear loops" if number == 0 else "", here.time_s, smooth, "black", ":"))
    before, last = _ends(turning[0])[-2:]
    table = Table(
        "What a cycle of one reversed and one forward pass leaves of the heading error",
        [
            "turn",
            "exact turn",
            "turn as made",
            "so that",
            f"simulated, {before:g} to {last:g} s",
            "linear loops, same cycle",
            f"error at {before:g} s (deg)",
            f"at {last:g} s (deg)",
        ],
        rows,
        "Number [95 % interval]; errors from the limit. *Exact*, *as made*: factor of a cycle in"
        " the long run, the spectral radius of the linear azimuth loop, for an exact turn and for"
        " one made by a specific force that lags. So early faster modes are still there.",
    )
    values = {
        "turns": {
            "paper": f"{radii[PAPER_TURN]:.3f}",
            "rates": f"{radii[BOTH_TURN]:.3f}",
            "reflected": f"{radii[REFLECTED]:.2f}",
            "tape": f"{loops_of(turning[0].study).tape_s:g} s",
        }
    }
    claims = {
        "flipping the velocity leaves nearly all of the heading error": radii[PAPER_TURN] > 0.98,
        "flipping the azimuth rate too makes it grow": radii[BOTH_TURN] > 1,
        "reflecting the tilt makes the tape converge": radii[REFLECTED] < 0.5,
    }
    figure = _turns_figure(lines, turning[0].rows.num_rows)
    return Page(values, {"turns": table}, {"turns": figure}, claims)


def _radii(case: Case) -> tuple[float, float]:
    """Predicted factor of a cycle, for an exact turn and for a specific force that lags."""
    model = loops_of(case.study)
    of = {"damping": only(case.study, "azimuth_damping")}
    ideal = loops.cycle_radius(model.sigma, model.tape_s, model.turn, **of)
    (made,) = cycle_radius(
        np.array([model.sigma]),
        np.array([model.tape_s]),
        model.params.turn,
        smoothing_s=model.smoothing_s,
        **of,
    )
    return float(ideal), float(made)


def _ends(case: Case) -> NDArray:
    """Ends of the forward passes over a tape, s; between two of them lies a cycle."""
    tape_s = loops_of(case.study).tape_s
    passes = int(case.study.duration_s / tape_s * (1 + 1e-9))
    return np.arange(1, passes + 1, 2) * tape_s


def _cycles(case: Case, curves: Curves) -> list[str]:
    """The last cycle in cells: its factor simulated and linear, the errors before and after it."""
    ends = _ends(case)[-2:]
    before, after = (curves.at("heading", time) - case.limits.heading for time in ends)
    linear = heading_from_limit(case.study, ends)
    return [
        format_estimate(analysis.mean(after / before), digits=4),
        f"{linear[1] / linear[0]:.4f}",
        *(format_estimate(analysis.mean(errors), digits=3) for errors in (before, after)),
    ]


def _turns_figure(lines: Sequence[Line], draws: int) -> Picture:
    figure = plots.over_time(
        {"": lines},
        "Scheme 2 by what is done at a turn, heading from its limit",
        quantity="heading error from its limit (deg)",
    )
    return Picture(
        "turns",
        f"Mean over {draws} draws; shading: 95 % of them; dotted: linear loops without noise.",
        figure,
    )


def _long_run(radius: float, cycle_s: float) -> str:
    seconds = math.log(2) / abs(math.log(radius)) * cycle_s
    time = f"{seconds / 3600:.1f} h" if seconds > 3600 else f"{seconds:.0f} s"
    change = "half of it is gone" if radius < 1 else "it doubles"
    return f"{change} after {time}"


def divergence(cases: Sequence[Case], curves: Mapping[str, Curves]) -> Page:
    """How levelling with the printed K3 diverges, beside the same loop with the formula's.

    Args:
        cases: of one gyro drift.
        curves: of the cases, by label.
    """
    bad = next(case for case in cases if not case.is_stable)
    good = next(case for case in cases if _is_twin(case, bad))
    level_s = only(bad.study, "level_time_s")
    model = loops_of(bad.study)
    root = loops.roots(loops.level_polynomial(model.params.level, **model.earth))[0]
    period = 2 * math.pi / abs(root.imag)
    growth = {
        angle: _growth(bad, curves[bad.label], angle, period, level_s) for angle in _LEVEL_ANGLES
    }
    predicted = math.exp(root.real * period)
    times = [level_s / 3, 2 * level_s / 3, level_s, bad.study.duration_s]
    table = Table(
        "Largest level error so far, mean over the draws, deg",
        [
            "",
            *(f"{angle}, to {time:g} s" for angle in _LEVEL_ANGLES for time in times),
            "draws that diverge (%)",
        ],
        [_largest(case, curves[case.label], times) for case in (good, bad)],
        f"Levelling alone for {level_s:g} s. *Diverge*: the heading ends more than"
        f" {DIVERGED_DEG:g} deg from its limit.",
        folded=True,
    )
    values = {
        "k3": {
            "root": f"{root.real:+.4f} +- {abs(root.imag):.4f}j 1/s",
            "factor": f"{predicted:.2f}",
            "period": f"{period:.1f} s",
            **{angle: f"{factor:.2f}" for angle, factor in growth.items()},
        }
    }
    claims = {
        "with the printed K3 the levelling loop is unstable": bool(root.real > 0),
        "the simulated growth is the predicted one": all(
            abs(factor / predicted - 1) < 0.05 for factor in growth.values()
        ),
    }
    return Page(values, {"k3": table}, {"k3": _divergence_figure(good, bad, curves)}, claims)


def _is_twin(case: Case, other: Case) -> bool:
    """Whether a case is stable, and but for its gains the same as another."""
    alike = (only(case.study, key) == only(other.study, key) for key in _ALIKE)
    return case.is_stable and all(alike)


def _growth(case: Case, curves: Curves, angle: str, period_s: float, until_s: float) -> float:
    """The factor by which an error grows in a period of its oscillation, while it is small."""
    mean = curves.errors[angle].mean(axis=0) - getattr(case.limits, angle)
    # After a third of a period the fast root is gone.
    since = np.linspace(period_s / 3, until_s - period_s, 100)
    first, later = (np.interp(t, curves.time_s, mean) for t in (since, since + period_s))
    return float(np.sum(first * later) / np.sum(first**2))


def _largest(case: Case, curves: Curves, times_s: Sequence[float]) -> list[str]:
    cells = []
    for angle in _LEVEL_ANGLES:
        for time in times_s:
            so_far = np.abs(curves.errors[angle][:, curves.time_s <= time])
            cells.append(f"{so_far.max(axis=1).mean():.3g}")
    diverged = case.rows["status"].to_pylist().count("diverged")
    return [
        _NAMES[case.is_stable],
        *cells,
        percent(analysis.proportion(diverged, case.rows.num_rows)),
    ]


def _divergence_figure(good: Case, bad: Case, curves: Mapping[str, Curves]) -> Picture:
    def lines(angle: str) -> list[Line]:
        return [
            Line(
                _NAMES[case.is_stable],
                curves[case.label].time_s,
                np.abs(curves[case.label].errors[angle]),
                plots.colour(number),
            )
            for number, case in enumerate((good, bad))
        ]

    figure = plots.over_time(
        {angle: lines(angle) for angle in _LEVEL_ANGLES},
        "Level errors with the printed K3, from truth",
        quantity="size of the error (deg)",
        floor=_SMALLEST_DEG,
    )
    return Picture(
        "k3",
        "Size of the level errors, with the K3 that the paper prints and with that of its formula."
        f" Mean over {bad.rows.num_rows} draws; shading: 95 % of them.",
        figure,
    )
