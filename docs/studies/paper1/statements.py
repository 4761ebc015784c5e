"""Paper 1's statements about its simulation, judged on the runs of each reading.

What the paper's words mean was fixed before the first result.

Judged from the summary alone, hence not judged: the convergence trend of the first 100 s
(section 3.1) and the two added stable processes after resets (3.3.2), which need curves; that
pitch and roll converge, as settling is counted for yaw; the car test (4.2), which is a record.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa

from sinsjax import analysis
from sinsjax.analysis import Estimate, numeric_column, pair_by_draw
from sinsjax.errors import InputError
from sinsjax.execution.source import Source

RESET = "5 with resets"
CONDITIONS = ("1", "2", "3", "4", "5", RESET)
AS_PRECISE_ARCMIN = 1.0

CONCLUSIONS = ("S8", "S10", "S11", "S12")
"""What the paper's abstract concludes: failure, its reason, the cure, its accuracy."""


class Meaning(NamedTuple):
    """What some of the paper's words mean: a number of one or two conditions, and its bounds.

    Attributes:
        number: of the runs of the conditions.
        low: the number is at least this.
        high: it is at most this.
        by_interval: the whole interval is inside.
        complete: every draw has a number.
    """

    number: Callable[..., Estimate]
    low: float = -math.inf
    high: float = math.inf
    by_interval: bool = False
    complete: bool = False

    def judge(self, *runs: pa.Table) -> "Finding":
        """The number of some runs, against its bounds."""
        number = self.number(*runs)
        bounds = [bound for bound in (self.low, self.high) if math.isfinite(bound)]
        # Said as "not clear of it", so that an unknown end straddles.
        straddles = any(not (number.low > bound or number.high < bound) for bound in bounds)
        holds = self.low <= number.value <= self.high
        if self.by_interval:
            holds = holds and not straddles
        if self.complete:
            holds = holds and number.n == len(runs[0])
        return Finding(holds, straddles, number)


class Finding(NamedTuple):
    """A number, whether it meets its meaning, and whether its interval reaches across a bound."""

    holds: bool
    straddles: bool
    number: Estimate


def _settled(runs: pa.Table) -> Estimate:
    return analysis.share(~np.isnan(numeric_column(runs, "settle_10_s")))


def _median_time(runs: pa.Table) -> Estimate:
    return analysis.quantile(numeric_column(runs, "settle_10_s"))


def _longer(runs: pa.Table, other: pa.Table) -> Estimate:
    return analysis.quantile_difference(*pair_by_draw(runs, other, "settle_10_s"))


def _worse(runs: pa.Table, other: pa.Table) -> Estimate:
    means, limits = (
        pair_by_draw(runs, other, f"{name}_arcmin") for name in ("phi_u_mean", "floor")
    )
    return analysis.mean_difference(*(np.abs(m - at) for m, at in zip(means, limits, strict=True)))


def _p_above(runs: pa.Table, column: str, missing: float) -> Estimate:
    # Every run has equally many records, so the mean share is that of all records together; the
    # records of a run that is not finite count against the statement.
    found = analysis.mean(np.nan_to_num(numeric_column(runs, column), nan=missing))
    return found._replace(low=max(found.low, 0.0), high=min(found.high, 1.0))


def _apart(runs: pa.Table, other: pa.Table) -> Estimate:
    return analysis.mean_difference(*pair_by_draw(runs, other, "phi_u_mean_arcmin"))


def _sigma_ratio(runs: pa.Table, other: pa.Table) -> Estimate:
    sigma, reference = pair_by_draw(runs, other, "sigma_u_arcmin")
    return analysis.mean(sigma / reference)


_CONVERGES = Meaning(_settled, low=0.95)
_CANNOT = Meaning(_settled, high=math.nextafter(0.05, 0.0))  # under it
_SHORT = Meaning(_median_time, high=200.0)
_LONGER = Meaning(_longer, low=0.0, by_interval=True)
_WORSE = Meaning(_worse, low=0.0, by_interval=True)
_LARGER = Meaning(partial(_p_above, column="p_above_error_share", missing=0.0), low=0.95)
_SMALLER = Meaning(
    partial(_p_above, column="p_above_error_steady_share", missing=1.0), high=1 - 0.95
)
_PRECISE = Meaning(_apart, -AS_PRECISE_ARCMIN, AS_PRECISE_ARCMIN, by_interval=True, complete=True)
_EQUAL = Meaning(_sigma_ratio, 1 - 0.1, 1 + 0.1, complete=True)


