"""The sections of a study file: one frozen model per section, one field per key.

Values stay in the units of the file, which the names of keys state. Leaf keys are unique over all
sections, so a key alone names an axis and a result column. Rules within one section are here, rules
between sections in `rules`. The methods have sections of their own, see `methods.registry`.
"""

from functools import cache
from typing import Annotated, Any, Literal, cast, get_args, get_origin

import numpy as np
from pydantic import AfterValidator, ConfigDict, Field, model_validator

from sinsjax.messages import shorten
from sinsjax.records.layout import (
    ACCEL_UNITS,
    GYRO_UNITS,
    RecordLayout,
    find_fault,
    parse_axes_order,
)
from sinsjax.value_types import (
    AccelNoise,
    Amplitude,
    Angle,
    AngleSigma,
    Band,
    Bands,
    Bandwidth,
    Columns,
    Count,
    CrossAxis,
    Damping,
    Effect,
    Elevation,
    EventTimes,
    Factor,
    Finite,
    GyroNoise,
    HalfTurn,
    IncreasingPair,
    KeyCondition,
    KeyInfo,
    Name,
    NoisePerAxis,
    NonNegative,
    Normal,
    Numbers,
    Period,
    Positive,
    ReportTimes,
    Seconds,
    SecondsOrZero,
    Section,
    Starts,
    Triad,
    Vector,
    key_info,
    require_unique,
    rule_error,
)


class StudySection(Section):
    """[study]: settings of all runs, which cannot be swept."""

    name: Name = Field(description="name in reports and manifests; default: the file's stem")
    duration_s: Seconds = Field(
        description="length of each run, s. Includes passes and coarse alignment, unless that hands"
        " over a record"
    )
    # None only in a recorded study before its record is read, see `load.with_rate`.
    rate_hz: Annotated[Positive, KeyInfo(usual_range=(1e-3, 1e6))] = Field(
        cast(float, None),
        description="sensor sample rate, Hz. Required in a simulation and without time stamps; must"
        " match a record's rate",
    )
    record_interval_s: Seconds = Field(
        1.0,
        description="interval of the record times for settling times, statistics and curves, s",
    )
    draws: Annotated[Count, Field(ge=1)] | None = Field(
        None,
        description="Monte Carlo draws; the maximum with [stop_when]. A record has one per start"
        " time; default: 64 in a simulation",
    )
    estimate: Literal["draws"] = Field(
        "draws", description="how errors are found: 'draws', Monte Carlo"
    )
    seed: int = Field(1, ge=0, lt=2**63, description="random seed")
    settle_bands_arcmin: Bands = Field(
        (60.0, 10.0, 3.0),
        description="half-widths of the heading bands for settling times, arcmin",
    )
    window_s: Annotated[tuple[NonNegative, Positive], KeyInfo(usual_range=(0, 1e8))] = Field(
        # A pydantic below 2.14 calls it even if the duration is missing or wrong.
        default_factory=lambda given: (
            given.get("duration_s", 1.0) / 1.5,
            given.get("duration_s", 1.0),
        ),
        description="start and end of the window for error means and deviations, s; default: the"
        " last third of the duration",
    )
    consistency_after_s: SecondsOrZero = Field(
        10.0,
        description="time after which p_above_error_share and p_above_floor_error_share count, s",
    )
    steady_after_s: SecondsOrZero = Field(
        300.0, description="time after which p_above_error_steady_share counts, s"
    )
    curves: bool = Field(
        False, description="whether a sweep stores errors at record times in `curves/`"
    )
    judged_from: Literal["truth", "floor"] | None = Field(
        None,
        description="reference for success. 'truth': true north, or the record's reference."
        " 'floor': the bias floor; default: 'truth'",
    )
    success_band_arcmin: Band | None = Field(
        None,
        description="largest final heading error of a successful run, arcmin; default: 10",
    )
    level_band_arcmin: Band | None = Field(
        None,
        description="largest final level error of a successful run, from truth plus the tilt due to"
        " accelerometer biases, arcmin; default: 10",
    )
    dwell_s: SecondsOrZero | None = Field(
        None,
        description="uninterrupted final time in the heading band that success requires, s;"
        " default: the smaller of 30 s and a tenth of the run",
    )
    diverged_deg: AngleSigma | None = Field(
        None,
        description="final heading error from the bias floor (truth without one) above which an"
        " unsuccessful run diverged, deg; default: 10",
    )
    report_times_s: ReportTimes | None = Field(
        None,
        description="times of heading error, sigma and NEES in the summary, from the first sample,"
        " s; default: none",
    )
    unchecked: bool | None = Field(
        None, description="whether to accept values outside their usual ranges; default: false"
    )
    external: Annotated[tuple[Name, ...], AfterValidator(require_unique)] | None = Field(
        None,
        description="programs whose results `sinsjax score` stored in the study's directory;"
        " default: none",
    )

    @model_validator(mode="after")
    def _check_window(self) -> "StudySection":
        start, end = self.window_s
        if not start < end <= self.duration_s:
            raise rule_error(
                f"must be [a, b] with 0 <= a < b <= duration_s = {self.duration_s:g},"
                f" not [{start:g}, {end:g}]",
                key="window_s",
            )
        return self


