"""The sections of a study file: one frozen model each, one field a key, the unit in its name.

Values stay in the file's units; leaf keys are unique over all sections, so that a key alone names
an axis and a result column. Rules that hold inside one section live here, those between sections in
`checks`.
"""

from typing import Annotated, Any, Literal, cast

import numpy as np
from pydantic import Field, field_validator, model_validator

from sinsjax.value_types import (
    ActsWhere,
    Amplitude,
    Angle,
    AngleSigma,
    Band,
    Bands,
    Bandwidth,
    Count,
    CrossAxis,
    Damping,
    Elevation,
    Finite,
    HalfTurn,
    Name,
    NoisePerAxis,
    NonNegative,
    Period,
    Positive,
    ReportTimes,
    Seconds,
    SecondsOrZero,
    Section,
    Usual,
    Vector,
    invalid,
)


class StudySection(Section):
    """[study]: what all runs of a study share; never an axis."""

    name: Name = Field(description="the study's name; default: the file's stem")
    duration_s: Seconds = Field(description="length of the fine alignment, s")
    # None only in a recorded study whose record is yet to be read, see `load.with_rate`.
    rate_hz: Annotated[Positive, Usual(1e-3, 1e6)] = Field(
        cast(float, None),
        description="sample rate, Hz; a record that tells its own must have this one",
    )
    record_interval_s: Seconds = Field(1.0, description="time between recorded values, s")
    draws: Annotated[Count, Field(ge=1)] | None = Field(
        None,
        description="draws of noise and of [drawn], with [stop_when] at most, with estimate ="
        " 'covariance' of variants that it does not hold for; default 64 where the sensors are"
        " simulated",
    )
    estimate: Literal["draws", "covariance"] = Field(
        "draws",
        description="source of the statistics: Monte Carlo over draws, with one run per draw"
        " (`summary/`), or linear covariance analysis, with one noise-free run per variant"
        " (`estimates/`)",
    )
    estimate_samples: Annotated[int, Field(ge=4, le=2**16, multiple_of=2)] | None = Field(
        None,
        description="sampled errors that settling times are estimated from, an even number;"
        " default 256 with estimate = 'covariance'",
    )
    check_linearity: bool | None = Field(
        None,
        description="whether 8 draws tell how far an estimate by covariance holds (`nonlinearity`),"
        " and `draws` of them stand for it where it does not; estimate = 'covariance' only, default"
        " true",
    )
    seed: int = Field(1, ge=0, lt=2**63, description="seed of all that is drawn")
    settle_bands_arcmin: Bands = Field(
        (60.0, 10.0, 3.0), description="heading error bands of the settling times, arcmin"
    )
    window_s: Annotated[tuple[NonNegative, Positive], Usual(0, 1e8)] = Field(
        # A pydantic below 2.14 asks for it even where the duration is missing or wrong.
        default_factory=lambda given: (
            given.get("duration_s", 1.0) / 1.5,
            given.get("duration_s", 1.0),
        ),
        description="statistics window, s; default: the last third of the duration",
    )
    consistency_after_s: SecondsOrZero = Field(
        10.0, description="start of the consistency statistics, s"
    )
    steady_after_s: SecondsOrZero = Field(
        300.0, description="start of the steady process in the consistency statistics, s"
    )
    curves: bool = Field(False, description="whether a sweep stores curves too")
    judged_from: Literal["truth", "floor"] | None = Field(
        None,
        description="what a run's success is judged from: the truth (default), or the bias floor"
        " that its own sensor biases leave",
    )
    success_band_arcmin: Band | None = Field(
        None, description="heading error band that a success ends in, arcmin; default 10"
    )
    level_band_arcmin: Band | None = Field(
        None, description="level error band that a success ends in, arcmin; default 10"
    )
    dwell_s: SecondsOrZero | None = Field(
        None,
        description="how long before its end a success has stayed in the heading band, s; default:"
        " the smaller of 30 s and a tenth of the run",
    )
    diverged_deg: AngleSigma | None = Field(
        None,
        description="heading error at the end beyond which a run has diverged, deg; default 10",
    )
    report_times_s: ReportTimes | None = Field(
        None,
        description="times from the first sample of data at which every run's heading error, its"
        " sigma and NEES are told too, s; default none",
    )
    unchecked: bool | None = Field(
        None, description="whether numbers beyond what is usual are run; default false"
    )

    @field_validator("judged_from", mode="before")
    @classmethod
    def _refuse_limit(cls, value: Any) -> Any:
        if value == "limit":
            raise invalid("'limit' was renamed to 'floor'")
        return value

    @field_validator("estimate", mode="before")
    @classmethod
    def _refuse_controlled(cls, value: Any) -> Any:
        if value == "controlled":
            text = "leave the key out for Monte Carlo, or use 'covariance'"
            raise invalid(f"'controlled' was dropped ({text})")
        return value

    @model_validator(mode="after")
    def _window_inside(self) -> "StudySection":
        start, end = self.window_s
        if not start < end <= self.duration_s:
            raise invalid(
                f"must be [a, b] with 0 <= a < b <= duration_s = {self.duration_s:g},"
                f" not [{start:g}, {end:g}]",
                key="window_s",
            )
        return self


