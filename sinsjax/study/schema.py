"""The sections of a study file: one frozen model per section, one field per key.

Values stay in the units of the file. Leaf keys are unique over all sections, so a key alone names
an axis and a result column. Rules within one section are here, those between sections in `rules`.
"""

from functools import cache
from typing import Annotated, Any, Generic, Literal, TypeVar, cast, get_args, get_origin

import numpy as np
from pydantic import AfterValidator, ConfigDict, Field, WithJsonSchema, model_validator

from sinsjax import value_types as vt
from sinsjax.messages import shorten, suggest_closest
from sinsjax.methods.registry import BROKEN, METHODS
from sinsjax.records.layout import ACCEL_UNITS, GYRO_UNITS, RecordLayout, find_faults
from sinsjax.value_types import (
    Effect,
    KeyCondition,
    Section,
    key_field,
    key_info,
    require_unique,
    rule_error,
)


class StudySection(Section):
    """[study]: settings of all runs, which cannot be swept."""

    name: vt.Name = key_field("name in reports and manifests", ..., otherwise="the file's stem")
    duration_s: vt.Seconds = key_field("length of a run, with passes and a stage of [coarse]", ...)
    # None only in a recorded study before its record is read, see `load.with_rate`.
    rate_hz: vt.Positive = key_field(
        "sensor sample rate. Required unless a record has time stamps, which it must match",
        cast(float, None),
        usual_range=(1e-3, 1e6),
    )
    record_interval_s: vt.Seconds = key_field(
        "interval of the record times for settling times, statistics and curves", 1.0
    )
    draws: Annotated[vt.Count, Field(ge=1)] | None = key_field(
        "Monte Carlo draws; the maximum with [stop_when]. A record has one per start time",
        in_simulation=64,
    )
    estimate: Literal["draws"] = key_field("how errors are found: 'draws', Monte Carlo", "draws")
    seed: int = key_field("random seed", 1, ge=0, lt=2**63)
    settle_bands_arcmin: vt.Bands = key_field(
        "half-widths of the heading bands for settling times", (60.0, 10.0, 3.0)
    )
    window_s: tuple[vt.NonNegative, vt.Positive] = key_field(
        "start and end of the window for error means and deviations",
        otherwise="the last third of the duration",
        default_factory=lambda given: (
            given.get("duration_s", 1.0) / 1.5,
            given.get("duration_s", 1.0),
        ),
        usual_range=(0, 1e8),
    )
    consistency_after_s: vt.SecondsOrZero = key_field(
        "time after which p_above_error_share and p_above_floor_error_share count", 10.0
    )
    steady_after_s: vt.SecondsOrZero = key_field(
        "time after which p_above_error_steady_share counts", 300.0
    )
    curves: bool = key_field("whether a sweep stores errors at record times in `curves/`", False)
    judged_from: Literal["truth", "floor"] | None = key_field(
        "reference for success: 'truth' (true north, or that of a record) or 'floor'",
        otherwise="'truth'",
    )
    success_band_arcmin: vt.Band | None = key_field(
        "largest final heading error of a successful run", otherwise=10.0
    )
    level_band_arcmin: vt.Band | None = key_field(
        "largest final level error of a successful run, without that of accelerometer biases",
        otherwise=10.0,
    )
    dwell_s: vt.SecondsOrZero | None = key_field(
        "uninterrupted final time in the heading band that success requires",
        otherwise="the smaller of 30 s and a tenth of the run",
    )
    diverged_deg: vt.AngleSigma | None = key_field(
        "final heading error from the bias floor (truth without one) above which an unsuccessful"
        " run diverged",
        otherwise=10.0,
    )
    report_times_s: vt.ReportTimes | None = key_field(
        "times of heading error, sigma and NEES in the summary, from the first sample",
        otherwise="none",
    )
    unchecked: bool | None = key_field(
        "whether to accept values outside their usual ranges", otherwise="false"
    )
    external: Annotated[tuple[vt.Name, ...], AfterValidator(require_unique)] | None = key_field(
        "programs whose results `sinsjax score` stored in the study's directory", otherwise="none"
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
            refused=True,
        ),
    )

    earth: Literal["constants", "wgs84"] = key_field(
        "'constants': sphere with constant gravity, the next three keys, valid only here. 'wgs84':"
        " ellipsoid with normal gravity",
        "constants",
    )
    gravity_m_per_s2: vt.Positive | None = key_field("gravity", default=9.8, usual_range=(9, 10.5))
    radius_m: vt.Positive | None = key_field(
        "radius of the sphere", default=6378137.0, usual_range=(6e6, 7e6)
    )
    earth_rate_deg_per_h: vt.Positive | None = key_field(
        "Earth rotation rate", default=15.041067, usual_range=(10, 20)
    )
    latitude_deg: vt.Elevation | None = key_field(
        "latitude, positive north. Required in a simulation, and if a record's header lacks it"
    )
    height_m: vt.Finite | None = key_field(
        "height above the ellipsoid or sphere",
        otherwise="that in the record's header, or 0",
        in_simulation=0.0,
        usual_range=(-12e3, 1e6),
    )