class EarthSection(Section):
    """[earth]: gravity, shape and rotation of the Earth, and the location."""

    conditions = (
        KeyCondition(
            ("gravity_m_per_s2", "radius_m", "earth_rate_deg_per_h"),
            ("earth",),
            lambda earth: earth == "constants",
        ),
    )

    earth: Literal["constants", "wgs84"] = Field(
        "constants",
        description="'constants': sphere with constant gravity, the next three keys, valid only"
        " here. 'wgs84': ellipsoid with normal gravity",
    )
    gravity_m_per_s2: Annotated[Positive, KeyInfo(usual_range=(9, 10.5))] | None = Field(
        None, description="gravity, m/s^2; default 9.8"
    )
    radius_m: Annotated[Positive, KeyInfo(usual_range=(6e6, 7e6))] | None = Field(
        None, description="radius of the sphere, m; default 6378137"
    )
    earth_rate_deg_per_h: Annotated[Positive, KeyInfo(usual_range=(10, 20))] | None = Field(
        None, description="Earth rotation rate, deg/h; default 15.041067"
    )
    latitude_deg: Elevation | None = Field(
        None,
        description="latitude, positive north, deg. Required in a simulation, and if a record's"
        " header lacks it",
    )
    height_m: Annotated[Finite, KeyInfo(usual_range=(-12e3, 1e6))] | None = Field(
        None,
        description="height above the ellipsoid or sphere, m; default: that in the record's header,"
        " or 0",
    )


def _any_nonzero(*values: Any) -> bool:
    """Return whether any of some numbers, or lists of numbers, is not zero; a drawn one is None."""
    return any(value is None or np.any(value) for value in values)


TURN_KEYS = (
    *("turn_times_s", "turn_angles_deg", "turn_rate_deg_per_s", "turn_ramp_s"),
    *("turn_repeat_s", "turn_axis"),
)
"""Keys of turns of the base."""


def _rotates(turn_times_s: Any, attitude_file: Any, *amplitudes: Any) -> bool:
    return bool(turn_times_s or attitude_file) or _any_nonzero(*amplitudes)


def acting(effect: Effect, low: float | int | None = None, high: float | int = 0) -> KeyInfo:
    """Return the properties of a key that acts on base or sensors, with its usual range, if any."""
    return KeyInfo(usual_range=None if low is None else (low, high), acts_as=effect)


