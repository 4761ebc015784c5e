"""The sections of a study file: one frozen model per section, one field per key.

Values stay in the units of the file, which the names of keys state. Leaf keys are unique over all
sections, so a key alone names an axis and a result column. Rules within one section are here, rules
between sections in `rules`. The methods have sections of their own, see `methods.registry`.
"""

from typing import Annotated, Any, Literal, cast, get_args, get_origin

import numpy as np
from pydantic import AfterValidator, ConfigDict, Field, field_validator, model_validator

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
    require_unique,
    rule_error,
)


class StudySection(Section):
    """[study]: settings that all runs of a study share; none of them can be swept."""

    name: Name = Field(
        description="name of the study in reports and manifests; default: the file's stem"
    )
    duration_s: Seconds = Field(
        description="length of each run, s. It includes all passes over a stored record and a"
        " coarse alignment, except one that hands over a record"
    )
    # None only in a recorded study before its record is read, see `load.with_rate`.
    rate_hz: Annotated[Positive, KeyInfo(usual_range=(1e-3, 1e6))] = Field(
        cast(float, None),
        description="sample rate of the sensors, Hz. Required in a simulation and for a record"
        " without time stamps; otherwise it must agree with the rate of the record",
    )
    record_interval_s: Seconds = Field(
        1.0,
        description="time between two record times, s. Settling times, statistics and curves use"
        " the attitude at record times",
    )
    draws: Annotated[Count, Field(ge=1)] | None = Field(
        None,
        description="number of Monte Carlo draws, each one realisation of the sensor noise and of"
        " [drawn]; the maximum with [stop_when]. With estimate = 'covariance', the draws of a"
        " variant for which the linear estimate does not hold. A recorded study has one draw per"
        " start time; default: 64 in a simulation",
    )
    estimate: Literal["draws", "covariance"] = Field(
        "draws",
        description="source of the statistics. 'draws': Monte Carlo with one run per draw and"
        " variant, stored in `summary/`. 'covariance': linear covariance analysis with one"
        " noise-free run per variant, stored in `estimates/`",
    )
    estimate_samples: Annotated[int, Field(ge=4, le=2**16, multiple_of=2)] | None = Field(
        None,
        description="number of errors sampled from the covariance to estimate settling times, an"
        " even number since they come in pairs of opposite sign; default: 256 with estimate ="
        " 'covariance'",
    )
    check_linearity: bool | None = Field(
        None,
        description="whether 8 draws per variant check the linear estimate (column"
        " `nonlinearity`). If it exceeds 0.5, `draws` Monte Carlo draws replace the estimate of"
        " the heading. Only with estimate = 'covariance'; default: true",
    )
    seed: int = Field(
        1, ge=0, lt=2**63, description="seed of all random numbers; equal seeds give equal draws"
    )
    settle_bands_arcmin: Bands = Field(
        (60.0, 10.0, 3.0),
        description="half-widths of the heading error bands into which settling times are"
        " reported, arcmin",
    )
    window_s: Annotated[tuple[NonNegative, Positive], KeyInfo(usual_range=(0, 1e8))] = Field(
        # A pydantic below 2.14 calls it even if the duration is missing or wrong.
        default_factory=lambda given: (
            given.get("duration_s", 1.0) / 1.5,
            given.get("duration_s", 1.0),
        ),
        description="start and end of the window over which means and standard deviations of the"
        " errors are taken, s; default: the last third of the duration",
    )
    consistency_after_s: SecondsOrZero = Field(
        10.0,
        description="time after which record times count in the columns p_above_error_share and"
        " p_above_floor_error_share, s",
    )
    steady_after_s: SecondsOrZero = Field(
        300.0,
        description="time after which record times count in the column"
        " p_above_error_steady_share, s",
    )
    curves: bool = Field(
        False,
        description="whether a sweep also stores the errors of every run at every record time, in"
        " `curves/`",
    )
    judged_from: Literal["truth", "floor"] | None = Field(
        None,
        description="reference from which the success of a run is judged. 'truth': true north, or"
        " the reference of a record. 'floor': the bias floor, the heading error that the constant"
        " sensor biases of the run leave; default: 'truth'",
    )
    success_band_arcmin: Band | None = Field(
        None,
        description="half-width of the band in which the heading error of a successful run ends,"
        " arcmin; default: 10",
    )
    level_band_arcmin: Band | None = Field(
        None,
        description="half-width of the band in which both level errors of a successful run end,"
        " arcmin. Judged from the truth, the tilt that the accelerometer biases leave is added to"
        " it; default: 10",
    )
    dwell_s: SecondsOrZero | None = Field(
        None,
        description="time that a successful run has spent in the heading band without"
        " interruption when it ends, s; default: the smaller of 30 s and a tenth of the run",
    )
    diverged_deg: AngleSigma | None = Field(
        None,
        description="final heading error beyond which a run that is no success counts as"
        " diverged, deg. It is measured from the bias floor, or from the truth if the run has no"
        " floor; default: 10",
    )
    report_times_s: ReportTimes | None = Field(
        None,
        description="times from the first sample of data at which the summary also lists the"
        " heading error of each run, its sigma and its NEES, s; default: none",
    )
    unchecked: bool | None = Field(
        None, description="whether values outside their usual range are accepted; default: false"
    )
    external: Annotated[tuple[Name, ...], AfterValidator(require_unique)] | None = Field(
        None,
        description="programs outside sinsjax whose results the directory of the study has, written"
        " by `sinsjax score`. They are methods of the study, but no runs of it; default: none",
    )

    @field_validator("judged_from", mode="before")
    @classmethod
    def _refuse_limit(cls, value: Any) -> Any:
        if value == "limit":
            raise rule_error("'limit' was renamed (use 'floor')")
        return value

    @field_validator("estimate", mode="before")
    @classmethod
    def _refuse_controlled(cls, value: Any) -> Any:
        if value == "controlled":
            text = "leave the key out for Monte Carlo, or use 'covariance'"
            raise rule_error(f"'controlled' was dropped ({text})")
        return value

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
    """[earth]: gravity, shape and rotation of the Earth, and the place on it."""

    conditions = (
        KeyCondition(
            ("gravity_m_per_s2", "radius_m", "earth_rate_deg_per_h"),
            ("earth",),
            lambda earth: earth == "constants",
        ),
    )

    earth: Literal["constants", "wgs84"] = Field(
        "constants",
        description="Earth model. 'constants': a sphere with constant gravity, given by the next"
        " three keys. 'wgs84': the WGS-84 ellipsoid with normal gravity at the latitude and"
        " height",
    )
    gravity_m_per_s2: Annotated[Positive, KeyInfo(usual_range=(9, 10.5))] | None = Field(
        None, description="gravity, m/s^2; only with earth = 'constants'; default 9.8"
    )
    radius_m: Annotated[Positive, KeyInfo(usual_range=(6e6, 7e6))] | None = Field(
        None, description="radius of the sphere, m; only with earth = 'constants'; default 6378137"
    )
    earth_rate_deg_per_h: Annotated[Positive, KeyInfo(usual_range=(10, 20))] | None = Field(
        None,
        description="rotation rate of the Earth, deg/h; only with earth = 'constants'; default"
        " 15.041067",
    )
    latitude_deg: Elevation | None = Field(
        None,
        description="latitude, positive north, deg. Required in a simulation; a recorded study"
        " may leave it out if the header of its record gives it",
    )
    height_m: Annotated[Finite, KeyInfo(usual_range=(-12e3, 1e6))] | None = Field(
        None,
        description="height above the ellipsoid or the sphere, m; default: the height in the"
        " header of the record, or 0",
    )


