"""The sections of a study file: one frozen model each, one field a key, the unit in its name.

Values stay in the file's units; leaf keys are unique over all sections, so that a key alone names
an axis and a result column. Rules that hold inside one section live here, those between sections in
`checks`.
"""

from typing import Annotated, Literal, cast

from pydantic import AfterValidator, Field, model_validator

from sinsjax.records.layout import Layout, axes, fault
from sinsjax.value_types import (
    AccelNoise,
    ActsWhere,
    Amplitude,
    Angle,
    AngleSigma,
    Band,
    Bands,
    Count,
    CrossAxis,
    Elevation,
    Finite,
    GyroNoise,
    HalfTurn,
    Name,
    NoisePerAxis,
    NonNegative,
    Period,
    Positive,
    Seconds,
    SecondsOrZero,
    Section,
    Starts,
    Triad,
    Usual,
    Vector,
    invalid,
)


def _axes_order(order: str) -> str:
    """Refuses what no turn of the box gives."""
    try:
        axes(order)
    except ValueError as error:
        raise invalid(str(error)) from None
    return order


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
        description="draws of noise and of [drawn], with [stop_when] at most; default 64 where the"
        " sensors are simulated",
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
    judged_from: Literal["truth", "limit"] | None = Field(
        None,
        description="what a run's success is judged from: the truth (default), or the limit that"
        " its own sensor biases leave",
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
    unchecked: bool | None = Field(
        None, description="whether numbers beyond what is usual are run; default false"
    )

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


class MotionSection(Section):
    """[motion]: angle(t) = center + amplitude sin(2 pi t / period + phase), each angle its own."""

    conditions = tuple(
        ActsWhere(
            (f"{angle}_period_s", f"{angle}_phase_deg"),
            (f"{angle}_amplitude_deg",),
            lambda amplitude: amplitude != 0,
        )
        for angle in ("pitch", "roll", "yaw")
    )

    pitch_center_deg: Elevation = Field(0.0, description="mean pitch, deg")
    pitch_amplitude_deg: Amplitude = Field(0.0, description="pitch amplitude, deg")
    pitch_period_s: Period = Field(10.0, description="pitch period, s")
    pitch_phase_deg: Angle = Field(0.0, description="pitch phase, deg")
    roll_center_deg: HalfTurn = Field(0.0, description="mean roll, deg")
    roll_amplitude_deg: Amplitude = Field(0.0, description="roll amplitude, deg")
    roll_period_s: Period = Field(10.0, description="roll period, s")
    roll_phase_deg: Angle = Field(0.0, description="roll phase, deg")
    yaw_center_deg: Angle | None = Field(
        None, description="heading, deg, counter-clockwise from north"
    )
    yaw_amplitude_deg: Amplitude = Field(0.0, description="yaw amplitude, deg")
    yaw_period_s: Period = Field(10.0, description="yaw period, s")
    yaw_phase_deg: Angle = Field(0.0, description="yaw phase, deg")


class SensorsSection(Section):
    """[sensors]: what the sensors do; a number for all three body axes or one number each."""

    exclusive = (
        ("gyro_noise_deg_per_h", "gyro_arw_deg_per_sqrt_h"),
        ("accel_noise_ug", "accel_vrw_ug_per_sqrt_hz"),
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
    accel_scale_ppm: Annotated[Vector, Usual(-1e6, 1e6)] = Field(
        0.0, description="accelerometer scale factor error, ppm"
    )
    accel_misalignment_arcsec: Annotated[CrossAxis, Usual(-1e5, 1e5)] = Field(
        0.0, description="accelerometer cross-axis angles xy, xz, yx, yz, zx, zy, arcsec"
    )


class RecordSection(Section):
    """[record]: how to read an IMU record, and where in it the draws start."""

    format: Literal["psins", "csv", "parquet"] = Field(description="file format")
    from_s: SecondsOrZero | None = Field(
        None, description="where the part that is used begins, s from the record's beginning"
    )
    to_s: Seconds | None = Field(None, description="where that part ends, s; default: its end")
    quantity: Literal["increments", "rates"] | None = Field(
        None, description="what the columns hold (csv, parquet)"
    )
    time_column: str | None = Field(
        None, description="time stamps (csv, parquet); without it rate_hz gives the times"
    )
    gyro_columns: Triad | None = Field(None, description="x, y, z gyro columns (csv, parquet)")
    accel_columns: Triad | None = Field(
        None, description="x, y, z accelerometer columns (csv, parquet)"
    )
    gyro_unit: Literal["rad", "deg", "arcsec", "rad_per_s", "deg_per_s", "deg_per_h"] | None = (
        Field(None, description="unit of the gyro columns (csv, parquet)")
    )
    accel_unit: Literal["m_per_s", "g_s", "ug_s", "m_per_s2", "g", "mg", "ug"] | None = Field(
        None, description="unit of the accelerometer columns (csv, parquet)"
    )
    axes_order: Annotated[str, AfterValidator(_axes_order)] = Field(
        "xyz", description="the record's axes that point right, front and up, such as 'y-xz'"
    )
    time_unit: Literal["s", "ms", "us", "ns", "iso"] | None = Field(
        None, description="unit of the time stamps, 'iso' for dates with time; default 's'"
    )
    start_s: Starts = Field(
        default_factory=lambda given: (given.get("from_s") or 0.0,),
        description="start times from the record's beginning, s; default: from_s, else 0",
    )
    max_gap_s: SecondsOrZero | None = Field(
        None, description="longest gap that is interpolated, s; default 0: none"
    )
    gyro_bias_deg_per_h: GyroNoise | None = Field(
        None, description="gyro bias that a plausible record may have, deg/h; default 10"
    )
    accel_bias_ug: AccelNoise | None = Field(
        None, description="accelerometer bias that a plausible record may have, ug; default 5000"
    )
    trust: bool | None = Field(
        None, description="whether an implausible record is aligned all the same; default false"
    )

    @model_validator(mode="after")
    def _columns_fit_format(self) -> "RecordSection":
        self._check_times()
        needed = ("quantity", "gyro_columns", "accel_columns", "gyro_unit", "accel_unit")
        if self.format == "psins":
            for key in (*needed, "time_column", "max_gap_s"):
                if getattr(self, key) is not None:
                    raise invalid("does not apply to format 'psins', which fixes it", key=key)
            return self
        for key in needed:
            if getattr(self, key) is None:
                raise invalid(f"required with format '{self.format}'", key=key)
        # Whether a rate is needed is known with the rest of the study.
        if found := fault(self.layout(rate_hz=1.0)):
            raise invalid(found.text, key=found.key)
        return self

    def layout(self, rate_hz: float | None) -> Layout:
        """How the file holds the record, at a rate if the study gives one."""
        given = {key: getattr(self, key, None) for key in Layout._fields} | {"rate_hz": rate_hz}
        return Layout(**{key: value for key, value in given.items() if value is not None})

    def _check_times(self) -> None:
        if self.time_unit is not None and self.time_column is None:
            raise invalid("requires a time_column", key="time_unit")
        begin, end = self.from_s or 0.0, self.to_s
        if end is not None and end <= begin:
            raise invalid(f"must be after from_s = {begin:g}, not {end:g}", key="to_s")
        if min(self.start_s) < begin:
            text = f"{min(self.start_s):g} s lies before from_s = {begin:g}"
            raise invalid(text, key="start_s")