class MotionSection(Section):
    """[motion]: simulated motion; angles are center + amplitude sin(2 pi t / period + phase).

    The base sways about a point that may be a lever arm away from the sensors, and may be turned
    about an axis through it. Surge moves that point. Vibration moves the housing of the sensors and
    rotates it about that point: the true attitude of a run is that of the housing.
    """

    conditions = (
        *(
            KeyCondition(
                (f"{angle}_period_s", f"{angle}_phase_deg"),
                (f"{angle}_amplitude_deg",),
                _any_nonzero,
            )
            for angle in ("pitch", "roll", "yaw")
        ),
        KeyCondition(TURN_KEYS[1:], TURN_KEYS[:1], bool),
        KeyCondition(
            ("lever_arm_m",),
            (
                *(TURN_KEYS[0], "attitude_file", "vibration_deg_per_h_rms"),
                *(f"{angle}_amplitude_deg" for angle in ("pitch", "roll", "yaw")),
            ),
            _rotates,
        ),
        KeyCondition(("surge_time_s", "surge_model"), ("surge_m_per_s",), _any_nonzero),
        KeyCondition(
            ("surge_bandwidth_hz",),
            ("surge_m_per_s", "surge_model"),
            lambda surge, model: _any_nonzero(surge) and model == "third_order",
        ),
        KeyCondition(
            ("vibration_hz", "vibration_damping"),
            ("vibration_ug_rms", "vibration_deg_per_h_rms"),
            _any_nonzero,
        ),
    )

    pitch_center_deg: Elevation = Field(0.0, description="mean pitch, positive front up, deg")
    pitch_amplitude_deg: Amplitude = Field(0.0, description="amplitude, deg")
    pitch_period_s: Period = Field(
        10.0, description="period, s; default: required with an amplitude"
    )
    pitch_phase_deg: Angle = Field(0.0, description="phase, deg")
    roll_center_deg: HalfTurn = Field(0.0, description="mean roll, positive right side down, deg")
    roll_amplitude_deg: Amplitude = Field(0.0, description="amplitude, deg")
    roll_period_s: Period = Field(
        10.0, description="period, s; default: required with an amplitude"
    )
    roll_phase_deg: Angle = Field(0.0, description="phase, deg")
    yaw_center_deg: Angle | None = Field(
        None,
        description="mean yaw, deg, counter-clockwise from north (minus heading). Required in a"
        " simulation without attitude_file",
    )
    yaw_amplitude_deg: Amplitude = Field(0.0, description="amplitude, deg")
    yaw_period_s: Period = Field(10.0, description="period, s; default: required with an amplitude")
    yaw_phase_deg: Angle = Field(0.0, description="phase, deg")
    lever_arm_m: Annotated[Vector, KeyInfo(usual_range=(-1e3, 1e3))] = Field(
        0.0,
        description="lever arm (right, front, up) to the sensors from the centre of sway on the"
        " turn axis, m",
    )
    turn_times_s: EventTimes | None = Field(
        None,
        description="start times of turns from the first sample, rounded to whole samples, s;"
        " default: no turns",
    )
    turn_angles_deg: Annotated[Numbers, KeyInfo(usual_range=(-1e8, 1e8))] | None = Field(
        None,
        description="turn angles, positive counter-clockwise from above, deg: one for all or per"
        " turn. An unfinished turn continues to the end: 1e6 for a carousel; default:"
        " 180",
    )
    turn_rate_deg_per_s: Annotated[Positive, KeyInfo(usual_range=(1e-4, 1e5))] | None = Field(
        None,
        description="turn rate, adjusted to whole samples per turn, deg/s; default: 10",
    )
    turn_ramp_s: Annotated[Positive, KeyInfo(usual_range=(1e-4, 1e4))] | None = Field(
        None, description="time to reach the turn rate, and to stop, s; default: 1"
    )
    turn_repeat_s: Seconds | None = Field(
        None,
        description="interval at which turns repeat until the end, s; default: no repetition",
    )
    turn_axis: Literal["vertical", "body"] | None = Field(
        None,
        description="'vertical': the vehicle turns, with its pitch and roll axes. 'body': a"
        " turntable on the swaying vehicle turns the sensors about z; default:"
        " 'vertical'",
    )
    attitude_file: Name | None = Field(
        None,
        description="text or Parquet file instead of angles and turns, with time_s, pitch_deg,"
        " roll_deg and yaw_deg (or heading_deg), interpolated by cubic splines; smooth"
        " noisy data first. Cannot be swept; default: none",
    )
    surge_m_per_s: Annotated[NoisePerAxis, acting("process", 0, 100)] = Field(
        0.0,
        description="rms velocity of surge, random motion about a fixed place, along east,"
        " north, up, m/s",
    )
    surge_time_s: Annotated[Period, acting("process_shape")] = Field(
        5.0, description="correlation time of the surge velocity, s"
    )
    surge_bandwidth_hz: Annotated[Bandwidth, acting("process_shape")] = Field(
        1.0,
        description="surge bandwidth, which limits acceleration, Hz; only for 'third_order'",
    )
    surge_model: Literal["third_order", "gauss_markov"] = Field(
        "third_order",
        description="'third_order': finite variances of position, velocity and acceleration."
        " 'gauss_markov': first-order Gauss-Markov velocity; acceleration grows with"
        " sample rate",
    )
    vibration_ug_rms: Annotated[NoisePerAxis, acting("process", 0, 1e8)] = Field(
        0.0,
        description="linear vibration of the sensors' housing along right, front, up, ug rms",
    )
    vibration_deg_per_h_rms: Annotated[NoisePerAxis, acting("process", 0, 1e8)] = Field(
        0.0,
        description="angular vibration of the sensors' housing about right, front, up, deg/h rms."
        " The true attitude is that of the housing",
    )
    vibration_hz: Annotated[Bandwidth, acting("process_shape")] = Field(
        30.0, description="undamped natural frequency of vibration, Hz"
    )
    vibration_damping: Annotated[Damping, acting("process_shape")] = Field(
        0.05, description="damping ratio of vibration"
    )