EARTH_CONSTANTS: dict[str, float] = {
    key: key_info(EarthSection.model_fields[key]).default for key in EarthSection.conditions[0].keys
}
"""Keys of [earth] that only ``earth = "constants"`` has, with their defaults."""


def _any_nonzero(*values: Any) -> bool:
    """Return whether any of some numbers, or lists of numbers, is not zero; a drawn one is None."""
    return any(value is None or np.any(value) for value in values)


TURN_KEYS = (
    *("turn_times_s", "turn_angles_deg", "turn_rate_deg_per_s", "turn_ramp_s"),
    *("turn_repeat_s", "turn_axis"),
)
"""Keys of turns of the base."""


_AMPLITUDES = ("pitch_amplitude_deg", "roll_amplitude_deg", "yaw_amplitude_deg")
_CENTERS = ("pitch_center_deg", "roll_center_deg", "yaw_center_deg")


def _rotates(turn_times_s: Any, attitude_file: Any, *amplitudes: Any) -> bool:
    return bool(turn_times_s or attitude_file) or _any_nonzero(*amplitudes)


def _error(acts_as: vt.Effect, largest: float, meaning: str) -> Any:
    """Return the field of a disturbance or an error, with the largest usual size of MEMS."""
    least = -largest if acts_as in ("bias", "distortion") else 0
    return key_field(meaning, 0.0, usual_range=(least, largest), acts_as=acts_as)


