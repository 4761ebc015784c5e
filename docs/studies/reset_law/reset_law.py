"""Tables, figures and numbers of docs/reset_law.md.

    python -m docs.studies.reset_law.reset_law DIR... [-o FOLDER]

The directories have the results of reset_law, reset_law_map, reset_own_noise, reset_surge,
reset_cycle_study and reset_phase.
"""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, NullLocator
from numpy.typing import NDArray

import sinsjax
from docs.studies.common import (
    Grid,
    Page,
    Runs,
    mean_time,
    medians,
    percent,
    read_arguments,
    share,
)
from sinsjax import analysis, plots
from sinsjax.analysis import format_estimate
from sinsjax.plots.style import with_style

SETTLE = "settle_10_s"
LAW, KEPT, LISTED, NONE = "law", "law, velocity as P0", "10 and 60 s", "no reset"
POLICIES = (LAW, KEPT, "trigger", LISTED, NONE)
EARLY, INERTIAL = "last reset at 55 s", "inertial"
SURGE_POLICIES = (NONE, EARLY, "last reset at 110 s", KEPT, LAW, "kalman_sincos", INERTIAL)
CELL = ("latitude_deg", "q_scale", "feedback_interval_s", "specific_force")


def starts_of(runs: Runs) -> list[tuple[float, float]]:
    """Return level and heading of the start of each variant."""
    return list(zip(*(runs.study.values(f"phi_{a}0_deg") for a in "eu"), strict=True))


def cells(runs: Runs, page: Page) -> None:
    """Write how each policy settles in every filter, never as the whole run."""
    axes = {"policy": "case", "start": starts_of(runs)} | {key: key for key in CELL}
    grid, end_s = runs.grid(SETTLE, **axes), runs.end_s
    times = {policy: grid.at(policy=policy) for policy in POLICIES}
    finite = {policy: np.minimum(one, end_s) for policy, one in times.items()}
    means = {policy: one.mean(axis=(0, -1)).ravel() for policy, one in finite.items()}
    rows = [
        [policy, f"{percent(share(np.isfinite(one)))} %", mean_time(one, end_s)]
        for policy, one in times.items()
    ]
    header = ["resets", "settled", "mean settling time"]
    page.show(f"{means[LAW].size} filters and places, eight starts each", header, rows)
    ratios = {policy: means[LAW] / means[policy] for policy in POLICIES if policy != LAW}
    rows = [
        [policy, f"{np.exp(np.log(r).mean()):.2f} ({r.min():.2f} to {r.max():.2f})"]
        for policy, r in ratios.items()
    ]
    header = ["resets", "law's mean over this, geometric mean over filters (least to largest)"]
    page.table("reset_law_by_filter", header, rows)
    law, kept = (finite[policy].mean(axis=tuple(range(5))) for policy in (LAW, KEPT))
    page.print_numbers(
        opening_velocity_saves=f"{percent(analysis.mean(1 - law / kept))} %",
        by_filter=f"{100 * (1 - ratios[KEPT].max()):.0f} to {100 * (1 - ratios[KEPT].min()):.0f} %",
        never_without_reset=f"{percent(share(np.isinf(times[NONE])))} %",
    )


def set_ticks(axes: Axes, x: Sequence[float], y: Sequence[float], never: float = np.inf) -> None:
    """Set logarithmic axes with plain numbers; one at ``never`` is named."""
    axes.set(xscale="log", yscale="log")
    for axis, ticks in ((axes.xaxis, x), (axes.yaxis, y)):
        axis.set_major_locator(FixedLocator(ticks))
        axis.set_minor_locator(NullLocator())
        axis.set_ticklabels([f"{tick:g}" if tick < never else "never" for tick in ticks])


@with_style
def draw_map(runs: Runs) -> Figure:
    """Draw mean settling times over the times of two resets, in a panel per latitude."""
    axes = {"latitude": "latitude_deg", "first": "reset_first_s", "later": "reset_cycle_s"}
    grid = runs.grid(SETTLE, **axes, start=starts_of(runs))
    figure = Figure(figsize=(9.5, 4.4))
    figure.suptitle("Two resets: the law moves with latitude, 10 and 60 s stays")
    panels = figure.subplots(1, len(grid.axes["latitude"]), sharey=True)
    for panel, latitude in zip(panels, grid.axes["latitude"], strict=True):
        means = np.minimum(grid.at(latitude=latitude), runs.end_s).mean(axis=(2, 3)).T
        levels = means.min() * np.array([1, 1.1, 1.25, 1.5, 2, 3, 4])
        x, y = grid.axes["first"], grid.axes["later"]
        filled = panel.contourf(x, y, means, levels, cmap="viridis_r", extend="max")
        panel.contour(x, y, means, levels[1:-1], colors="white", linewidths=0.8)
        one = runs.study.replace({"axes.latitude_deg": [latitude]})
        times = sinsjax.reset_schedule(one).times_s
        marks = {"law": ("o", (times[2], times[3] - times[2])), LISTED: ("X", (10.0, 50.0))}
        for name, (marker, point) in marks.items():
            style = {"color": plots.COLOURS[1], "markersize": 11, "markeredgecolor": "white"}
            panel.plot(*point, marker, label=name, **style)
        set_ticks(panel, (1, 3, 10, 30, 100), (10, 30, 100, 300))
        panel.set(xlabel="first reset (s)")
        panel.set_title(f"latitude {latitude:g} deg, best {means.min():.0f} s")
        panel.grid(False)
    panels[0].set_ylabel("from there to the second (s)")
    bar = figure.colorbar(filled, ax=list(panels), label="mean settling time, of the best")
    bar.set_ticks(levels, labels=[f"{level / levels[0]:g}" for level in levels])
    panels[0].legend(loc="lower left", frameon=True)
    return figure


