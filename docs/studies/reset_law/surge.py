"""Numbers on resets on a base that surges: R, the last reset, and methods that need neither."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from sinsjax.execution.source import Source
from sinsjax.report.base import Table
from sinsjax.report.study_page import Page
from sinsjax.study.study import Study

from ..common.grids import Grid, grid_of, held_out, least_mean, pooled_mean, shared
from ..common.settling import mean_time
from ..common.words import share

SETTLE = "settle_10_s"
LAW, NONE, INERTIAL, SINCOS = "law", "no reset", "inertial", "kalman_sincos"
EARLY, LATE = "55 s", "110 s"
SLOW, FAST = 0.02, 0.05
FIXED, DENSITY = "0.1 m/s", "1"
"""R of a surge: that of an update without surge, or a multiple of the default."""


def surge(source: Source) -> Page:
    """Return what R and the last reset decide on a base that surges.

    Args:
        source: results of `configs/reset_surge.toml`.
    """
    study = source.study
    axes = {
        "latitude": study.values("latitude_deg"),
        "noise": list(zip(study.values("surge_m_per_s"), _r_names(study), strict=True)),
        "policy": _policies(study),
        "start": study.values("phi_u0_deg"),
    }
    grid = grid_of(source, (SETTLE,), **axes)
    run_s = study.run_s

    def runs(surge_m_per_s: float, r: str, policy: str) -> NDArray:
        return grid.at(SETTLE, noise=(surge_m_per_s, r), policy=policy)

    def never(settle_s: NDArray) -> str:
        return share(shared(np.isinf(settle_s)))

    def mean(settle_s: NDArray) -> Any:
        return pooled_mean(np.minimum(settle_s, run_s))

    chosen = {base: _best_r(grid, base, run_s) for base in (SLOW, FAST)}
    law = runs(SLOW, DENSITY, LAW)
    fast = {r: runs(FAST, r, LAW) for r in ("0.25", DENSITY, "4")}
    values = {
        "draws": grid.draws,
        "runs": law.size,
        "still": mean_time(runs(0.0, DENSITY, LAW), run_s),
        "slow": {
            "law": {"never": never(law), "mean": mean_time(law, run_s)},
            "early": {"never": never(runs(SLOW, DENSITY, EARLY))},
            "none": {"never": never(runs(SLOW, DENSITY, NONE))},
            "inertial": mean_time(runs(SLOW, DENSITY, INERTIAL), run_s),
            "sincos": mean_time(runs(SLOW, DENSITY, SINCOS), run_s),
            "sincos_fixed": mean_time(runs(SLOW, FIXED, SINCOS), run_s),
        },
        "fast": {
            "law": {"never": never(fast[DENSITY])},
            "quarter": {"never": never(fast["0.25"])},
            "four": {"never": never(fast["4"])},
            "inertial": mean_time(runs(FAST, DENSITY, INERTIAL), run_s),
        },
        "best": {
            "r": " / ".join(dict.fromkeys(chosen[base].named(_R_FACTORS) for base in (SLOW, FAST))),
            "slow": mean_time(chosen[SLOW].values, run_s),
        },
    }
    unsettled = {base: shared(np.isinf(runs(base, DENSITY, LAW))) for base in (SLOW, FAST)}
    claims = {
        "the law leaves less than a tenth unsettled on a slow surge": unsettled[SLOW].high < 0.1,
        "resets at 55 s are too early there": (
            shared(np.isinf(runs(SLOW, DENSITY, EARLY))).low > unsettled[SLOW].high
        ),
        "a quarter of the density is best on both": (
            all(chosen[base].named(_R_FACTORS) == "0.25" for base in (SLOW, FAST))
            and mean(fast["0.25"]).high < mean(fast[DENSITY]).low
            and shared(np.isinf(fast["0.25"])).high < unsettled[FAST].low
        ),
        "four times the density is worse": mean(fast["4"]).low > mean(fast[DENSITY]).high,
        "inertial alignment settles sooner": all(
            mean(runs(base, DENSITY, INERTIAL)).high < mean(chosen[base].values).low
            for base in (SLOW, FAST)
        ),
        "kalman_sincos gains from the R of the surge": (
            mean(runs(SLOW, DENSITY, SINCOS)).high < mean(runs(SLOW, FIXED, SINCOS)).low
        ),
    }
    return Page(values, {"surge": _table(grid, run_s)}, {}, claims)


_R_FACTORS = ("0.25", "1", "2", "4")


def _r_names(study: Study) -> list[str]:
    """Return R of each variant: 0.1 m/s of an update, or its ratio to the default."""
    return [
        FIXED if scale < 0.1 else f"{scale:g}"  # the smallest scale of a surge undoes its density
        for scale in study.values("r_scale")
    ]


def _policies(study: Study) -> list[str]:
    """Return what resets each variant, or the method that needs no reset."""
    names = {"none": NONE, "law": LAW}
    values = (study.values(key) for key in ("method", "schedule"))
    return [
        method if method != "kalman5" else names.get(schedule) or f"{times[-1]:g} s"
        for method, schedule, times in zip(*values, study.reset_times(), strict=True)
    ]


def _best_r(grid: Grid, surge_m_per_s: float, run_s: float) -> Any:
    """Return the R with the least mean by the law, judged by the half that did not choose it."""
    runs = [grid.at(SETTLE, noise=(surge_m_per_s, r), policy=LAW) for r in _R_FACTORS]
    means = np.stack([np.minimum(one, run_s).mean(axis=(0, 1)) for one in runs])
    return held_out(means, least_mean)


def _table(grid: Grid, run_s: float) -> Table:
    """Return the mean time and the runs that never settle, by surge, R and policy."""
    policies = (NONE, EARLY, LATE, LAW, SINCOS, INERTIAL)
    rows = []
    for base, r in grid.axes["noise"]:
        cells = []
        for policy in policies:
            settle_s = grid.at(SETTLE, noise=(base, r), policy=policy)
            lost = np.count_nonzero(np.isinf(settle_s))
            cells.append(mean_time(settle_s, run_s) + (f", {lost} never" if lost else ""))
        rows.append([f"{base:g}", r if base else FIXED, *cells])
    header = [
        "surge (m/s)",
        "R",
        *(f"last reset at {p}" if p[0].isdigit() else p for p in policies),
    ]
    starts = len(grid.axes["start"])
    note = (
        f"Mean time [95 % interval over {grid.draws} draws] until the heading stays within 10' of"
        f" the bias floor, over latitudes of"
        f" {', '.join(f'{one:g}' for one in grid.axes['latitude'])} deg and {starts} initial"
        f" misalignments: {settle_s.size} runs each. One that never settles counts as {run_s:g} s."
        " R: 0.1 m/s for each update, or a multiple of its default, which follows the surge."
    )
    return Table("Resets of kalman5 on a base that surges", header, rows, note)