class EarthSection(Section):
    """[earth]: the model of gravity and of the earth's shape and turn."""

    conditions = (
        ActsWhere(
            ("gravity_m_per_s2", "radius_m", "earth_rate_deg_per_h"),
            ("earth",),
            lambda earth: earth == "constants",
        ),
    )

    earth: Literal["constants", "wgs84"] = Field("constants", description="earth model")
    gravity_m_per_s2: Annotated[Positive, Usual(9, 10.5)] | None = Field(
        None, description="gravity, m/s^2; constants only, default 9.8"
    )
    radius_m: Annotated[Positive, Usual(6e6, 7e6)] | None = Field(
        None, description="radius, m; constants only, default 6378137"
    )
    earth_rate_deg_per_h: Annotated[Positive, Usual(10, 20)] | None = Field(
        None, description="rotation rate, deg/h; constants only, default 15.041067"
    )
    latitude_deg: Elevation | None = Field(
        None, description="latitude, deg; a recorded study may take it from the record"
    )
    height_m: Annotated[Finite, Usual(-12e3, 1e6)] | None = Field(
        None, description="height, m; default: in a recorded study its record's if known, else 0"
    )


def _some(*values: Any) -> bool:
    """Whether one of some numbers, or lists of them, is not zero; a drawn one is None."""
    return any(value is None or np.any(value) for value in values)


class MotionSection(Section):
    """[motion]: angle(t) = center + amplitude sin(2 pi t / period + phase), each angle its own.

    The sway turns about a point that the sensors may be away from; surge moves that point, and
    vibration the box.
    """

    conditions = (
        *(
            ActsWhere(
                (f"{angle}_period_s", f"{angle}_phase_deg"), (f"{angle}_amplitude_deg",), _some
            )
            for angle in ("pitch", "roll", "yaw")
        ),
        ActsWhere(
            ("lever_arm_m",),
            tuple(f"{angle}_amplitude_deg" for angle in ("pitch", "roll", "yaw")),
            _some,
        ),
        ActsWhere(("surge_time_s", "surge_model"), ("surge_m_per_s",), _some),
        ActsWhere(
            ("surge_bandwidth_hz",),
            ("surge_m_per_s", "surge_model"),
            lambda surge, model: _some(surge) and model == "third_order",
        ),
        ActsWhere(
            ("vibration_hz", "vibration_damping"),
            ("vibration_ug_rms", "vibration_deg_per_h_rms"),
            _some,
        ),
    )

    pitch_center_deg: Elevation = Field(0.0, description="mean pitch, deg")
    pitch_amplitude_deg: Amplitude = Field(0.0, description="pitch amplitude, deg")
    pitch_period_s: Period = Field(10.0, description="pitch period, s")
    pitch_phase_deg: Angle = Field(0.0, description="pitch phase, deg")
    roll_center_deg: HalfTurn = Field(0.0, description="mean roll, deg")
    roll_amplitude_deg: Amplitude = Field(0.0, description="roll amplitude, deg")
    roll_period_s: Period = Field(10.0, description="roll period, s")
    roll_phase_deg: Angle = Field(0.0, description="roll phase, deg")
    yaw_center_deg: Angle | None = Field(None, description="yaw, deg, counter-clockwise from north")
    yaw_amplitude_deg: Amplitude = Field(0.0, description="yaw amplitude, deg")
    yaw_period_s: Period = Field(10.0, description="yaw period, s")
    yaw_phase_deg: Angle = Field(0.0, description="yaw phase, deg")
    lever_arm_m: Annotated[Vector, Usual(-1e3, 1e3)] = Field(
        0.0, description="from the centre of the sway to the sensors, right, front and up, m"
    )
    surge_m_per_s: Annotated[NoisePerAxis, Usual(0, 100)] = Field(
        0.0, description="surge of the base, rms of the velocity east, north and up, m/s"
    )
    surge_time_s: Period = Field(5.0, description="correlation time of the surge, s")
    surge_bandwidth_hz: Bandwidth = Field(
        1.0, description="bandwidth of the surge, which bounds its acceleration, Hz"
    )
    surge_model: Literal["third_order", "gauss_markov"] = Field(
        "third_order",
        description="third_order: position, velocity and acceleration are bounded; gauss_markov:"
        " first-order velocity, whose acceleration grows with the sample rate",
    )
    vibration_ug_rms: Annotated[NoisePerAxis, Usual(0, 1e8)] = Field(
        0.0, description="vibration of the box, specific force along body axes, ug rms"
    )
    vibration_deg_per_h_rms: Annotated[NoisePerAxis, Usual(0, 1e8)] = Field(
        0.0, description="vibration of the box, angular rate about body axes, deg/h rms"
    )
    vibration_hz: Bandwidth = Field(30.0, description="resonant frequency of the vibration, Hz")
    vibration_damping: Damping = Field(0.05, description="damping ratio of the resonance")


