"""Numbers of the page on the law of resets: 72 filters, paper 1's own, and where it fails."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sinsjax import analysis
from sinsjax.analysis import Estimate
from sinsjax.analysis.formats import format_percent
from sinsjax.analysis.grids import median_over_draws
from sinsjax.execution.source import Source
from sinsjax.report.base import Picture, Table
from sinsjax.report.study_page import Page, Sources
from sinsjax.study.reset_plan import iter_plans

from ..common.grids import Grid, grid_of, pooled_mean, shared
from ..common.settling import mean_time
from ..common.words import seconds, share
from . import listed
from .figures import MapPanel, PredictionPanel, draw_map, draw_predictions
from .surge import surge

SETTLE = "settle_10_s"
NONE, LISTED, LAW, TRIGGER, KEPT = (
    "no reset",
    "10 and 60 s",
    "law",
    "trigger",
    "law, velocity as P0",
)
POLICIES = (LAW, KEPT, TRIGGER, LISTED, NONE)
SLOW = 2.0
"""Feedback interval below which levelling is done in time, s."""

CELL = {
    "latitude": "latitude_deg",
    "q": "q_scale",
    "feedback": "feedback_interval_s",
    "force": "specific_force",
}
PRINTED, KALMAN_SINCOS, OPTIMISATION = (
    "as printed, feedback every 1 s",
    "kalman_sincos",
    "optimisation",
)


def page(sources: Sources) -> Page:
    """The law in 72 filters, its map and predictions, paper 1's sensors, and lists of times."""
    return Page.merge(
        _cells(sources["reset_law"]),
        _map(sources["reset_law_map"]),
        _own_noise(sources["reset_own_noise"]),
        surge(sources["reset_surge"]),
        _appendix(sources),
    )


def _cells(source: Source) -> Page:
    """Every policy in every filter; a run that never settles counts as the whole run."""
    study, run_s = source.study, source.study.run_s
    start = list(zip(study.values("phi_e0_deg"), study.values("phi_u0_deg"), strict=True))
    grid = grid_of(source, (SETTLE,), policy="case", start=start, **CELL)
    times = {policy: grid.at(SETTLE, policy=policy) for policy in POLICIES}
    finite = {policy: np.minimum(runs, run_s) for policy, runs in times.items()}
    ratios = {
        policy: _cell_means(finite[LAW]) / _cell_means(runs) for policy, runs in finite.items()
    }
    opened = _cell_means(finite[LAW]) / _cell_means(finite[KEPT])
    panels, predicted = _predictions(source, grid, times, run_s)
    values: dict[str, Any] = {
        "filters": ratios[LAW].size,
        "law": {"mean": seconds(pooled_mean(finite[LAW]))},
        "without": {"never": share(shared(np.isinf(times[NONE])))},
        "opened": {
            "saved": share(_saved(finite[LAW], finite[KEPT])),
            "most": f"{100 * (1 - opened.min()):.0f}",
            "least": f"{100 * (opened.max() - 1):.0f}",
        },
    }
    claims = {
        "every run of the law settles": bool(np.isfinite(times[LAW]).all()),
        "every run of the law settles with velocity as P0": bool(np.isfinite(times[KEPT]).all()),
        "opening velocity is sooner on average": _saved(finite[LAW], finite[KEPT]).low > 0,
        "10 and 60 s fails in some filters": shared(np.isinf(times[LISTED])).low > 0.02,
    }
    rows = [
        [
            policy,
            share(shared(np.isfinite(times[policy]))),
            seconds(pooled_mean(finite[policy])),
        ]
        for policy in POLICIES
    ]
    header = ["resets", "settled", "mean settling time"]
    note = (
        f"{source.runs:,} runs of {run_s:,g} s (never counts as that): latitudes of 0 to 75 deg, Q"
        " a tenth to ten times paper 1's, feedback every 0.1 to 10 s, measured force or gravity in"
        f" A(t) [95 % interval over {grid.draws} draws]. *Settled*: within 10 arcmin of the bias"
        " floor."
    )
    table = Table(f"{ratios[LAW].size} filters and places, eight starts each", header, rows, note)
    header = ["resets", "law's mean over this, geometric mean over filters (least to largest)"]
    rows = [[policy, _range(ratios[policy])] for policy in POLICIES if policy != LAW]
    by_filter = Table("The law against each, by filter", header, rows, folded=True)
    tables = {"cells": table, "by_filter": by_filter, "predictions": predicted}
    return Page(values, tables, {"predicted": panels}, claims)


