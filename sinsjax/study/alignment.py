"""The sections of a study that an alignment reads, whatever its method."""

from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import Field, ValidationError, WrapValidator

from sinsjax import value_types as vt
from sinsjax.messages import explain_error
from sinsjax.methods.registry import METHODS, external_names
from sinsjax.value_types import KeyCondition, Section, field, rule_error

_ANGLES = ("phi_e0_deg", "phi_n0_deg", "phi_u0_deg")


def _check_method_name(name: Any, check: Any) -> Any:
    """Return the name of a method, or raise an error with the known names."""
    if isinstance(name, str) and external_names([name]):
        return name
    try:
        return check(name)
    except ValidationError as error:
        raise rule_error(explain_error(error.errors()[0])) from None


if TYPE_CHECKING:
    MethodName = str
else:
    MethodName = Annotated[Literal[tuple(METHODS)], WrapValidator(_check_method_name)]


def _initial_angle(about: str) -> Any:
    rotate = "the three angles rotate the computed to the true attitude"
    return field(f"initial misalignment about {about}; {rotate}", 0.0)


def _initial_velocity(axis: str) -> Any:
    error = "an error, since the base does not travel"
    return field(f"initial computed {axis} velocity; {error}", 0.0)


def _has_rotation(*angles: float | None) -> bool:
    return any(angle is None or angle != 0 for angle in angles)


class AlignmentSection(Section):
    """[alignment]: the method, its initial errors, and the feedback of its estimate."""

    conditions = (KeyCondition(("misalignment",), _ANGLES, _has_rotation),)

    method: MethodName = field("see `sinsjax keys METHOD`", "kalman5")
    phi_e0_deg: vt.HalfTurn = _initial_angle("east")
    phi_n0_deg: vt.HalfTurn = _initial_angle("north")
    phi_u0_deg: vt.HalfTurn = _initial_angle("up, the heading error")
    misalignment: Literal["vector", "euler"] = field(
        "'vector': a rotation vector. 'euler': successive rotations about up, east and north",
        "vector",
    )
    ve0_m_per_s: vt.Speed = _initial_velocity("east")
    vn0_m_per_s: vt.Speed = _initial_velocity("north")
    position: Literal["fixed", "integrated"] = field(
        "'fixed': constant. 'integrated': latitude and longitude from computed velocity", "fixed"
    )
    specific_force: Literal["measured", "gravity"] | None = field(
        "specific force in the error model. 'measured': accelerometer output in the computed"
        " attitude. 'gravity': that of a base at rest",
        default="measured",
    )
    feedback_interval_s: vt.Seconds | None = field(
        "interval between feedbacks into the navigation solution",
        otherwise="one sample",
        whole="sample",
        time="s",
    )
    feedback_time_constant_s: vt.SecondsOrZero | None = field(
        "time constant T: each feedback applies 1 - exp(-interval / T) of the estimate, all if T ="
        " 0",
        default=0.0,
    )


class PassesSection(Section):
    """[passes]: repeated passes over a stored record, every second one backward."""

    conditions = (
        KeyCondition(("turn_smoothing_s",), ("turn",), lambda turn: turn in (None, "reflect")),
        KeyCondition(("turn_inflation",), ("turn_covariance",), lambda kind: kind == "inflated"),
    )

    stored_s: vt.Seconds | None = field(
        "length of the stored record. Without it a run reads all data once, forward", whole="record"
    )
    passes: Annotated[vt.Count, Field(ge=1)] | None = field(
        "number of passes", otherwise="set by `ending`"
    )
    ending: Literal["duration", "forward"] = field(
        "end of a run without `passes`. 'duration': duration_s, even within a pass. 'forward': the"
        " last complete forward pass within it",
        "duration",
    )
    turn: (
        Literal["reflect", "velocity", "velocity_and_rate", "velocity_drop_rate", "restart", "keep"]
        | None
    ) = field(
        "compass states that change sign at a reversal, with the levelling integrals. 'velocity':"
        " velocity, as in paper 2. 'reflect': velocity and tilt, so the loops continue their"
        " motion. 'velocity_and_rate': velocity and azimuth rate. 'velocity_drop_rate': velocity;"
        " azimuth rate becomes zero. 'keep': none. 'restart': all become zero but the attitude",
        default="reflect",
    )
    turn_smoothing_s: vt.Seconds | None = field(
        "delay of the low-pass filter on specific force for the tilt of 'reflect'", default=5.0
    )
    turn_covariance: Literal["carried", "inflated", "reset"] | None = field(
        "P after a reversal. 'carried': unchanged. 'inflated': multiplied by turn_inflation."
        " 'reset': P0",
        default="carried",
    )
    turn_inflation: vt.Factor | None = field("factor on P with 'inflated'", default=10.0)


class CoarseSection(Section):
    """[coarse]: coarse alignment before the method.

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
        KeyCondition(
            ("coarse_duration_s", "coarse_then"), ("coarse_method",), lambda name: name != "none"
        ),
    )

    coarse_method: Literal["inertial", "optimisation", "none"] = field(
        "'inertial': rotation of gravity in inertial space. 'optimisation': least squares of"
        " integrated velocities. 'none': only in a simulation",
        "inertial",
    )
    coarse_duration_s: vt.Seconds = field("duration", 60.0)
    coarse_then: Literal["hand_over", "replay"] | None = field(
        "'hand_over': the method starts with the data that follow. 'replay': with the first"
        " sample, from the coarse attitude propagated back",
        otherwise="'hand_over'",
    )
