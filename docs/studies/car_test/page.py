"""Numbers of the page on the car test of paper 1, on another car's record."""

from itertools import product

import numpy as np
from numpy.typing import NDArray

from sinsjax import analysis
from sinsjax.analysis.grids import median_over_draws
from sinsjax.execution.source import Source
from sinsjax.plots import GridAxis
from sinsjax.report.base import Table
from sinsjax.report.study_page import Page, Sources
from sinsjax.units import ARCMIN, DEG

from ..common.grids import Grid, grid_of
from ..common.settling import settling_maps

PAPER, UNIT = "paper's tuning", "laser-gyro tuning"
RESETS = (50.0, 100.0, 150.0, 200.0)
END, MEAN, TRUTH = "phi_u_arcmin", "phi_u_mean_arcmin", "settle_10_truth_s"


def page(sources: Sources) -> Page:
    """The three schemes over all start times, and a batch of misalignments."""
    return Page.merge(_schemes(sources["car_test"]), _batch(sources["car_batch"]))


def _schemes(source: Source) -> Page:
    """Compare the three schemes with two tunings each, over feedback intervals and start times."""
    grid = grid_of(source, (END, MEAN, TRUTH), case="case", feedback="feedback_interval_s")

    def worst(case: str, **feedback: float) -> float:
        return float(np.abs(grid.at(END, case=case, **feedback)).max()) * ARCMIN / DEG

    aligned, without, resets = (worst(f"scheme {number}, {UNIT}") for number in (1, 2, 3))
    often = worst(f"scheme 2, {UNIT}", feedback=0.01)
    paper_without, paper_resets = (worst(f"scheme {number}, {PAPER}") for number in (2, 3))
    told = {
        "aligned": f"{aligned:.3f} deg",
        "resets": f"{resets:.3f} deg",
        "without": f"{without:.3f} deg",
        "often": f"{often:.3f} deg",
        "paper_resets": f"{paper_resets:.3f} deg",
        "paper_without": f"{paper_without:.1f} deg",
    }
    values = {"starts": source.draws, "schemes": told, "no_interval": analysis.NO_INTERVAL}
    claims = {
        "with resets the misaligned runs end as near as the aligned ones": resets < 1.5 * aligned,
        "without resets the paper's tuning and feedback every second fail": paper_without > 1,
        "with feedback at every sample the unit's tuning needs no resets": often < 1.5 * aligned,
        "the unit's tuning ends nearer than the paper's": resets < paper_resets / 2,
    }
    return Page(values, {"expected": _expected(grid), "all": _all(grid)}, claims=claims)


def _batch(source: Source) -> Page:
    """Four resets and none over the misalignments of a batch."""
    times = [tuple(times) for times in source.study.reset_times()]
    grid = grid_of(source, (TRUTH,), resets=times, level="phi_e0_deg", yaw="phi_u0_deg")
    without, resets = (grid.at(TRUTH, resets=times) for times in ((), RESETS))
    share = [100 * float(np.isfinite(runs).mean()) for runs in (without, resets)]
    small = grid.at(TRUTH, resets=(), yaw=[-10, 0, 10])
    medians = median_over_draws(resets)
    values = {
        "runs": source.runs,
        "without": f"{share[0]:.0f} %",
        "resets": f"{share[1]:.0f} %",
        "misalignments": without[..., 0].size,
        "slowest": f"{medians.max():.0f} s",
        "small": f"{100 * np.isfinite(small).mean():.0f} %",
    }
    claims = {
        "with four resets every run of the batch settles": share[1] == 100,
        "with four resets every misalignment takes equally long": np.unique(medians).size == 1,
        "without them many do not": share[0] < 75,
        "small heading errors settle without": np.isfinite(small).all(),
    }
    picture = settling_maps(
        source,
        "batch",
        {f"{share[0]:.0f} % of the runs settle, with four resets {share[1]:.0f} %": without},
        "Level errors about east, 5 deg about north.",
        rows=GridAxis("added level error_deg", grid.axes["level"]),
        columns=GridAxis("added heading error_deg", grid.axes["yaw"]),
        title="How long until the heading stays within 10', without resets?",
    )
    return Page({"batch": values}, figures={"batch": picture}, claims=claims)


def _expected(grid: Grid) -> Table:
    """Return the worst heading error and the median settling time of each scheme."""
    schemes = (1, 2, 3)
    rows = []
    for tuning, feedback in product((PAPER, UNIT), grid.axes["feedback"]):
        cells = []
        for case in (f"scheme {number}, {tuning}" for number in schemes):
            end, settle_s = (grid.at(name, case=case, feedback=feedback) for name in (END, TRUTH))
            worst = np.abs(end).max() * ARCMIN / DEG
            cells.append(f"{worst:.4f}; {_median_time(settle_s)}")
        rows.append([f"{tuning}, {feedback:g} s", *cells])
    header = ["noise settings, feedback", *(f"Scheme {number}" for number in schemes)]
    title = f"Final heading error, worst of {grid.draws} starts (deg); median settling time (s)"
    return Table(title, header, rows)


def _median_time(settle_s: NDArray) -> str:
    time = analysis.quantile(settle_s).value
    return "never" if np.isinf(time) else f"{time:.0f}"


def _all(grid: Grid) -> Table:
    rows = []
    for case, feedback in product(*grid.axes.values()):
        end, mean, settle_s = (
            grid.at(name, case=case, feedback=feedback) for name in (END, MEAN, TRUTH)
        )
        name, _, tuning = case.partition(", ")
        rows.append(
            [
                name.capitalize(),
                f"{tuning}, feedback {feedback:g} s",
                f"{np.median(end) * ARCMIN / DEG:+.4f}",
                *(f"{np.abs(errors).max() * ARCMIN / DEG:.4f}" for errors in (end, mean)),
                f"{np.isfinite(settle_s).sum()} of {grid.draws}",
                _median_time(settle_s),
            ]
        )
    header = ["", "setting", "at the end: median", "worst", "300 to 500 s mean: worst"]
    title = "Every case: heading error from the reference (deg)"
    return Table(title, [*header, "settled to 10'", "median time (s)"], rows, folded=True)
