"""The runs of a study of reset policies, laid out by tuning, start and policy."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sinsjax import analysis
from sinsjax.alignment.triggers.columns import TRIGGER_COUNTS
from sinsjax.alignment.triggers.scores import TRIGGERS
from sinsjax.errors import InputError
from sinsjax.report.base import Source, value_text
from sinsjax.report.reset_grid import (
    BAND_ARCMIN,
    NONE,
    PAPER_READING,
    PAPER_SCHEDULE,
    Schedule,
    schedule_name,
)
from sinsjax.study.study import Study

HEALTHY_LEVEL_DEG, HEALTHY_YAW_DEG = 0.1, 1.0
"""Up to here a start is healthy, and a reset of no use: the linear model holds.

The specific force in A(t) is off by no more than 0.002 g, six times what 500 ug accelerometers
leave after coarse levelling, and sin of the yaw error by 5e-5 of it.
"""

_LOOK_BACK = ("innovation", "whiteness", "tilt_drift", "levelled")
_SETTLED = f"settle_{BAND_ARCMIN}_s"
_FIRED = tuple(own.column.name for own in TRIGGER_COUNTS)


class Tuning(NamedTuple):
    """How the filter is set.

    Attributes:
        q: how Q is read.
        feedback_s: between two feedbacks, s.
    """

    q: str
    feedback_s: float

    @property
    def name(self) -> str:
        """In words."""
        return f"{self.q}, {self.feedback_s:g} s"


class Start(NamedTuple):
    """What a run starts from.

    Attributes:
        bias: of the gyros, on every axis, deg/h.
        level: initial level error about east and north alike, deg.
        yaw: initial yaw error, deg.
    """

    bias: float
    level: float
    yaw: float

    @property
    def name(self) -> str:
        """Its misalignment in words."""
        return f"({self.level:g}, {self.level:g}, {self.yaw:g})"

    @property
    def is_healthy(self) -> bool:
        """Whether the misalignment is so small that no reset is needed."""
        return abs(self.level) <= HEALTHY_LEVEL_DEG and abs(self.yaw) <= HEALTHY_YAW_DEG


class Policy(NamedTuple):
    """What resets the filter, told by the keys of ``[resets]``.

    Attributes:
        times: of fixed resets, s.
        trigger: that calls for resets, or None.
        threshold: of the trigger; it and the next ones are None where there is no trigger.
        window_s: over which it looks back.
        refractory_s: that a reset has to be after the one before.
        until_s: after which there is none.
        most: resets that it may call for.
    """

    times: Schedule
    trigger: str | None = None
    threshold: float | None = None
    window_s: float | None = None
    refractory_s: float | None = None
    until_s: float | None = None
    most: int | None = None

    @classmethod
    def of(cls, times: Schedule, trigger: str | None, *numbers: Any) -> "Policy":
        """From the values of a variant; those of a trigger say nothing where there is none."""
        return cls(times) if trigger in (None, "none") else cls(times, trigger, *numbers)

    @property
    def fades(self) -> bool:
        """Whether it makes P fade, all the time, and never resets."""
        return self.trigger is not None and TRIGGERS[self.trigger].fade is not None

    @property
    def is_single(self) -> bool:
        """Whether it is one reset at a fixed time."""
        return self.trigger is None and len(self.times) == 1

    @property
    def name(self) -> str:
        """In words."""
        if self.trigger is None:
            return schedule_name(self.times)
        return f"{self.trigger} {self.threshold:g}"

    @property
    def settings(self) -> str:
        """The other numbers of the trigger in words, those that it heeds and that are given."""
        if self.trigger is None or self.fades:
            return ""
        window_s = self.window_s if self.trigger in _LOOK_BACK else None
        given = {"window": window_s, "refractory": self.refractory_s, "until": self.until_s}
        words = [f"{name} {value:g} s" for name, value in given.items() if value is not None]
        return ", ".join([*words, *([f"at most {self.most}"] if self.most is not None else [])])


@dataclass(frozen=True, eq=False)
class Cells:
    """Every run of a study, by tuning, start, policy and draw.

    Attributes:
        study: whose runs.
        tunings: by Q in the study's order, by feedback interval.
        starts: in the study's order.
        policies: likewise.
        settle_s: (tunings, starts, policies, draws), infinite where a run never settled.
        count: the same shape, resets that the trigger called for.
        first_s: the same shape, time of the first of them; NaN for none.
        last_s: the same of the last.
    """

    study: Study
    tunings: tuple[Tuning, ...]
    starts: tuple[Start, ...]
    policies: tuple[Policy, ...]
    settle_s: NDArray
    count: NDArray
    first_s: NDArray
    last_s: NDArray

    @classmethod
    def of(cls, source: Source) -> "Cells":
        """Lays out the runs of a study.

        Raises:
            InputError: runs are missing, or the study is no such grid.
        """
        study = source.study
        tuned, started, followed = _tunings(study), _starts(study), _policies(study)
        qs = list(dict.fromkeys(tuning.q for tuning in tuned))
        tunings = tuple(sorted(set(tuned), key=lambda t: (qs.index(t.q), t.feedback_s)))
        starts, policies = tuple(dict.fromkeys(started)), tuple(dict.fromkeys(followed))
        _require(study, tunings, starts, policies)
        points: tuple[tuple[Sequence[Any], Sequence[Any]], ...] = (
            (tunings, tuned),
            (starts, started),
            (policies, followed),
        )
        shape = tuple(len(order) for order, _ in points)
        at = [[order.index(value) for value in values] for order, values in points]
        place = np.ravel_multi_index(at, shape)
        if not np.array_equal(np.sort(place), np.arange(np.prod(shape))):
            raise _unfit(study, "every policy once at every start and tuning")
        draws, rows = source.draws, source.rows((_SETTLED, *_FIRED))
        settle, count, first, last = [
            analysis.numbers(rows, name).reshape(draws, -1)[:, np.argsort(place)].T
            for name in (_SETTLED, *_FIRED)
        ]
        return cls(
            study,
            tunings,
            starts,
            policies,
            settle_s=np.nan_to_num(settle, nan=np.inf).reshape(*shape, draws),
            count=np.nan_to_num(count).reshape(*shape, draws),
            first_s=first.reshape(*shape, draws),
            last_s=last.reshape(*shape, draws),
        )

    @property
    def draws(self) -> int:
        """Draws of every variant."""
        return self.settle_s.shape[-1]

    @cached_property
    def judged(self) -> tuple[int, ...]:
        """Places of the starts that the policies are held against the oracle at.

        Those with the largest gyro bias: with a bias or without, the best time of a reset would be
        about the same.
        """
        most = max(start.bias for start in self.starts)
        return tuple(i for i, start in enumerate(self.starts) if start.bias == most)

    def healthy(self, *, biased: bool) -> list[int]:
        """Places of the healthy starts with or without gyro bias."""
        return [i for i, s in enumerate(self.starts) if s.is_healthy and (s.bias != 0) == biased]

    @property
    def n_cells(self) -> int:
        """Cells, which are tunings x judged starts."""
        return len(self.tunings) * len(self.judged)

    @property
    def feedbacks(self) -> tuple[float, ...]:
        """Feedback intervals, ascending, s."""
        return tuple(sorted({tuning.feedback_s for tuning in self.tunings}))

    def tuned(self, feedback_s: float | None = None) -> list[int]:
        """Places of the tunings with a feedback interval, or of all."""
        return [
            i
            for i, t in enumerate(self.tunings)
            if feedback_s is None or t.feedback_s == feedback_s
        ]

    def policy(self, times: Schedule) -> int:
        """Place of a fixed schedule; the study is known to have it."""
        return self.policies.index(Policy(times))

    @property
    def singles(self) -> list[int]:
        """Places of the single resets at fixed times."""
        return [i for i, policy in enumerate(self.policies) if policy.is_single]

    @property
    def triggered(self) -> list[int]:
        """Places of the policies with a trigger."""
        return [i for i, policy in enumerate(self.policies) if policy.trigger is not None]


def _tunings(study: Study) -> list[Tuning]:
    keys = ("q_reading", "feedback_interval_s")
    return [Tuning(*point) for point in zip(*map(study.values, keys), strict=True)]


def _starts(study: Study) -> list[Start]:
    keys = ("gyro_bias_deg_per_h", "phi_e0_deg", "phi_n0_deg", "phi_u0_deg")
    bias, east, north, up = map(study.values, keys)
    if east != north:
        raise _unfit(study, "level errors about east and north that are the same")
    if not all(isinstance(value, int | float) for value in bias):
        raise _unfit(study, "a gyro bias that is the same on every axis, a number")
    return [Start(*point) for point in zip(bias, east, up, strict=True)]


def _policies(study: Study) -> list[Policy]:
    keys = ("threshold", "window_s", "refractory_s", "until_s", "most")
    numbers = [study.values(f"trigger_{key}") for key in keys]
    rows = zip(study.reset_times(), study.values("reset_trigger"), *numbers, strict=True)
    return [Policy.of(*row) for row in rows]


def _unfit(study: Study, needs: str) -> InputError:
    return InputError(f"{study.name}: its layout needs {needs}")


def _require(
    study: Study, tunings: Sequence[Tuning], starts: Sequence[Start], policies: Sequence[Policy]
) -> None:
    """Refuses a study without the points that the page speaks of."""
    if Tuning(PAPER_READING.q, PAPER_READING.feedback_s) not in tunings:
        raise _unfit(study, f"the tuning {PAPER_READING.name}")
    for biased, words in ((True, "with a gyro bias"), (False, "without one")):
        if not any(s.is_healthy and (s.bias != 0) == biased for s in starts):
            raise _unfit(
                study,
                f"a healthy start {words}: a level error up to {HEALTHY_LEVEL_DEG:g} and a yaw"
                f" error up to {HEALTHY_YAW_DEG:g} deg",
            )
    for wanted in (NONE, PAPER_SCHEDULE):
        if Policy(wanted) not in policies:
            raise _unfit(study, f"the schedule of resets at {value_text(list(wanted))} s")
    if not any(policy.is_single for policy in policies):
        raise _unfit(study, "a single reset at a fixed time")
    if all(policy.fades or policy.trigger is None for policy in policies):
        raise _unfit(study, "a trigger that resets")
    if study.n_draws < 2:
        raise _unfit(study, "two draws or more, of which one half judges what the other chooses")