class MotionSection(Section):
    """[motion]: simulated motion; angles are center + amplitude sin(2 pi t / period + phase).

    The base sways about a point that may be a lever arm away from the sensors, and may be turned
    about an axis through it. Surge moves that point. Vibration moves the housing of the sensors and
    rotates it about that point: the true attitude of a run is that of the housing.
    """

    conditions = (
        KeyCondition(("pitch_period_s", "pitch_phase_deg"), _AMPLITUDES[:1], _any_nonzero),
        KeyCondition(("roll_period_s", "roll_phase_deg"), _AMPLITUDES[1:2], _any_nonzero),
        KeyCondition(("yaw_period_s", "yaw_phase_deg"), _AMPLITUDES[2:], _any_nonzero),
        KeyCondition(
            (*TURN_KEYS, *_AMPLITUDES, *_CENTERS),
            ("attitude_file",),
            lambda file: file is None,
            refused=True,
        ),
        KeyCondition(TURN_KEYS[1:], TURN_KEYS[:1], bool, refused=True),
        KeyCondition(
            ("lever_arm_m",),
            ("turn_times_s", "attitude_file", "vibration_deg_per_h_rms", *_AMPLITUDES),
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

    pitch_center_deg: vt.Elevation = key_field("mean pitch, positive front up", 0.0)
    pitch_amplitude_deg: vt.Amplitude = key_field("amplitude", 0.0)
    pitch_period_s: vt.Period = key_field("period", 10.0, otherwise="required with an amplitude")
    pitch_phase_deg: vt.Angle = key_field("phase", 0.0)
    roll_center_deg: vt.HalfTurn = key_field("mean roll, positive right side down", 0.0)
    roll_amplitude_deg: vt.Amplitude = key_field("amplitude", 0.0)
    roll_period_s: vt.Period = key_field("period", 10.0, otherwise="required with an amplitude")
    roll_phase_deg: vt.Angle = key_field("phase", 0.0)
    yaw_center_deg: vt.Angle | None = key_field(
        "mean yaw, counter-clockwise from north (minus heading). Required in a simulation without"
        " attitude_file"
    )
    yaw_amplitude_deg: vt.Amplitude = key_field("amplitude", 0.0)
    yaw_period_s: vt.Period = key_field("period", 10.0, otherwise="required with an amplitude")
    yaw_phase_deg: vt.Angle = key_field("phase", 0.0)
    lever_arm_m: vt.Vector = key_field(
        "lever arm (right, front, up) to the sensors from the centre of sway on the turn axis",
        0.0,
        usual_range=(-300, 300),
    )
    turn_times_s: vt.EventTimes | None = key_field(
        "start times of turns from the first sample, rounded to whole samples",
        otherwise="no turns",
        time="s",
    )
    turn_angles_deg: vt.Numbers | None = key_field(
        "turn angles, positive counter-clockwise from above, one or per turn; 1e6 for a carousel",
        otherwise=180.0,
        usual_range=(-1e8, 1e8),
    )
    turn_rate_deg_per_s: vt.Positive | None = key_field(
        "turn rate, adjusted to whole samples per turn", otherwise=10.0, usual_range=(1e-3, 3600)
    )
    turn_ramp_s: vt.Positive | None = key_field(
        "time to reach the turn rate, and to stop", otherwise=1.0, usual_range=(1e-3, 1e3)
    )
    turn_repeat_s: vt.Seconds | None = key_field(
        "interval at which turns repeat until the end", otherwise="no repetition"
    )
    turn_axis: Literal["vertical", "body"] | None = key_field(
        "'vertical': the vehicle turns. 'body': a turntable on it turns the sensors about z",
        otherwise="'vertical'",
    )
    attitude_file: vt.Name | None = key_field(
        "file instead of angles and turns: time_s, pitch_deg, roll_deg and yaw_deg or heading_deg,"
        " without noise, for cubic splines. Cannot be swept",
        otherwise="none",
    )
    surge_m_per_s: vt.NoisePerAxis = _error(
        "process", 10.0, "rms velocity of surge, random motion about a place, along east, north, up"
    )
    surge_time_s: vt.Period = key_field(
        "correlation time of the surge velocity", 5.0, acts_as="process_shape"
    )
    surge_bandwidth_hz: vt.Bandwidth = key_field(
        "surge bandwidth, which limits acceleration; only for 'third_order'",
        1.0,
        acts_as="process_shape",
    )
    surge_model: Literal["third_order", "gauss_markov"] = key_field(
        "'third_order': finite variances of position, velocity and acceleration. 'gauss_markov':"
        " first-order Gauss-Markov velocity; acceleration grows with sample rate",
        "third_order",
    )
    vibration_ug_rms: vt.NoisePerAxis = _error(
        "process", 1e7, "linear vibration of the sensors' housing along right, front, up"
    )
    vibration_deg_per_h_rms: vt.NoisePerAxis = _error(
        "process", 1e6, "angular vibration of the sensors' housing, whose attitude is the truth"
    )
    vibration_hz: vt.Bandwidth = key_field(
        "undamped natural frequency of vibration", 30.0, acts_as="process_shape"
    )
    vibration_damping: vt.Damping = key_field(
        "damping ratio of vibration", 0.05, acts_as="process_shape"
    )


_WHITE = "white noise sigma of one sample; alternative to the random walk"
_WALK = "angle or velocity random walk; alternative to the noise"
_INSTABILITY = (
    "rms bias instability, first-order Gauss-Markov; its Allan deviation is at most 0.617 of it"
)
_RATE_WALK = "rate or acceleration random walk, zero at the first sample"
_RESOLUTION = "resolution of angle or velocity output; remainders carry over to the next sample"
_CROSS_AXIS = (
    "axis misalignments xy, xz, yx, yz, zx, zy: xy is the fraction of the y input that sensor x"
    " senses"
)


class SensorsSection(Section):
    """[sensors]: errors of the simulated sensors; one number for all body axes, or one per axis."""

    conditions = (
        KeyCondition(("gyro_instability_time_s",), ("gyro_instability_deg_per_h",), _any_nonzero),
        KeyCondition(("accel_instability_time_s",), ("accel_instability_ug",), _any_nonzero),
    )

    gyro_bias_deg_per_h: vt.Vector = _error("bias", 1e5, "constant bias, measured minus true")
    gyro_noise_deg_per_h: vt.NoisePerAxis | None = key_field(
        _WHITE, otherwise="no noise", usual_range=(0, 1e5), acts_as="noise"
    )
    gyro_arw_deg_per_sqrt_h: vt.NoisePerAxis | None = key_field(
        _WALK, usual_range=(0, 3), acts_as="noise", alternative_to="gyro_noise_deg_per_h"
    )
    gyro_instability_deg_per_h: vt.NoisePerAxis = _error("process", 1e3, _INSTABILITY)
    gyro_instability_time_s: vt.Period = key_field(
        "correlation time of the bias instability", 300.0, acts_as="process_shape"
    )
    gyro_rrw_deg_per_h_per_sqrt_h: vt.NoisePerAxis = _error("process", 1e3, _RATE_WALK)
    gyro_quantisation_arcsec: vt.NoisePerAxis = _error("quantum", 1e3, _RESOLUTION)
    gyro_scale_ppm: vt.Vector = _error("distortion", 1e5, "scale factor error")
    gyro_misalignment_arcsec: vt.CrossAxis = _error("distortion", 1e5, _CROSS_AXIS)
    accel_bias_ug: vt.Vector = _error("bias", 5e5, "constant bias, measured minus true")
    accel_noise_ug: vt.NoisePerAxis | None = key_field(
        _WHITE, otherwise="no noise", usual_range=(0, 1e6), acts_as="noise"
    )
    accel_vrw_ug_per_sqrt_hz: vt.NoisePerAxis | None = key_field(
        _WALK, usual_range=(0, 5e3), acts_as="noise", alternative_to="accel_noise_ug"
    )
    accel_instability_ug: vt.NoisePerAxis = _error("process", 2e4, _INSTABILITY)
    accel_instability_time_s: vt.Period = key_field(
        "correlation time of the bias instability", 300.0, acts_as="process_shape"
    )
    accel_rrw_ug_per_sqrt_h: vt.NoisePerAxis = _error("process", 2e4, _RATE_WALK)
    accel_quantisation_um_per_s: vt.NoisePerAxis = _error("quantum", 1e5, _RESOLUTION)
    accel_scale_ppm: vt.Vector = _error("distortion", 1e5, "scale factor error")
    accel_misalignment_arcsec: vt.CrossAxis = _error("distortion", 1e5, _CROSS_AXIS)


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

    method: MethodName = key_field(f"see `sinsjax keys METHOD` ({_METHODS})", "kalman5")
    phi_e0_deg: vt.HalfTurn = key_field(f"initial misalignment about east; {_ROTATE}", 0.0)
    phi_n0_deg: vt.HalfTurn = key_field(f"initial misalignment about north; {_ROTATE}", 0.0)
    phi_u0_deg: vt.HalfTurn = key_field(
        f"initial misalignment about up, the heading error; {_ROTATE}", 0.0
    )
    misalignment: Literal["vector", "euler"] = key_field(
        "'vector': a rotation vector. 'euler': successive rotations about up, east and north",
        "vector",
    )
    ve0_m_per_s: vt.Speed = key_field(f"initial computed east velocity; {_AN_ERROR}", 0.0)
    vn0_m_per_s: vt.Speed = key_field(f"initial computed north velocity; {_AN_ERROR}", 0.0)
    position: Literal["fixed", "integrated"] = key_field(
        "'fixed': constant. 'integrated': latitude and longitude from computed velocity", "fixed"
    )
    specific_force: Literal["measured", "gravity"] | None = key_field(
        "specific force in the error model. 'measured': accelerometer output in the computed"
        " attitude. 'gravity': that of a base at rest",
        default="measured",
    )
    feedback_interval_s: vt.Seconds | None = key_field(
        "interval between feedbacks into the navigation solution",
        otherwise="one sample",
        whole="sample",
        time="s",
    )
    feedback_time_constant_s: vt.SecondsOrZero | None = key_field(
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

    stored_s: vt.Seconds | None = key_field(
        "length of the stored record. Without it a run reads all data once, forward", whole="record"
    )
    passes: Annotated[vt.Count, Field(ge=1)] | None = key_field(
        "number of passes", otherwise="set by `ending`"
    )
    ending: Literal["duration", "forward"] = key_field(
        "end of a run without `passes`. 'duration': duration_s, even within a pass. 'forward': the"
        " last complete forward pass within it",
        "duration",
    )
    turn: Literal["reflect", "velocity", "velocity_and_rate", "keep"] | None = key_field(
        "compass states that change sign at a reversal, with the levelling integrals. 'velocity':"
        " velocity, as in paper 2. 'reflect': velocity and tilt, so the loops continue their"
        " motion. 'velocity_and_rate': velocity and azimuth rate. 'keep': none",
        default="reflect",
    )
    turn_smoothing_s: vt.Seconds | None = key_field(
        "delay of the low-pass filter on specific force for the tilt of 'reflect'", default=5.0
    )
    turn_covariance: Literal["carried", "inflated", "reset"] | None = key_field(
        "P after a reversal. 'carried': unchanged. 'inflated': multiplied by turn_inflation."
        " 'reset': P0",
        default="carried",
    )
    turn_inflation: vt.Factor | None = key_field("factor on P with 'inflated'", default=10.0)


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

    coarse_method: Literal["inertial", "optimisation", "none"] = key_field(
        "'inertial': rotation of gravity in inertial space. 'optimisation': least squares of"
        " integrated velocities. 'none': only in a simulation",
        "inertial",
    )
    coarse_duration_s: vt.Seconds = key_field("duration", 60.0)
    coarse_then: Literal["hand_over", "replay"] | None = key_field(
        "'hand_over': the method starts with the data that follow. 'replay': with the first"
        " sample, from the coarse attitude propagated back",
        otherwise="'hand_over'",
    )


_ALWAYS = ("format", "from_s", "to_s", "start_s", "gyro_bias_deg_per_h", "accel_bias_ug", "trust")
_APPLYING_KEYS = {"psins": {*_ALWAYS, "axes_order"}, "arrays": {*_ALWAYS}}
"""Keys of [record] that apply to formats that fix columns and units."""

_USED_PART = "start and end of the used part, from the record's beginning"
_SCALE = "multiplier for all columns, or per column: one count in the unit, or -1"
_ACCEPTED = "largest bias that the check accepts"


class RecordSection(Section):
    """[record]: format, units and axes of an IMU record, and start times of the alignments."""

    format: Literal["psins", "csv", "parquet", "arrays"] = key_field(
        "'csv': text with a header line. 'parquet': Apache Parquet. 'psins': PSINS text. 'arrays':"
        " Python arrays. The last two fix columns and units, 'arrays' also axes",
        ...,
    )
    from_s: vt.SecondsOrZero | None = key_field(_USED_PART, otherwise="its beginning")
    to_s: vt.Seconds | None = key_field(_USED_PART, otherwise="its end")
    columns: vt.Columns | None = key_field(
        "column names of a text file without them",
        otherwise="those in the file, or column_1, column_2, ...",
    )
    skip_rows: vt.Count | None = key_field(
        "lines of a text file before its column names or samples", otherwise="0"
    )
    quantity: Literal["increments", "rates"] | None = key_field(
        "sensor columns: 'increments' (integrals over each sample) or 'rates' (means)",
        otherwise="by the units",
    )
    time_column: str | None = key_field(
        "column of time stamps, at the end of each sample. Without it rate_hz gives the times"
    )
    time_fraction_column: vt.Name | None = key_field(
        "column of the fraction of a second that time_column lacks, such as nsecs"
    )
    time_fraction_unit: Literal["ms", "us", "ns"] | None = key_field(
        "unit of time_fraction_column: 'ms', 'us' or 'ns'", otherwise="'ns'"
    )
    gyro_columns: vt.Triad | None = key_field("columns of the x, y, z sensors")
    accel_columns: vt.Triad | None = key_field("columns of the x, y, z sensors")
    gyro_unit: Literal["rad", "deg", "arcsec", "rad_per_s", "deg_per_s", "deg_per_h"] | None = (
        key_field(
            "unit of increments: 'rad', 'deg', 'arcsec'; of rates: 'rad_per_s', 'deg_per_s',"
            " 'deg_per_h'"
        )
    )
    accel_unit: Literal["m_per_s", "g_s", "ug_s", "m_per_s2", "g", "mg", "ug"] | None = key_field(
        "unit of increments: 'm_per_s', 'g_s', 'ug_s'; of rates: 'm_per_s2', 'g', 'mg', 'ug'"
    )
    gyro_scale: vt.Vector | None = key_field(_SCALE, otherwise="1", usual_range=(-1e6, 1e6))
    accel_scale: vt.Vector | None = key_field(_SCALE, otherwise="1", usual_range=(-1e6, 1e6))
    axes_order: str = key_field(
        "record axes that point right, front, up: 'y-xz'; or directions of x, y, z: 'rfu', 'frd'",
        "xyz",
    )
    time_unit: Literal["s", "ms", "us", "ns", "iso"] | None = key_field(
        "time stamps in 's', 'ms', 'us', 'ns', or 'iso' for dates with time",
        otherwise="'s'",
    )
    time_scale: vt.Factor | None = key_field("multiplier of the time stamps", otherwise="1")
    start_s: vt.Starts = key_field(
        "start times, coarse alignment included, one per draw, from the record's beginning",
        otherwise="from_s, else 0",
        default_factory=lambda given: (given.get("from_s") or 0.0,),
    )
    max_gap_s: vt.SecondsOrZero | None = key_field(
        "longest gap between good samples that is interpolated", otherwise="0"
    )
    gyro_bias_deg_per_h: vt.GyroNoise | None = key_field(
        _ACCEPTED, otherwise="10 or with low noise 4.5"
    )
    accel_bias_ug: vt.AccelNoise | None = key_field(_ACCEPTED, otherwise="5000")
    trust: bool | None = key_field(
        "whether to align despite errors that the check finds", otherwise="false"
    )

    @model_validator(mode="after")
    def _check_span_columns_and_units(self) -> "RecordSection":
        begin, end, names_columns = self.from_s or 0.0, self.to_s, self.format in ("csv", "parquet")
        if end is not None and end <= begin:
            raise rule_error(f"must be after from_s = {begin:g}, not {end:g}", key="to_s")
        if min(self.start_s) < begin:
            text = f"{min(self.start_s):g} s is before from_s = {begin:g} (start later)"
            raise rule_error(text, key="start_s")
        fields = type(self).model_fields
        applying = _APPLYING_KEYS.get(self.format, fields.keys() - {"columns", "skip_rows"})
        for key in fields if self.format != "csv" else ():
            if key not in applying and getattr(self, key) != fields[key].default:
                raise rule_error(f"does not apply to format '{self.format}' (drop it)", key=key)
        for key in ("gyro_columns", "accel_columns", "gyro_unit", "accel_unit"):
            if names_columns and getattr(self, key) is None:
                raise rule_error(f"required with format '{self.format}'", key=key)
        # `rules` checks whether a rate is needed.
        if self.format != "arrays":
            for key, text in find_faults(self.layout(rate_hz=1.0)):
                raise rule_error(shorten(text), key=key)
        for key, known in (("gyro_unit", GYRO_UNITS), ("accel_unit", ACCEL_UNITS)):
            if self.quantity is not None and getattr(self, key) not in known[self.quantity]:
                units = ", ".join(known[self.quantity])
                text = f"{getattr(self, key)!r} is not one of {units} for {self.quantity}"
                raise rule_error(f"{text} (drop quantity if the sensors differ)", key=key)
        return self

    def layout(self, rate_hz: float | None) -> RecordLayout:
        """Return the layout of the record in its file, with the rate of the study, if any."""
        given = {key: getattr(self, key, None) for key in RecordLayout._fields}
        for key in ("gyro_scale", "accel_scale"):
            if isinstance(given[key], float | int):
                given[key] = (given[key],) * 3
        given["rate_hz"] = rate_hz
        return RecordLayout(**{key: value for key, value in given.items() if value is not None})


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


class Distribution(Section):
    """Distribution of a drawn key; give exactly one of these keys.

    The entries of a list are values of the drawn key: for a vector one number or one per axis.
    """

    uniform: vt.IncreasingPair | None = key_field("[low, high]")
    normal: vt.Normal | None = key_field("[mean, standard deviation]")
    values: Annotated[tuple[Any, ...], Field(min_length=1)] | None = key_field(
        "one per draw, repeated from the first"
    )

    @model_validator(mode="after")
    def _check_kind(self) -> "Distribution":
        names = type(self).model_fields
        given = [name for name in names if getattr(self, name) is not None]
        if len(given) != 1:
            listed = " and ".join(given) or "none"
            raise rule_error(f"needs one of {', '.join(names)}, not {listed}")
        return self

    @property
    def rms(self) -> float:
        """Root mean square of its numbers, about zero; of the largest axis of lists."""
        if self.normal is not None:
            return float(np.hypot(*self.normal))
        if self.uniform is not None:
            low, high = self.uniform
            return float(np.sqrt((low * low + low * high + high * high) / 3))
        return float(np.sqrt(np.mean([np.max(np.square(entry)) for entry in self.values or ()])))

    @property
    def limits(self) -> tuple[float, float]:
        """Limits of its numbers; of a normal law those of 2^52 draws."""
        if self.normal is not None:
            mean, deviation = self.normal
            return mean - 8.3 * deviation, mean + 8.3 * deviation
        numbers = [number for v in self.uniform or self.values or () for number in np.ravel(v)]
        return float(min(numbers)), float(max(numbers))


class DrawnSection(Section):
    """[drawn]: keys with a random value per draw, shared by all variants."""

    model_config = ConfigDict(extra="allow")
    __pydantic_extra__: dict[str, Distribution] = Field(init=False)

    sampling: Literal["random", "sobol"] = key_field(
        "'random': independent numbers. 'sobol': scrambled Sobol points of all drawn keys together",
        "random",
    )

    @property
    def laws(self) -> dict[str, Distribution]:
        """The distribution of each drawn key, in the order of the file."""
        return self.__pydantic_extra__


class AdviseSection(Section):
    """[advise]: requirements for `sinsjax advise` only."""

    time_s: Annotated[vt.Seconds, Field(ge=10, le=7200, multiple_of=1)] = key_field(
        "available alignment time: whole seconds, 10 to 7200", 300.0
    )
    wanted_deg: vt.AngleSigma | None = key_field(
        "heading error that 95 % of alignments must not exceed"
    )


class StopWhenSection(Section):
    """[stop_when]: precision at which a study stops before its last draw."""

    statistic: vt.Name = key_field(
        "'success_rate', or 'settle_B_s_mean', the mean settling time into B arcmin; both follow"
        " judged_from",
        ...,
    )
    half_width: vt.Positive = key_field(
        "half-width of its 95 % interval, in the variant where it is widest, that ends the study:"
        " a fraction for 'success_rate', else s",
        ...,
    )


Some = Annotated[vt.Count, Field(ge=1)]
Searches = Annotated[
    tuple[Literal["grid", "sobol", "gradient"], ...],
    Field(min_length=1),
    AfterValidator(require_unique),
]


End = TypeVar("End", bound=vt.Finite)
Value = TypeVar("Value")


class Range(Section, Generic[End, Value]):
    """Range of a tuned key: low and high, or fixed, or candidates."""

    low: End | None = key_field("ends of the range")
    high: End | None = key_field("ends of the range")
    scale: Literal["linear", "log"] | None = key_field(
        "spacing of the values: 'linear', or 'log' for equal ratios",
        otherwise="'linear'",
        default_factory=lambda given: None if given.get("low") is None else "linear",
    )
    fixed: Value | None = key_field("single value")
    candidates: Annotated[tuple[Value, ...], Field(min_length=1)] | None = key_field("values tried")

    @model_validator(mode="after")
    def _check_bounds_fixed_or_candidates(self) -> "Range[End, Value]":
        names = ("low", "high", "fixed", "candidates")
        given = [name for name in names if getattr(self, name) is not None]
        if given not in (["low", "high"], ["fixed"], ["candidates"]):
            listed = " and ".join(given) or "none"
            raise rule_error(f"needs low and high, or fixed, or candidates, not {listed}")
        if len({*(self.candidates or ())}) < len(self.candidates or ()):
            raise rule_error("repeats a value (drop one)", key="candidates")
        if self.low is None or self.high is None:
            if self.scale is not None:
                raise rule_error("requires low and high", key="scale")
        elif isinstance(self.low, int):
            raise rule_error("must be whole numbers (list them as candidates)")
        elif not self.low < self.high:
            text = f"must be above low = {self.low:.12g}, not {self.high:.12g}"
            raise rule_error(text, key="high")
        elif self.scale == "log" and self.low <= 0:
            raise rule_error(f"'log' needs low > 0, not {self.low:.12g}", key="scale")
        return self

    @property
    def is_free(self) -> bool:
        """Return whether it is an interval to be searched."""
        return self.low is not None


class TuneSection(Section):
    """[tune]: objective, variables and searches of `sinsjax tune`."""

    objective: Literal["settle_mean", "settle_quantile", "final_error", "failure_rate"] = key_field(
        "'settle_mean': mean settling time, unsettled runs counting with their length."
        " 'settle_quantile': its quantile. 'final_error': rms final heading error. 'failure_rate':"
        " fraction of unsettled runs",
        "settle_mean",
    )
    objective_band_arcmin: vt.Band = key_field(
        "heading band: one of settle_bands_arcmin, or the success band", 10.0
    )
    objective_quantile: Annotated[float, Field(gt=0, lt=1)] = key_field(
        "quantile for 'settle_quantile'", 0.9
    )
    objective_across: Literal["mean", "worst"] = key_field(
        "objective over several variants: 'mean' or 'worst'", "mean"
    )
    searches: Searches = key_field(
        "'grid', 'sobol': points in the ranges. 'gradient': descents. If reset times are tuned,"
        " each also evaluates the reset law's schedule",
        ("grid", "gradient"),
    )
    tune_draws: Some | None = key_field(
        "draws for searches; in a recorded study every second start time",
        in_simulation=16,
    )
    evaluation_draws: Some | None = key_field(
        "other draws, to compare the best points; in a recorded study the other start times",
        in_simulation=64,
    )
    grid_points: Annotated[vt.Count, Field(ge=2)] = key_field(
        "points per variable of a 'grid' search; at most two variables", 15
    )
    sobol_points: Some = key_field("points of a 'sobol' search per combination of candidates", 256)
    descent_screen: Some = key_field(
        "Sobol points evaluated before the descents, which start from the best", 16
    )
    descent_starts: Some = key_field("parallel descents", 4)
    descent_steps: Some = key_field("steps of a descent", 16)
    descent_draws: Some = key_field("new draws per step", 4)
    descent_rate: vt.Positive = key_field("Adam learning rate, in lengths of the ranges", 0.1)
    relaxed_window_s: tuple[vt.Seconds, vt.Seconds] = key_field(
        "half-widths of smooth reset windows at the first and last step", (4.0, 1.0)
    )
    relaxed_sharpness: tuple[vt.Positive, vt.Positive] = key_field(
        "sharpness of the smooth heading band edge at the first and last step", (6.0, 16.0)
    )
    variables: dict[str, Range | tuple[Range, ...]] = key_field(
        "tuned keys with their ranges, the table [tune.variables]", ...
    )
    baseline: dict[str, Any] = key_field(
        "values to compare with, the table [tune.baseline]", {}, otherwise="the study's"
    )
