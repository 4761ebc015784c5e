"""Paper 1's simulation: Figs 2, 3, 5 and 6, and the limit accuracy of section 2.4.1."""

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
from scipy.spatial.transform import Rotation

from sinsjax import analysis, plots
from sinsjax.analysis import format_estimate
from sinsjax.plots import Ensemble, Line
from sinsjax.report.base import (
    Block,
    Picture,
    Report,
    Section,
    Source,
    Table,
    Text,
    percent,
    value_text,
)
from sinsjax.statements import CONDITIONS, RESET
from sinsjax.studies import Study
from sinsjax.types import InputError
from sinsjax.units import ARCMIN, DEG, DEG_PER_H, MICRO

PAPER_LIMITS_ARCMIN = {"e": -1.7189, "n": 1.7189, "u": -27.0248}
"""Limit accuracy as section 2.4.1 prints it: pitch, roll, yaw."""

_PAPER_RATE_DEG_PER_H = 15.0  # the Earth rate that gives the paper's yaw limit to all digits
_CASE = "condition {}".format


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
    panels = {_CASE(name): _variance_lines(shown[_CASE(name)], limits["u"]) for name in ("1", "5")}
    fig3 = plots.squares(
        panels, "Yaw variance without resets: what the filter believes and what is true"
    )
    blocks: list[Block] = [
        Picture("fig2", f"As the paper's Fig. 2. {_band(source)}; grey: the limit.", fig2),
        _table(source, runs),
    ]
    covariance: list[Block] = [
        Picture(
            "fig3",
            f"As the paper's Fig. 3. {_band(source)}. The paper compares P with the total squared"
            " error; from the limit is what a filter without bias states can be asked for.",
            fig3,
        ),
        Text(_covariance_text(runs, source.study)),
    ]
    return Report(
        [f"Conditions, {_reading(source.study)}: {_ended(runs)}."],
        [
            Section("Conditions 1 to 5 without resets (Fig. 2)", blocks),
            Section("Covariance and true error, conditions 1 and 5 (Fig. 3)", covariance),
            Section("Limit accuracy (section 2.4.1)", _limit_blocks(source, runs[_CASE("1")])),
        ],
    )


def report_resets(source: Source) -> Report:
    """Condition 5 with resets beside condition 1: Figs 5 and 6."""
    runs = _runs(source, ("1", "5", RESET))
    shown = _ensembles(source, runs)
    limits = limit_accuracy(source.study)
    moments = runs[_CASE(RESET)]["reset_times_s"][0].as_py()
    fig5 = plots.misalignment(
        [shown[_CASE(name)] for name in ("1", RESET)],
        f"Condition 5 with {len(moments)} resets beside condition 1",
        limits=limits,
        resets_s=moments,
        zoom_s=_steady(source.study),
    )
    with_resets = shown[_CASE(RESET)]
    lines = [
        _variance(shown[_CASE("1")], "P, condition 1", 0),
        _variance(with_resets, f"P, {_CASE(RESET)}", 1),
        *_errors(with_resets, limits["u"]),
    ]
    fig6 = plots.squares(
        {"against the true error of condition 5 with resets": lines},
        "Yaw variance with resets: what the filter believes and what is true",
        resets_s=moments,
    )
    apart = analysis.difference(
        *analysis.paired(runs[_CASE(RESET)], runs[_CASE("1")], "phi_u_mean_arcmin")
    )
    start, end = source.study.study.window_s
    return Report(
        [
            f"Resets at {value_text(moments)} s, {_reading(source.study)}: {_ended(runs)}."
            f" Over {start:g} to {end:g} s the yaw with resets is apart from condition 1's by"
            f" {format_estimate(apart, 'arcmin', 2)} on the same noise."
        ],
        [
            Section(
                "Condition 5 with resets (Fig. 5)",
                [
                    Picture(
                        "fig5", f"As the paper's Fig. 5. {_band(source)}; dotted: resets.", fig5
                    ),
                    _table(source, runs),
                ],
            ),
            Section(
                "Covariance with resets (Fig. 6)",
                [
                    Picture(
                        "fig6", f"As the paper's Fig. 6. {_band(source)}; dotted: resets.", fig6
                    ),
                    Text(_covariance_text(runs, source.study)),
                ],
            ),
        ],
    )


