"""Numbers of the page on paper 1: its conditions, its resets, its statements."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from sinsjax import analysis, plots
from sinsjax.analysis import format_estimate
from sinsjax.plots import Ensemble, Line
from sinsjax.report.base import Picture, Source, Table, percent
from sinsjax.report.folder import Page, Sources
from sinsjax.report.output import counted
from sinsjax.report.words import arcmin, seconds, share

from ..loops.runs import limits_of
from . import limits, verdicts
from .statements import CONDITIONS, RESET, Meaning

Runs = Mapping[str, pa.Table]


def page(sources: Sources) -> Page:
    """Figs 2, 3, 5 and 6, the limit accuracy, and every statement under every reading."""
    free, reset = sources["paper1_conditions"], sources["paper1_resets"]
    readings = sources["paper1_readings"]
    judged = verdicts.judge_all(readings)
    runs, with_resets = _runs(free, CONDITIONS[:-1]), _runs(reset, ("1", "5", RESET))
    shown, shown_resets = _ensembles(free, runs), _ensembles(reset, with_resets)
    limit, limit_tables, limit_claims = limits.compared(free.study, runs["1"])
    ended, ended_claims = _ended(runs, with_resets)
    covariance, covariance_claims = _covariance(reset, shown_resets)
    about, about_claims = verdicts.told(judged)
    return Page(
        {
            "limit": limit,
            "ended": ended,
            "covariance": covariance,
            "about": about,
            "draws": str(free.study.n_draws),
            "many": str(readings.study.n_draws),
        },
        {
            "conditions": _table(free, {**runs, RESET: with_resets[RESET]}),
            "covariance": _covariance_table({**runs, RESET: with_resets[RESET]}),
            "words": verdicts.meaning_table(),
            "best": verdicts.best_table(verdicts.best_of(judged)),
            "numbers": verdicts.number_table(judged),
            **limit_tables,
        },
        {
            "answer": _resets_figure(reset, shown_resets),
            "conditions": _conditions_figure(free, shown),
            "covariance": _covariance_figure(free, reset, shown, shown_resets),
            "verdicts": verdicts.figure(judged, readings),
        },
        limit_claims | ended_claims | covariance_claims | about_claims,
    )


def _ended(runs: Runs, with_resets: Runs) -> tuple[dict[str, Any], dict[str, bool]]:
    """Where the heading ends, and how far resets leave it from condition 1's."""
    apart = analysis.difference(
        *analysis.paired(with_resets[RESET], with_resets["1"], "phi_u_mean_arcmin")
    )
    final = {name: _final(table) for name, table in {**runs, RESET: with_resets[RESET]}.items()}
    limit = float(analysis.numbers(runs["1"], "floor_arcmin")[0])
    settle = {name: analysis.numbers(table, "settle_10_s") for name, table in with_resets.items()}
    settled = {name: analysis.share(np.isfinite(times)) for name, times in settle.items()}
    truth = analysis.numbers(with_resets[RESET], "settle_10_truth_s")
    values = {
        "limit": f"{limit:.1f} arcmin",
        "apart": arcmin(apart, 2),
        "without": arcmin(final["5"]),
        "resets": arcmin(final[RESET]),
        "fourth": arcmin(final["4"]),
        "settled": share(settled[RESET]),
        "settle": seconds(analysis.quantile(settle[RESET])),
        "truth": share(analysis.share(np.isfinite(truth))),
    }
    claims = {
        "every draw of condition 5 settles with resets, none without": (
            settled[RESET].value == 1 and settled["5"].value == 0
        ),
        "with resets the heading is as precise as condition 1's": (
            max(abs(apart.low), abs(apart.high)) < Meaning(0.0, 0.0).as_precise_arcmin
        ),
        "conditions 2 to 5 end ever further from the limit": all(
            abs(final[a].value - limit) < abs(final[b].value - limit)
            for a, b in zip("1234", "2345", strict=True)
        ),
        "true north is another matter: settled runs stay further from it than the band": (
            not np.isfinite(truth).any()
        ),
    }
    return values, claims


def _covariance(source: Source, shown: Mapping[str, Ensemble]) -> Any:
    """When P lies below the true squared error with resets, and how P ends."""
    ensemble, settings = shown[RESET], source.study.study
    time = ensemble.time_s
    above = ensemble.columns["sigma_u_arcmin"] ** 2 > ensemble.columns["phi_u_arcmin"] ** 2
    part = above.mean(axis=0)
    below = time[part < 0.5]
    later = time > settings.consistency_after_s
    running = np.cumsum(part[later]) / np.arange(1, later.sum() + 1)
    enough = time[later][_to_the_end(running >= Meaning(0.0, 0.0).covariance_share)]
    ratio = (ensemble.columns["sigma_u_arcmin"] / shown["1"].columns["sigma_u_arcmin"]).mean(axis=0)
    early = int(np.argmin(np.abs(time - 2 / 3 * time[-1])))
    values = {
        "first": f"{below[0]:g}" if below.size else "-",
        "last": f"{below[-1]:g} s" if below.size else "-",
        "enough": f"{enough[0]:g} s" if enough.size else "-",
        "early": f"{time[early]:g} s",
        "ratio_early": f"{ratio[early]:.2f}",
        "ratio_end": f"{ratio[-1]:.2f}",
        "end": f"{time[-1]:g} s",
    }
    claims = {
        "with resets P lies below the squared error early on, though above it on the whole": bool(
            below.size and enough.size and below[-1] < 60
        ),
        "with resets P ends larger than condition 1's": bool(ratio[-1] > 1.1),
    }
    return values, claims


