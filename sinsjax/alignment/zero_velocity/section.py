"""[filter] and [resets]: what a zero-velocity filter believes, and when P is reset."""

from typing import Annotated, Literal

from pydantic import Field

from sinsjax.alignment.triggers.section import TriggerName
from sinsjax.value_types import (
    AccelNoise,
    AccelSigma,
    AngleSigma,
    Count,
    Factor,
    GyroNoise,
    GyroSigma,
    GyroWalk,
    NonNegative,
    Seconds,
    SecondsOrZero,
    Section,
    SpeedSigma,
    Times,
)

Q_DENSITIES = {
    "q_accel_ug": {"q_accel_ug_per_sqrt_hz": 1.0},
    "q_gyro_deg_per_h": {"q_gyro_deg_per_h_per_sqrt_hz": 1.0, "q_gyro_arw_deg_per_sqrt_h": 60.0},
}
"""Under ``q_reading = "psd"``, the keys that give Q by its true units: factors to the old keys."""

OF_SCHEDULES = ("reset_times_s", "reset_count", "reset_cycle_s", "reset_first_s")
"""The keys that give the times of resets, in the order of `reset_times`."""


class FilterSection(Section):
    """[filter]: what the filter believes; standard deviations."""

    p0_velocity_m_per_s: SpeedSigma = Field(0.1, description="initial velocity, m/s")
    p0_level_deg: AngleSigma = Field(15.0, description="initial level misalignment, deg")
    p0_yaw_deg: AngleSigma = Field(80.0, description="initial heading misalignment, deg")
    p0_gyro_bias_deg_per_h: GyroSigma = Field(0.1, description="gyro bias states, deg/h")
    p0_accel_bias_ug: AccelSigma = Field(500.0, description="accelerometer bias states, ug")
    q_accel_ug: AccelNoise | None = Field(
        None, description="velocity process noise, ug; default 500; under 'psd' in ug/sqrt(Hz)"
    )
    q_gyro_deg_per_h: GyroNoise | None = Field(
        None, description="attitude process noise, deg/h; default 0.1; under 'psd' deg/h/sqrt(Hz)"
    )
    q_accel_ug_per_sqrt_hz: AccelNoise | None = Field(
        None, description="q_accel_ug under 'psd', by its unit there, ug/sqrt(Hz)"
    )
    q_gyro_deg_per_h_per_sqrt_hz: GyroNoise | None = Field(
        None, description="q_gyro_deg_per_h under 'psd', by its unit there, deg/h/sqrt(Hz)"
    )
    q_gyro_arw_deg_per_sqrt_h: GyroWalk | None = Field(
        None, description="the same as an angle random walk, deg/sqrt(h): a 60th of the number"
    )
    q_reading: Literal["per_step", "psd", "per_sample"] = Field(
        "per_step", description="Q of a step: as is, times dt, times dt^2"
    )
    r_velocity_m_per_s: SpeedSigma = Field(0.1, description="velocity measurement noise, m/s")
    r_reading: Literal["per_update", "psd"] = Field(
        "per_update", description="R of an update: as is, divided by dt"
    )
    q_scale: Factor | None = Field(None, description="factor on Q; default 1")
    r_scale: Factor | None = Field(None, description="factor on R; default 1")


class ResetsSection(Section):
    """[resets]: covariance resets, by count and cycle, at explicit times, or by a trigger."""

    reset_count: Count | None = Field(
        None, description="number of resets, a cycle apart; default 0"
    )
    reset_cycle_s: Seconds | None = Field(None, description="time between resets, s")
    reset_first_s: Seconds | None = Field(
        None, description="time of the first of counted resets, s; default: the cycle"
    )
    reset_times_s: Times | None = Field(None, description="explicit reset times, s")
    reset_kind: Literal["full", "yaw", "scale"] = Field("full", description="what P is set to")
    reset_scale: Factor = Field(10.0, description="factor on P, for kind 'scale'")
    reset_velocity_m_per_s: SpeedSigma | None = Field(
        None, description="what the velocity is reset to, m/s; default: as at the start"
    )
    reset_level_deg: AngleSigma | None = Field(
        None, description="what the level angles are reset to, deg; default: as at the start"
    )
    reset_yaw_deg: AngleSigma | None = Field(
        None, description="what the heading is reset to, deg; default: as at the start"
    )
    reset_gyro_bias_deg_per_h: GyroSigma | None = Field(
        None, description="what gyro biases are reset to, deg/h; default: as at the start"
    )
    reset_accel_bias_ug: AccelSigma | None = Field(
        None,
        description="what accelerometer biases are reset to, ug; default: as at the start",
    )
    reset_trigger: TriggerName | None = Field(
        None, description="what calls for resets besides the schedule; default 'none'"
    )
    trigger_threshold: NonNegative | None = Field(
        None, description="score above which the trigger resets; what a fading one fades by"
    )
    trigger_window_s: Seconds | None = Field(
        None, description="what a trigger that looks back sums up, s; default 10"
    )
    trigger_refractory_s: SecondsOrZero | None = Field(
        None, description="least time after the start and after a reset, s; default 5"
    )
    trigger_most: Annotated[Count, Field(ge=1)] | None = Field(
        None, description="most resets that a trigger calls for; default 10"
    )
    trigger_until_s: Seconds | None = Field(
        None, description="time after which a trigger calls for none, s; default: no limit"
    )


def counted_resets(count: int, cycle_s: float | None, first_s: float | None) -> tuple[float, ...]:
    """Times of counted resets, s.

    Args:
        count: how many.
        cycle_s: between two of them; not needed for a first one alone.
        first_s: of the first; without it they come at the cycle and its multiples.
    """
    if first_s is None:
        return tuple((i + 1) * (cycle_s or 0.0) for i in range(count))
    return tuple(first_s + i * (cycle_s or 0.0) for i in range(count))


def reset_times(
    times_s: tuple[float, ...] | None,
    count: int | None,
    cycle_s: float | None,
    first_s: float | None,
) -> tuple[float, ...]:
    """Times of the resets of a schedule, s: as given, or counted."""
    return counted_resets(count or 0, cycle_s, first_s) if times_s is None else tuple(times_s)