class SensorsSection(Section):
    """[sensors]: errors of the simulated sensors; one number for all body axes, or one per axis."""

    conditions = (
        KeyCondition(("gyro_instability_time_s",), ("gyro_instability_deg_per_h",), _any_nonzero),
        KeyCondition(("accel_instability_time_s",), ("accel_instability_ug",), _any_nonzero),
    )

    gyro_bias_deg_per_h: Annotated[Vector, acting("bias", -1e5, 1e5)] = Field(
        0.0, description="constant bias, measured minus true, deg/h"
    )
    gyro_noise_deg_per_h: Annotated[NoisePerAxis, acting("noise", 0, 1e6)] | None = Field(
        None,
        description="white noise sigma of one sample, deg/h; alternative to the random walk;"
        " default: no noise",
    )
    gyro_arw_deg_per_sqrt_h: Annotated[
        Annotated[NoisePerAxis, KeyInfo(usual_range=(0, 1e4))] | None,
        KeyInfo(acts_as="noise", alternative_to="gyro_noise_deg_per_h"),
    ] = Field(
        None,
        description="angle or velocity random walk, deg/sqrt(h); alternative to the noise",
    )
    gyro_instability_deg_per_h: Annotated[NoisePerAxis, acting("process", 0, 1e4)] = Field(
        0.0,
        description="rms bias instability, first-order Gauss-Markov, deg/h; its Allan deviation is"
        " at most 0.617 of it",
    )
    gyro_instability_time_s: Annotated[Period, acting("process_shape")] = Field(
        300.0, description="correlation time of the bias instability, s"
    )
    gyro_rrw_deg_per_h_per_sqrt_h: Annotated[NoisePerAxis, acting("process", 0, 1e4)] = Field(
        0.0, description="rate or acceleration random walk, zero at the first sample, deg/h/sqrt(h)"
    )
    gyro_quantisation_arcsec: Annotated[NoisePerAxis, acting("quantum", 0, 1e4)] = Field(
        0.0,
        description="resolution of angle or velocity output, arcsec; remainders carry over to the"
        " next sample",
    )
    gyro_scale_ppm: Annotated[Vector, acting("distortion", -1e6, 1e6)] = Field(
        0.0, description="scale factor error, ppm"
    )
    gyro_misalignment_arcsec: Annotated[CrossAxis, acting("distortion", -1e5, 1e5)] = Field(
        0.0,
        description="axis misalignments xy, xz, yx, yz, zx, zy, arcsec: xy is the fraction of the y"
        " input that sensor x senses",
    )
    accel_bias_ug: Annotated[Vector, acting("bias", -1e6, 1e6)] = Field(
        0.0, description="constant bias, measured minus true, ug"
    )
    accel_noise_ug: Annotated[NoisePerAxis, acting("noise", 0, 1e7)] | None = Field(
        None,
        description="white noise sigma of one sample, ug; alternative to the random walk; default:"
        " no noise",
    )
    accel_vrw_ug_per_sqrt_hz: Annotated[
        Annotated[NoisePerAxis, KeyInfo(usual_range=(0, 1e7))] | None,
        KeyInfo(acts_as="noise", alternative_to="accel_noise_ug"),
    ] = Field(
        None,
        description="angle or velocity random walk, ug/sqrt(Hz); alternative to the noise",
    )
    accel_instability_ug: Annotated[NoisePerAxis, acting("process", 0, 1e6)] = Field(
        0.0,
        description="rms bias instability, first-order Gauss-Markov, ug; its Allan deviation is at"
        " most 0.617 of it",
    )
    accel_instability_time_s: Annotated[Period, acting("process_shape")] = Field(
        300.0, description="correlation time of the bias instability, s"
    )
    accel_rrw_ug_per_sqrt_h: Annotated[NoisePerAxis, acting("process", 0, 1e6)] = Field(
        0.0, description="rate or acceleration random walk, zero at the first sample, ug/sqrt(h)"
    )
    accel_quantisation_um_per_s: Annotated[NoisePerAxis, acting("quantum", 0, 1e6)] = Field(
        0.0,
        description="resolution of angle or velocity output, um/s; remainders carry over to the"
        " next sample",
    )
    accel_scale_ppm: Annotated[Vector, acting("distortion", -1e6, 1e6)] = Field(
        0.0, description="scale factor error, ppm"
    )
    accel_misalignment_arcsec: Annotated[CrossAxis, acting("distortion", -1e5, 1e5)] = Field(
        0.0,
        description="axis misalignments xy, xz, yx, yz, zx, zy, arcsec: xy is the fraction of the y"
        " input that sensor x senses",
    )


