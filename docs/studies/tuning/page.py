"""Numbers of the page on tuned reset schedules and gains."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from sinsjax import analysis, plots
from sinsjax.analysis import Estimate
from sinsjax.execution.source import Source
from sinsjax.plots.labels import format_value
from sinsjax.report import tuning_figures
from sinsjax.report.base import Picture, Table
from sinsjax.report.study_page import Page, Sources
from sinsjax.study.study import Study
from sinsjax.tuning import results
from sinsjax.tuning.results import Tuning
from sinsjax.tuning.run_tuning import GRADIENT, LAW

from ..common.grids import grid_of, pooled_mean
from ..common.words import seconds

STUDIES = {
    "small": "tune_condition5",
    "large": "tune_large",
    "belief": "tune_filter",
    "compass": "tune_compass",
}
QUESTIONS = {
    "small": "paper 1's condition 5",
    "large": "eight large misalignments",
    "belief": "the same, P0, Q and R of the plain two",
    "compass": "compass gains",
}
EQUAL, BASELINE = "equal cost", "baseline"
PLAIN, PLAIN_TUNED_Q = "plain two", "plain two, tuned Q"
TUNED, WITHOUT_LAST = "tuned", "tuned, without the last reset"
PLAIN_S = (10.0, 60.0)
CONDITION_5 = (5.0, 30.0)  # deg, level and heading error
SETTLE = "settle_10_s"
SHIFTED = {
    "plain": "the plain two",
    "sobol": "Sobol points",
    "other": "another search",
    "robust": "the same over four shifts",
    "put_off": "the plain two, put off to the next feedback",
}
SHIFTS_S = np.arange(-10, 10) / 20  # of configs/tuned_phase.toml, schedule by schedule


def page(sources: Sources) -> Page:
    """What each tuning found, judged on noise that tuned nothing, beside the plain two resets."""
    tunings = {name: results.Tuning.from_source(sources[study]) for name, study in STUDIES.items()}
    beside = sources["tuned_schedules"]
    grid = grid_of(beside, (SETTLE, "nees"), case="case", start=_starts(beside.study))

    def time_s(case: str, **start: tuple[float, float]) -> Estimate:
        return pooled_mean(np.minimum(grid.at(SETTLE, case=case, **start), beside.study.run_s))

    plain = {"small": time_s(PLAIN, start=CONDITION_5), "large": time_s(PLAIN)}
    nees = {case: pooled_mean(grid.at("nees", case=case)) for case in grid.axes["case"]}
    cases = {case: time_s(case) for case in grid.axes["case"]}
    values: dict[str, Any] = {name: _told(tuning) for name, tuning in tunings.items()}
    for name, one in plain.items():
        values[name]["plain"] = seconds(one)
    for name in ("small", "large"):
        values[name]["law"] = seconds(tunings[name].score(LAW))
    values["large"] |= {
        "tuned_q": seconds(cases[PLAIN_TUNED_Q]),
        "without_last": seconds(cases[WITHOUT_LAST]),
    }
    values["nees"] = {"tuned": f"{nees[TUNED].value:.0f}"}
    values["sizes"] = {
        f"{when}_{how}": count
        for how, tuning in (("on", tunings["small"]), ("each", tunings["large"]))
        for when, count in (
            ("tuned", tuning.tune.tune_draws),
            ("judged", tuning.run_values.shape[2]),
        )
    }
    del values["belief"]["baseline"], values["compass"]["baseline"]  # of the table only
    claims = _claims(tunings) | {
        "the plain two are nearly as fast at condition 5": (
            plain["small"].value < 1.1 * tunings["small"].score(tunings["small"].best).value
        ),
        "most of the gain is that of Q": (
            cases[PLAIN].value - cases[PLAIN_TUNED_Q].value
            > 0.8 * (cases[PLAIN].value - cases[TUNED].value)
        ),
        "the tuned Q breaks NEES": nees[TUNED].low > 5 * nees[PLAIN].high,
        "the two last resets are no single one": cases[TUNED].high < cases[WITHOUT_LAST].low,
    }
    seen = _seen(tunings["small"], sources[STUDIES["small"]])
    page = Page(values, {"expected": _expected(tunings, plain)}, {"seen": seen}, claims)
    belief = _filter(tunings, sources[STUDIES["belief"]])
    return Page.merge(page, belief, _shifted(sources["tuned_phase"]))


def _filter(tunings: Mapping[str, Tuning], source: Source) -> Page:
    """P0, Q and R, tuned."""
    tuning, times = tunings["belief"], tunings["large"]
    # By candidate, misalignment and draw: the cases of the judging are its outermost dimension.
    every = analysis.numeric_column(source.rows(["nees"]), "nees")
    by_variant = every.reshape(-1, source.study.n_variants).T
    by_case = by_variant.reshape(-1, tuning.study.n_variants, by_variant.shape[1])
    nees = {
        name: pooled_mean(by_case[tuning.case_numbers[candidate]])
        for name, candidate in (("tuned", tuning.best), ("given", BASELINE))
    }
    apart = tuning.difference(GRADIENT)
    values = {
        "nees": f"{nees['tuned'].value:.0f}",
        "nees_given": f"{nees['given'].value:.0f}",
    }
    best = tuning.score(tuning.best)
    claims = {
        "a tuned filter needs no tuned times": best.high < times.score(times.best).low,
        "by smooth variables all searches find the same": (
            apart.low < 5.0 and apart.high > -5.0 and abs(apart.value) < 5.0
        ),
        "a tuned filter believes too much": nees["tuned"].low > 3 * nees["given"].high,
    }
    return Page({"search": values}, claims=claims)


def _shifted(source: Source) -> Page:
    """Settling times of four schedules, with all resets shifted within a feedback interval."""
    study = source.study
    keys = ("reset_times_s", "q_scale", "reset_at_feedback")
    schedules = list(zip(*map(study.values, keys), strict=True))
    grid = grid_of(source, (SETTLE,), schedule=schedules, start=_starts(study))
    runs = np.minimum(grid.at(SETTLE), study.run_s)
    runs = runs.reshape(len(SHIFTED), len(SHIFTS_S), *runs.shape[1:])
    times = [[pooled_mean(one) for one in of] for of in runs]
    over = {name: pooled_mean(of) for name, of in zip(SHIFTED, runs, strict=True)}
    _, sobol, _, robust, _ = runs.mean(axis=(1, 2))  # over shifts and misalignments, by draw
    apart = analysis.mean_difference(robust, sobol)
    plain, found, put_off = ([one.value for one in times[at]] for at in (0, 3, 4))
    figure = plots.draw_along_axis(
        "shift_s",
        list(SHIFTS_S),
        {"mean settling time (s)": dict(zip(SHIFTED.values(), times, strict=True))},
        title="Where resets fall between two feedbacks decides: heading from its bias floor",
    )
    figure.axes[-1].set_xlabel("shift of all resets (s), with feedback every second")
    caption = (
        "Mean settling time over eight misalignments; bars: 95 % intervals. Shift 0: each schedule"
        " as found."
    )
    told = ("plain", "sobol", "robust", "put_off")
    values = {name: seconds(over[name]) for name in told} | {
        "apart": seconds(apart, 1),
        "plain_range": f"{min(plain):.0f} to {max(plain):.0f} s",
        "robust_range": f"{min(found):.0f} to {max(found):.0f} s",
    }
    claims = {
        "over all shifts the robust schedule beats Sobol's": apart.high < 0,
        "no shift of it takes a fifth longer than its mean": max(found)
        < 1.2 * over["robust"].value,
        "the plain two hang on the shift": max(plain) > 1.3 * min(plain),
        "put off they do not": max(put_off) < 1.02 * min(put_off),
    }
    pictures = {"shifted": Picture("shifted", caption, figure, source.sample_size_text)}
    return Page({"shifted": values}, figures=pictures, claims=claims)


def _seen(tuning: Tuning, source: Source) -> Picture:
    """Where the searches with two reset times looked, with the plain two marked."""
    (seen,) = tuning_figures.landscape_pictures(tuning)
    (axes, *_) = seen.figure.axes
    axes.plot(*PLAIN_S, "X", color="white", markeredgecolor="black", markersize=11)
    axes.annotate(
        "plain: 10 and 60 s", PLAIN_S, (9, -4), textcoords="offset points", fontweight="bold"
    )
    title = "When to reset twice: mean settling time, heading from its bias floor"
    seen.figure.suptitle(title, fontweight="bold")
    caption = (
        f"Condition 5, each pair of reset times over {tuning.tune.tune_draws} runs; light is good."
        " Lines: gradient descents."
    )
    return Picture("small_seen", caption, seen.figure, source.sample_size_text)


def _starts(study: Study) -> list[tuple[float, float]]:
    """Level and heading error of each variant, deg."""
    return list(zip(study.values("phi_e0_deg"), study.values("phi_u0_deg"), strict=True))


def _told(tuning: Tuning) -> dict[str, str]:
    gradient, rival = tuning.searches[GRADIENT], tuning.searches[tuning.rival]
    return {
        "best": seconds(tuning.score(tuning.best)),
        "baseline": seconds(tuning.score(BASELINE)),
        "gradient": seconds(tuning.difference(GRADIENT), 1),
        "equal": seconds(tuning.difference(EQUAL), 1),
        "cost": f"{100 * gradient.cost / rival.cost:.0f} %",
    }


def _claims(tunings: Mapping[str, Tuning]) -> dict[str, bool]:
    apart = {name: one.difference(GRADIENT) for name, one in tunings.items()}
    return {
        "every tuning beats its baseline": all(
            one.score(one.best).high < one.score(BASELINE).low for one in tunings.values()
        ),
        "no search beats the law with two reset times": (
            tunings["small"].score(tunings["small"].best).value >= tunings["small"].score(LAW).value
        ),
        "with more variables the gradient falls behind": (
            apart["large"].low > 0 and apart["compass"].low > 0
        ),
        "the gradient costs a fifth": all(
            one.searches[GRADIENT].cost < 0.21 * one.searches[one.rival].cost
            for one in tunings.values()
        ),
        "a search of the same cost does as well where the gradient falls behind": all(
            tunings[name].difference(EQUAL).value < apart[name].value
            for name in ("large", "compass")
        ),
    }


def _expected(tunings: Mapping[str, Tuning], plain: Mapping[str, Estimate]) -> Table:
    """The best of each tuning beside the paper's settings and the plain two resets."""
    rows = []
    for name, tuning in tunings.items():
        found = {}
        candidates = {"the paper's": BASELINE, "the law": LAW, "tuned": tuning.best}
        for label, candidate in candidates.items():
            if candidate not in tuning.case_numbers:
                continue  # the law has no times where none are tuned
            case = tuning.evaluation_study.cases[tuning.case_numbers[candidate]]
            settings = (f"{key} = {_shown(value)}" for key, value in case.items() if key != "case")
            found[label] = "; ".join(settings), tuning.score(candidate)
        if name in plain:
            found["plain two"] = f"reset_times_s = {_shown(PLAIN_S)}", plain[name]
        rows += [[QUESTIONS[name], how, keys, seconds(s)] for how, (keys, s) in found.items()]
    note = (
        "Mean time until the heading stays within 10 arcmin of its bias floor [95 % interval over"
        " runs that tuned nothing]; compass gains: the time by which 90 % are within 3 arcmin"
        " (600 s: never)."
    )
    header = ["question", "how", "settings", "time"]
    return Table("What to set, and what to expect", header, rows, note, folded=True)


def _shown(value: Any) -> str:
    if isinstance(value, list | tuple):
        return f"[{', '.join(_shown(one) for one in value)}]"
    return f"{value:.3g}" if isinstance(value, float) else format_value(value)