def _to_the_end(holds: NDArray) -> slice:
    """The places from which something holds to the end."""
    broken = np.flatnonzero(~holds)
    return slice(int(broken[-1]) + 1 if broken.size else 0, None)


def _final(runs: pa.Table) -> analysis.Estimate:
    return analysis.mean(analysis.numbers(runs, "phi_u_arcmin"))


def _runs(source: Source, names: tuple[str, ...]) -> dict[str, pa.Table]:
    groups = {key["case"]: rows for key, rows in analysis.groups(source.summary, ["case"])}
    return {name: groups[f"condition {name}"] for name in names}


def _ensembles(source: Source, runs: Runs) -> dict[str, Ensemble]:
    ids = {name: rows["run_id"].to_pylist() for name, rows in runs.items()}
    return {one.label: one for one in plots.ensembles(source.curves(), ids)}


def _named(shown: Mapping[str, Ensemble], *names: str) -> list[Ensemble]:
    return [shown[name]._replace(label=f"condition {name}") for name in names]


def _conditions_figure(source: Source, shown: Mapping[str, Ensemble]) -> Picture:
    figure = plots.misalignment(
        _named(shown, *CONDITIONS[:-1]),
        "Misalignment left by conditions 1 to 5 without resets, from truth",
        limits=limits_of(source.study)._asdict(),
        zoom_s=_steady(source),
    )
    caption = f"After the paper's Fig. 2. {_band(source)}. Grey: the limit."
    return Picture("conditions", caption, figure, counted(source))


def _resets_figure(source: Source, shown: Mapping[str, Ensemble]) -> Picture:
    moments = source.study.reset_times()[-1]
    figure = plots.misalignment(
        _named(shown, "1", "5", RESET),
        "Condition 5 with and without resets beside condition 1, from truth",
        limits=limits_of(source.study)._asdict(),
        resets_s=moments,
        zoom_s=_steady(source),
    )
    caption = f"After the paper's Fig. 5. {_band(source)}. Grey: the limit; dotted: resets."
    return Picture("resets", caption, figure, counted(source))


def _covariance_figure(
    free: Source, reset: Source, shown: Mapping[str, Ensemble], resets: Mapping[str, Ensemble]
) -> Picture:
    limit = limits_of(free.study).u
    panels = {
        "condition 1": _variances(shown["1"], limit),
        "condition 5": _variances(shown["5"], limit),
        "condition 5 with resets": _variances(resets[RESET], limit),
    }
    figure = plots.squares(panels, "Heading variance: what the filter believes and what is true")
    caption = (
        f"After the paper's Figs 3 and 6. {_band(free)}. The paper takes the error from truth; from"
        " the limit is what a filter without bias states can be asked for."
    )
    return Picture("covariance", caption, figure, f"{counted(free)}; {counted(reset)}")


def _variances(ensemble: Ensemble, limit: float) -> list[Line]:
    time, phi = ensemble.time_s, ensemble.columns["phi_u_arcmin"]
    believed = ensemble.columns["sigma_u_arcmin"] ** 2
    return [
        Line("the filter's variance P", time, believed, plots.colour(0), "--"),
        Line("squared error from truth", time, phi**2, plots.colour(2)),
        Line("squared error from the limit", time, (phi - limit) ** 2, plots.colour(3)),
    ]


def _steady(source: Source) -> tuple[float, float]:
    return source.study.study.steady_after_s, source.study.duration_s


def _band(source: Source) -> str:
    return f"Mean over {source.study.n_draws} draws, shading: 95 % of them"


def _table(source: Source, runs: Runs) -> Table:
    """What to expect of each condition."""
    starts = {
        point["case"].removeprefix("condition "): point
        for point in source.study.combinations("case", "phi_e0_deg", "phi_n0_deg", "phi_u0_deg")
    }
    start, end = source.study.study.window_s
    rows = []
    for name, table in runs.items():
        begun = starts.get(name, starts["5"])
        settle = analysis.numbers(table, "settle_10_s")
        angles = (f"{begun[f'phi_{axis}0_deg']:g}" for axis in "enu")
        rows.append(
            [
                f"condition {name}",
                f"({', '.join(angles)}) deg",
                percent(analysis.share(np.isfinite(settle))),
                format_estimate(analysis.quantile(settle), digits=0),
                *(
                    format_estimate(analysis.mean(analysis.numbers(table, column)), digits=1)
                    for column in ("phi_u_mean_arcmin", "sigma_u_arcmin")
                ),
            ]
        )
    header = ["", "misalignment", "settled (%)", "median time (s)", "heading error (arcmin)"]
    note = (
        f"Number [95 % interval over {source.study.n_draws} draws]. Settled: within 10 arcmin of"
        f" the limit to the end. Heading error: mean from truth, {start:g} to {end:g} s."
    )
    return Table("What to expect", [*header, "believed sigma (arcmin)"], rows, note)


def _covariance_table(runs: Runs) -> Table:
    columns = ("p_above_error_share", "p_above_error_steady_share", "p_above_floor_error_share")
    rows = [
        [
            f"condition {name}",
            *(f"{100 * np.nanmean(analysis.numbers(table, column)):.1f}" for column in columns),
        ]
        for name, table in runs.items()
    ]
    header = ["", "from truth, after 10 s", "from truth, after 300 s", "from the limit, after 10 s"]
    title = "Records with the filter's heading variance above the squared error (%)"
    return Table(title, header, rows, folded=True)