def _check_axes_order(order: str) -> str:
    """Refuse an order of axes that is not a rotation."""
    try:
        parse_axes_order(order)
    except ValueError as error:
        raise rule_error(shorten(str(error))) from None
    return order


_COLUMN_KEYS = (
    *("quantity", "gyro_columns", "accel_columns", "gyro_unit", "accel_unit", "time_column"),
    *("max_gap_s", "columns", "skip_rows", "time_fraction_column", "time_fraction_unit"),
    *("gyro_scale", "accel_scale", "time_scale"),
)
"""Keys of [record] that describe columns."""


class RecordSection(Section):
    """[record]: format, units and axes of an IMU record, and start times of the alignments."""

    format: Literal["psins", "csv", "parquet", "arrays"] = Field(
        description="format of the record. 'csv': text with a header line. 'parquet': Apache"
        " Parquet. 'psins': PSINS text. 'arrays': Python arrays. The last two fix"
        " columns and units, 'arrays' also axes"
    )
    from_s: SecondsOrZero | None = Field(
        None,
        description="start and end of the used part, s, from the record's beginning; default: its"
        " beginning",
    )
    to_s: Seconds | None = Field(
        None,
        description="start and end of the used part, s, from the record's beginning; default: its"
        " end",
    )
    columns: Columns | None = Field(
        None,
        description="column names of a text file without them; default: those in the file, or"
        " column_1, column_2, ...",
    )
    skip_rows: Count | None = Field(
        None, description="lines of a text file before its column names or samples; default: 0"
    )
    quantity: Literal["increments", "rates"] | None = Field(
        None,
        description="sensor columns: 'increments' (integrals over each sample) or 'rates' (means);"
        " default: by the units",
    )
    time_column: str | None = Field(
        None,
        description="column of time stamps, at the end of each sample. Without it rate_hz gives"
        " the times",
    )
    time_fraction_column: Name | None = Field(
        None, description="column of the fraction of a second that time_column lacks, such as nsecs"
    )
    time_fraction_unit: Literal["ms", "us", "ns"] | None = Field(
        None, description="unit of time_fraction_column: 'ms', 'us' or 'ns'; default: 'ns'"
    )
    gyro_columns: Triad | None = Field(None, description="columns of the x, y, z sensors")
    accel_columns: Triad | None = Field(None, description="columns of the x, y, z sensors")
    gyro_unit: Literal["rad", "deg", "arcsec", "rad_per_s", "deg_per_s", "deg_per_h"] | None = (
        Field(
            None,
            description="unit of increments: 'rad', 'deg', 'arcsec'; of rates: 'rad_per_s',"
            " 'deg_per_s', 'deg_per_h'",
        )
    )
    accel_unit: Literal["m_per_s", "g_s", "ug_s", "m_per_s2", "g", "mg", "ug"] | None = Field(
        None,
        description="unit of increments: 'm_per_s', 'g_s', 'ug_s'; of rates: 'm_per_s2', 'g', 'mg',"
        " 'ug'",
    )
    gyro_scale: Annotated[Vector, KeyInfo(usual_range=(-1e6, 1e6))] | None = Field(
        None,
        description="multiplier for all columns, or per column: one count in the unit, or -1;"
        " default: 1",
    )
    accel_scale: Annotated[Vector, KeyInfo(usual_range=(-1e6, 1e6))] | None = Field(
        None,
        description="multiplier for all columns, or per column: one count in the unit, or -1;"
        " default: 1",
    )
    axes_order: Annotated[str, AfterValidator(_check_axes_order)] = Field(
        "xyz",
        description="record axes that point right, front, up: 'y-xz' is +y right, -x front, +z up."
        " Or directions of its x, y, z axes: 'rfu', 'frd', 'flu'",
    )
    mounting_deg: tuple[Angle, Angle, Angle] | None = Field(
        None,
        description="attitude of the IMU (after axes_order) in the vehicle, deg: pitch, roll,"
        " counter-clockwise yaw. Attitudes are then the vehicle's; default: 0, 0, 0",
    )
    time_unit: Literal["s", "ms", "us", "ns", "iso"] | None = Field(
        None,
        description="time stamps in 's', 'ms', 'us', 'ns', or 'iso' for dates with time or times of"
        " day; default: 's'",
    )
    time_scale: Factor | None = Field(None, description="multiplier of the time stamps; default: 1")
    start_s: Starts = Field(
        default_factory=lambda given: (given.get("from_s") or 0.0,),
        description="start times, coarse alignment included, one per draw, s, from the record's"
        " beginning; default: from_s, else 0",
    )
    max_gap_s: SecondsOrZero | None = Field(
        None,
        description="longest gap between good samples that is interpolated, s; default: 0",
    )
    gyro_bias_deg_per_h: GyroNoise | None = Field(
        None,
        description="largest bias that the check accepts, deg/h; default: 10 or with low noise 4.5",
    )
    accel_bias_ug: AccelNoise | None = Field(
        None,
        description="largest bias that the check accepts, ug; default: 5000",
    )
    trust: bool | None = Field(
        None, description="whether to align despite errors that the check finds; default: false"
    )

    @model_validator(mode="after")
    def _check_columns(self) -> "RecordSection":
        self._check_times()
        needed = ("gyro_columns", "accel_columns", "gyro_unit", "accel_unit")
        if self.format in ("psins", "arrays"):
            given = [key for key in _COLUMN_KEYS if getattr(self, key) is not None]
            if self.format == "arrays":
                given += ["axes_order"] if self.axes_order != "xyz" else []
                given += ["mounting_deg"] if self.mounting_deg is not None else []
            why = "fixes it" if self.format == "psins" else "has it already"
            for key in given:
                text = f"does not apply to format '{self.format}', which {why} (drop it)"
                raise rule_error(text, key=key)
            return self
        for key in needed:
            if getattr(self, key) is None:
                raise rule_error(f"required with format '{self.format}'", key=key)
        for key, known in (("gyro_unit", GYRO_UNITS), ("accel_unit", ACCEL_UNITS)):
            if self.quantity is not None and getattr(self, key) not in known[self.quantity]:
                units = ", ".join(known[self.quantity])
                text = f"{getattr(self, key)!r} is not one of {units} for {self.quantity}"
                raise rule_error(f"{text} (drop quantity if the sensors differ)", key=key)
        for key in ("columns", "skip_rows"):
            if self.format == "parquet" and getattr(self, key) is not None:
                raise rule_error("applies to text only (drop it with format 'parquet')", key=key)
        # `rules` checks whether a rate is needed.
        if found := find_fault(self.layout(rate_hz=1.0)):
            raise rule_error(found.text, key=found.key)
        return self

    def layout(self, rate_hz: float | None) -> RecordLayout:
        """Return the layout of the record in its file, with the rate of the study, if any."""
        given = {key: getattr(self, key, None) for key in RecordLayout._fields}
        for key in ("gyro_scale", "accel_scale"):
            if isinstance(given[key], float | int):
                given[key] = (given[key],) * 3
        given["rate_hz"] = rate_hz
        return RecordLayout(**{key: value for key, value in given.items() if value is not None})

    def _check_times(self) -> None:
        for key in ("time_unit", "time_scale", "time_fraction_column"):
            if getattr(self, key) is not None and self.time_column is None:
                raise rule_error("requires a time_column (give it, or drop this)", key=key)
        if self.time_fraction_unit is not None and self.time_fraction_column is None:
            text = "requires a time_fraction_column (give it, or drop this)"
            raise rule_error(text, key="time_fraction_unit")
        begin, end = self.from_s or 0.0, self.to_s
        if end is not None and end <= begin:
            raise rule_error(f"must be after from_s = {begin:g}, not {end:g}", key="to_s")
        if min(self.start_s) < begin:
            text = f"{min(self.start_s):g} s is before from_s = {begin:g} (start later)"
            raise rule_error(text, key="start_s")


