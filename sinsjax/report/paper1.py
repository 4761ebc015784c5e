"""Paper 1's simulation: Figs 2 and 3 without resets, Figs 5 and 6 with them."""

from collections.abc import Mapping

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from sinsjax import analysis, plots
from sinsjax.analysis import format_estimate
from sinsjax.errors import InputError
from sinsjax.plots import Ensemble, Line
from sinsjax.report.base import (
    Block,
    Picture,
    Report,
    Section,
    Source,
    Table,
    percent,
    value_text,
    yardstick,
)
from sinsjax.report.limits import limit_accuracy, limit_blocks, only
from sinsjax.report.statements import CONDITIONS, RESET
from sinsjax.study.study import Study


def report_conditions(source: Source) -> Report:
    """Conditions 1 to 5 without resets: Figs 2 and 3, and the limit accuracy."""
    runs = _runs(source, CONDITIONS[:-1])
    shown = _ensembles(source, runs)
    limits = limit_accuracy(source.study)
    fig2 = plots.misalignment(
        list(shown.values()),
        "Misalignment left by conditions 1 to 5 without resets",
        limits=limits,
        zoom_s=_steady(source.study),
    )
    panels = {
        _label(name): _variance_lines(shown[_label(name)], limits["u"]) for name in ("1", "5")
    }
    fig3 = plots.squares(
        panels, "Yaw variance without resets: what the filter believes and what is true"
    )
    blocks: list[Block] = [
        Picture(
            "fig2",
            f"After the paper's Fig. 2. {_band(source)}; grey: the limit, what the constant"
            " sensor biases leave of the error however long the filter runs.",
            fig2,
        ),
        _table(source, runs),
    ]
    covariance: list[Block] = [
        Picture(
            "fig3",
            f"After the paper's Fig. 3. {_band(source)}. The paper takes the total squared error;"
            " from the limit is what a filter without bias states can be asked for.",
            fig3,
        ),
        _covariance_table(runs, source.study),
    ]
    return Report(
        [f"Conditions, {_reading(source.study)}: {_ended(runs)}."],
        [
            Section("Conditions 1 to 5 without resets (Fig. 2)", blocks),
            Section("Covariance and true error, conditions 1 and 5 (Fig. 3)", covariance),
            Section(
                "Limit accuracy (section 2.4.1)", limit_blocks(source.study, runs[_label("1")])
            ),
        ],
    )


def report_resets(source: Source) -> Report:
    """Condition 5 with resets beside condition 1: Figs 5 and 6."""
    runs = _runs(source, ("1", "5", RESET))
    shown = _ensembles(source, runs)
    limits = limit_accuracy(source.study)
    moments = runs[_label(RESET)]["reset_times_s"][0].as_py()
    fig5 = plots.misalignment(
        [shown[_label(name)] for name in ("1", RESET)],
        f"Condition 5 with {len(moments)} resets beside condition 1",
        limits=limits,
        resets_s=moments,
        zoom_s=_steady(source.study),
    )
    with_resets = shown[_label(RESET)]
    lines = [
        _variance(shown[_label("1")], "P, condition 1", 0),
        _variance(with_resets, f"P, {_label(RESET)}", 1),
        *_errors(with_resets, limits["u"]),
    ]
    fig6 = plots.squares(
        {"against the true error of condition 5 with resets": lines},
        "Yaw variance with resets: what the filter believes and what is true",
        resets_s=moments,
    )
    apart = analysis.difference(
        *analysis.paired(runs[_label(RESET)], runs[_label("1")], "phi_u_mean_arcmin")
    )
    start, end = source.study.study.window_s
    return Report(
        [
            f"Resets at {value_text(moments)} s, {_reading(source.study)}: {_ended(runs)}."
            f" Over {start:g} to {end:g} s the yaw with resets is apart from condition 1's by"
            f" {format_estimate(apart, 'arcmin', 2)} on the same noise.",
            _below(source, with_resets),
            _sigma_ratio(with_resets, shown[_label("1")]),
        ],
        [
            Section(
                "Condition 5 with resets (Fig. 5)",
                [
                    Picture(
                        "fig5", f"After the paper's Fig. 5. {_band(source)}; dotted: resets.", fig5
                    ),
                    _table(source, runs),
                ],
            ),
            Section(
                "Covariance with resets (Fig. 6)",
                [
                    Picture(
                        "fig6", f"After the paper's Fig. 6. {_band(source)}; dotted: resets.", fig6
                    ),
                    _covariance_table(runs, source.study),
                ],
            ),
        ],
    )


def _below(source: Source, ensemble: Ensemble) -> str:
    """When P lies below the true squared error, and how long a run must be for S13 to hold."""
    time, study = ensemble.time_s, source.study
    squared = ensemble.columns["phi_u_arcmin"] ** 2
    share = (ensemble.columns["sigma_u_arcmin"] ** 2 > squared).mean(axis=0)
    below = time[share < 0.5]
    text = "With resets the filter's yaw variance, in most draws,"
    if below.size == 0:
        return f"{text} is above the true squared error throughout (S13)."
    counted = time > study.study.consistency_after_s
    running = np.cumsum(share[counted]) / np.arange(1, counted.sum() + 1)
    least = study.statements.covariance_share
    enough = time[counted][_last_run(running >= least)]
    told = (
        f"{text} lies below the true squared error at {below.size} records from {below[0]:g} to"
        f" {below[-1]:g} s. That it is larger *throughout* (S13: at {100 * least:g} % of the"
        f" records after {study.study.consistency_after_s:g} s) is"
    )
    if enough.size == 0:
        return f"{told} not so."
    return f"{told} so because the run is long: if it ended before {enough[0]:g} s it would not be."


