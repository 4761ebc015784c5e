"""Tables, figures and numbers of docs/paper1.md.

    python -m docs.studies.paper1 DIR DIR DIR [-o FOLDER]

The directories have the results of paper1_conditions, paper1_resets and paper1_readings.
"""

import math
from collections.abc import Callable, Mapping
from itertools import combinations

import numpy as np
import pyarrow as pa
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from matplotlib.ticker import FixedLocator, NullLocator, StrMethodFormatter
from numpy.typing import NDArray

import sinsjax
from docs.studies.common import GREY, Page, Runs, percent, read_arguments
from sinsjax import analysis, plots
from sinsjax.analysis import Estimate, format_estimate, numeric_column, pair_by_draw
from sinsjax.plots.style import with_style

RESET, BAND_ARCMIN = "5 with resets", 10.0
INF, UNDER_5 = math.inf, math.nextafter(0.05, 0.0)
Number = Callable[..., Estimate]


def of(column: str, statistic: Number) -> Number:
    """Return a statistic of a column of some runs; of two tables on the same noise."""

    def number(runs: pa.Table, *other: pa.Table) -> Estimate:
        if other:
            return statistic(*pair_by_draw(runs, other[0], column))
        return statistic(numeric_column(runs, column))

    return number


def worse(a: pa.Table, b: pa.Table) -> Estimate:
    """Return by how much further from its floor one condition ends than another."""
    means, floors = (pair_by_draw(a, b, f"{one}_arcmin") for one in ("phi_u_mean", "floor"))
    return analysis.mean_difference(*np.abs(np.subtract(means, floors)))


def mean(shares: NDArray, missing: float) -> Estimate:
    """Return the mean share of records; the runs that are not finite have another."""
    return analysis.mean(np.nan_to_num(shares, nan=missing))


settled = of("settle_10_s", lambda times: analysis.share(~np.isnan(times)))
apart = of("phi_u_mean_arcmin", analysis.mean_difference)
MEANINGS: dict[str, tuple[float, float, Number]] = {
    "converges": (0.95, INF, settled),
    "cannot converge": (-INF, UNDER_5, settled),
    "short": (-INF, 200.0, of("settle_10_s", analysis.quantile)),
    "longer": (0.0, INF, of("settle_10_s", analysis.quantile_difference)),
    "worse": (0.0, INF, worse),
    "P larger": (0.95, INF, of("p_above_error_share", lambda x: mean(x, missing=0.0))),
    "P smaller": (-INF, 0.05, of("p_above_error_steady_share", lambda x: mean(x, missing=1.0))),
    "as precise": (-1.0, 1.0, apart),
    "P as": (0.9, 1.1, of("sigma_u_arcmin", lambda a, b: analysis.mean(a / b))),
}
"""What the paper's words mean: a number and its bounds. Fixed before the first result."""

STATEMENTS = {
    "condition 1 converges": ("converges", "1"),
    "condition 2 converges": ("converges", "2"),
    "condition 1 in a short time": ("short", "1"),
    "condition 2 in a short time": ("short", "2"),
    "condition 3 converges": ("converges", "3"),
    "condition 3 longer than condition 2": ("longer", "3", "2"),
    "condition 3 longer than condition 1": ("longer", "3", "1"),
    "condition 4 converges": ("converges", "4"),
    "condition 4 longer than condition 2": ("longer", "4", "2"),
    "condition 4 longer than condition 1": ("longer", "4", "1"),
    "condition 4 worse than condition 2": ("worse", "4", "2"),
    "condition 4 worse than condition 1": ("worse", "4", "1"),
    "condition 5 cannot converge": ("cannot converge", "5"),
    "condition 1: P larger throughout": ("P larger", "1"),
    "condition 5: P smaller when steady": ("P smaller", "5"),
    "condition 5 with resets converges": ("converges", RESET),
    "condition 5 with resets as precise": ("as precise", RESET, "1"),
    "condition 5 with resets: P larger": ("P larger", RESET),
    "condition 5 with resets: P as 1's": ("P as", RESET, "1"),
}
"""What the paper says: a word and its conditions. Not judged, as the summary does not show it: the
trend of the first 100 s (section 3.1), stable processes after resets (3.3.2), pitch and roll."""

TEXTS = list(STATEMENTS)
HEADLINE = "The cure holds under all {} interpretations, equal covariances under none"
EXPLAINED, CONCLUSIONS = [7, 12, 14], [12, 14, 15, 16]
"""Places of the paper's explanation (4 converges, 5 does not, P is too small) and abstract."""