INITIAL_NUMBERS = ("phi_e0_deg", "phi_n0_deg", "phi_u0_deg", "ve0_m_per_s", "vn0_m_per_s")
"""Keys of [alignment] that may be drawn, in a recorded study the only ones."""


@cache
def keys_acting_as(*effects: Effect) -> tuple[str, ...]:
    """Return the keys of [motion] and [sensors] with some effects, see `KeyInfo.acts_as`."""
    fields = (MotionSection.model_fields | SensorsSection.model_fields).items()
    return tuple(key for key, field in fields if key_info(field).acts_as in effects)


BIAS_KEYS = keys_acting_as("bias")
"""Keys of the constant sensor biases."""


def _max_list_length(annotation: Any) -> int:
    """Return the longest list length of a type, 1 for a number, 0 for text."""
    if annotation is str or get_origin(annotation) is Literal:
        return 0
    if get_origin(annotation) is tuple:
        return len(get_args(annotation))
    return max(map(_max_list_length, get_args(annotation)), default=1)


NUMBERS_DRAWN = {
    "latitude_deg": 1,
    **{
        key: numbers
        for section in (MotionSection, SensorsSection)
        for key, field in section.model_fields.items()
        if key not in (*TURN_KEYS, "attitude_file")
        and (numbers := _max_list_length(field.annotation))
    },
    **dict.fromkeys(INITIAL_NUMBERS, 1),
}
"""Keys that may be drawn, with the numbers per draw: one, or one per axis of a vector."""

