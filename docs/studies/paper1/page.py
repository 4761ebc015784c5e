"""Numbers of the page on paper 1: its conditions, its resets, its limit, its statements."""

from collections.abc import Mapping, Sequence
from itertools import combinations

import numpy as np
import pyarrow as pa
from matplotlib.figure import Figure

from sinsjax import analysis, plots
from sinsjax.analysis import format_estimate, numeric_column
from sinsjax.analysis.formats import format_percent
from sinsjax.execution.source import Source
from sinsjax.plots import Ensemble
from sinsjax.plots.labels import format_value
from sinsjax.plots.style import GREY
from sinsjax.report.base import Picture, Table
from sinsjax.report.study_page import Page, Sources

from ..common.words import arcmin, share
from ..loops.runs import limits_of
from .figures import Verdicts, verdict_bars, yaw_errors
from .statements import AS_PRECISE_ARCMIN, CONDITIONS, RESET, STATEMENTS, Judged, best_of, judge_all

BAND_ARCMIN = 10.0
COLUMNS = ("settle_10_s", "phi_u_mean_arcmin", "floor_arcmin")
PRINTED_LIMITS = {"e": -1.7189, "n": 1.7189, "u": -27.0248}  # of section 2.4.1, arcmin


def page(sources: Sources) -> Page:
    """Figs 2 and 5, the limit accuracy, and every statement under every interpretation."""
    free, reset = sources["paper1_conditions"], sources["paper1_resets"]
    readings = sources["paper1_readings"]
    plain, with_resets = _runs(free, CONDITIONS[:-1]), _runs(reset, ("1", "5", RESET))
    runs = {**plain, RESET: with_resets[RESET]}
    shown, beside = _ensembles(free, plain), _ensembles(reset, with_resets)
    band = (
        f"Mean and 95 % of {free.draws} Monte Carlo runs. Grey: within"
        f" {BAND_ARCMIN:g} arcmin of the bias floor, settled."
    )
    figures = {
        "answer": Picture(
            "resets",
            f"After the paper's Fig. 5. {band} Dotted: resets.",
            _heading(reset, beside, "condition 5, with and without resets"),
            reset.sample_size_text,
        ),
        "conditions": Picture(
            "conditions",
            "As above.",
            _heading(free, shown, "conditions 1 to 5"),
            free.sample_size_text,
        ),
    }
    return Page.merge(
        Page({}, {"conditions": _table(free, runs)}, figures),
        _ended(runs, with_resets["1"]),
        _limit(free, runs["1"]),
        _statements(judge_all(readings), readings),
    )


def _runs(source: Source, names: Sequence[str]) -> dict[str, pa.Table]:
    groups = {key["case"]: rows for key, rows in analysis.group_rows(source.summary, ["case"])}
    return {name: groups[f"condition {name}"] for name in names}


def _ensembles(source: Source, runs: Mapping[str, pa.Table]) -> dict[str, Ensemble]:
    ids = {f"condition {name}": rows["run_id"].to_pylist() for name, rows in runs.items()}
    return dict(zip(runs, plots.group_curves(source.curves(), ids), strict=True))


def _limit_arcmin(runs: pa.Table) -> float:
    """The heading error that the constant biases leave, the same in all runs."""
    return float(numeric_column(runs, "floor_arcmin")[0])


def _heading(source: Source, shown: Mapping[str, Ensemble], title: str) -> Figure:
    """Heading errors from the bias floor, with the settled band and the resets."""
    limit = _limit_arcmin(source.summary)
    moved = [
        one._replace(columns={"phi_u_arcmin": one.columns["phi_u_arcmin"] - limit})
        for one in shown.values()
    ]
    figure = yaw_errors({"": moved}, f"Heading error from its bias floor: {title}")
    (axes,) = figure.axes
    axes.set_xlim(0, source.study.duration_s)
    axes.axhspan(-BAND_ARCMIN, BAND_ARCMIN, color=GREY, alpha=0.25, linewidth=0)
    for time_s in source.study.reset_times()[-1]:
        axes.axvline(time_s, color=GREY, linestyle=":")
    return figure