def judge(runs: Mapping[str, pa.Table]) -> list[tuple[bool, bool, Estimate]]:
    """Return whether each statement holds, whether its interval has a bound, and its number."""
    findings = []
    for word, *names in STATEMENTS.values():
        low, high, number_of = MEANINGS[word]
        number = number_of(*(runs[name] for name in names))
        finite = [bound for bound in (low, high) if math.isfinite(bound)]
        straddles = any(not (number.low > bound or number.high < bound) for bound in finite)
        holds = low <= number.value <= high
        if word in ("longer", "worse", "as precise"):
            holds = holds and not straddles
        if word in ("as precise", "P as"):  # every draw has a number
            holds = holds and number.n == runs[names[0]].num_rows
        findings.append((holds, straddles, number))
    return findings


def by_condition(table: pa.Table) -> dict[str, pa.Table]:
    """Return the runs of each condition."""
    groups = analysis.group_rows(table, ["case"])
    return {key["case"].removeprefix("condition "): rows for key, rows in groups}


def judge_readings(readings: Runs, page: Page) -> None:
    """Judge every statement under every interpretation of what the paper does not print."""
    words = {"per_step": "as printed", "per_sample": "sample", "per_update": "per update"}
    names, judged = [], []
    keys = ["q_reading", "r_reading", "feedback_interval_s"]
    for key, rows in analysis.group_rows(readings.rows(), keys):
        q, r, feedback_s = key.values()
        names.append([words.get(q, "density"), words.get(r, "density"), f"{feedback_s:g} s"])
        judged.append(judge(by_condition(rows)))
    holds, straddles = (np.array([[f[k] for f in found] for found in judged]) for k in (0, 1))
    held, concluded = holds.sum(axis=1), holds[:, CONCLUSIONS].sum(axis=1)
    best = int(np.lexsort((straddles.sum(axis=1), -concluded, -held))[0])
    numbers, pairs = [number for *_, number in judged[best]], combinations(EXPLAINED, 2)
    page.print_numbers(
        best_interpretation=", ".join(names[best]),
        statements_held=f"{held[best]} of {len(TEXTS)} under the best of {len(judged)}",
        ties=(held == held[best]).sum() - 1,
        whole_explanation=holds[:, EXPLAINED].all(axis=1).sum(),
        two_parts_of_it=[int(holds[:, pair].all(axis=1).sum()) for pair in pairs],
        p_larger_with_resets=format_estimate(numbers[17], digits=3),
        p_larger_when_steady=format_estimate(numbers[14], digits=3),
        ratio_of_sigmas=format_estimate(numbers[18], digits=2),
    )
    cells = [[("no", "yes")[yes] + " ~" * open_ for yes, open_, _ in found] for found in judged]
    rows = [[*name, *row] for name, row in zip(names, cells, strict=True)]
    page.table("paper1_verdicts", ["Q", "R", "feedback", *TEXTS], rows)
    page.figure("paper1_verdicts", draw_verdicts(holds, straddles, best), readings.footer)


@with_style
def draw_verdicts(holds: NDArray, straddles: NDArray, best: int) -> Figure:
    """Draw the number of interpretations under which each statement holds."""
    count, places, grey = len(holds), range(len(TEXTS)), "#cfcfcf"
    figure = Figure(figsize=(9.2, 1.5 + 0.26 * len(TEXTS)))
    figure.suptitle(HEADLINE.format(count))
    axes = figure.subplots()
    held, (yes, no) = holds.sum(axis=0), plots.COLOURS[:2]
    axes.barh(places, held, height=0.7, color=np.where(holds[best], yes, no))
    axes.barh(places, (~holds & straddles).sum(axis=0), height=0.7, left=held, color=grey)
    for place, number in enumerate(held):
        inside = number > 0.1 * count
        side, colour = ("right", "white") if inside else ("left", "black")
        at = number + (-0.4 if inside else 0.4)
        axes.text(at, place, f"{number}", ha=side, va="center", size=10.5, color=colour)
    axes.set_yticks(places, TEXTS)
    axes.set(xlim=(0, count), ylim=(len(TEXTS) - 0.4, -0.6))
    axes.set_xlabel(f"interpretations under which it holds, of {count}")
    axes.grid(visible=False, axis="y")
    labels = {yes: "holds under the best one too", no: "not under the best one"}
    labels[grey] = "fails, interval includes the bound"
    handles = [Patch(color=colour, label=label) for colour, label in labels.items()]
    figure.legend(handles=handles, loc="outside lower center", ncols=3)
    return figure