ListEntries = Annotated[tuple[Any, ...], Field(min_length=1)]


class Distribution(Section):
    """Distribution of a drawn key; give exactly one of these keys.

    The entries of a list are values of the drawn key: for a vector one number or one per axis.
    """

    uniform: IncreasingPair | None = Field(None, description="[low, high]")
    normal: Normal | None = Field(None, description="[mean, standard deviation]")
    values: ListEntries | None = Field(None, description="one per draw, repeated from the first")
    grid: ListEntries | None = Field(
        None,
        description="grid values; the draws are the product of all grids, the last key fastest",
    )

    @property
    def rms(self) -> float:
        """Root mean square of its numbers, about zero; of the largest axis of lists."""
        if self.normal is not None:
            return float(np.hypot(*self.normal))
        if self.uniform is not None:
            low, high = self.uniform
            return float(np.sqrt((low * low + low * high + high * high) / 3))
        entries = self.values if self.values is not None else self.grid
        assert entries is not None
        return float(np.sqrt(np.mean([np.max(np.square(entry)) for entry in entries])))


class DrawnSection(Section):
    """[drawn]: keys with a random value per draw, shared by all variants."""

    model_config = ConfigDict(extra="allow")
    __pydantic_extra__: dict[str, Distribution] = Field(init=False)

    sampling: Literal["random", "sobol"] = Field(
        "random",
        description="'random': independent numbers. 'sobol': scrambled Sobol points of all drawn"
        " keys together",
    )

    @property
    def laws(self) -> dict[str, Distribution]:
        """The distribution of each drawn key, in the order of the file."""
        return self.__pydantic_extra__


class AdviseSection(Section):
    """[advise]: requirements for `sinsjax advise` only."""

    time_s: Seconds = Field(
        300.0, description="available alignment time, s: whole seconds, 10 to 7200"
    )
    wanted_deg: AngleSigma | None = Field(
        None, description="heading error that 95 % of alignments must not exceed, deg"
    )
    known_heading_deg: AngleSigma | None = Field(
        None, description="1 sigma of prior heading knowledge, deg; default: nothing is known"
    )


class StopWhenSection(Section):
    """[stop_when]: precision at which a study stops before its last draw."""

    statistic: Name = Field(
        description="'success_rate', or 'settle_B_s_mean', the mean settling time into B arcmin;"
        " both follow judged_from"
    )
    half_width: Positive = Field(
        description="half-width of its 95 % interval, in the variant where it is widest, that ends"
        " the study: a fraction for 'success_rate', else s"
    )