class Ingredients(NamedTuple):
    """What the limit accuracy is made of, arcmin.

    Attributes:
        phi_e: -nabla_N/g.
        phi_n: nabla_E/g.
        gyro: -eps_E/omega_N, the first term of the yaw limit.
        accel: (nabla_E/g) tan L, its second term.
    """

    phi_e: float
    phi_n: float
    gyro: float
    accel: float


def ingredients(study: Study, earth_rate_deg_per_h: float | None = None) -> Ingredients:
    """The closed form of the limit accuracy for a study's constant biases.

    The biases are turned to n at the centre of the swing. Valid where the filter has no bias states
    and its innovations have vanished.

    Args:
        study: simulated, with an Earth of constants.
        earth_rate_deg_per_h: instead of the study's.

    Raises:
        InputError: a study that has no such limit, or more than one.
    """
    if study.is_recorded or any(p["earth"] != "constants" for p in study.combinations("earth")):
        raise InputError(f"{study.study.name}: paper 1's layouts need earth = 'constants'")
    angles = [_only(study, f"{a}_center_deg") for a in ("yaw", "pitch", "roll")]
    turn = Rotation.from_euler("ZXY", angles, degrees=True)
    eps_e = turn.apply(np.ones(3) * _only(study, "gyro_bias_deg_per_h"))[0] * DEG_PER_H
    nabla_e, nabla_n, _ = turn.apply(np.ones(3) * _only(study, "accel_bias_ug")) * MICRO
    latitude = _only(study, "latitude_deg") * DEG
    rate = earth_rate_deg_per_h or _only(study, "earth_rate_deg_per_h")
    terms = (
        -nabla_n,
        nabla_e,
        -eps_e / (rate * DEG_PER_H * math.cos(latitude)),
        nabla_e * math.tan(latitude),
    )
    return Ingredients(*(float(term) / ARCMIN for term in terms))


def limit_accuracy(study: Study) -> dict[str, float]:
    """The limits of phi about e, n and u in arcmin, see `ingredients`."""
    parts = ingredients(study)
    return {"e": parts.phi_e, "n": parts.phi_n, "u": parts.gyro + parts.accel}


def _only(study: Study, key: str) -> Any:
    first, *rest = study.combinations(key)
    if rest:
        raise InputError(f"{study.study.name}: paper 1's layouts need one {key}, not a sweep of it")
    return first[key]


def _limit_blocks(source: Source, runs: pa.Table) -> list[Block]:
    study = source.study
    here, paper_rate = ingredients(study), ingredients(study, _PAPER_RATE_DEG_PER_H)
    limits = limit_accuracy(study)
    start, end = study.study.window_s
    names = {"e": "phi_e (pitch)", "n": "phi_n (roll)", "u": "phi_u (yaw)"}
    forms = {"e": "-nabla_N/g", "n": "nabla_E/g", "u": "-eps_E/omega_N + (nabla_E/g) tan L"}
    found = {a: analysis.mean(analysis.numbers(runs, f"phi_{a}_mean_arcmin")) for a in "enu"}
    rows = [
        [
            name,
            f"{PAPER_LIMITS_ARCMIN[a]:.4f}",
            forms[a],
            f"{limits[a]:.4f}",
            format_estimate(found[a], digits=3),
        ]
        for a, name in names.items()
    ]
    rate = f"{_only(study, 'earth_rate_deg_per_h'):g}"
    yaw = [
        [f"{shown} deg/h", f"{p.gyro:.4f}", f"{p.accel:+.4f}", f"{p.gyro + p.accel:.4f}"]
        for shown, p in ((f"{_PAPER_RATE_DEG_PER_H:g}", paper_rate), (rate, here))
    ]
    latitude = _only(study, "latitude_deg")
    return [
        Table(
            "What phi settles to, arcmin",
            [
                "",
                "paper",
                "closed form",
                "for this study",
                f"simulated, condition 1, mean {start:g} to {end:g} s",
            ],
            rows,
        ),
        Table(
            f"The yaw limit by its ingredients, at latitude {latitude:g} deg, arcmin",
            ["Earth rate", "-eps_E/omega_N", "(nabla_E/g) tan L", "both"],
            yaw,
        ),
        Text(
            f"The paper's {PAPER_LIMITS_ARCMIN['u']:.4f} arcmin is the first term alone, with an"
            f" Earth rate of {_PAPER_RATE_DEG_PER_H:g} deg/h: {paper_rate.gyro:.5f} arcmin. It"
            f" leaves out (nabla_E/g) tan L, {here.accel:+.4f} arcmin, which follows from phi_n. So"
            " a faithful simulation does not end at the paper's figure."
        ),
        Text(
            "Nor does it end at the closed form, which holds once the innovations have vanished."
            " The filter has no bias states: while its gain falls, the north gyro bias pulls phi_n"
            f" ({found['n'].value - limits['n']:+.2f} arcmin here) and the up gyro bias pulls phi_u"
            f" ({found['u'].value - limits['u']:+.2f} arcmin, still growing at the end). Therefore"
            " condition 1 on the same noise, not the closed form, is what *as precise* is measured"
            " against."
        ),
    ]