def _last_run(holds: NDArray) -> slice:
    """The places from which something holds to the end."""
    broken = np.flatnonzero(~holds)
    return slice(int(broken[-1]) + 1 if broken.size else 0, None)


def _sigma_ratio(ensemble: Ensemble, other: Ensemble) -> str:
    """By how much the believed sigmas differ, two thirds on and at the end."""
    ratio = (ensemble.columns["sigma_u_arcmin"] / other.columns["sigma_u_arcmin"]).mean(axis=0)
    time = ensemble.time_s
    early = int(np.argmin(np.abs(time - 2 / 3 * time[-1])))
    return (
        "Whether the yaw covariances end about equal (S14) cannot be read off the paper, which"
        f" shows two lines in a figure and prints no number: here the filter's 1 sigma with resets"
        f" is {ratio[early]:.2f} times that of condition 1 at {time[early]:g} s, and"
        f" {ratio[-1]:.2f} times at {time[-1]:g} s."
    )


def _label(name: str) -> str:
    """A condition of `CONDITIONS` as the cases of the studies are labelled."""
    return f"condition {name}"


def _runs(source: Source, names: tuple[str, ...]) -> dict[str, pa.Table]:
    """The runs of each condition by its label; the study is known to have them."""
    groups = {key["case"]: rows for key, rows in analysis.groups(source.summary, ["case"])}
    return {_label(name): groups[_label(name)] for name in names}


def _ensembles(source: Source, runs: Mapping[str, pa.Table]) -> dict[str, Ensemble]:
    curves = source.curves()
    if curves.num_rows == 0:
        raise InputError(f"{source.directory}: its layout needs curves (use `sinsjax run`)")
    ids = {label: rows["run_id"].to_pylist() for label, rows in runs.items()}
    return {ensemble.label: ensemble for ensemble in plots.ensembles(curves, ids)}


def _variance(ensemble: Ensemble, label: str, number: int) -> Line:
    values = ensemble.columns["sigma_u_arcmin"] ** 2
    return Line(label, ensemble.time_s, values, plots.colour(number), "--")


def _errors(ensemble: Ensemble, limit: float) -> list[Line]:
    """The true squared yaw error, in total and from its limit."""
    phi, time = ensemble.columns["phi_u_arcmin"], ensemble.time_s
    return [
        Line("true squared error, total", time, phi**2, plots.colour(2)),
        Line("true squared error, from the limit", time, (phi - limit) ** 2, plots.colour(3)),
    ]


def _variance_lines(ensemble: Ensemble, limit: float) -> list[Line]:
    return [_variance(ensemble, "P, the filter's yaw variance", 0), *_errors(ensemble, limit)]


def _table(source: Source, runs: Mapping[str, pa.Table]) -> Table:
    start, end = source.study.study.window_s
    rows = []
    yards = source.yardsticks
    for label, table in runs.items():
        ok = (analysis.share(table[yard.ok].fill_null(False).to_numpy()) for yard in yards)
        cells = (
            *(analysis.quantile(analysis.numbers(table, yard.settle)) for yard in yards),
            *(analysis.mean(analysis.numbers(table, f"phi_{a}_mean_arcmin")) for a in "enu"),
            analysis.mean(analysis.numbers(table, "sigma_u_arcmin")),
        )
        digits = (*(0 for _ in yards), 2, 2, 1, 1)
        printed = (format_estimate(c, digits=d) for c, d in zip(cells, digits, strict=True))
        rows.append([label, *map(percent, ok), *printed])
    return Table(
        f"Over {source.study.n_draws} draws",
        [
            "",
            *(f"ok: {yard.words} (%)" for yard in yards),
            *(f"time to {yard.words}, median (s)" for yard in yards),
            "phi_e (arcmin)",
            "phi_n (arcmin)",
            "phi_u (arcmin)",
            "sigma_u at the end (arcmin)",
        ],
        rows,
        f"Number [95 % interval]. phi: mean over {start:g} to {end:g} s. {yardstick(source.study)}",
    )


def _covariance_table(runs: Mapping[str, pa.Table], study: Study) -> Table:
    """How often P is above the true squared error."""
    columns = ("p_above_error_share", "p_above_error_steady_share", "p_above_floor_error_share")
    shares = ([analysis.numbers(table, column) for column in columns] for table in runs.values())
    rows = [
        [label, *(f"{100 * np.nanmean(share):.1f}" for share in here)]
        for label, here in zip(runs, shares, strict=True)
    ]
    after, steady = study.study.consistency_after_s, study.study.steady_after_s
    header = ["", f"after {after:g} s", f"after {steady:g} s", f"from the limit, after {after:g} s"]
    return Table("Records with P above the true squared error (%)", header, rows)


def _ended(runs: Mapping[str, pa.Table]) -> str:
    """Where the yaw of each case ends, in words."""
    found = (
        f"{label} {analysis.mean(analysis.numbers(table, 'phi_u_arcmin')).value:.1f}"
        for label, table in runs.items()
    )
    limit = analysis.numbers(next(iter(runs.values())), "floor_arcmin")[0]
    return f"mean phi_u at the end, arcmin (limit {limit:.1f}): {', '.join(found)}"


def _reading(study: Study) -> str:
    q, r = only(study, "q_reading"), only(study, "r_reading")
    return f"Q `{q}`, R `{r}`, feedback {only(study, 'feedback_interval_s'):g} s (inferred)"


def _steady(study: Study) -> tuple[float, float]:
    """The span that is enlarged: the paper's steady process."""
    return study.study.steady_after_s, study.duration_s


def _band(source: Source) -> str:
    return f"Mean over {source.study.n_draws} draws; shading: 95 % of them"