Some = Annotated[Count, Field(ge=1)]
Searches = Annotated[
    tuple[Literal["grid", "sobol", "gradient"], ...],
    Field(min_length=1),
    AfterValidator(require_unique),
]


class Range(Section):
    """Range of a tuned key: low and high, or fixed, or candidates."""

    low: Finite | None = Field(None, description="ends of the range")
    high: Finite | None = Field(None, description="ends of the range")
    scale: Literal["linear", "log"] | None = Field(
        None,
        description="spacing of the values: 'linear', or 'log' for equal ratios; default: 'linear'",
    )
    fixed: Any = Field(None, description="single value")
    candidates: ListEntries | None = Field(None, description="values to try")

    @model_validator(mode="after")
    def _check_kind(self) -> "Range":
        names = ("low", "high", "fixed", "candidates")
        given = [name for name in names if getattr(self, name) is not None]
        if given not in (["low", "high"], ["fixed"], ["candidates"]):
            listed = " and ".join(given) or "none"
            raise rule_error(f"needs low and high, or fixed, or candidates, not {listed}")
        if self.low is None or self.high is None:
            if self.scale is not None:
                raise rule_error("requires low and high", key="scale")
            return self
        if not self.low < self.high:
            raise rule_error(
                f"must be above low = {self.low:.12g}, not {self.high:.12g}", key="high"
            )
        if self.scale == "log" and self.low <= 0:
            raise rule_error(f"'log' needs low > 0, not {self.low:.12g}", key="scale")
        return self

    @property
    def is_free(self) -> bool:
        """Return whether it is an interval to be searched."""
        return self.low is not None


class TuneSection(Section):
    """[tune]: objective, variables and searches of `sinsjax tune`."""

    objective: Literal["settle_mean", "settle_quantile", "final_error", "failure_rate"] = Field(
        "settle_mean",
        description="'settle_mean': mean settling time, unsettled runs counting with their length."
        " 'settle_quantile': its quantile. 'final_error': rms final heading error."
        " 'failure_rate': fraction of unsettled runs",
    )
    objective_band_arcmin: Band = Field(
        10.0,
        description="heading band, arcmin: one of settle_bands_arcmin, or the success band",
    )
    objective_quantile: Annotated[float, Field(gt=0, lt=1)] = Field(
        0.9, description="quantile for 'settle_quantile'"
    )
    objective_across: Literal["mean", "worst"] = Field(
        "mean", description="objective over several variants: 'mean' or 'worst'"
    )
    searches: Searches = Field(
        ("grid", "gradient"),
        description="'grid', 'sobol': points in the ranges. 'gradient': descents. If reset times"
        " are tuned, each also evaluates the reset law's schedule",
    )
    tune_draws: Some | None = Field(
        None,
        description="draws for searches; in a recorded study every second start time; default: 16"
        " in a simulation",
    )
    evaluation_draws: Some | None = Field(
        None,
        description="other draws, to compare the best points with the baseline; in a recorded study"
        " the other start times; default: 64 in a simulation",
    )
    grid_points: Annotated[Count, Field(ge=2)] = Field(
        15, description="points per variable of a 'grid' search; at most two variables"
    )
    sobol_points: Some = Field(
        256, description="points of a 'sobol' search per combination of candidates"
    )
    descent_screen: Some = Field(
        16,
        description="Sobol points evaluated before the descents, which start from the best; on"
        " `descent_draws` draws",
    )
    descent_starts: Some = Field(4, description="parallel descents")
    descent_steps: Some = Field(16, description="steps of a descent")
    descent_draws: Some = Field(4, description="new draws per step")
    descent_rate: Positive = Field(0.1, description="Adam learning rate, in lengths of the ranges")
    relaxed_window_s: tuple[Seconds, Seconds] = Field(
        (4.0, 1.0),
        description="half-widths of smooth reset windows at the first and last step, s; only if a"
        " variable moves a reset",
    )
    relaxed_sharpness: tuple[Positive, Positive] = Field(
        (6.0, 16.0),
        description="sharpness of the smooth heading band edge at the first and last step",
    )
    variables: dict[str, Range | tuple[Range, ...]] = Field(
        description="tuned keys with their ranges, the table [tune.variables]"
    )
    baseline: dict[str, Any] = Field(
        default={},
        description="values to compare with, the table [tune.baseline]; default: the study's",
    )
