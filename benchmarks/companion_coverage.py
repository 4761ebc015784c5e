"""What the 95 % intervals of controlled estimates cover, and how many draws companions save.

The draws of a study, run with their companions, are the population: samples of n are taken from
them many times, and it is counted how often the interval holds the mean of all. The expectation of
the companions is their mean over the population. Statistics that are the same for 95 % of the draws
or more are left out: few draws tell nothing of the rest.

Then how far the mean settling time over eight misalignments and that of its companions go together
from draw to draw, of each schedule of `configs/tuned_schedules.toml`.
"""

import argparse
import math
import tomllib
from collections.abc import Iterator
from typing import NamedTuple

import common
import covariance_accuracy as accuracy
import numpy as np
from numpy.typing import NDArray

import sinsjax
from sinsjax.analysis.controlled import Expectation
from sinsjax.bench.timing import Row, conditions
from sinsjax.execution import controlled, layouts
from sinsjax.platform.assets import asset
from sinsjax.study.load import study_from_dict
from sinsjax.study.study import Study

SIZES, REPETITIONS, DRAWS, CORRELATED = (16, 64), 2000, 1024, 256
SCHEDULES = [[50.0, 100.0, 150.0], [10.0, 60.0], [12.15, 63.44, 63.72]]
TIMES_S = (60, 150, 300, 900)
STARTS = [(5.0, 5.0), (5.0, 30.0), (10.0, 60.0), (20.0, 120.0)]
"""Level and heading errors, deg."""

MOST_ALIKE = 0.95


SETTLED = ("settle_10_s", "companion_settle_10_s")


class Coverage(NamedTuple):
    """Of the intervals of one statistic of one variant at one number of draws.

    Attributes:
        kind: of the statistic.
        n: draws.
        controlled: share of the controlled intervals that hold the mean.
        plain: share of the plain ones.
        saved: median factor.
    """

    kind: str
    n: int
    controlled: float
    plain: float
    saved: float


def study_of(draws: int) -> Study:
    """Paper 1's filter, with feedback every second, from small and large errors."""
    cases = [
        {"phi_e0_deg": e, "phi_n0_deg": e, "phi_u0_deg": u, "reset_times_s": resets}
        for e, u in STARTS
        for resets in SCHEDULES
    ]
    given = {"estimate": "controlled", "draws": draws}
    return accuracy.study_of({"study": given, "cases": cases}, TIMES_S, seed=1)


def covered(study: Study, draws: int, repetitions: int) -> Iterator[Coverage]:
    """The coverage of every statistic of every variant."""
    summary = sinsjax.run(study).summary.select(controlled.needed(study))
    random = np.random.default_rng(1)
    for rows in controlled.by_variant(study, summary):
        for one in layouts.controlled(study):
            y, x = rows.of(one), rows.of(one, "companion_")
            if np.mean(y == np.median(y)) < MOST_ALIKE and np.isfinite([*y, *x]).all():
                for n in SIZES:
                    picks = random.integers(0, draws, (repetitions, n))
                    yield _of_one(one.kind, n, y, x, picks)


def _of_one(kind: str, n: int, y: NDArray, x: NDArray, picks: NDArray) -> Coverage:
    expected, mean = Expectation(float(x.mean())), float(y.mean())
    if kind == "rms":
        expected, mean = Expectation(float(np.mean(x**2))), math.sqrt(np.mean(y**2))
    found = [controlled.ESTIMATE[kind](y[pick], x[pick], expected) for pick in picks]
    hit = np.array([[one.low <= mean <= one.high for one in both] for both in found])
    saved = float(np.nanmedian([both.saved for both in found]))
    return Coverage(kind, n, hit[:, 1].mean(), hit[:, 0].mean(), saved)


def rows_of(found: list[Coverage]) -> Iterator[Row]:
    """A line for each kind and number of draws."""
    for kind in dict.fromkeys(one.kind for one in found):
        for n in SIZES:
            own = [one for one in found if (one.kind, one.n) == (kind, n)]
            mean = np.mean([(one.controlled, one.plain) for one in own], axis=0)
            least = min(one.controlled for one in own)
            yield {
                "kind": kind,
                "n": n,
                "statistics": len(own),
                "coverage": round(float(mean[0]), 3),
                "least": round(least, 3),
                "plain": round(float(mean[1]), 3),
                "saved": round(float(np.median([one.saved for one in own])), 1),
            }


def correlations(draws: int) -> Iterator[Row]:
    """Correlation of the mean settling time over misalignments with its companions', by schedule.

    Args:
        draws: of each schedule and misalignment.
    """
    tables = tomllib.loads(asset("configs/tuned_schedules.toml").read_text("utf-8"))
    tables["study"] |= {"estimate": "controlled", "draws": draws}
    study = study_from_dict(tables, "correlations")
    table, run_s = sinsjax.run(study).summary, study.run_s
    case = np.array(table["case"].to_pylist())
    for name in dict.fromkeys(case):
        own = table.filter(case == name)
        # By draw, as runs are; one that never settles counts as long as it takes.
        both = [own[column].to_numpy().reshape(draws, -1) for column in SETTLED]
        y, x = (np.where(np.isnan(one), run_s, one).mean(axis=1) for one in both)
        picks = np.random.default_rng(1).integers(0, draws, (2000, draws))
        ends = np.quantile([np.corrcoef(y[p], x[p])[0, 1] for p in picks], [0.025, 0.975])
        found = [np.corrcoef(y, x)[0, 1], *ends]
        numbers = zip(("correlation", "low", "high"), found, strict=True)
        yield {"schedule": str(name), "draws": draws} | {
            key: round(float(r), 3) for key, r in numbers
        }


def main() -> None:
    """Measure and print; no timing, so it is no set of the history."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--json", action="store_true", help="one JSON object a line")
    parser.add_argument("--draws", type=int, default=DRAWS, help="of the population")
    parser.add_argument("--correlated", type=int, default=CORRELATED, help="draws of a schedule")
    parser.add_argument("--repetitions", type=int, default=REPETITIONS, help="of each statistic")
    flags = parser.parse_args()
    sinsjax.configure()
    found = list(covered(study_of(flags.draws), flags.draws, flags.repetitions))
    common.show(list(rows_of(found)), conditions(), as_json=flags.json)
    common.show(list(correlations(flags.correlated)), conditions(), as_json=flags.json)


if __name__ == "__main__":
    main()