def _cell_means(times: NDArray) -> NDArray:
    """Mean over starts and draws of times (start, cell..., draws), flat over the cells."""
    return times.mean(axis=(0, -1)).ravel()


def _saved(sooner: NDArray, later: NDArray) -> Estimate:
    """Share of the mean time that one policy saves, with the interval of the draws."""
    by_draw = [runs.reshape(-1, runs.shape[-1]).mean(axis=0) for runs in (sooner, later)]
    return analysis.mean(1 - by_draw[0] / by_draw[1])


def _range(ratios: NDArray) -> str:
    mean = float(np.exp(np.log(ratios).mean()))
    return f"{mean:.2f} ({ratios.min():.2f} to {ratios.max():.2f})"


def _predictions(
    source: Source, grid: Grid, times: Mapping[str, NDArray], run_s: float
) -> tuple[Picture, Table]:
    """Predicted against measured medians of four policies, by heading of the start."""
    study = source.study
    predicted = study.predicted_settling.to_list()
    keys = ("case", "phi_e0_deg", "phi_u0_deg", *CELL.values())
    points = zip(*(study.values(key) for key in keys), strict=True)
    by_point = dict(zip(points, predicted, strict=True))
    is_slow = np.array(grid.axes["feedback"]) > SLOW
    is_slow = np.broadcast_to(is_slow[:, None], times[LAW].shape[:-1])
    panels, rows = [], []
    for policy in (LAW, KEPT, LISTED, NONE):
        foreseen = np.full(times[policy].shape[:-1], np.inf)
        for at in np.ndindex(foreseen.shape):
            place = [values[k] for values, k in zip(list(grid.axes.values())[1:], at, strict=True)]
            (level, yaw), *cell = place
            time_s = by_point[policy, level, yaw, *cell]
            foreseen[at] = np.inf if time_s is None else time_s
        measured = median_over_draws(times[policy])
        panels.append(PredictionPanel(policy, foreseen, measured, is_slow))
        both = np.isfinite(foreseen) & np.isfinite(measured)
        ratio = (measured / np.where(both, foreseen, 1))[both]
        low, middle, high = np.quantile(ratio, [0.05, 0.5, 0.95])
        agreed = both | (np.isinf(foreseen) & np.isinf(measured))
        right = format_percent(analysis.share(agreed.ravel(), np.arange(agreed.size)))
        rows.append([policy, f"{middle:.2f} ({low:.2f} to {high:.2f})", right])
    caption = (
        "A point per start and filter, medians of the draws; orange: feedback every 10 s, slower"
        " than levelling."
    )
    picture = Picture(
        "predicted", caption, draw_predictions(panels, run_s), source.sample_size_text
    )
    header = ["resets", "measured over predicted, median (5 to 95 %)", "starts judged right (%)"]
    return picture, Table("Measured over predicted times", header, rows, folded=True)


def _map(source: Source) -> Page:
    """Mean settling time over the first and second of two resets, at two latitudes."""
    study, run_s = source.study, source.study.run_s
    start = list(zip(study.values("phi_e0_deg"), study.values("phi_u0_deg"), strict=True))
    grid = grid_of(
        source,
        (SETTLE,),
        latitude="latitude_deg",
        first="reset_first_s",
        later="reset_cycle_s",
        start=start,
    )
    plans = {point["latitude_deg"]: plan for point, plan in iter_plans(study)}
    panels = []
    for latitude in grid.axes["latitude"]:
        runs = np.minimum(grid.at(SETTLE, latitude=latitude), run_s)
        means = runs.mean(axis=(2, 3))
        times = plans[latitude].times_s
        panels.append(
            MapPanel(
                latitude,
                np.array(grid.axes["first"]),
                np.array(grid.axes["later"]),
                means,
                (times[2], times[3] - times[2]),
            )
        )
    caption = (
        f"Mean of eight starts, {source.draws} draws, Q and R as printed; never counts as"
        f" {run_s:g} s. Circle: the law's last two resets, after two earlier ones. Cross: 10 and"
        " 60 s."
    )
    picture = Picture("map", caption, draw_map(panels), source.sample_size_text)
    return Page({}, figures={"map": picture})


