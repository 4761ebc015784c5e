"""The keys of [resets] that concern triggers, which call for resets besides the schedule."""

from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

from pydantic import Field

from sinsjax.alignment.description import CheckedStudy, StudyView
from sinsjax.alignment.triggers.description import TRIGGERS
from sinsjax.value_types import (
    ActsWhere,
    Count,
    KeyInfo,
    NonNegative,
    Seconds,
    SecondsOrZero,
    Section,
)

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
    """Whether a value of ``reset_trigger`` names one."""
    return name not in (None, "none")


def any_trigger(study: StudyView) -> bool:
    """Whether a trigger calls for resets in some variant of a study."""
    points = study.combinations("reset_trigger") if study.has("resets") else ()
    return any(has_trigger(point["reset_trigger"]) for point in points)


def check_trigger(study: CheckedStudy) -> None:
    """Refuses a trigger without a threshold, and numbers of one where there is none."""
    if not study.has("resets"):
        return
    if not any_trigger(study):
        for key in _NUMBERS:
            if study.place(key):
                study.refuse(key, "requires a reset_trigger")
    for point in study.combinations("reset_trigger", "trigger_threshold"):
        name, threshold = point["reset_trigger"], point["trigger_threshold"]
        if has_trigger(name) and threshold is None:
            study.refuse("trigger_threshold", f"required with reset_trigger = '{name}'")


class TriggerKeys(Section):
    """The keys of triggers, in the section of whatever they reset."""

    conditions: ClassVar[tuple[ActsWhere, ...]] = (
        ActsWhere(_NUMBERS, ("reset_trigger",), has_trigger),
    )

    reset_trigger: TriggerName | None = Field(
        None, description="what calls for resets besides the schedule; default 'none'"
    )
    trigger_threshold: NonNegative | None = Field(
        None, description="score above which the trigger resets; what a fading one fades by"
    )
    trigger_window_s: Annotated[Seconds | None, KeyInfo(default=10.0, beside="reset_trigger")] = (
        Field(None, description="what a trigger that looks back sums up, s; default 10")
    )
    trigger_refractory_s: Annotated[
        SecondsOrZero | None, KeyInfo(default=5.0, beside="reset_trigger", time="s")
    ] = Field(None, description="least time after the start and after a reset, s; default 5")
    trigger_most: Annotated[
        Annotated[Count, Field(ge=1)] | None, KeyInfo(default=10, beside="reset_trigger")
    ] = Field(None, description="most resets that a trigger calls for; default 10")
    trigger_until_s: Annotated[Seconds | None, KeyInfo(time="s")] = Field(
        None, description="time after which a trigger calls for none, s; default: no limit"
    )
