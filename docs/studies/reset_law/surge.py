"""Numbers on resets on a base that surges: R, the last reset, and methods that need neither."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from sinsjax.execution.source import Source
from sinsjax.report.base import Table
from sinsjax.report.study_page import Page
from sinsjax.study.study import Study

from ..common.grids import Grid, grid_of, pooled_mean, shared
from ..common.settling import mean_time
from ..common.words import share

SETTLE = "settle_10_s"
LAW, KEPT, NONE, EARLY, INERTIAL, SINCOS = (
    *("law", "law, velocity as P0", "no reset", "last reset at 55 s"),
    *("inertial", "kalman_sincos"),
)
POLICIES = (NONE, EARLY, "last reset at 110 s", KEPT, LAW, SINCOS, INERTIAL)
SLOW, FAST = 0.02, 0.05
FIXED, DENSITY, FACTORS = "0.1 m/s", "1", ("0.25", "1", "2", "4")
"""R of a surge: that of an update without surge, or a multiple of the default."""


def surge(source: Source) -> Page:
    """Return what R and the last reset decide on a base that surges.

    Args:
        source: results of `configs/reset_surge.toml`.
    """
    study = source.study
    grid = grid_of(
        source,
        (SETTLE,),
        latitude="latitude_deg",
        noise=list(zip(study.values("surge_m_per_s"), _r_names(study), strict=True)),
        policy="case",
        start="phi_u0_deg",
    )
    run_s = study.run_s

    def runs(surge_m_per_s: float, policy: str, r: str = DENSITY) -> NDArray:
        return grid.at(SETTLE, noise=(surge_m_per_s, r), policy=policy)

    values: dict[str, Any] = {"runs": runs(SLOW, LAW).size}
    for name, base in (("slow", SLOW), ("fast", FAST)):
        times = {policy: runs(base, policy) for policy in POLICIES}
        never = {policy: share(shared(np.isinf(one))) for policy, one in times.items()}
        values[name] = {
            "law": {"mean": mean_time(times[LAW], run_s), "never": never[LAW]},
            "early": {"never": never[EARLY]},
            "inertial": mean_time(times[INERTIAL], run_s),
        }
    spread = {base: _spread([runs(base, LAW, r) for r in FACTORS], run_s) for base in (SLOW, FAST)}
    values["spread"] = f"{100 * max(spread.values()):.0f}"
    unsettled = {base: shared(np.isinf(runs(base, LAW))) for base in (SLOW, FAST)}
    claims = {
        "by the law hardly any run fails on a surge": all(
            one.value < 0.01 for one in unsettled.values()
        ),
        "a last reset at 55 s is too early on a surge": all(
            shared(np.isinf(runs(base, EARLY))).low > unsettled[base].high for base in (SLOW, FAST)
        ),
        "a quarter to four times R hardly matters": max(spread.values()) < 0.05,
        "with velocity as P0 it does": (
            shared(np.isinf(runs(FAST, KEPT))).low > unsettled[FAST].high
        ),
        "inertial alignment settles sooner on a surge": all(
            _mean(runs(base, INERTIAL), run_s).high < _mean(runs(base, LAW), run_s).low
            for base in (SLOW, FAST)
        ),
    }
    return Page({"surge": values}, {"surge": _table(grid, run_s)}, {}, claims)


def _mean(settle_s: NDArray, run_s: float) -> Any:
    return pooled_mean(np.minimum(settle_s, run_s))


def _spread(runs: list[NDArray], run_s: float) -> float:
    """Share by which the largest mean exceeds the least."""
    means = [_mean(one, run_s).value for one in runs]
    return max(means) / min(means) - 1


def _r_names(study: Study) -> list[str]:
    """Return R of each variant: 0.1 m/s of an update, or its ratio to the default."""
    return [
        FIXED if scale < 0.1 else f"{scale:g}"  # the smallest scale of a surge undoes its density
        for scale in study.values("r_scale")
    ]


def _table(grid: Grid, run_s: float) -> Table:
    """Return the mean time and the share of runs that never settle, by surge, R and policy."""
    rows = []
    for base, r in grid.axes["noise"]:
        cells = []
        for policy in POLICIES:
            settle_s = grid.at(SETTLE, noise=(base, r), policy=policy)
            lost = np.count_nonzero(np.isinf(settle_s))
            cells.append(mean_time(settle_s, run_s) + (f", {lost} never" if lost else ""))
        rows.append([f"{base:g}", r if base else FIXED, *cells])
    latitudes = " and ".join(f"{one:g}" for one in grid.axes["latitude"])
    note = (
        f"Mean time [95 % interval over {grid.draws} draws], latitudes of {latitudes} deg,"
        f" {len(grid.axes['start'])} misalignments; {run_s:g} s for never. R: 0.1 m/s per update,"
        " or a multiple of its default."
    )
    header = ["surge (m/s)", "R", *POLICIES]
    return Table("Resets on a base that surges", header, rows, note, folded=True)