def _own_noise(source: Source) -> Page:
    """Paper 1's sensors from five starts, as printed and with the filter's Q their own noise."""
    run_s = source.study.run_s
    grid = grid_of(source, (SETTLE,), case="case", yaw="phi_u0_deg")
    cases = list(dict.fromkeys(case.partition(": ")[0] for case in grid.axes["case"]))
    rows = []
    for name in cases:
        policies = [f"{name}: {policy}" for policy in (NONE, LISTED, LAW)]
        known = policies if policies[0] in grid.axes["case"] else [name]
        cells = [_from_to(grid.at(SETTLE, case=case)) for case in known]
        rows.append([name, *cells, *[""] * (3 - len(cells))])
    header = ["filter", NONE, LISTED, LAW]
    note = f"Least and largest median of five starts up to (0, 0, 170) deg, {grid.draws} draws, s."
    own = {case: grid.at(SETTLE, case=f"{case}: {LAW}") for case in cases if case.startswith("own")}
    law = np.concatenate([runs.reshape(-1, grid.draws) for runs in own.values()])
    best = grid.at(SETTLE, case=OPTIMISATION)
    values = {
        "own": {
            "law": mean_time(law, run_s),
            "worst": f"{max(median_over_draws(runs).max() for runs in own.values()):.0f} s",
            "best": mean_time(best, run_s),
        },
    }
    ratio = np.mean(law) / np.mean(best)
    claims = {
        "with the sensors' own noise the law settles from every start": bool(
            np.isfinite(law).all()
        ),
        "the law takes 1.3 times the best method's time": 1.2 < ratio < 1.4,
        "as printed nothing settles without reset": bool(
            np.isinf(median_over_draws(grid.at(SETTLE, case=f"{PRINTED}: {NONE}"))).all()
        ),
    }
    table = Table("Paper 1's sensors and sway, 32 deg", header, rows, note, folded=True)
    return Page(values, {"own": table}, claims=claims)


def _from_to(runs: NDArray) -> str:
    medians = median_over_draws(runs)
    settled = medians[np.isfinite(medians)]
    if not settled.size:
        return "never"
    low, high = (f"{time:.0f}" for time in (settled.min(), settled.max()))
    text = low if low == high else f"{low} to {high}"
    never = medians.size - settled.size
    return f"{text}; never from {never}" if never else text


def _appendix(sources: Sources) -> Page:
    """The earlier answer, tables of listed times for one filter at one latitude."""
    answered = listed.page(sources)
    phase, failure = answered.values["phase"], answered.values["failure"]
    table = answered.tables["settings"]._replace(folded=True, title="Listed times, 32 deg")
    rows = [
        ["10 s", "17.5 and 67.5 s, between feedbacks", phase["settled"], phase["between"]],
        ["10 s", "at a feedback", "", f"{phase['on']} later than between"],
        ["10 s", "0.1 s before a feedback", "", f"{phase['before']} later than between"],
        ["1 s", "0.1 s before a feedback", "", f"{phase['often']} later than at one"],
    ]
    header = ["feedback every", "resets", "settled", "mean settling time"]
    moments = Table("Two resets within a feedback interval", header, rows, folded=True)
    values = {
        "phase": {"on": phase["on"]},
        "failure": failure,
    }
    claims = (
        "just before or with a feedback is a bad time for a reset",
        "gravity in A(t) prevents most failures",
    )
    tables = {"listed": table, "moments": moments}
    return Page(values, tables, claims={text: answered.claims[text] for text in claims})