def _any_nonzero(*values: Any) -> bool:
    """Return whether any of some numbers, or lists of numbers, is not zero; a drawn one is None."""
    return any(value is None or np.any(value) for value in values)


TURN_KEYS = (
    *("turn_times_s", "turn_angles_deg", "turn_rate_deg_per_s", "turn_ramp_s"),
    *("turn_repeat_s", "turn_axis"),
)
"""Keys of turns of the base."""


def _moves(turn_times_s: Any, attitude_file: Any, *amplitudes: Any) -> bool:
    return bool(turn_times_s or attitude_file) or _any_nonzero(*amplitudes)


class MotionSection(Section):
    """[motion]: simulated motion; angles are center + amplitude sin(2 pi t / period + phase).

    The base sways about a point that may be a lever arm away from the sensors, and may be turned
    about an axis through it. Surge moves that point, vibration the sensor housing.
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
                *(TURN_KEYS[0], "attitude_file"),
                *(f"{angle}_amplitude_deg" for angle in ("pitch", "roll", "yaw")),
            ),
            _moves,
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

    pitch_center_deg: Elevation = Field(
        0.0, description="mean pitch, positive with the front up, deg"
    )
    pitch_amplitude_deg: Amplitude = Field(
        0.0, description="amplitude of the sinusoidal pitch motion, deg"
    )
    pitch_period_s: Period = Field(
        10.0,
        description="period of the pitch motion, s; default: required with an amplitude",
    )
    pitch_phase_deg: Angle = Field(0.0, description="phase of the pitch motion at t = 0, deg")
    roll_center_deg: HalfTurn = Field(
        0.0, description="mean roll, positive with the right side down, deg"
    )
    roll_amplitude_deg: Amplitude = Field(
        0.0, description="amplitude of the sinusoidal roll motion, deg"
    )
    roll_period_s: Period = Field(
        10.0,
        description="period of the roll motion, s; default: required with an amplitude",
    )
    roll_phase_deg: Angle = Field(0.0, description="phase of the roll motion at t = 0, deg")
    yaw_center_deg: Angle | None = Field(
        None, description="mean yaw, deg, counter-clockwise from north: the negative of the heading"
    )
    yaw_amplitude_deg: Amplitude = Field(
        0.0, description="amplitude of the sinusoidal yaw motion, deg"
    )
    yaw_period_s: Period = Field(
        10.0,
        description="period of the yaw motion, s; default: required with an amplitude",
    )
    yaw_phase_deg: Angle = Field(0.0, description="phase of the yaw motion at t = 0, deg")
    lever_arm_m: Annotated[Vector, KeyInfo(usual_range=(-1e3, 1e3))] = Field(
        0.0,
        description="vector from the centre of the sway to the sensors along the body axes right,"
        " front, up, m. The axis of turns passes through that centre",
    )
    turn_times_s: EventTimes | None = Field(
        None,
        description="beginning of each turn of the base, s from the first sample, rounded to whole"
        " samples; default: no turns",
    )
    turn_angles_deg: Annotated[Numbers, KeyInfo(usual_range=(-1e8, 1e8))] | None = Field(
        None,
        description="signed angle of the turns, counter-clockwise from above, deg: one for all, or"
        " one per turn. A turn that is not finished goes on to the end: 1e6 for a carousel;"
        " default: 180",
    )
    turn_rate_deg_per_s: Annotated[Positive, KeyInfo(usual_range=(1e-4, 1e5))] | None = Field(
        None,
        description="rate of the turns, deg/s. It is adjusted so that a turn of the exact angle"
        " lasts a whole number of samples; default: 10",
    )
    turn_ramp_s: Annotated[Positive, KeyInfo(usual_range=(1e-4, 1e4))] | None = Field(
        None,
        description="time in which a turn reaches its rate, and in which it stops, s; default: 1",
    )
    turn_repeat_s: Seconds | None = Field(
        None,
        description="time after which the turns are repeated, until the end, s; default: they are"
        " not repeated",
    )
    turn_axis: Literal["vertical", "body"] | None = Field(
        None,
        description="axis of the turns. 'vertical': the vehicle turns about the vertical, its"
        " pitch and roll axes with it. 'body': a turntable on the vehicle, which sways along, turns"
        " the sensors about their z axis; default: 'vertical'",
    )
    attitude_file: Name | None = Field(
        None,
        description="file of the attitude of the base, text or Parquet with the columns time_s,"
        " pitch_deg, roll_deg and yaw_deg (or heading_deg), in place of all angles and turns. Cubic"
        " splines lead from row to row; smooth a noisy file first. It cannot be swept; default:"
        " none",
    )
    surge_m_per_s: Annotated[NoisePerAxis, KeyInfo(usual_range=(0, 100))] = Field(
        0.0,
        description="rms velocity of the surge, a random motion about a fixed place, along east,"
        " north, up, m/s",
    )
    surge_time_s: Period = Field(5.0, description="correlation time of the surge velocity, s")
    surge_bandwidth_hz: Bandwidth = Field(
        1.0,
        description="bandwidth of the surge, which limits its acceleration, Hz; only with"
        " surge_model = 'third_order'",
    )
    surge_model: Literal["third_order", "gauss_markov"] = Field(
        "third_order",
        description="random process of the surge. 'third_order': position, velocity and"
        " acceleration have finite variances. 'gauss_markov': the velocity is a first-order"
        " Gauss-Markov process, whose acceleration grows with the sample rate",
    )
    vibration_ug_rms: Annotated[NoisePerAxis, KeyInfo(usual_range=(0, 1e8))] = Field(
        0.0,
        description="specific force of the sensor housing's vibration along the body axes right,"
        " front, up, ug rms",
    )
    vibration_deg_per_h_rms: Annotated[NoisePerAxis, KeyInfo(usual_range=(0, 1e8))] = Field(
        0.0,
        description="angular rate of the sensor housing's vibration about the body axes right,"
        " front, up, deg/h rms",
    )
    vibration_hz: Bandwidth = Field(
        30.0, description="undamped natural frequency of the vibration, Hz"
    )
    vibration_damping: Damping = Field(0.05, description="damping ratio of the vibration")


class SensorsSection(Section):
    """[sensors]: errors of the simulated sensors; one number for all body axes, or one per axis."""

    exclusive = (
        ("gyro_noise_deg_per_h", "gyro_arw_deg_per_sqrt_h"),
        ("accel_noise_ug", "accel_vrw_ug_per_sqrt_hz"),
    )
    conditions = (
        KeyCondition(("gyro_instability_time_s",), ("gyro_instability_deg_per_h",), _any_nonzero),
        KeyCondition(("accel_instability_time_s",), ("accel_instability_ug",), _any_nonzero),
    )

    gyro_bias_deg_per_h: Annotated[Vector, KeyInfo(usual_range=(-1e5, 1e5))] = Field(
        0.0, description="constant gyro bias, measured minus true rate, deg/h"
    )
    gyro_noise_deg_per_h: Annotated[NoisePerAxis, KeyInfo(usual_range=(0, 1e6))] | None = Field(
        None,
        description="white noise of the gyros as the standard deviation of one sample of the"
        " rate, deg/h; an alternative to gyro_arw_deg_per_sqrt_h; default: no noise if both are"
        " left out",
    )
    gyro_arw_deg_per_sqrt_h: Annotated[NoisePerAxis, KeyInfo(usual_range=(0, 1e4))] | None = Field(
        None,
        description="white noise of the gyros as the angle random walk of a data sheet,"
        " deg/sqrt(h); an alternative to gyro_noise_deg_per_h",
    )
    gyro_instability_deg_per_h: Annotated[NoisePerAxis, KeyInfo(usual_range=(0, 1e4))] = Field(
        0.0,
        description="gyro bias instability as the rms of a first-order Gauss-Markov process,"
        " deg/h. The Allan deviation of this process is at most 0.617 of its rms",
    )
    gyro_instability_time_s: Period = Field(
        300.0, description="correlation time of the gyro bias instability, s"
    )
    gyro_rrw_deg_per_h_per_sqrt_h: Annotated[NoisePerAxis, KeyInfo(usual_range=(0, 1e4))] = Field(
        0.0,
        description="rate random walk of the gyros, deg/h/sqrt(h). It starts from zero at the"
        " first sample",
    )
    gyro_quantisation_arcsec: Annotated[NoisePerAxis, KeyInfo(usual_range=(0, 1e4))] = Field(
        0.0,
        description="resolution of the gyros' angle output, arcsec. What is rounded off is"
        " carried over to the next sample",
    )
    gyro_scale_ppm: Annotated[Vector, KeyInfo(usual_range=(-1e6, 1e6))] = Field(
        0.0, description="scale factor error of the gyros, ppm"
    )
    gyro_misalignment_arcsec: Annotated[CrossAxis, KeyInfo(usual_range=(-1e5, 1e5))] = Field(
        0.0,
        description="small misalignment angles of the gyro axes xy, xz, yx, yz, zx, zy, arcsec:"
        " with xy, gyro x also measures that fraction of the rate about y",
    )
    accel_bias_ug: Annotated[Vector, KeyInfo(usual_range=(-1e6, 1e6))] = Field(
        0.0, description="constant accelerometer bias, measured minus true specific force, ug"
    )
    accel_noise_ug: Annotated[NoisePerAxis, KeyInfo(usual_range=(0, 1e7))] | None = Field(
        None,
        description="white noise of the accelerometers as the standard deviation of one sample,"
        " ug; an alternative to accel_vrw_ug_per_sqrt_hz; default: no noise if both are left out",
    )
    accel_vrw_ug_per_sqrt_hz: Annotated[NoisePerAxis, KeyInfo(usual_range=(0, 1e7))] | None = Field(
        None,
        description="white noise of the accelerometers as the velocity random walk of a data"
        " sheet, ug/sqrt(Hz); an alternative to accel_noise_ug",
    )
    accel_instability_ug: Annotated[NoisePerAxis, KeyInfo(usual_range=(0, 1e6))] = Field(
        0.0,
        description="accelerometer bias instability as the rms of a first-order Gauss-Markov"
        " process, ug",
    )
    accel_instability_time_s: Period = Field(
        300.0, description="correlation time of the accelerometer bias instability, s"
    )
    accel_rrw_ug_per_sqrt_h: Annotated[NoisePerAxis, KeyInfo(usual_range=(0, 1e6))] = Field(
        0.0,
        description="acceleration random walk of the accelerometers, ug/sqrt(h). It starts from"
        " zero at the first sample",
    )
    accel_quantisation_um_per_s: Annotated[NoisePerAxis, KeyInfo(usual_range=(0, 1e6))] = Field(
        0.0,
        description="resolution of the accelerometers' velocity output, um/s. What is rounded off"
        " is carried over to the next sample",
    )
    accel_scale_ppm: Annotated[Vector, KeyInfo(usual_range=(-1e6, 1e6))] = Field(
        0.0, description="scale factor error of the accelerometers, ppm"
    )
    accel_misalignment_arcsec: Annotated[CrossAxis, KeyInfo(usual_range=(-1e5, 1e5))] = Field(
        0.0,
        description="small misalignment angles of the accelerometer axes xy, xz, yx, yz, zx, zy,"
        " arcsec: with xy, accelerometer x also measures that fraction of the specific force"
        " along y",
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
    """[record]: format, units and axes of an IMU record, and the start times of the alignments."""

    format: Literal["psins", "csv", "parquet", "arrays"] = Field(
        description="format of the record. 'psins': PSINS text. 'csv': text with a header line."
        " 'parquet': Apache Parquet. 'arrays': a record given as arrays in Python"
    )
    from_s: SecondsOrZero | None = Field(
        None,
        description="start of the part of the record that is used, s from its beginning; default:"
        " its beginning",
    )
    to_s: Seconds | None = Field(
        None,
        description="end of the part of the record that is used, s from its beginning; default:"
        " its end",
    )
    columns: Columns | None = Field(
        None,
        description="names of all columns of a text file that does not name them (csv); default:"
        " the names in the file, or column_1, column_2 and so on",
    )
    skip_rows: Count | None = Field(
        None,
        description="lines of a text file before the names of its columns, or before its samples"
        " (csv); default: 0",
    )
    quantity: Literal["increments", "rates"] | None = Field(
        None,
        description="quantity in the columns of both sensors (csv, parquet). 'increments':"
        " integrals over each sample. 'rates': means over each sample. Default: as the units say",
    )
    time_column: str | None = Field(
        None,
        description="column of the time stamps, which mark the end of each sample (csv, parquet)."
        " Without it the sample times follow from rate_hz",
    )
    time_fraction_column: Name | None = Field(
        None,
        description="column of the fraction of a second that time_column lacks, such as nsecs (csv,"
        " parquet)",
    )
    time_fraction_unit: Literal["ms", "us", "ns"] | None = Field(
        None, description="unit of time_fraction_column; default: 'ns'"
    )
    gyro_columns: Triad | None = Field(
        None, description="columns of the x, y and z gyro (csv, parquet)"
    )
    accel_columns: Triad | None = Field(
        None, description="columns of the x, y and z accelerometer (csv, parquet)"
    )
    gyro_unit: Literal["rad", "deg", "arcsec", "rad_per_s", "deg_per_s", "deg_per_h"] | None = (
        Field(
            None,
            description="unit of the gyro columns (csv, parquet): 'rad', 'deg' and 'arcsec' for"
            " increments, the others for rates",
        )
    )
    accel_unit: Literal["m_per_s", "g_s", "ug_s", "m_per_s2", "g", "mg", "ug"] | None = Field(
        None,
        description="unit of the accelerometer columns (csv, parquet): 'm_per_s', 'g_s' and"
        " 'ug_s' for increments, the others for rates",
    )
    gyro_scale: Annotated[Vector, KeyInfo(usual_range=(-1e6, 1e6))] | None = Field(
        None,
        description="multiplier of the gyro columns in gyro_unit, or one per column (csv, parquet):"
        " the value of one count, or -1; default: 1",
    )
    accel_scale: Annotated[Vector, KeyInfo(usual_range=(-1e6, 1e6))] | None = Field(
        None,
        description="multiplier of the accelerometer columns in accel_unit, or one per column (csv,"
        " parquet): the value of one count, or -1; default: 1",
    )
    axes_order: Annotated[str, AfterValidator(_check_axes_order)] = Field(
        "xyz",
        description="axes of the record that point right, front and up. 'y-xz': right is +y of"
        " the record, front is -x, up is +z. Or the directions of its x, y and z axes by name:"
        " 'rfu', 'frd' or 'flu'",
    )
    mounting_deg: tuple[Angle, Angle, Angle] | None = Field(
        None,
        description="attitude of the IMU, with the axes of axes_order, in the vehicle: pitch, roll"
        " and yaw (counter-clockwise), deg. Attitudes are those of the vehicle then; default: 0,"
        " 0, 0",
    )
    time_unit: Literal["s", "ms", "us", "ns", "iso"] | None = Field(
        None,
        description="unit of the time stamps, or 'iso' for dates with time or times of day;"
        " default: 's'",
    )
    time_scale: Factor | None = Field(
        None, description="multiplier of the time stamps in time_unit; default: 1"
    )
    start_s: Starts = Field(
        default_factory=lambda given: (given.get("from_s") or 0.0,),
        description="start times of the alignments, one per draw, s from the beginning of the"
        " record. A coarse alignment starts there; default: from_s, else 0",
    )
    max_gap_s: SecondsOrZero | None = Field(
        None,
        description="longest time between two good samples across which missing ones are"
        " interpolated, s; default: 0, no interpolation",
    )
    gyro_bias_deg_per_h: GyroNoise | None = Field(
        None,
        description="largest gyro bias that the check of the record accepts as plausible, deg/h;"
        " default: 10",
    )
    accel_bias_ug: AccelNoise | None = Field(
        None,
        description="largest accelerometer bias that the check of the record accepts as"
        " plausible, ug; default: 5000",
    )
    trust: bool | None = Field(
        None,
        description="whether a record is aligned even if the check finds errors in it; default:"
        " false",
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

BIAS_KEYS = ("gyro_bias_deg_per_h", "accel_bias_ug")
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
    """Distribution of a drawn key, by exactly one of these keys.

    The entries of a list are values of the drawn key: for a vector one number or one per axis.
    """

    uniform: IncreasingPair | None = Field(
        None, description="uniform distribution from low to high, [low, high]"
    )
    normal: Normal | None = Field(
        None, description="normal distribution, [mean, standard deviation]"
    )
    values: ListEntries | None = Field(
        None, description="list of values, one per draw, used again from the first after the last"
    )
    grid: ListEntries | None = Field(
        None,
        description="list of grid values. The draws are the points of the product of all grids,"
        " the last key fastest",
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


def is_normal(key: str, law: Distribution) -> bool:
    """Return whether a key draws initial errors or constant biases from a normal distribution."""
    return law.normal is not None and key in (*INITIAL_NUMBERS, *BIAS_KEYS)


class DrawnSection(Section):
    """[drawn]: keys with a random value per draw, which all variants of the draw share."""

    model_config = ConfigDict(extra="allow")
    __pydantic_extra__: dict[str, Distribution] = Field(init=False)

    sampling: Literal["random", "sobol"] = Field(
        "random",
        description="source of uniform and normal values. 'random': independent numbers. 'sobol':"
        " scrambled Sobol points of all drawn keys together",
    )

    @property
    def laws(self) -> dict[str, Distribution]:
        """The distribution of each drawn key, in the order of the file."""
        return self.__pydantic_extra__


class AdviseSection(Section):
    """[advise]: what `sinsjax advise` is asked of a data sheet; no other command reads it."""

    time_s: Seconds = Field(
        300.0, description="time that there is to align, s: whole seconds, at least 10"
    )
    wanted_deg: AngleSigma | None = Field(
        None, description="heading error that 95 % of the alignments are to stay within, deg"
    )
    known_heading_deg: AngleSigma | None = Field(
        None, description="1 sigma of the heading known before, deg; default: nothing is known"
    )


class StopWhenSection(Section):
    """[stop_when]: the precision of a statistic at which a study stops before its last draw."""

    statistic: Name = Field(
        description="statistic whose precision ends the study: 'success_rate', or"
        " 'settle_B_s_mean', the mean settling time into the band of B arcmin. Both follow"
        " judged_from"
    )
    half_width: Positive = Field(
        description="half-width of the 95 % confidence interval at which the study stops, in the"
        " variant where it is widest: a share for 'success_rate', otherwise s"
    )


Some = Annotated[Count, Field(ge=1)]
Searches = Annotated[
    tuple[Literal["grid", "sobol", "random", "gradient", "covariance"], ...],
    Field(min_length=1),
    AfterValidator(require_unique),
]


class Range(Section):
    """Range of a tuned key: low and high, or one fixed value, or a list of candidates."""

    low: Finite | None = Field(None, description="lowest value")
    high: Finite | None = Field(None, description="highest value")
    scale: Literal["linear", "log"] | None = Field(
        None,
        description="spacing of the values from low to high, 'log' for equal ratios; default:"
        " 'linear'",
    )
    fixed: Any = Field(None, description="one value, which is not searched")
    candidates: ListEntries | None = Field(
        None, description="list of values, each of which is tried"
    )

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
    """[tune]: objective and variables of `sinsjax tune`, and the searches for the best values."""

    objective: Literal["settle_mean", "settle_quantile", "final_error", "failure_rate"] = Field(
        "settle_mean",
        description="quantity to be minimised. 'settle_mean': mean settling time; a run that"
        " never settles counts with its length. 'settle_quantile': quantile of the settling time."
        " 'final_error': rms of the final heading error. 'failure_rate': share of the runs that"
        " never settle",
    )
    objective_band_arcmin: Band = Field(
        10.0,
        description="half-width of the heading error band of settling times and failures, arcmin:"
        " one of settle_bands_arcmin, or the success band",
    )
    objective_quantile: Annotated[float, Field(gt=0, lt=1)] = Field(
        0.9, description="quantile of the settling time with objective = 'settle_quantile'"
    )
    objective_across: Literal["mean", "worst"] = Field(
        "mean", description="objective of several variants: the mean of theirs, or the worst"
    )
    searches: Searches = Field(
        ("grid", "gradient"),
        description="searches, in this order. 'grid': all points of a grid. 'sobol' and 'random':"
        " points in the ranges. 'gradient': descents along the derivatives. 'covariance': an"
        " evolution strategy on linear covariance analysis. If reset times are tuned, each also"
        " evaluates the schedule by the law of resets",
    )
    tune_draws: Some | None = Field(
        None,
        description="number of draws that the searches use. A recorded study uses every second"
        " start time instead; default: 16 in a simulation",
    )
    evaluation_draws: Some | None = Field(
        None,
        description="number of other draws on which the best points are compared with the"
        " baseline. A recorded study uses the other start times instead; default: 64 in a"
        " simulation",
    )
    grid_points: Annotated[Count, Field(ge=2)] = Field(
        15, description="points per variable in a 'grid' search, which takes up to two variables"
    )
    sobol_points: Some = Field(
        256, description="points of a 'sobol' or 'random' search per combination of candidates"
    )
    descent_screen: Some = Field(
        16,
        description="Sobol points that are evaluated before the descents, on `descent_draws`"
        " draws or by covariance analysis. The descents start from the best of them",
    )
    descent_starts: Some = Field(4, description="number of parallel descents")
    descent_steps: Some = Field(16, description="number of steps of a descent")
    descent_draws: Some = Field(
        4,
        description="draws per step of a descent, the next ones at each step. None are needed if"
        " no variable moves a reset and covariance analysis applies",
    )
    descent_rate: Positive = Field(
        0.1, description="learning rate of the optimiser Adam, in lengths of the ranges"
    )
    relaxed_window_s: tuple[Seconds, Seconds] = Field(
        (4.0, 1.0),
        description="half-width of the smooth windows over which the resets are spread at the"
        " first and last step of a descent, s; only if a variable moves a reset",
    )
    relaxed_sharpness: tuple[Positive, Positive] = Field(
        (6.0, 16.0),
        description="sharpness of the smooth edge of the heading error band at the first and last"
        " step of a descent",
    )
    evolution_screen: Some = Field(
        64,
        description="Sobol points that a 'covariance' search evaluates first per combination of"
        " candidates. It starts from the best of them",
    )
    evolution_steps: Some = Field(12, description="generations of a 'covariance' search")
    feedback_phases: Some = Field(
        4,
        description="number of shifts of the reset times within a feedback interval over which a"
        " 'covariance' search averages; 1 is no shift",
    )
    variables: dict[str, Range | tuple[Range, ...]] = Field(
        description="keys to be tuned, each with its range, in the table [tune.variables]"
    )
    baseline: dict[str, Any] = Field(
        default={},
        description="values to compare the tuned ones with, in the table [tune.baseline];"
        " default: those of the study",
    )