@with_style
def draw_headings(runs: Runs, conditions: Mapping[str, pa.Table], title: str) -> Figure:
    """Draw heading errors from the bias floor, with the settled band and the resets."""
    figure = Figure(figsize=(9.2, 4.2))
    figure.suptitle(f"Heading error from its bias floor: {title}")
    axes = figure.subplots()
    ids = {f"condition {name}": rows["run_id"].to_pylist() for name, rows in conditions.items()}
    lines = plots.group_curves(sinsjax.read_curves(runs.directory), ids)
    for colour, one in zip(plots.COLOURS, lines, strict=False):
        values = one.columns["phi_u_arcmin"] - conditions["1"]["floor_arcmin"][0].as_py()
        plots.draw_mean_and_95_percent_band(axes, one.label, one.time_s, values, colour)
    axes.set_yscale("asinh", linear_width=1.0)
    axes.axhspan(-BAND_ARCMIN, BAND_ARCMIN, color=GREY, alpha=0.25, linewidth=0)
    for time_s in [*conditions.values()][-1]["reset_times_s"][0].as_py() or ():
        axes.axvline(time_s, color=GREY, linestyle=":")
    axes.yaxis.set_major_locator(FixedLocator([-10, 0, 10, 100, 1000]))
    axes.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axes.yaxis.set_minor_locator(NullLocator())
    label = "heading error (arcmin)\nlogarithmic far from 0"
    axes.set(xlim=(0, runs.end_s), xlabel="time (s)", ylabel=label)
    figure.legend(loc="outside lower center", ncols=len(ids))
    return figure


def expect(free: Runs, runs: Mapping[str, pa.Table], page: Page) -> None:
    """Print what to expect of each condition, and where the heading ends."""
    rows = []
    for name, table in runs.items():
        start = ", ".join(f"{table[f'phi_{axis}0_deg'][0].as_py():g}" for axis in "enu")
        ends = numeric_column(table, "phi_u_mean_arcmin") - numeric_column(table, "floor_arcmin")
        settling = format_estimate(MEANINGS["short"][2](table), digits=0)
        rows.append([f"{name}: {start}", settling, format_estimate(analysis.mean(ends))])
    header = ["condition: misalignment (deg)", "settled after (s)", "heading error (arcmin)"]
    page.show("What to expect", header, rows)
    settle_truth = ~np.isnan(numeric_column(runs[RESET], "settle_10_truth_s"))
    *without, cured = (np.mean(numeric_column(one, "sigma_u_arcmin")) for one in runs.values())
    page.print_numbers(
        settling=[percent(analysis.share([settles] * free.draws)) for settles in (True, False)],
        floor=f"{runs['1']['floor_arcmin'][0].as_py():.1f} arcmin",
        settling_from_truth=percent(analysis.share(settle_truth)),
        sigma_at_the_end=f"{cured:.1f}, without resets {min(without):.1f} to {max(without):.1f}",
    )


def limits(free: Runs, runs: pa.Table, page: Page) -> None:
    """Print the limit accuracy of section 2.4.1 in closed form, and as simulated; heading north."""
    keys = ("accel_bias_ug", "gyro_bias_deg_per_h", "earth_rate_deg_per_h", "latitude_deg")
    bias, drift, rate, latitude = (float(free.study.values(key)[0]) for key in keys)
    level, tilt = math.degrees(bias * 1e-6) * 60, math.tan(math.radians(latitude))
    turn = -math.degrees(drift / math.cos(math.radians(latitude))) * 60
    means = (analysis.mean(numeric_column(runs, f"phi_{axis}_mean_arcmin")) for axis in "enu")
    page.print_numbers(
        closed_forms=f"{-level:.4f}, {level:.4f}, {turn / rate + level * tilt:.4f} arcmin",
        paper_heading=f"{turn / 15:.4f} arcmin, without {level * tilt:+.4f}",
        condition_1_ends_at=", ".join(format_estimate(one, digits=3) for one in means),
    )


def main() -> None:
    """Write the tables and figures."""
    studies = ("paper1_conditions", "paper1_resets", "paper1_readings")
    runs, page = read_arguments(__doc__, studies)
    free, resets, readings = runs.values()
    plain, cured = by_condition(free.rows()), by_condition(resets.rows())
    between = apart(cured[RESET], cured["1"])
    page.print_numbers(resets_apart_from_condition_1=format_estimate(between, "arcmin", 2))
    expect(free, {**plain, RESET: cured[RESET]}, page)
    limits(free, plain["1"], page)
    title = "condition 5, with and without resets"
    page.figure("paper1_resets", draw_headings(resets, cured, title), resets.footer)
    page.figure("paper1_conditions", draw_headings(free, plain, "conditions 1 to 5"), free.footer)
    judge_readings(readings, page)


if __name__ == "__main__":
    main()
