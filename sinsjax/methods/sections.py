"""The sections of a study that an alignment reads, whatever its method; free of jax."""

from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import Field, ValidationError, WrapValidator

from sinsjax.messages import explain_error
from sinsjax.methods.registry import METHODS, external_names, hint_broken_plugins
from sinsjax.value_types import (
    Count,
    Factor,
    HalfTurn,
    KeyCondition,
    KeyInfo,
    Seconds,
    SecondsOrZero,
    Section,
    Speed,
    rule_error,
)

_ANGLES = ("phi_e0_deg", "phi_n0_deg", "phi_u0_deg")


def _check_method_name(name: Any, check: Any) -> Any:
    """Return the name of a method, or raise an error with the known names."""
    if isinstance(name, str) and external_names([name]):
        return name
    try:
        return check(name)
    except ValidationError as error:
        raise rule_error(explain_error(error.errors()[0]) + hint_broken_plugins()) from None


if TYPE_CHECKING:
    MethodName = str
else:
    MethodName = Annotated[Literal[tuple(METHODS)], WrapValidator(_check_method_name)]


def _has_rotation(*angles: float | None) -> bool:
    return any(angle is None or angle != 0 for angle in angles)


class AlignmentSection(Section):
    """[alignment]: the method, its initial errors, and the feedback of its estimate."""

    conditions = (KeyCondition(("misalignment",), _ANGLES, _has_rotation),)

    method: MethodName = Field(
        "kalman5", description="alignment method; `sinsjax keys METHOD` describes one"
    )
    phi_e0_deg: HalfTurn = Field(
        0.0,
        description="initial misalignment about east, deg. The misalignment is the rotation from"
        " the computed to the true attitude",
    )
    phi_n0_deg: HalfTurn = Field(0.0, description="initial misalignment about north, deg")
    phi_u0_deg: HalfTurn = Field(
        0.0, description="initial misalignment about up, the heading error, deg"
    )
    misalignment: Literal["vector", "euler"] = Field(
        "vector",
        description="meaning of phi_e0_deg, phi_n0_deg and phi_u0_deg. 'vector': components of"
        " one rotation vector. 'euler': successive rotations about up, east and north",
    )
    ve0_m_per_s: Speed = Field(
        0.0,
        description="initial east velocity of the navigation solution, m/s. The base does not"
        " travel, so this is its error",
    )
    vn0_m_per_s: Speed = Field(
        0.0, description="initial north velocity of the navigation solution, m/s"
    )
    position: Literal["fixed", "integrated"] = Field(
        "fixed",
        description="position of the navigation solution. 'fixed': constant. 'integrated':"
        " latitude and longitude are integrated from the computed velocity",
    )
    specific_force: Annotated[
        Literal["measured", "gravity"] | None, KeyInfo(default="measured")
    ] = Field(
        None,
        description="specific force in the filter's error model. 'measured': that of the"
        " accelerometers, transformed with the computed attitude. 'gravity': that of a base at"
        " rest; default 'measured'",
    )
    feedback_interval_s: Annotated[Seconds | None, KeyInfo(whole="sample")] = Field(
        None,
        description="time between two feedbacks of the estimated errors into the navigation"
        " solution, s; default: one sample",
    )
    feedback_time_constant_s: Annotated[SecondsOrZero | None, KeyInfo(default=0.0)] = Field(
        None,
        description="time constant T of the feedback, s: each one feeds back the share 1 -"
        " exp(-interval / T) of the estimate, or all of it with T = 0; default 0",
    )