class SensorsSection(Section):
    """[sensors]: what the sensors do; a number for all three body axes or one number each."""

    exclusive = (
        ("gyro_noise_deg_per_h", "gyro_arw_deg_per_sqrt_h"),
        ("accel_noise_ug", "accel_vrw_ug_per_sqrt_hz"),
    )
    conditions = (
        ActsWhere(("gyro_instability_time_s",), ("gyro_instability_deg_per_h",), _some),
        ActsWhere(("accel_instability_time_s",), ("accel_instability_ug",), _some),
    )

    gyro_bias_deg_per_h: Annotated[Vector, Usual(-1e5, 1e5)] = Field(
        0.0, description="gyro bias, deg/h"
    )
    gyro_noise_deg_per_h: Annotated[NoisePerAxis, Usual(0, 1e6)] | None = Field(
        None, description="gyro white noise, standard deviation of a sample, deg/h"
    )
    gyro_arw_deg_per_sqrt_h: Annotated[NoisePerAxis, Usual(0, 1e4)] | None = Field(
        None, description="gyro angle random walk, deg/sqrt(h)"
    )
    gyro_instability_deg_per_h: Annotated[NoisePerAxis, Usual(0, 1e4)] = Field(
        0.0,
        description="gyro bias instability, rms of a first-order Gauss-Markov bias, deg/h;"
        " its Allan deviation is at most 0.617 of it",
    )
    gyro_instability_time_s: Period = Field(
        300.0, description="correlation time of the gyro bias instability, s"
    )
    gyro_rrw_deg_per_h_per_sqrt_h: Annotated[NoisePerAxis, Usual(0, 1e4)] = Field(
        0.0, description="gyro rate random walk, deg/h/sqrt(h)"
    )
    gyro_quantisation_arcsec: Annotated[NoisePerAxis, Usual(0, 1e4)] = Field(
        0.0, description="quantum of the angle that a gyro puts out, arcsec"
    )
    gyro_scale_ppm: Annotated[Vector, Usual(-1e6, 1e6)] = Field(
        0.0, description="gyro scale factor error, ppm"
    )
    gyro_misalignment_arcsec: Annotated[CrossAxis, Usual(-1e5, 1e5)] = Field(
        0.0, description="gyro cross-axis angles xy, xz, yx, yz, zx, zy, arcsec"
    )
    accel_bias_ug: Annotated[Vector, Usual(-1e6, 1e6)] = Field(
        0.0, description="accelerometer bias, ug"
    )
    accel_noise_ug: Annotated[NoisePerAxis, Usual(0, 1e7)] | None = Field(
        None, description="accelerometer white noise, standard deviation of a sample, ug"
    )
    accel_vrw_ug_per_sqrt_hz: Annotated[NoisePerAxis, Usual(0, 1e7)] | None = Field(
        None, description="accelerometer velocity random walk, ug/sqrt(Hz)"
    )
    accel_instability_ug: Annotated[NoisePerAxis, Usual(0, 1e6)] = Field(
        0.0,
        description="accelerometer bias instability, rms of a first-order Gauss-Markov bias, ug",
    )
    accel_instability_time_s: Period = Field(
        300.0, description="correlation time of the accelerometer bias instability, s"
    )
    accel_rrw_ug_per_sqrt_h: Annotated[NoisePerAxis, Usual(0, 1e6)] = Field(
        0.0, description="accelerometer acceleration random walk, ug/sqrt(h)"
    )
    accel_quantisation_um_per_s: Annotated[NoisePerAxis, Usual(0, 1e6)] = Field(
        0.0, description="quantum of the velocity that an accelerometer puts out, um/s"
    )
    accel_scale_ppm: Annotated[Vector, Usual(-1e6, 1e6)] = Field(
        0.0, description="accelerometer scale factor error, ppm"
    )
    accel_misalignment_arcsec: Annotated[CrossAxis, Usual(-1e5, 1e5)] = Field(
        0.0, description="accelerometer cross-axis angles xy, xz, yx, yz, zx, zy, arcsec"
    )