def _table(source: Source, runs: Mapping[str, pa.Table]) -> Table:
    """Return the expected settling and heading error of each condition."""
    keys = ("phi_e0_deg", "phi_n0_deg", "phi_u0_deg")
    starts = {point["case"]: point for point in source.study.combinations("case", *keys)}
    start, end = source.study.study.window_s
    rows = []
    for name, table in runs.items():
        begun = starts[f"condition {name[0]}"]
        settle, truth, floor = (numeric_column(table, column) for column in COLUMNS)
        rows.append(
            [
                f"{name}: {', '.join(format_value(begun[key]) for key in keys)}",
                format_estimate(analysis.quantile(settle), digits=0),
                format_estimate(analysis.mean(truth - floor)),
            ]
        )
    header = ["condition: misalignment (deg)", "settled after (s)", "heading error (arcmin)"]
    every, none = (analysis.proportion(settled, source.draws) for settled in (source.draws, 0))
    note = (
        f"Median [95 % interval]; {format_percent(every)} % of the runs settle, if *never*"
        f" {format_percent(none)} %."
        f" Heading error: from the floor (from true north add {_limit_arcmin(source.summary):.1f}"
        f" arcmin), mean of {start:g} to {end:g} s. A run that passes true north on its way has not"
        " settled there."
    )
    return Table("What to expect", header, rows, note)


def _ended(runs: Mapping[str, pa.Table], first: pa.Table) -> Page:
    """Where the heading ends; ``first`` is condition 1 on the noise of the runs with resets."""
    apart = analysis.mean_difference(
        *analysis.pair_by_draw(runs[RESET], first, "phi_u_mean_arcmin")
    )
    limit = _limit_arcmin(runs["1"])
    away = [
        abs(np.mean(numeric_column(runs[name], "phi_u_arcmin")) - limit) for name in CONDITIONS[:-1]
    ]
    settled = {n: np.isfinite(numeric_column(runs[n], "settle_10_s")) for n in ("5", RESET)}
    truth = analysis.share(np.isfinite(numeric_column(runs[RESET], "settle_10_truth_s")))
    sigmas = {n: float(np.mean(numeric_column(runs[n], "sigma_u_arcmin"))) for n in runs}
    without = [sigma for name, sigma in sigmas.items() if name != RESET]
    values = {
        "limit": f"{limit:.1f} arcmin",
        "apart": arcmin(apart, 2),
        "truth": share(truth),
        "sigma": f"{sigmas[RESET]:.1f} arcmin",
        "sigma_without": f"{min(without):.1f} to {max(without):.1f}",
    }
    shares = [np.isfinite(numeric_column(table, "settle_10_s")).mean() for table in runs.values()]
    claims = {
        "every draw of a condition settles or none": set(shares) <= {0.0, 1.0},
        "every draw of condition 5 settles with resets, none without": (
            settled[RESET].all() and not settled["5"].any()
        ),
        "with resets the heading is as precise as condition 1's": (
            max(abs(apart.low), abs(apart.high)) < AS_PRECISE_ARCMIN
        ),
        "conditions 2 to 5 end ever further from the limit": away == sorted(away),
        "no run with resets settles from true north": truth.value == 0,
    }
    return Page({"ended": values}, claims=claims)


