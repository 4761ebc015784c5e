"""Triggers as studies know them: their list, their keys in [resets], and their result columns.

Free of JAX.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray
from pydantic import Field

from sinsjax.columns import Column
from sinsjax.methods.description import CheckedStudy, OwnColumn, StudyView
from sinsjax.value_types import (
    Count,
    KeyCondition,
    KeyInfo,
    NonNegative,
    Seconds,
    SecondsOrZero,
    Section,
)


@dataclass(frozen=True)
class TriggerDescription:
    """A trigger as studies know it.

    Attributes:
        name: in ``[resets] reset_trigger``; in capitals, the name of its `Trigger` in `scores`.
        summary: condition of its resets, in half a line.
    """

    name: str
    summary: str

    @cached_property
    def trigger(self) -> Any:
        """The `trigger.Trigger` that computes it; imports JAX."""
        from sinsjax.methods.triggers import scores

        return getattr(scores, self.name.upper())


TRIGGERS: dict[str, TriggerDescription] = {
    trigger.name: trigger
    for trigger in (
        TriggerDescription("innovation", "innovations summed over a window, normalised"),
        TriggerDescription("linearisation", "P_UU below what a linear model can know"),
    )
}
"""All triggers by name; a new one is registered here."""


if TYPE_CHECKING:
    TriggerName = str
else:
    TriggerName = Literal["none", *TRIGGERS]


_NUMBERS = (
    "trigger_threshold",
    "trigger_window_s",
    "trigger_refractory_s",
    "trigger_most",
    "trigger_until_s",
)


def has_trigger(name: str | None) -> bool:
    """Return whether a value of ``reset_trigger`` names a trigger."""
    return name not in (None, "none")


def any_trigger(study: StudyView) -> bool:
    """Return whether some variant of a study has a trigger."""
    points = study.combinations("reset_trigger") if study.has("resets") else ()
    return any(has_trigger(point["reset_trigger"]) for point in points)


def check_trigger(study: CheckedStudy) -> None:
    """Refuse a trigger without a threshold, and keys of triggers without a trigger."""
    if not study.has("resets"):
        return
    if not any_trigger(study):
        for key in _NUMBERS:
            if study.place(key):
                study.refuse(key, "requires a reset_trigger (give one, or drop this)")
    for point in study.combinations("reset_trigger", "trigger_threshold"):
        name, threshold = point["reset_trigger"], point["trigger_threshold"]
        if has_trigger(name) and threshold is None:
            study.refuse("trigger_threshold", f"required with reset_trigger = '{name}'")


class TriggerKeys(Section):
    """The keys of triggers, in the section of the resets that they cause."""

    conditions: ClassVar[tuple[KeyCondition, ...]] = (
        KeyCondition(_NUMBERS, ("reset_trigger",), has_trigger),
    )

    reset_trigger: TriggerName | None = Field(
        None,
        description="score that triggers a reset above trigger_threshold, in addition to the"
        " schedule, or 'none'. 'innovation': normalised squared sum of innovations in a"
        " window. 'linearisation': heading knowledge in excess of a base at rest; default 'none'",
    )
    trigger_threshold: NonNegative | None = Field(
        None,
        description="score above which P is reset; required with a trigger",
    )
    trigger_window_s: Annotated[Seconds | None, KeyInfo(default=10.0, beside="reset_trigger")] = (
        Field(None, description="window of 'innovation', s; default 10")
    )
    trigger_refractory_s: Annotated[
        SecondsOrZero | None, KeyInfo(default=5.0, beside="reset_trigger", time="s")
    ] = Field(
        None, description="shortest time from start or any reset to a triggered reset, s; default 5"
    )
    trigger_most: Annotated[
        Annotated[Count, Field(ge=1)] | None, KeyInfo(default=10, beside="reset_trigger")
    ] = Field(None, description="most triggered resets per run; default 10")
    trigger_until_s: Annotated[Seconds | None, KeyInfo(time="s")] = Field(
        None, description="end of triggered resets, s; default: no limit"
    )


def _triggered_count(results: Any, rate_hz: float) -> NDArray:
    counts = results.trigger_counts
    return np.asarray(0.0 if counts is None else counts.count)


def _triggered_first_s(results: Any, rate_hz: float) -> NDArray:
    counts = results.trigger_counts
    return _time_s(0.0 if counts is None else counts.first, rate_hz)


def _triggered_last_s(results: Any, rate_hz: float) -> NDArray:
    counts = results.trigger_counts
    return _time_s(0.0 if counts is None else counts.last, rate_hz)


def _time_s(sample: Any, rate_hz: float) -> NDArray:
    """Return the time of a sample, s; NaN for 0, which stands for no reset."""
    sample = np.asarray(sample)
    return np.where(sample > 0, sample / rate_hz, np.nan)


TRIGGER_COUNTS = (
    OwnColumn(
        Column("triggered_count", pa.int64(), "", "resets that the trigger called for"),
        _triggered_count,
        0.0,
        any_trigger,
    ),
    OwnColumn(
        Column("triggered_first_s", pa.float64(), "s", "time of the first of them; null for none"),
        _triggered_first_s,
        applies_to=any_trigger,
    ),
    OwnColumn(
        Column("triggered_last_s", pa.float64(), "s", "time of the last of them; null for none"),
        _triggered_last_s,
        applies_to=any_trigger,
    ),
)
"""Result columns of a trigger."""


def last_triggered_sample(results: Any) -> NDArray | None:
    """Return the sample of the last reset by a trigger, (runs,), 0 for none; None without one."""
    counts = results.trigger_counts
    return None if counts is None else np.asarray(counts.last)
