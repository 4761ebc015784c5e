"""The sections of a study that an alignment reads, whatever its method."""

from typing import Annotated, Literal

from pydantic import AfterValidator, Field, WithJsonSchema

from sinsjax import value_types as vt
from sinsjax.messages import suggest_closest
from sinsjax.methods.registry import BROKEN, METHODS
from sinsjax.value_types import KeyCondition, Section, field, rule_error

_ANGLES = ("phi_e0_deg", "phi_n0_deg", "phi_u0_deg")


def _check_method_name(name: str) -> str:
    """Refuse the name of no method, or of one that cannot be used."""
    if name in BROKEN.keys() - METHODS.keys():
        raise rule_error(f"{name!r} cannot be used: {BROKEN[name]}")
    if name not in METHODS:
        *others, last = map(repr, METHODS)
        text = f"must be {', '.join(others)} or {last}, not {name!r}"
        raise rule_error(f"{text}{suggest_closest(name, METHODS)}")
    return name


_NAMES = WithJsonSchema({"enum": [*METHODS], "type": "string"})
MethodName = Annotated[str, AfterValidator(_check_method_name), _NAMES]

_METHODS = ", ".join(f'"{name}"' for name in METHODS)
_ROTATE = "the three angles rotate the computed to the true attitude"
_AN_ERROR = "an error, since the base does not travel"


def _has_rotation(*angles: float | None) -> bool:
    return any(angle is None or angle != 0 for angle in angles)


class AlignmentSection(Section):
    """[alignment]: the method, its initial errors, and the feedback of its estimate."""

    conditions = (KeyCondition(("misalignment",), _ANGLES, _has_rotation),)

    method: MethodName = field(f"see `sinsjax keys METHOD` ({_METHODS})", "kalman5")
    phi_e0_deg: vt.HalfTurn = field(f"initial misalignment about east; {_ROTATE}", 0.0)
    phi_n0_deg: vt.HalfTurn = field(f"initial misalignment about north; {_ROTATE}", 0.0)
    phi_u0_deg: vt.HalfTurn = field(
        f"initial misalignment about up, the heading error; {_ROTATE}", 0.0
    )
    misalignment: Literal["vector", "euler"] = field(
        "'vector': a rotation vector. 'euler': successive rotations about up, east and north",
        "vector",
    )
    ve0_m_per_s: vt.Speed = field(f"initial computed east velocity; {_AN_ERROR}", 0.0)
    vn0_m_per_s: vt.Speed = field(f"initial computed north velocity; {_AN_ERROR}", 0.0)
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
    turn: Literal["reflect", "velocity", "velocity_and_rate", "keep"] | None = field(
        "compass states that change sign at a reversal, with the levelling integrals. 'velocity':"
        " velocity, as in paper 2. 'reflect': velocity and tilt, so the loops continue their"
        " motion. 'velocity_and_rate': velocity and azimuth rate. 'keep': none",
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

    It is the first stage of a run, in place of the initial misalignment and velocity; times count
    from the first sample of data. 'replay' processes that data again before the next record time.
    A record that is handed over is coarsely aligned before the run: its end is t = 0, and the
    initial misalignment is added to its attitude.
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
