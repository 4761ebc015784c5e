"""Numbers of the page on paper 2: its two schemes, and why its tables do not come out."""

from collections.abc import Sequence

from sinsjax import analysis
from sinsjax.analysis import format_estimate
from sinsjax.report.base import Table
from sinsjax.report.folder import Page, Sources

from . import reasons, turns
from .cases import PRINTED, Case, cases_of, curves_of, figure, table
from .gains import AZIMUTH, LEVEL_K3, gain_blocks, printed_gains


def page(sources: Sources) -> Page:
    """Figs 3 to 6, Tables 1 and 2, and the reasons."""
    static, swing = sources["paper2_static"], sources["paper2_swing"]
    cases = cases_of(static)
    stated = [case for case in cases if case.drift == cases[0].drift]
    curves = dict(zip((c.label for c in stated), curves_of(static, stated), strict=True))
    figures, tables = {}, {}
    for number, (source, base) in enumerate(((static, "Static"), (swing, "Swing"))):
        here = [case for case in cases_of(source) if case.is_stable]
        tables[f"table_{number + 1}"] = table(source, here, number + 1)
        for scheme in (1, 2):
            shown = [c for c in here if c.starts_as_stated and c.scheme == scheme]
            place = 2 + 2 * number + scheme
            figures[f"fig_{place}"] = figure(source, shown, place, base)
    gains = dict(zip(("gains", "level_loop", "sigmas", "radius"), gain_blocks(), strict=True))
    return Page.joined(
        Page({"draws": str(static.study.n_draws)}, tables | gains, figures),
        _expected(stated),
        _gains(),
        reasons.limit(cases),
        reasons.unsettled(cases, curves),
        turns.turns(stated, curves),
        turns.divergence(stated, curves),
        reasons.spread(stated),
        reasons.bases([static, swing]),
        reasons.angles(static, stated),
    )


def _expected(cases: Sequence[Case]) -> Page:
    """What each scheme ends with, from truth and from its limit."""
    start, end = cases[0].study.study.window_s
    rows = []
    for case in cases:
        if case.is_stable and case.starts_as_stated:
            mean = analysis.mean(case.mean_errors("heading"))
            away = mean.value - case.limits.heading
            rows.append([case.label, format_estimate(mean, digits=4), f"{away:+.4f}"])
    printed = [f"{PRINTED[scheme]['heading']:.4f}" for scheme in (1, 2)]
    note = f"Mean from {start:g} to {end:g} s; printed: {printed[0]} and {printed[1]} deg."
    header = ["", "heading error from truth (deg)", "from its limit (deg)"]
    return Page({}, {"expected": Table("What to expect", header, rows, note)})


def _gains() -> Page:
    """The one printed gain that is not its formula."""
    found = {(one.loop, one.gain): one.value for one in printed_gains()}
    ratio = float(LEVEL_K3) / found["horizontal", "K3"]
    values = {"gains": {"ratio": f"{ratio:.0f}", "sigma": f"{AZIMUTH.sigma:g} 1/s"}}
    return Page(
        values, claims={"the printed K3 is fifty times that of its formula": round(ratio) == 50}
    )