def own_noise(runs: Runs, page: Page) -> None:
    """Write how paper 1's sensors settle from five starts, as printed and with their own noise."""
    grid = runs.grid(SETTLE, case="case", yaw="phi_u0_deg")
    names = dict.fromkeys(case.partition(": ")[0] for case in grid.axes["case"])
    rows = []
    for name in names:
        policies = [f"{name}: {policy}" for policy in (NONE, LISTED, LAW)]
        known = [case for case in (*policies, name) if case in grid.axes["case"]]
        texts = [from_to(grid.at(case=case)) for case in known]
        rows.append([name, *texts, *[""] * (3 - len(texts))])
    page.table("reset_law_own", ["filter", NONE, LISTED, LAW], rows)
    by_law = [case for case in grid.axes["case"] if case.startswith("own") and case.endswith(LAW)]
    law = grid.at(case=by_law)
    page.print_numbers(
        own_noise_law=f"{mean_time(law, runs.end_s)}, {medians(law).max():.0f} s at worst",
        optimisation=mean_time(grid.at(case="optimisation"), runs.end_s),
    )


def from_to(settle_s: NDArray) -> str:
    """Return the least and largest median of times (starts, draws) as text."""
    found = medians(settle_s)
    settled = found[np.isfinite(found)]
    if not settled.size:
        return "never"
    text = " to ".join(dict.fromkeys(f"{time:.0f}" for time in (settled.min(), settled.max())))
    never = found.size - settled.size
    return f"{text}; never from {never}" if never else text


def surge(runs: Runs, page: Page) -> None:
    """Write what R and the last reset decide on a base that surges."""
    study, end_s = runs.study, runs.end_s
    # The smallest scale of a surge undoes its density: 0.1 m/s of an update.
    r = ["0.1 m/s" if scale < 0.1 else f"{scale:g}" for scale in study.values("r_scale")]
    noise = list(zip(study.values("surge_m_per_s"), r, strict=True))
    axes = {"latitude": "latitude_deg", "policy": "case", "start": "phi_u0_deg"}
    grid = runs.grid(SETTLE, **axes, noise=noise)
    rows, spreads = [], []
    for base, scale in grid.axes["noise"]:
        texts = []
        for policy in SURGE_POLICIES:
            times = grid.at(noise=(base, scale), policy=policy)
            lost = np.isinf(times).sum()
            texts.append(mean_time(times, end_s) + (f", {lost} never" if lost else ""))
        rows.append([f"{base:g}", scale if base else "0.1 m/s", *texts])
    page.table("reset_law_surge", ["surge (m/s)", "R", *SURGE_POLICIES], rows)
    for base in (0.02, 0.05):
        for policy in (LAW, EARLY, INERTIAL):
            times = grid.at(noise=(base, "1"), policy=policy)
            never = f"never {percent(share(np.isinf(times)))} % of {times.size} runs"
            print(f"surge of {base:g} m/s, {policy}: {mean_time(times, end_s)}, {never}")
        by_r = [grid.at(noise=(base, scale), policy=LAW) for scale in ("0.25", "1", "2", "4")]
        means = [np.minimum(times, end_s).mean() for times in by_r]
        spreads.append(max(means) / min(means) - 1)
    page.print_numbers(r_changes_the_mean_by=f"{100 * max(spreads):.0f} %")


def listed(cycle: Runs, phase: Runs, page: Page) -> None:
    """Print what resets from a list show: without any, and within a feedback interval."""
    keys = [cycle.study.values(key) for key in ("specific_force", "reset_count")]
    for force in ("measured", "gravity"):
        alone = [key == (force, 0) for key in zip(*keys, strict=True)]
        never = share(np.isinf(cycle.column(SETTLE)[alone]))
        print(f"never without reset, {force}: {percent(never)} %")
    resets = {"resets": [tuple(times) for times in phase.study.values("reset_times_s")]}
    starts = {"feedback": "feedback_interval_s", "start": starts_of(phase)}
    grid, end_s = phase.grid(SETTLE, **starts, **resets), phase.end_s
    page.print_numbers(
        at_a_feedback=later(grid, end_s, 10.0, 20.0, 17.5),
        before_a_feedback=later(grid, end_s, 10.0, 19.9, 17.5),
        before_a_frequent_one=later(grid, end_s, 1.0, 19.9, 20.0),
    )


def later(grid: Grid, end_s: float, feedback_s: float, first_s: float, other_s: float) -> str:
    """Return by how much two resets 50 s apart settle later than two others."""
    resets = ((first, first + 50.0) for first in (first_s, other_s))
    pair = (np.minimum(grid.at(feedback=feedback_s, resets=one), end_s) for one in resets)
    means = (times.mean(axis=0) for times in pair)
    return format_estimate(analysis.mean_difference(*means), "s later", 0)


def main() -> None:
    """Write the tables and figures."""
    more = ("reset_own_noise", "reset_surge", "reset_cycle_study", "reset_phase")
    given, page = read_arguments(__doc__, ("reset_law", "reset_law_map", *more))
    law, mapped, own, on_surge, cycle, phase = given.values()
    cells(law, page)
    page.figure("reset_law_map", draw_map(mapped), mapped.footer)
    own_noise(own, page)
    surge(on_surge, page)
    listed(cycle, phase, page)


if __name__ == "__main__":
    main()
