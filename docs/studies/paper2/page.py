"""Numbers of the page on paper 2: its two schemes, and why its tables do not come out."""

from collections.abc import Sequence

import numpy as np

from sinsjax import analysis
from sinsjax.analysis import Estimate, format_estimate
from sinsjax.report.folder import Page, Sources
from sinsjax.units import ARCMIN, DEG, MICRO

from ..loops.linear import heading_from_limit
from ..loops.runs import bound_arcmin, limits_of
from .cases import PRINTED, Case, cases_of, figure, table
from .reasons import REFLECTED, gains, turns

PRINTED_K3 = "K3 as printed"


def page(sources: Sources) -> Page:
    """Figs 3 to 6, Tables 1 and 2, and the reasons."""
    static, swing = (cases_of(sources[f"paper2_{base}"]) for base in ("static", "swing"))
    named = {case.name: case for case in static if case.drift == static[0].drift}
    shown = [case for case in static if case.name != PRINTED_K3]
    stated = [c for c in shown if c["phi_u0_deg"] < 0 and c["misalignment"] == "vector"]
    first = [c for c in stated if c.drift == static[0].drift]
    figures = {
        f"fig{number + scheme}": figure(
            [case for case in cases if case.scheme == scheme], number + scheme, base
        )
        for base, cases, number in (("Static", stated, 2), ("Swing", swing, 4))
        for scheme in (1, 2)
    }
    tables = {
        "expected": table(first, "What to expect, and what is printed", folded=False),
        "table_1": table(shown, "Table 1, static base: every reading"),
        "table_2": table(swing, "Table 2, swing base"),
    }
    return Page.joined(
        Page({"draws": str(static[0].source.draws)}, tables, figures),
        _limit(static[0]),
        _unsettled([case for case in shown if case.scheme == 1]),
        turns(named),
        gains(named[PRINTED_K3]),
        _spread(first[0], named[REFLECTED]),
        _bases(first, swing),
    )


def _limit(case: Case) -> Page:
    """The limit of the heading error, and the biases that the printed means would follow from."""
    limit, random = case.limits["heading"], case["gyro_noise_deg_per_h"]
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
    moves = [abs(np.mean(case.from_limit(end) - case.from_limit(start))) for case in stated]
    centres = [means[case].value for case in stated]
    near = min(means.values(), key=lambda mean: abs(mean.value - printed))
    left = analysis.mean(first.from_limit(start))
    linear = float(heading_from_limit(first.study, np.array([start]))[0])
    values = {
        "window": f"{start:g} to {end:g} s",
        "start": f"{start:g} s",
        "moves": f"{min(moves):.3f} to {max(moves):.3f} deg",
        "means": f"{min(centres):.4f} to {max(centres):.4f} deg",
        "nearest": _deg(near),
        "readings": str(len(cases)),
        "left": _deg(left),
        "linear": f"{linear:.4f}",
    }
    claims = {
        "Scheme 1 has not settled in the window": bool(min(moves) > 0.05),
        "linear loops without noise leave the same": abs(linear - left.value) < 0.01,
        "no reading comes to the printed heading": not near.low <= printed <= near.high,
    }
    return Page({"unsettled": values}, claims=claims)


def _spread(whole: Case, tape: Case) -> Page:
    """How far apart the draws are in heading where 600 s are used and where a tape is."""
    few, many = (analysis.std(c.means("heading"), is_normal=True) for c in (tape, whole))
    least = float(bound_arcmin(tape.study, tape.loops.tape_s)) * ARCMIN / DEG
    values = {"tape": _deg(few), "whole": _deg(many), "least": f"{least:.4f} deg"}
    claims = {
        "the tape's heading scatters far more than that of 600 s": few.value > 5 * many.value,
        "it is near what the noise of the tape must leave": 1 <= few.value / least < 2,
    }
    return Page({"spread": values}, claims=claims)


def _bases(static: Sequence[Case], swing: Sequence[Case]) -> Page:
    """How far the mean headings of two bases are apart on the same noise."""
    moved = {(case["case"], case.drift): case.means("heading") for case in swing}
    apart = [
        analysis.difference(moved[case["case"], case.drift], case.means("heading"))
        for case in static
    ]
    sizes = sorted(abs(one.value) for one in apart)
    values = {"least": f"{sizes[0]:.4f}", "most": f"{sizes[-1]:.4f} deg"}
    unlike = all(one.low > 0 or one.high < 0 for one in apart)
    return Page({"bases": values}, claims={"the bases are not the same": unlike})


def _deg(estimate: Estimate) -> str:
    return format_estimate(estimate, "deg", digits=4)
