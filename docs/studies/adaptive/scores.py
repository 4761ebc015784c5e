"""Reset policies against the best single reset of each cell: ratios, the best trigger, alarms."""

from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sinsjax.analysis import Estimate
from sinsjax.analysis.estimates import RESAMPLES, SEED, TAIL, quantile_index
from sinsjax.analysis.grids import median_over_draws
from sinsjax.execution.source import Source

from ..common.grids import grid_of, held_out, shared, soonest

WITHIN = 1.1
"""A policy does what the best single reset does up to this ratio of median settling times."""

LATER_SHARE, LATER_S = 0.1, 5.0
"""A reset in a healthy run is a false alarm if it delays settling by more than either."""

FADING = ("strong_tracking", "fading")
"""Rivals that multiply P all the time instead of resetting it."""

SETTLE, COUNT = "settle_10_s", "triggered_count"


class Start(NamedTuple):
    """Gyro bias (deg/h), initial level error and initial heading error (deg)."""

    bias: float
    level: float
    yaw: float

    @property
    def name(self) -> str:
        """Its misalignment in words."""
        return f"({self.level:g}, {self.level:g}, {self.yaw:g})"

    @property
    def is_healthy(self) -> bool:
        """Whether the linear model holds, so that a reset is of no use."""
        return self.level <= 0.1 and self.yaw <= 1.0


class Policy(NamedTuple):
    """What resets the filter; numbers of a trigger are 0 where there is none."""

    times: tuple[float, ...]
    trigger: str = "none"
    threshold: float = 0.0
    window_s: float = 0.0
    refractory_s: float = 0.0
    until_s: float = 0.0
    most: int = 0

    @property
    def words(self) -> str:
        """The trigger with blanks, or which resets there are."""
        if self.trigger == "none":
            return "three fixed" if self == PAPER else "no reset"
        return "NIS" if self.trigger == "nis" else self.trigger.replace("_", " ")


NONE, PAPER = Policy(()), Policy((50.0, 100.0, 150.0))


class Scores:
    """How the policies of the study compare, over cells of tuning and start."""

    def __init__(self, source: Source) -> None:
        study = source.study
        bias, east, yaw = (
            study.values(key) for key in ("gyro_bias_deg_per_h", "phi_e0_deg", "phi_u0_deg")
        )
        keys = ("threshold", "window_s", "refractory_s", "until_s", "most")
        numbers = [study.values(f"trigger_{key}") for key in keys]
        rows = zip(study.reset_times(), study.values("reset_trigger"), *numbers, strict=True)
        self.grid = grid_of(
            source,
            (SETTLE, COUNT),
            q="q_reading",
            feedback="feedback_interval_s",
            start=[Start(*one) for one in zip(bias, east, yaw, strict=True)],
            policy=[
                Policy(tuple(times)) if trigger == "none" else Policy(tuple(times), trigger, *rest)
                for times, trigger, *rest in rows
            ],
        )
        self.starts: list[Start] = [s for s in self.grid.axes["start"] if s.bias]
        self.healthy: list[Start] = [s for s in self.grid.axes["start"] if s.is_healthy]
        policies: tuple[Policy, ...] = self.grid.axes["policy"]
        self.singles = [p for p in policies if p.trigger == "none" and len(p.times) == 1]
        self.triggered = [p for p in policies if p.trigger != "none"]

    @cached_property
    def cells(self) -> list[tuple[str, float, Start]]:
        """Interpretation of Q, feedback interval (s) and start of each cell."""
        axes = self.grid.axes
        return [(q, f, s) for q in axes["q"] for f in axes["feedback"] for s in self.starts]

    def runs(self, policy: Policy) -> NDArray:
        """(cells, draws) settling times with a policy, s."""
        runs = self.grid.at(SETTLE, policy=policy, start=self.starts)
        return runs.reshape(len(self.cells), -1)

    @cached_property
    def best_runs(self) -> NDArray:
        """(cells, draws) settling times with the best single reset, chosen on other draws, s."""
        runs = np.stack([self.runs(policy) for policy in self.singles], axis=1)
        return held_out(runs, soonest).values

    def ratios(self, policy: Policy, draws: slice = slice(None)) -> NDArray:
        """(cells,) median settling time over that of the best single reset."""
        return _ratio(
            median_over_draws(self.runs(policy)[:, draws]),
            median_over_draws(self.best_runs[:, draws]),
        )

    def intervals(self, policy: Policy) -> NDArray:
        """(2, cells) ends of the ratios' intervals, by the bootstrap over the draws."""
        draws = self.grid.draws
        pick = np.random.default_rng(SEED).integers(0, draws, (RESAMPLES, draws))
        middle = quantile_index(draws, 0.5)
        one, other = (
            np.partition(runs[:, pick], middle, axis=-1)[..., middle]
            for runs in (self.runs(policy), self.best_runs)
        )
        return np.quantile(_ratio(one, other), [TAIL, 1 - TAIL], axis=-1, method="inverted_cdf")

    def within(self, policy: Policy, feedback: float | None = None) -> Estimate:
        """Number of cells within `WITHIN`; its ends count whole intervals, and parts of them."""
        here = np.array([feedback in (None, cell[1]) for cell in self.cells])
        low, high = self.intervals(policy)[:, here] <= WITHIN
        value = int((self.ratios(policy)[here] <= WITHIN).sum())
        least, most = min(int(high.sum()), value), max(int(low.sum()), value)
        return Estimate(value, least, most, int(here.sum()))

    def ties(self, policy: Policy) -> int:
        """Number of cells in which neither a policy nor the best single reset settles half."""
        never = np.isinf(median_over_draws(self.runs(policy))) & np.isinf(
            median_over_draws(self.best_runs)
        )
        return int(never.sum())

    def best(self, policies: list[Policy], draws: slice = slice(None)) -> Policy:
        """The policy with the fewest cells beyond `WITHIN`, then the smallest worst ratio."""
        ratios = np.stack([self.ratios(policy, draws) for policy in policies])
        order = np.lexsort((ratios.max(axis=1), (ratios > WITHIN).sum(axis=1)))
        return policies[int(order[0])]

    @cached_property
    def by_trigger(self) -> dict[str, Policy]:
        """The best threshold of each trigger."""
        names = dict.fromkeys(policy.trigger for policy in self.triggered)
        return {
            name: self.best([policy for policy in self.triggered if policy.trigger == name])
            for name in names
        }

    def acts(self, policy: Policy, **points: Any) -> NDArray:
        """(q, feedback, starts, draws) whether it resets; what fades acts all the time."""
        count = np.nan_to_num(self.grid.at(COUNT, policy=policy, **points))
        return (count > 0) | (policy.trigger in FADING or bool(policy.times))

    def alarms(self, policy: Policy, feedback: float | None = None) -> Estimate:
        """Share of healthy runs that a policy resets and delays, on the same noise."""
        at: dict[str, Any] = {"start": self.healthy}
        if feedback is not None:
            at["feedback"] = [feedback]
        runs, without = (self.grid.at(SETTLE, policy=one, **at) for one in (policy, NONE))
        same = runs == without  # also where neither settles
        later = np.where(same, 0.0, runs - np.where(same, 0.0, without))
        share = LATER_SHARE * np.where(np.isfinite(without), without, 0.0)
        return shared(self.acts(policy, **at) & ((later > share) | (later > LATER_S)))


def _ratio(one: NDArray, other: NDArray) -> NDArray:
    """Ratio of settling times; 1 where neither ever settles, 0 where only the first does."""
    same = one == other
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(same, 1.0, one / other)
