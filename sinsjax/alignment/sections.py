"""The sections of a study that an alignment reads, whatever its method; free of jax."""

from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import Field, ValidationError, WrapValidator

from sinsjax.alignment.methods import METHODS, unusable
from sinsjax.messages import explained
from sinsjax.value_types import (
    ActsWhere,
    Count,
    Factor,
    HalfTurn,
    KeyInfo,
    Seconds,
    SecondsOrZero,
    Section,
    Speed,
    invalid,
)

_ANGLES = ("phi_e0_deg", "phi_n0_deg", "phi_u0_deg")


def _known(name: Any, check: Any) -> Any:
    """The name of a method."""
    try:
        return check(name)
    except ValidationError as error:
        raise invalid(explained(error.errors()[0]) + unusable()) from None


if TYPE_CHECKING:
    MethodName = str
else:
    MethodName = Annotated[Literal[tuple(METHODS)], WrapValidator(_known)]


def _may_turn(*angles: float | None) -> bool:
    return any(angle is None or angle != 0 for angle in angles)


class AlignmentSection(Section):
    """[alignment]: the method, where it starts, and how its estimate is fed back."""

    conditions = (ActsWhere(("misalignment",), _ANGLES, _may_turn),)

    method: MethodName = Field("kalman5", description="alignment method")
    phi_e0_deg: HalfTurn = Field(0.0, description="initial east misalignment, deg")
    phi_n0_deg: HalfTurn = Field(0.0, description="initial north misalignment, deg")
    phi_u0_deg: HalfTurn = Field(0.0, description="initial up (heading) misalignment, deg")
    misalignment: Literal["vector", "euler"] = Field(
        "vector", description="reading of the three angles: rotation vector or Euler angles"
    )
    ve0_m_per_s: Speed = Field(0.0, description="initial east velocity, m/s")
    vn0_m_per_s: Speed = Field(0.0, description="initial north velocity, m/s")
    position: Literal["fixed", "integrated"] = Field(
        "fixed", description="whether position stays or follows the velocity"
    )
    specific_force: Annotated[
        Literal["measured", "gravity"] | None, KeyInfo(default="measured")
    ] = Field(
        None,
        description="specific force in A(t): 'measured' (default), or 'gravity', of a base at rest",
    )
    feedback_interval_s: Annotated[Seconds | None, KeyInfo(whole="sample")] = Field(
        None, description="time between feedbacks, s; default: one sample"
    )
    feedback_time_constant_s: Annotated[SecondsOrZero | None, KeyInfo(default=0.0)] = Field(
        None, description="time constant of the feedback, s; default 0: all is fed back at once"
    )


class PassesSection(Section):
    """[passes]: repeated passes over a stored record, forward and in reverse by turns, or forward.

    Rewinding begins every pass as a start does, from the attitude wound back to the beginning of
    the record, with velocity zero and P0; what the gyros' biases, and the amplitude of sine and
    cosine of the azimuth, are estimated as stays.
    """

    conditions = (
        ActsWhere(
            ("turn", "turn_smoothing_s", "turn_covariance", "turn_inflation"),
            ("direction",),
            lambda direction: direction != "rewind",
        ),
        ActsWhere(("turn_smoothing_s",), ("turn",), lambda turn: turn in (None, "reflect")),
        ActsWhere(("turn_inflation",), ("turn_covariance",), lambda kind: kind == "inflated"),
    )

    stored_s: Annotated[Seconds | None, KeyInfo(whole="record")] = Field(
        None,
        description="length of the stored record, s; without it all of the duration, once forward",
    )
    passes: Annotated[Count, Field(ge=1)] | None = Field(
        None, description="number of passes; default: what the duration holds"
    )
    ending: Literal["duration", "forward"] = Field(
        "duration", description="end with the duration, or with the last whole forward pass in it"
    )
    direction: Literal["alternate", "rewind"] | None = Field(
        None,
        description="whether the record is read backward in every second pass, 'alternate'"
        " (default), or forward in every one from its beginning, 'rewind'",
    )
    turn: Annotated[
        Literal["reflect", "velocity", "velocity_and_rate", "velocity_drop_rate", "restart", "keep"]
        | None,
        KeyInfo(default="reflect"),
    ] = Field(None, description="what compass loops do at a direction reversal; default 'reflect'")
    turn_smoothing_s: Annotated[Seconds | None, KeyInfo(default=5.0)] = Field(
        None, description="delay of the low-passed force that 'reflect' turns by, s; default 5"
    )
    turn_covariance: Annotated[
        Literal["carried", "inflated", "reset"] | None, KeyInfo(default="carried")
    ] = Field(
        None, description="what becomes of a filter's P at a direction reversal; default 'carried'"
    )
    turn_inflation: Annotated[Factor | None, KeyInfo(default=10.0)] = Field(
        None, description="factor on P, for 'inflated'; default 10"
    )


def _is_aligned(method: str) -> bool:
    return method != "none"


class CoarseSection(Section):
    """[coarse]: the coarse alignment before the fine one, which begins at rest and with its own P0.

    In a simulation it is a stage of every run. Until it ends, a run's attitude is that of the
    coarse method; all times count from the first sample of data, resets and feedback too, and none
    comes before fine alignment. The initial misalignment and velocity of [alignment] are not read.
    'replay' winds the coarse attitude back to the first sample, and filters all data again before
    the next record: what it gives before the end of coarse alignment is known only then, and not
    recorded.

    Of a record, 'replay' is the same; otherwise the coarse alignment of each start time is made
    beforehand, its end is t = 0, and the initial misalignment is added to its attitude.
    """

    conditions = (ActsWhere(("coarse_duration_s", "coarse_then"), ("coarse_method",), _is_aligned),)

    coarse_method: Literal["inertial", "analytic", "optimisation", "none"] = Field(
        "inertial", description="method of coarse alignment, or none"
    )
    coarse_duration_s: Seconds = Field(60.0, description="length of coarse alignment, s")
    coarse_then: Literal["hand_over", "replay"] | None = Field(
        None,
        description="where fine alignment begins: at the end of coarse alignment, 'hand_over'"
        " (default), or over the same data again, 'replay'",
    )