class PassesSection(Section):
    """[passes]: repeated passes over a stored record, alternately forward and backward, or forward.

    With ``direction = "rewind"`` every pass starts as a run does: from the attitude propagated back
    to the beginning of the record, with zero velocity and with P0. Only the estimated gyro biases,
    and the amplitude of the sine and cosine of the azimuth, are kept.
    """

    conditions = (
        KeyCondition(
            ("turn", "turn_smoothing_s", "turn_covariance", "turn_inflation"),
            ("direction",),
            lambda direction: direction != "rewind",
        ),
        KeyCondition(("turn_smoothing_s",), ("turn",), lambda turn: turn in (None, "reflect")),
        KeyCondition(("turn_inflation",), ("turn_covariance",), lambda kind: kind == "inflated"),
    )

    stored_s: Annotated[Seconds | None, KeyInfo(whole="record")] = Field(
        None,
        description="length of the stored record, s. Without it a run reads all its data once,"
        " forward",
    )
    passes: Annotated[Count, Field(ge=1)] | None = Field(
        None,
        description="number of passes over the record; default: until the end given by `ending`",
    )
    ending: Literal["duration", "forward"] = Field(
        "duration",
        description="end of a run without a given number of passes. 'duration': at duration_s,"
        " even within a pass. 'forward': at the end of the last whole forward pass within"
        " duration_s",
    )
    direction: Literal["alternate", "rewind"] | None = Field(
        None,
        description="direction of the passes. 'alternate': every second pass is backward."
        " 'rewind': every pass is forward, and starts from the attitude propagated back to the"
        " beginning of the record; default: 'alternate'",
    )
    turn: Annotated[
        Literal["reflect", "velocity", "velocity_and_rate", "velocity_drop_rate", "restart", "keep"]
        | None,
        KeyInfo(default="reflect"),
    ] = Field(
        None,
        description="state of the compass loops after a direction reversal. 'velocity': the"
        " velocity changes sign, tilt and azimuth rate stay, as in paper 2. 'reflect': velocity"
        " and tilt change sign, so the next pass continues the motion of the loops."
        " 'velocity_and_rate': velocity and azimuth rate change sign. 'velocity_drop_rate': the"
        " velocity changes sign, the azimuth rate becomes zero. 'keep': all three stay."
        " 'restart': only the attitude stays. The levelling integrals change sign, with 'restart'"
        " they become zero; default 'reflect'",
    )
    turn_smoothing_s: Annotated[Seconds | None, KeyInfo(default=5.0)] = Field(
        None,
        description="delay of the low-pass filter on the specific force from which turn ="
        " 'reflect' computes the tilt, s; default 5",
    )
    turn_covariance: Annotated[
        Literal["carried", "inflated", "reset"] | None, KeyInfo(default="carried")
    ] = Field(
        None,
        description="covariance P of a filter after a direction reversal. 'carried': unchanged."
        " 'inflated': multiplied by turn_inflation. 'reset': P0; default 'carried'",
    )
    turn_inflation: Annotated[Factor | None, KeyInfo(default=10.0)] = Field(
        None, description="factor on P with turn_covariance = 'inflated'; default 10"
    )


def _is_aligned(method: str) -> bool:
    return method != "none"


class CoarseSection(Section):
    """[coarse]: coarse alignment, from which the method gets its first attitude.

    In a simulation it is a stage of every run, after which the method starts with zero velocity and
    its P0. Until then the attitude of a run is that of the coarse method. All times count from the
    first sample of data, and resets and feedback start with the method. The initial misalignment
    and velocity of [alignment] have no effect. 'replay' propagates the coarse attitude back to the
    first sample, and the method processes all data again before the next record time; its results
    for the time of the coarse alignment are known only then, and are not stored.

    For a record, 'replay' is the same. With 'hand_over' each start time is coarsely aligned before
    the run: the end of the coarse alignment is t = 0, and the initial misalignment is added to its
    attitude.
    """

    conditions = (
        KeyCondition(("coarse_duration_s", "coarse_then"), ("coarse_method",), _is_aligned),
    )

    coarse_method: Literal["inertial", "analytic", "optimisation", "none"] = Field(
        "inertial",
        description="method of coarse alignment. 'inertial': the turn of gravity in inertial"
        " space, for a base that sways. 'analytic': mean specific force and mean rate, for a base"
        " at rest, only to hand over a record. 'optimisation': least squares of integrated"
        " velocities. 'none': no coarse alignment, only in a simulation",
    )
    coarse_duration_s: Seconds = Field(60.0, description="length of coarse alignment, s")
    coarse_then: Literal["hand_over", "replay"] | None = Field(
        None,
        description="start of the method after coarse alignment. 'hand_over': it continues with"
        " the data that follow. 'replay': it processes all data from the first sample, from the"
        " coarse attitude propagated back to there; default: 'hand_over'",
    )
