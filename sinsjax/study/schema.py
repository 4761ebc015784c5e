"""The sections of a study file: one frozen model each, one field a key, the unit in its name.

Values stay in the file's units; leaf keys are unique over all sections, so that a key alone names
an axis and a result column. Rules that hold inside one section live here, those between sections in
`rules`. The sections of methods come with them, see `alignment.methods`.
"""

from typing import Annotated, Any, Literal, cast, get_args, get_origin

import numpy as np
from pydantic import AfterValidator, ConfigDict, Field, field_validator, model_validator

from sinsjax.messages import shortened
from sinsjax.records.layout import Layout, axes, fault
from sinsjax.value_types import (
    AccelNoise,
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
    GyroNoise,
    HalfTurn,
    IncreasingPair,
    KeyInfo,
    Name,
    NoisePerAxis,
    NonNegative,
    Normal,
    Period,
    Positive,
    ReportTimes,
    Seconds,
    SecondsOrZero,
    Section,
    Starts,
    Triad,
    Vector,
    invalid,
    unique,
)


class StudySection(Section):
    """[study]: what all runs of a study share; never an axis."""

    name: Name = Field(description="the study's name; default: the file's stem")
    duration_s: Seconds = Field(description="length of the fine alignment, s")
    # None only in a recorded study whose record is yet to be read, see `load.with_rate`.
    rate_hz: Annotated[Positive, KeyInfo(usual=(1e-3, 1e6))] = Field(
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
    window_s: Annotated[tuple[NonNegative, Positive], KeyInfo(usual=(0, 1e8))] = Field(
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
    gravity_m_per_s2: Annotated[Positive, KeyInfo(usual=(9, 10.5))] | None = Field(
        None, description="gravity, m/s^2; constants only, default 9.8"
    )
    radius_m: Annotated[Positive, KeyInfo(usual=(6e6, 7e6))] | None = Field(
        None, description="radius, m; constants only, default 6378137"
    )
    earth_rate_deg_per_h: Annotated[Positive, KeyInfo(usual=(10, 20))] | None = Field(
        None, description="rotation rate, deg/h; constants only, default 15.041067"
    )
    latitude_deg: Elevation | None = Field(
        None, description="latitude, deg; a recorded study may take it from the record"
    )
    height_m: Annotated[Finite, KeyInfo(usual=(-12e3, 1e6))] | None = Field(
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
    lever_arm_m: Annotated[Vector, KeyInfo(usual=(-1e3, 1e3))] = Field(
        0.0, description="from the centre of the sway to the sensors, right, front and up, m"
    )
    surge_m_per_s: Annotated[NoisePerAxis, KeyInfo(usual=(0, 100))] = Field(
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
    vibration_ug_rms: Annotated[NoisePerAxis, KeyInfo(usual=(0, 1e8))] = Field(
        0.0, description="vibration of the box, specific force along body axes, ug rms"
    )
    vibration_deg_per_h_rms: Annotated[NoisePerAxis, KeyInfo(usual=(0, 1e8))] = Field(
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

    gyro_bias_deg_per_h: Annotated[Vector, KeyInfo(usual=(-1e5, 1e5))] = Field(
        0.0, description="gyro bias, deg/h"
    )
    gyro_noise_deg_per_h: Annotated[NoisePerAxis, KeyInfo(usual=(0, 1e6))] | None = Field(
        None, description="gyro white noise, standard deviation of a sample, deg/h"
    )
    gyro_arw_deg_per_sqrt_h: Annotated[NoisePerAxis, KeyInfo(usual=(0, 1e4))] | None = Field(
        None, description="gyro angle random walk, deg/sqrt(h)"
    )
    gyro_instability_deg_per_h: Annotated[NoisePerAxis, KeyInfo(usual=(0, 1e4))] = Field(
        0.0,
        description="gyro bias instability, rms of a first-order Gauss-Markov bias, deg/h;"
        " its Allan deviation is at most 0.617 of it",
    )
    gyro_instability_time_s: Period = Field(
        300.0, description="correlation time of the gyro bias instability, s"
    )
    gyro_rrw_deg_per_h_per_sqrt_h: Annotated[NoisePerAxis, KeyInfo(usual=(0, 1e4))] = Field(
        0.0, description="gyro rate random walk, deg/h/sqrt(h)"
    )
    gyro_quantisation_arcsec: Annotated[NoisePerAxis, KeyInfo(usual=(0, 1e4))] = Field(
        0.0, description="quantum of the angle that a gyro puts out, arcsec"
    )
    gyro_scale_ppm: Annotated[Vector, KeyInfo(usual=(-1e6, 1e6))] = Field(
        0.0, description="gyro scale factor error, ppm"
    )
    gyro_misalignment_arcsec: Annotated[CrossAxis, KeyInfo(usual=(-1e5, 1e5))] = Field(
        0.0, description="gyro cross-axis angles xy, xz, yx, yz, zx, zy, arcsec"
    )
    accel_bias_ug: Annotated[Vector, KeyInfo(usual=(-1e6, 1e6))] = Field(
        0.0, description="accelerometer bias, ug"
    )
    accel_noise_ug: Annotated[NoisePerAxis, KeyInfo(usual=(0, 1e7))] | None = Field(
        None, description="accelerometer white noise, standard deviation of a sample, ug"
    )
    accel_vrw_ug_per_sqrt_hz: Annotated[NoisePerAxis, KeyInfo(usual=(0, 1e7))] | None = Field(
        None, description="accelerometer velocity random walk, ug/sqrt(Hz)"
    )
    accel_instability_ug: Annotated[NoisePerAxis, KeyInfo(usual=(0, 1e6))] = Field(
        0.0,
        description="accelerometer bias instability, rms of a first-order Gauss-Markov bias, ug",
    )
    accel_instability_time_s: Period = Field(
        300.0, description="correlation time of the accelerometer bias instability, s"
    )
    accel_rrw_ug_per_sqrt_h: Annotated[NoisePerAxis, KeyInfo(usual=(0, 1e6))] = Field(
        0.0, description="accelerometer acceleration random walk, ug/sqrt(h)"
    )
    accel_quantisation_um_per_s: Annotated[NoisePerAxis, KeyInfo(usual=(0, 1e6))] = Field(
        0.0, description="quantum of the velocity that an accelerometer puts out, um/s"
    )
    accel_scale_ppm: Annotated[Vector, KeyInfo(usual=(-1e6, 1e6))] = Field(
        0.0, description="accelerometer scale factor error, ppm"
    )
    accel_misalignment_arcsec: Annotated[CrossAxis, KeyInfo(usual=(-1e5, 1e5))] = Field(
        0.0, description="accelerometer cross-axis angles xy, xz, yx, yz, zx, zy, arcsec"
    )


def _axes_order(order: str) -> str:
    """Refuses what no turn of the box gives."""
    try:
        axes(order)
    except ValueError as error:
        raise invalid(shortened(str(error))) from None
    return order


class RecordSection(Section):
    """[record]: how to read an IMU record, and where in it the draws start."""

    format: Literal["psins", "csv", "parquet", "arrays"] = Field(
        description="file format, or 'arrays' from Python"
    )
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
        "xyz",
        description="the record's axes that point right, front and up, such as 'y-xz', or where its"
        " x, y and z point: 'rfu', 'frd', 'flu'",
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
        if self.format in ("psins", "arrays"):
            told = [
                key
                for key in (*needed, "time_column", "max_gap_s")
                if getattr(self, key) is not None
            ]
            if self.format == "arrays" and self.axes_order != "xyz":
                told.append("axes_order")
            why = "which fixes it" if self.format == "psins" else "which come with it"
            for key in told:
                raise invalid(f"does not apply to format '{self.format}', {why}", key=key)
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


INITIAL_NUMBERS = ("phi_e0_deg", "phi_n0_deg", "phi_u0_deg", "ve0_m_per_s", "vn0_m_per_s")
"""The keys of [alignment] that may be drawn; in a recorded study no others may."""

BIAS_KEYS = ("gyro_bias_deg_per_h", "accel_bias_ug")
"""The keys of the constant sensor biases."""


def _longest_list(annotation: Any) -> int:
    """The longest list that a type takes, 1 if it takes none; 0 of what is no number."""
    if annotation is str or get_origin(annotation) is Literal:
        return 0
    if get_origin(annotation) is tuple:
        return len(get_args(annotation))
    return max(map(_longest_list, get_args(annotation)), default=1)


NUMBERS_DRAWN = {
    "latitude_deg": 1,
    **{
        key: numbers
        for section in (MotionSection, SensorsSection)
        for key, field in section.model_fields.items()
        if (numbers := _longest_list(field.annotation))
    },
    **dict.fromkeys(INITIAL_NUMBERS, 1),
}
"""Every key that may be drawn and its numbers a draw: one, or one for each axis of a vector."""

ListEntries = Annotated[tuple[Any, ...], Field(min_length=1)]


class Distribution(Section):
    """How the values of a key are drawn; exactly one of the fields is given.

    The entries of a list are values of the key: for a vector one number or one for each axis.
    """

    uniform: IncreasingPair | None = Field(None, description="evenly between [low, high]")
    normal: Normal | None = Field(None, description="normally, with [mean, standard deviation]")
    values: ListEntries | None = Field(None, description="one entry a draw, from the first again")
    grid: ListEntries | None = Field(
        None, description="one point a draw of the product of all grids, the last key fastest"
    )


def is_normal(key: str, law: Distribution) -> bool:
    """Whether a key adds normal numbers to what runs begin with, or to constant biases."""
    return law.normal is not None and key in (*INITIAL_NUMBERS, *BIAS_KEYS)


class DrawnSection(Section):
    """[drawn]: one value a draw, common to all variants of the draw."""

    model_config = ConfigDict(extra="allow")
    __pydantic_extra__: dict[str, Distribution] = Field(init=False)

    sampling: Literal["random", "sobol"] = Field(
        "random", description="uniform and normal numbers: independent, or scrambled Sobol points"
    )

    @property
    def laws(self) -> dict[str, Distribution]:
        """How every drawn key is drawn, in the order written."""
        return self.__pydantic_extra__


class StopWhenSection(Section):
    """[stop_when]: drawing goes on until a statistic is known well in every variant."""

    statistic: Name = Field(
        description="'success_rate', or the mean settling time 'settle_B_s_mean' of a band of B',"
        " from the truth or the bias floor as judged_from says"
    )
    half_width: Positive = Field(
        description="of its 95 % interval in the variant where it is widest: a share, or s"
    )


Some = Annotated[Count, Field(ge=1)]
Searches = Annotated[
    tuple[Literal["grid", "sobol", "random", "gradient", "covariance"], ...],
    Field(min_length=1),
    AfterValidator(unique),
]


class Range(Section):
    """What a variable may be: between two ends, or one value, or one of some.

    Exactly one of these is given; ``scale`` requires low and high.
    """

    low: Finite | None = Field(None, description="least value")
    high: Finite | None = Field(None, description="greatest value")
    scale: Literal["linear", "log"] | None = Field(
        None, description="how it is gone through from low to high; default 'linear'"
    )
    fixed: Any = Field(None, description="the one value, which is not searched")
    candidates: ListEntries | None = Field(None, description="values that are tried one by one")

    @model_validator(mode="after")
    def _one_of_three(self) -> "Range":
        names = ("low", "high", "fixed", "candidates")
        given = [name for name in names if getattr(self, name) is not None]
        if given not in (["low", "high"], ["fixed"], ["candidates"]):
            told = " and ".join(given) or "none"
            raise invalid(f"needs low and high, or fixed, or candidates, not {told}")
        if self.low is None or self.high is None:
            if self.scale is not None:
                raise invalid("requires low and high", key="scale")
            return self
        if not self.low < self.high:
            raise invalid(f"must be above low = {self.low:.12g}, not {self.high:.12g}", key="high")
        if self.scale == "log" and self.low <= 0:
            raise invalid(f"'log' needs low > 0, not {self.low:.12g}", key="scale")
        return self

    @property
    def is_free(self) -> bool:
        """Whether it has two ends to search between."""
        return self.low is not None


class TuneSection(Section):
    """[tune]: an objective, the variables that it is tuned by, and how they are searched."""

    objective: Literal["settle_mean", "settle_quantile", "final_error", "failure_rate"] = Field(
        "settle_mean", description="what is made as small as it can be"
    )
    objective_band_arcmin: Band = Field(
        10.0, description="band of settling times and failures, arcmin; one of the study's"
    )
    objective_quantile: Annotated[float, Field(gt=0, lt=1)] = Field(
        0.9, description="of the settling time, for 'settle_quantile'"
    )
    objective_across: Literal["mean", "worst"] = Field(
        "mean", description="what of the objectives of all variants"
    )
    searches: Searches = Field(("grid", "gradient"), description="searches, in this order")
    tune_draws: Some | None = Field(
        None,
        description="draws that tune; default 16. In a recorded study every other start time does",
    )
    evaluation_draws: Some | None = Field(
        None, description="draws that judge what was found; default 64. Recorded: the other starts"
    )
    grid_points: Annotated[Count, Field(ge=2)] = Field(
        15, description="points a variable of a grid, of up to two variables"
    )
    sobol_points: Some = Field(256, description="points of a Sobol or random search")
    descent_screen: Some = Field(
        16,
        description="points looked at first, on `descent_draws` draws or by covariance analysis;"
        " the best are begun at",
    )
    descent_starts: Some = Field(4, description="descents side by side")
    descent_steps: Some = Field(16, description="steps of a descent")
    descent_draws: Some = Field(
        4,
        description="draws a step and descent, in turn; none where all variables leave resets where"
        " they are and covariance analysis holds, which then stands for draws",
    )
    descent_rate: Positive = Field(0.1, description="rate of Adam, all ranges being one long")
    relaxed_window_s: tuple[Seconds, Seconds] = Field(
        (4.0, 1.0),
        description="half width of relaxed resets at the first and last step, s; only where a"
        " variable moves resets",
    )
    relaxed_sharpness: tuple[Positive, Positive] = Field(
        (6.0, 16.0), description="sharpness of the band's relaxed edge at the first and last step"
    )
    evolution_screen: Some = Field(
        64, description="Sobol points looked at first by 'covariance'; the best is begun at"
    )
    evolution_steps: Some = Field(12, description="generations")
    feedback_phases: Some = Field(
        4,
        description="shifts of the reset times within a feedback interval that 'covariance' "
        "averages over; 1 leaves them as they are",
    )
    variables: dict[str, Range | tuple[Range, ...]] = Field(
        description="what may change: [tune.variables] with a range a key"
    )
    baseline: dict[str, Any] = Field(
        default={}, description="what to stand beside; default: the study's own values"
    )