def _runs(source: Source, names: tuple[str, ...]) -> dict[str, pa.Table]:
    """The runs of each condition by its label.

    Raises:
        InputError: a condition is missing, or one has runs of several variants.
    """
    if "case" not in source.summary.column_names:
        raise InputError(f"{source.config}: its layout needs [[cases]] with labels")
    groups = {key["case"]: rows for key, rows in analysis.groups(source.summary, ["case"])}
    for label in map(_CASE, names):
        if label not in groups:
            raise InputError(f"{source.config}: its layout needs a case '{label}'")
        if len(groups[label]) != source.study.n_draws:
            raise InputError(f"{source.config}: its layout takes no [axes]")
    return {_CASE(name): groups[_CASE(name)] for name in names}


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
    for label, table in runs.items():
        ok = analysis.proportion(table["status"].to_pylist().count("ok"), table.num_rows)
        cells = (
            analysis.quantile(analysis.numbers(table, "settle_10_s")),
            *(analysis.mean(analysis.numbers(table, f"phi_{a}_mean_arcmin")) for a in "enu"),
            analysis.mean(analysis.numbers(table, "sigma_u_arcmin")),
        )
        digits = (0, 2, 2, 1, 1)
        printed = (format_estimate(c, digits=d) for c, d in zip(cells, digits, strict=True))
        rows.append([label, percent(ok), *printed])
    return Table(
        f"Over {source.study.n_draws} draws",
        [
            "",
            "ok (%)",
            "settled to 10', median (s)",
            "phi_e (arcmin)",
            "phi_n (arcmin)",
            "phi_u (arcmin)",
            "sigma_u at the end (arcmin)",
        ],
        rows,
        f"Number [95 % interval]. phi: mean over {start:g} to {end:g} s. *Settled*: phi_u stays"
        " within 10 arcmin of its limit to the last record; *never*: it does not.",
    )


def _covariance_text(runs: Mapping[str, pa.Table], study: Study) -> str:
    """How often P is above the true squared error, for each case, in words."""

    def share(table: pa.Table, column: str) -> str:
        return f"{100 * np.nanmean(analysis.numbers(table, column)):.1f}"

    parts = (
        f"{label}: {share(table, 'p_above_error_share')} % of the records"
        f" ({share(table, 'p_above_floor_error_share')} % against the error from the limit),"
        f" {share(table, 'p_above_error_steady_share')} % of the steady ones"
        for label, table in runs.items()
    )
    settings = study.study
    return (
        f"P is above the true squared error after {settings.consistency_after_s:g} s (steady: after"
        f" {settings.steady_after_s:g} s) in: {'; '.join(parts)}."
    )


def _ended(runs: Mapping[str, pa.Table]) -> str:
    """Where the yaw of each case ends, in words."""
    found = (
        f"{label} {analysis.mean(analysis.numbers(table, 'phi_u_arcmin')).value:.1f}"
        for label, table in runs.items()
    )
    limit = analysis.numbers(next(iter(runs.values())), "floor_arcmin")[0]
    return f"mean phi_u at the end, arcmin (limit {limit:.1f}): {', '.join(found)}"


def _reading(study: Study) -> str:
    q, r = _only(study, "q_reading"), _only(study, "r_reading")
    return f"Q `{q}`, R `{r}`, feedback {_only(study, 'feedback_interval_s'):g} s (inferred)"


def _steady(study: Study) -> tuple[float, float]:
    """The span that is enlarged: the paper's steady process."""
    return study.study.steady_after_s, study.study.duration_s


def _band(source: Source) -> str:
    return f"Mean over {source.study.n_draws} draws; shading: 95 % of them"