def _limit(source: Source, runs: pa.Table) -> Page:
    """The limit accuracy of section 2.4.1: as printed, in closed form, and as simulated."""
    here, paper = limits_of(source.study), limits_of(source.study, 15.0)
    means = {a: analysis.mean(numeric_column(runs, f"phi_{a}_mean_arcmin")) for a in "enu"}
    values = {
        "paper": ", ".join(f"{limit:.4f}" for limit in PRINTED_LIMITS.values()),
        "first": f"{paper.gyro:.4f} arcmin",
        "second": f"{here.accel:+.4f} arcmin",
        "here": ", ".join(f"{getattr(here, axis):.4f}" for axis in "enu"),
        "ends": ", ".join(format_estimate(mean, "", 3) for mean in means.values()),
    }
    claims = {
        "the paper's limits are the closed form, but for the heading's": all(
            abs(getattr(here, axis) - PRINTED_LIMITS[axis]) < 1e-4 for axis in "en"
        ),
        "the paper's limit is its first term alone, with 15 deg/h": (
            abs(paper.gyro - PRINTED_LIMITS["u"]) < 1e-3
        ),
        "the simulation does not end at the closed form": abs(means["u"].value - here.u) > 0.1,
    }
    return Page({"limit": values}, claims=claims)


def _statements(judged: Sequence[Judged], source: Source) -> Page:
    """Every statement under every reading."""
    best = best_of(judged)
    texts = {name: one.text for name, one in STATEMENTS.items()}
    verdicts = _verdicts(judged, [one is best for one in judged].index(True), source)
    larger, steady, ratio = (best.findings[name].number for name in ("S13", "S10", "S14"))
    explained = ("S5", "S8", "S10")  # 4 converges, 5 does not, and P is too small
    values = {
        "statements": len(texts),
        "readings": len(judged),
        "held": best.held,
        "ties": sum(one.held == best.held for one in judged) - 1,
        "larger": format_estimate(larger, digits=3),
        "steady": format_estimate(steady, digits=3),
        "ratio": format_estimate(ratio, digits=2),
        "pairs": {
            "_".join(pair): str(sum(one.holds(*pair) for one in judged))
            for pair in combinations(explained, 2)
        },
    }
    claims = {
        "the best reading is Q as printed, R as a density, feedback every second": (
            best.words == ["as printed", "density", "1 s"]
        ),
        "no reading makes the paper's explanation hold together": not any(
            one.holds(*explained) for one in judged
        ),
        "the cure and its accuracy hold under every reading": all(
            one.holds("S11", "S12") for one in judged
        ),
        "with resets P is above the squared error in little more than the share asked for": (
            0.95 <= larger.value < 0.97
        ),
        "without resets P is not smaller when steady": not best.holds("S10"),
        "with resets P ends larger than condition 1's": ratio.low > 1.1,
        "failure and its cure hold under the best reading": best.holds("S8", "S11", "S12"),
        "the covariances end equal under no reading": not any(one.holds("S14") for one in judged),
    }
    tables = {"verdicts": _verdict_table(judged)}
    return Page({"about": values}, tables, {"verdicts": verdicts}, claims)


def _verdicts(judged: Sequence[Judged], best: int, source: Source) -> Picture:
    found = [one.findings.values() for one in judged]
    verdicts = Verdicts(
        statements=[one.text for one in STATEMENTS.values()],
        holds=np.array([[finding.holds for finding in one] for one in found]),
        straddles=np.array([[finding.straddles for finding in one] for one in found]),
        best=best,
    )
    title = f"The cure holds under all {len(judged)} interpretations, equal covariances under none"
    caption = f"{source.draws} Monte Carlo runs per condition."
    return Picture("verdicts", caption, verdict_bars(verdicts, title), source.sample_size_text)


def _verdict_table(judged: Sequence[Judged]) -> Table:
    """Return whether each statement holds under each interpretation."""
    words = {True: "yes", False: "no"}
    rows = [
        [*one.words, *(f"{words[f.holds]}{' ~' * f.straddles}" for f in one.findings.values())]
        for one in judged
    ]
    header = ["Q", "R", "feedback", *(one.text for one in STATEMENTS.values())]
    note = "~: the interval includes the bound."
    return Table("Every statement and interpretation", header, rows, note, folded=True)
