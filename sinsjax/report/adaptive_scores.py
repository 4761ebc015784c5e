"""Reset policies against the best single reset of each cell: ratios, the best trigger, alarms."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sinsjax import analysis
from sinsjax.analysis import Estimate
from sinsjax.analysis.estimates import RESAMPLES, SEED, TAIL, place
from sinsjax.report.adaptive_cells import Cells
from sinsjax.report.reset_best import Pick, held_out
from sinsjax.report.reset_grid import NONE, median, shared

WITHIN = 1.1
"""A policy does what the oracle does up to this ratio of their median settling times."""

LATER_SHARE, LATER_S = 0.1, 5.0
"""A reset in a healthy run is a false alarm if it delays settling by more than either."""

FEW_ALARMS = 0.01
"""Below this share false alarms are few enough."""

At = tuple[int, int]
"""A cell: places of its tuning and start."""


def ratio_of(one: NDArray, other: NDArray) -> NDArray:
    """Ratio of settling times; 1 where neither ever settles, 0 where only the first does."""
    same = one == other  # also where both are infinite
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(same, 1.0, one / other)


class Alarms(NamedTuple):
    """Healthy runs of a policy.

    Attributes:
        false: share of them in which it acts and that settle later than without reset by more
            than `LATER_SHARE` or `LATER_S`, either being enough.
        both: share of those that are later by more than both.
        acts: share of them that were reset, or in which it fades.
    """

    false: Estimate
    both: Estimate
    acts: Estimate


class Choice(NamedTuple):
    """The best of all triggers and thresholds.

    Attributes:
        place: of the policy.
        halves: places of those that each half of the draws chose; told by the other half if they
            are the same one.
    """

    place: int
    halves: tuple[int, int]

    @property
    def is_held_out(self) -> bool:
        """Whether both halves of the draws chose it, so that no draw is told by its own choice."""
        return set(self.halves) == {self.place}


@dataclass(frozen=True, eq=False)
class Scores:
    """How the policies of a study compare.

    Attributes:
        cells: their runs.
    """

    cells: Cells

    @cached_property
    def at(self) -> list[At]:
        """The cells, by tuning, then by start."""
        return [(t, s) for t in range(len(self.cells.tunings)) for s in self.cells.judged]

    @cached_property
    def oracle(self) -> dict[At, Pick]:
        """The best single reset of every cell, chosen by each half of the draws for the other."""
        singles = self.cells.singles
        return {at: held_out(self.cells.settle_s[at], singles) for at in self.at}

    @cached_property
    def ratios(self) -> NDArray:
        """(cells, policies) the same ratios without their intervals."""
        return self._plain(slice(None))

    @cached_property
    def _ends(self) -> NDArray:
        """(2, cells, policies) ends of the ratios' intervals, by the bootstrap over the draws.

        As `analysis` does it for one ratio, but all policies share the medians of the oracle.
        """
        draws = self.cells.draws
        pick = np.random.default_rng(SEED).integers(0, draws, (RESAMPLES, draws))
        middle = place(draws, 0.5)
        ends = []
        for at in self.at:
            runs = np.vstack([self.cells.settle_s[at], self.oracle[at].settle_s])
            medians = np.partition(runs[:, pick], middle, axis=-1)[..., middle]
            drawn = ratio_of(medians[:-1], medians[-1])
            ends.append(np.quantile(drawn, [TAIL, 1 - TAIL], axis=-1, method="inverted_cdf"))
        return np.stack(ends, axis=1)

    def ratio(self, at: At, policy: int) -> Estimate:
        """Median settling time of a policy in a cell over that of the oracle.

        Its interval is that of the bootstrap over the draws, each resampled whole.
        """
        number = self.at.index(at)
        low, high = self._ends[:, number, policy]
        return Estimate(
            float(self.ratios[number, policy]), float(low), float(high), self.cells.draws
        )

    def _plain(self, draws: slice) -> NDArray:
        """(cells, policies) ratios to the oracle over some draws."""
        oracle = np.array([self.oracle[at].settle_s[None, draws] for at in self.at])
        runs = np.array([self.cells.settle_s[at][:, draws] for at in self.at])
        return ratio_of(median(runs), median(oracle))

    def within(self, policy: int, feedback_s: float | None = None) -> Estimate:
        """Number of cells within `WITHIN` of the oracle, all or those with a feedback interval.

        The ends of its interval are the numbers of cells whose ratio's whole interval lies within,
        and of those whose interval reaches there.
        """
        tuned = self.cells.tuned(feedback_s)
        found = [self.ratio(at, policy) for at in self.at if at[0] in tuned]
        ends = [
            [getattr(ratio, end) <= WITHIN for ratio in found] for end in ("value", "high", "low")
        ]
        value, low, high = map(sum, ends)
        return Estimate(value, min(low, value), max(high, value), len(found))

    def worst(self, policy: int) -> At:
        """The cell with the largest ratio to the oracle; the first of several."""
        return self.at[int(np.argmax(self.ratios[:, policy]))]

    def best(self, places: Sequence[int], draws: slice = slice(None)) -> int:
        """The policy with the fewest cells beyond `WITHIN`, then with the smallest worst ratio.

        Args:
            places: of the policies to choose from; the first of equals.
            draws: by which.
        """
        ratios = self._plain(draws)[:, places]
        order = np.lexsort((ratios.max(axis=0), (ratios > WITHIN).sum(axis=0)))
        return places[int(order[0])]

    @cached_property
    def choice(self) -> Choice:
        """The best of all triggers that reset or fade."""
        places = self.cells.triggered
        one, other = (self.best(places, slice(half, None, 2)) for half in range(2))
        return Choice(self.best(places), (one, other))

    @cached_property
    def by_trigger(self) -> dict[str, int]:
        """The place of the best threshold of every trigger, in the order of the study."""
        found: dict[str, list[int]] = {}
        for number in self.cells.triggered:
            found.setdefault(str(self.cells.policies[number].trigger), []).append(number)
        return {name: self.best(places) for name, places in found.items()}

    def settled(self, policy: int) -> Estimate:
        """Share of the runs of all cells that settle."""
        runs = np.array([self.cells.settle_s[*at, policy] for at in self.at])
        return shared(np.isfinite(runs))

    def acts(self, policy: int) -> NDArray:
        """(tunings, starts, draws) whether it reset; what fades acts all the time."""
        one, count = self.cells.policies[policy], self.cells.count[:, :, policy]
        return np.full(count.shape, one.fades or bool(one.times)) | (count > 0)

    def in_need(self) -> list[At]:
        """The cells in which the median without reset lies beyond `WITHIN` of the oracle's."""
        ratios = self.ratios[:, self.cells.policy(NONE)]
        return [at for at, ratio in zip(self.at, ratios, strict=True) if ratio > WITHIN]

    def acts_in_need(self, policy: int) -> Estimate:
        """Share of the runs of the cells `in_need` in which it acts."""
        acts = self.acts(policy)
        runs = np.array([acts[at] for at in self.in_need()])
        return shared(runs) if runs.size else analysis.UNKNOWN

    def alarms(
        self, policy: int, *, biased: bool | None = None, feedback_s: float | None = None
    ) -> Alarms:
        """What a trigger does in healthy runs, against no reset on the same noise.

        Args:
            policy: its place.
            biased: with gyro bias or without; None for both.
            feedback_s: of the tunings; None for all.
        """
        cells = self.cells
        kinds = (False, True) if biased is None else (biased,)
        starts = [start for kind in kinds for start in cells.healthy(biased=kind)]
        at = np.ix_(cells.tuned(feedback_s), starts)
        acts = self.acts(policy)[at]
        without = cells.settle_s[:, :, cells.policy(NONE)][at]
        later = _later(cells.settle_s[:, :, policy][at], without)
        much = later > LATER_SHARE * np.where(np.isfinite(without), without, 0.0), later > LATER_S
        counts = acts & (much[0] | much[1]), acts & much[0] & much[1], acts
        return Alarms(*map(shared, counts))


def _later(settle_s: NDArray, other_s: NDArray) -> NDArray:
    """A difference of settling times; 0 where both are infinite."""
    same = settle_s == other_s
    return np.where(same, 0.0, settle_s - np.where(same, 0.0, other_s))
