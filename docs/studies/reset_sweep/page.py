"""Numbers of the page on the default sweep: number of resets, time between them, heading error."""

import numpy as np

import sinsjax
from sinsjax import analysis
from sinsjax.analysis import Estimate, format_estimate
from sinsjax.analysis.grids import median_over_draws
from sinsjax.report.base import Picture, Table
from sinsjax.report.study_page import Page, Sources

from ..common.grids import Choice, Grid, grid_of, held_out, soonest
from ..common.settling import how_many, mean_time, settled

LIMIT, TRUTH = "settle_10_s", "settle_10_truth_s"


def page(sources: Sources) -> Page:
    """When several resets beat one."""
    source = sources["reset_sweep"]
    run_s = source.study.run_s
    axes = {"count": "reset_count", "cycle": "reset_cycle_s", "yaw": "phi_u0_deg"}
    grid = grid_of(source, (LIMIT, TRUTH), **axes)
    counts, cycles, yaws = grid.axes.values()
    without = grid.at(LIMIT, count=0)[0]
    reset = grid.at(LIMIT, count=list(counts[1:]))
    means = np.minimum(reset, run_s).mean(axis=2).reshape(-1, grid.draws)
    settings = [(count, cycle) for count in counts[1:] for cycle in cycles]
    best = settings[int(np.argmin(means.mean(axis=-1)))]
    at_best = grid.at(LIMIT, count=best[0], cycle=best[1])
    single = grid.at(LIMIT, count=1)
    one = single[int(np.argmin(np.minimum(single, run_s).mean(axis=(1, 2))))]
    truth = grid.at(TRUTH, count=list(counts[1:]))
    floor = float(analysis.numeric_column(source.rows(["floor_arcmin"]), "floor_arcmin")[0])
    values = {
        "runs": f"{source.runs:,}",
        "limit": f"{abs(floor):.0f} arcmin",
        "without": settled(without),
        "best": {
            "count": best[0],
            "cycle": f"{best[1]:g} s",
            "mean": mean_time(at_best, run_s),
            "one": mean_time(one, run_s),
        },
    }
    contests = _contests(grid)
    gains = [analysis.quantile_difference(more.values, one.values) for one, more in contests]
    claims = {
        "two resets are the best for all": best[0] == 2,
        "with resets every run settles": np.isfinite(reset).all(),
        "without, only small heading errors do": (
            np.isfinite(without[:2]).all() and np.isinf(median_over_draws(without[3:])).all()
        ),
        "one reset takes longer": (
            np.minimum(one, run_s).mean() > np.minimum(at_best, run_s).mean() + 10
        ),
        "several win at large heading errors": all(gain.high < 0 for gain in gains[5:]),
        "no run with resets stays near true north": not np.isfinite(truth).any(),
    }
    columns = ["reset_count", "reset_cycle_s", LIMIT, "phi_u0_deg", "reset_times_s", "phi_u_arcmin"]
    figure = sinsjax.plot_map(source.rows(columns), *columns[:3], by="phi_u0_deg")
    first = "The first reset comes after one time between resets; level errors of 5 deg."
    picture = Picture("settling_time", f"Medians over {how_many(source, reset)}. {first}", figure)
    return Page(values, _best(grid, contests, gains), {"settling": picture}, claims)


def _contests(grid: Grid) -> list[tuple[Choice, Choice]]:
    """The best single reset and the best of several at each heading error, on unused draws."""
    several = [count for count in grid.axes["count"] if count > 1]
    found = []
    for yaw in grid.axes["yaw"]:
        one = held_out(grid.at(LIMIT, count=1, yaw=yaw), soonest)
        more = grid.at(LIMIT, count=several, yaw=yaw).reshape(-1, grid.draws)
        found.append((one, held_out(more, soonest)))
    return found


def _best(
    grid: Grid, contests: list[tuple[Choice, Choice]], gains: list[Estimate]
) -> dict[str, Table]:
    """The best schedules at each heading error; with all medians in a file."""
    counts, cycles = grid.axes["count"], grid.axes["cycle"]
    once = [f"{cycle:g} s" for cycle in cycles]
    often = [f"{n}, {cycle:g} s" for n in counts if n > 1 for cycle in cycles]
    rows = []
    for yaw, (one, more), gain in zip(grid.axes["yaw"], contests, gains, strict=True):
        runs = grid.at(LIMIT, count=0, yaw=yaw)[0], one.values, more.values
        none_s, one_s, more_s = (
            format_estimate(analysis.quantile(settle_s), digits=0) for settle_s in runs
        )
        later = format_estimate(gain, digits=0)
        names = one.named(once), more.named(often)
        rows.append([f"{yaw:g} deg", none_s, names[0], one_s, names[1], more_s, later])
    header = ["initial heading error", "no reset (s)", "one at", "median (s)"]
    header += ["several: number, spacing", "median (s)", "difference (s)"]
    short = ["heading error", "one at", "number, spacing", "difference (s)"]
    note = (
        f"Difference of the medians [95 % interval over {grid.draws} runs], negative if several"
        " settle sooner. Each half of the runs chose for the other; if they differ, set either."
    )
    title = "What to set if the heading error is known"
    return {
        "best": Table(title, short, [[row[k] for k in (0, 2, 4, 6)] for row in rows], note),
        "medians": Table("The same with all medians", header, rows, folded=True),
    }