class Statement(NamedTuple):
    """What the paper says of one or two conditions; P is the filter's heading variance."""

    text: str
    meaning: Meaning
    conditions: tuple[str, ...]


STATEMENTS = {
    "S1a": Statement("condition 1 converges", _CONVERGES, ("1",)),
    "S1b": Statement("condition 2 converges", _CONVERGES, ("2",)),
    "S2a": Statement("condition 1 in a short time", _SHORT, ("1",)),
    "S2b": Statement("condition 2 in a short time", _SHORT, ("2",)),
    "S3": Statement("condition 3 converges", _CONVERGES, ("3",)),
    "S4a": Statement("condition 3 longer than condition 2", _LONGER, ("3", "2")),
    "S4b": Statement("condition 3 longer than condition 1", _LONGER, ("3", "1")),
    "S5": Statement("condition 4 converges", _CONVERGES, ("4",)),
    "S6a": Statement("condition 4 longer than condition 2", _LONGER, ("4", "2")),
    "S6b": Statement("condition 4 longer than condition 1", _LONGER, ("4", "1")),
    "S7a": Statement("condition 4 worse than condition 2", _WORSE, ("4", "2")),
    "S7b": Statement("condition 4 worse than condition 1", _WORSE, ("4", "1")),
    "S8": Statement("condition 5 cannot converge", _CANNOT, ("5",)),
    "S9": Statement("condition 1: P larger throughout", _LARGER, ("1",)),
    "S10": Statement("condition 5: P smaller when steady", _SMALLER, ("5",)),
    "S11": Statement("condition 5 with resets converges", _CONVERGES, (RESET,)),
    "S12": Statement("condition 5 with resets as precise", _PRECISE, (RESET, "1")),
    "S13": Statement("condition 5 with resets: P larger", _LARGER, (RESET,)),
    "S14": Statement("condition 5 with resets: P as 1's", _EQUAL, (RESET, "1")),
}


def judge(conditions: Mapping[str, pa.Table]) -> dict[str, Finding]:
    """Judges every statement on the runs of each condition in one reading, the same draws in all.

    Raises:
        InputError: a condition or a column is missing, a condition has no runs, or draws differ.
    """
    for name in CONDITIONS:
        if name not in conditions or conditions[name].num_rows == 0:
            raise InputError(f"paper 1's statements: there are no runs of condition {name}")
    return {
        name: one.meaning.judge(*(conditions[condition] for condition in one.conditions))
        for name, one in STATEMENTS.items()
    }


class Judged(NamedTuple):
    """One reading, its value by key, with the finding of each statement."""

    reading: Mapping[str, Any]
    findings: Mapping[str, Finding]

    @property
    def held(self) -> int:
        """How many statements hold."""
        return sum(finding.holds for finding in self.findings.values())

    @property
    def words(self) -> list[str]:
        """The reading in words: Q, R and feedback interval."""
        words = {"per_step": "as printed", "per_sample": "sample", "per_update": "per update"}
        q, r = (self.reading[key] for key in ("q_reading", "r_reading"))
        feedback = f"{self.reading['feedback_interval_s']:g} s"
        return [words.get(q, "density"), words.get(r, "density"), feedback]

    def holds(self, *names: str) -> bool:
        """Whether some statements hold, all of them."""
        return all(self.findings[name].holds for name in names)


def judge_all(source: Source) -> list[Judged]:
    """Every reading of the study, judged."""
    found = []
    for reading, rows in analysis.group_rows(source.summary, list(source.study.axes)):
        cases = analysis.group_rows(rows, ["case"])
        conditions = {key["case"].removeprefix("condition "): table for key, table in cases}
        found.append(Judged(reading, judge(conditions)))
    return found


def best_of(judged: Sequence[Judged]) -> Judged:
    """The reading under which most statements hold.

    Ties go to the one with more of `CONCLUSIONS`, then with fewer that straddle, then to the first.
    """
    return max(
        judged,
        key=lambda one: (
            one.held,
            sum(one.findings[name].holds for name in CONCLUSIONS),
            -sum(finding.straddles for finding in one.findings.values()),
        ),
    )
