"""Gain schedules with their runs, and the rule that ranks them."""

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sinsjax import analysis
from sinsjax.alignment.bounds import share_outside
from sinsjax.analysis import Estimate
from sinsjax.report.base import Source, name_of, shown_keys
from sinsjax.study.times import spans_s

from ..loops.runs import bound_arcmin, heading_errors


class Scored(NamedTuple):
    """A schedule with its runs.

    Attributes:
        key: what is swept, by the keys that tell schedules apart.
        variant: its number.
        tape_s: length of its tape, s.
        wide_s: (draws,) settling times to the widest band, s; infinite if never.
        narrow_s: the same to the narrowest.
        errors: (draws,) heading from its floor at the end, arcmin; NaN if unknown.
        end_s: end of the runs, s.
        outside: share of draws that an estimator at the tape's bound leaves outside the narrowest.
    """

    key: Mapping[str, Any]
    variant: int
    tape_s: float
    wide_s: NDArray
    narrow_s: NDArray
    errors: NDArray
    end_s: float
    outside: float

    @property
    def name(self) -> str:
        """The schedule in words."""
        return name_of(self.key)

    @property
    def wide(self) -> Estimate:
        """Median settling time to the widest band, s of updates."""
        return analysis.quantile(self.wide_s)

    @property
    def last_cycle(self) -> Estimate | None:
        """Share of draws inside the narrowest band for the last two passes; None in one pass."""
        if 2 * self.tape_s > self.end_s:
            return None
        count = int((self.narrow_s <= self.end_s - 2 * self.tape_s).sum())
        return analysis.proportion(count, self.narrow_s.size)

    @property
    def narrow(self) -> Estimate:
        """Median settling time to the narrowest band, s of updates."""
        return analysis.quantile(self.narrow_s)


class Ranking(NamedTuple):
    """Schedules by the rule.

    Attributes:
        ordered: the best first.
        tied: how many of them share the first place by the first criterion.
    """

    ordered: Sequence[Scored]
    tied: int


def bands_of(source: Source) -> tuple[float, float]:
    """The widest and the narrowest settle band, arcmin."""
    bands = source.study.study.settle_bands_arcmin
    return max(bands), min(bands)


def scored_of(source: Source) -> list[Scored]:
    """Every variant with its runs, in the study's order."""
    study, found = source.study, []
    ends, tapes = spans_s(study).T
    wide, narrow = bands_of(source)
    outside = share_outside(bound_arcmin(study, tapes), narrow)
    for key, rows in analysis.groups(source.summary, ["variant_id", *shown_keys(study)]):
        variant = key.pop("variant_id")
        settle = (analysis.numbers(rows, f"settle_{band:g}_s") for band in (wide, narrow))
        wide_s, narrow_s = (np.nan_to_num(times, nan=np.inf) for times in settle)
        found.append(
            Scored(
                key=key,
                variant=variant,
                tape_s=float(tapes[variant]),
                end_s=float(ends[variant]),
                wide_s=wide_s,
                narrow_s=narrow_s,
                errors=heading_errors(rows),
                outside=float(outside[variant]),
            )
        )
    return sorted(found, key=lambda s: s.variant)


def rank(scored: Sequence[Scored]) -> Ranking:
    """Schedules from the best one; equals in the order given.

    The smallest median settling time to the narrow band, a draw that never settles counting as
    infinite. Schedules whose interval of that median overlaps the best one's are tied; among them
    the smallest median to the wide band wins, then the smallest to the narrow one.
    """
    medians = [(s.narrow, s.wide) for s in scored]
    best = min(medians, key=lambda m: (m[0].value, m[1].value))[0]
    is_tied = [_overlap(narrow, best) for narrow, _ in medians]

    def place(i: int) -> tuple[bool, float, float]:
        narrow, wide = (estimate.value for estimate in medians[i])
        return (False, wide, narrow) if is_tied[i] else (True, narrow, wide)

    order = sorted(range(len(scored)), key=place)
    return Ranking([scored[i] for i in order], sum(is_tied))


def _overlap(one: Estimate, other: Estimate) -> bool:
    """Whether two intervals share a value; an end that is not known is no bound."""
    lows, highs = ([getattr(e, end) for e in (one, other)] for end in ("low", "high"))
    low = max(-math.inf if math.isnan(x) else x for x in lows)
    high = min(math.inf if math.isnan(x) else x for x in highs)
    return low <= high
