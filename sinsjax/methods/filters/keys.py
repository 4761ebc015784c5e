"""The keys of filters that measure zero velocity: [filter] and [resets], their rules and columns.

P0, Q and R of each kind of state; resets of P, by a schedule or a trigger. `params` makes numbers
of them.
"""

from collections.abc import Mapping, Sequence
from functools import partial
from operator import attrgetter
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray
from pydantic import Field

from sinsjax import value_types as vt
from sinsjax.columns import column
from sinsjax.methods.method import Method, OwnColumn, StudyKeys
from sinsjax.types import Scalar
from sinsjax.units import si_factor
from sinsjax.value_types import ROUNDING, KeyCondition, Section, key_field, keys_of

_DEFAULT_R = 0.1
"""r_velocity_m_per_s on a base without surge."""


class FilterSection(Section):
    """[filter]: covariance P0, process noise Q (required with a record), measurement noise R."""

    p0_velocity_m_per_s: vt.SpeedSigma = key_field(
        "initial sigma of east and north velocity errors", 0.1
    )
    p0_level_deg: vt.AngleSigma = key_field("initial sigma of level errors, east and north", 15.0)
    p0_yaw_deg: vt.HeadingSigma = key_field("initial sigma of heading", 80.0)
    p0_gyro_bias_deg_per_h: vt.GyroSigma = key_field("initial sigma of each gyro's bias", 0.1)
    p0_accel_bias_ug: vt.AccelSigma = key_field(
        "initial sigma of each level accelerometer's bias", 500.0
    )
    q_accel_ug: vt.AccelNoise | None = key_field(
        "process noise of velocity errors; per sqrt(Hz) with q_reading = 'psd'",
        otherwise="that of the accelerometers in [sensors]",
    )
    q_gyro_deg_per_h: vt.GyroNoise | None = key_field(
        "process noise of misalignments; per sqrt(Hz) with q_reading = 'psd'",
        otherwise="that of the gyros in [sensors]",
    )
    q_accel_ug_per_sqrt_hz: vt.AccelNoise | None = key_field(
        "process noise density of velocity errors; alternative to q_accel_ug with q_reading ="
        " 'psd'",
        alternative_to="q_accel_ug",
    )
    q_gyro_deg_per_h_per_sqrt_hz: vt.GyroNoise | None = key_field(
        "process noise density of misalignments; alternative to q_gyro_deg_per_h with q_reading ="
        " 'psd'",
        alternative_to="q_gyro_deg_per_h",
    )
    q_gyro_arw_deg_per_sqrt_h: vt.GyroWalk | None = key_field(
        "angle random walk, a sixtieth of the number in deg/h/sqrt(Hz); alternative to"
        " q_gyro_deg_per_h with q_reading = 'psd'",
        alternative_to="q_gyro_deg_per_h",
    )
    q_reading: Literal["psd", "per_sample", "per_step"] | None = key_field(
        "units of the q_ keys, required with them. 'psd': data sheet densities. 'per_sample':"
        " sigma of one sample. 'per_step': sigma added per filter step, as in paper 1; at 100 Hz a"
        " hundred times that of 'per_sample'"
    )
    r_velocity_m_per_s: vt.SpeedSigma | None = key_field(
        "sigma r of the zero-velocity measurement; per sqrt(Hz) with r_reading = 'psd'. If"
        " omitted, methods without [surge] add the surge density 2 s^2 T, s the larger of"
        " surge_m_per_s east and north, T surge_time_s",
        same_as=_DEFAULT_R,
    )
    r_reading: Literal["per_update", "psd"] = key_field(
        "'per_update': the variance R of an update is r squared. 'psd': r squared / sample time",
        "per_update",
    )
    q_scale: vt.Factor | None = key_field("factor on the variance Q", same_as=1.0)
    r_scale: vt.Factor | None = key_field("factor on the variance R", same_as=1.0)


# Q and R


def q_unit_factors(dt: float) -> dict[str, float]:
    """Return the factor from a squared q_ key to Q of a step of dt s, per word of ``q_reading``."""
    return {"per_step": 1.0, "psd": dt, "per_sample": dt * dt}


class ProcessNoise(NamedTuple):
    """A quantity of Q, and the sensors whose white noise it is."""

    key: str  # key of its first form
    sensors: str  # in words
    white: tuple[str, str]  # keys of their noise in [sensors], as that of a sample and as a density

    @property
    def forms(self) -> Mapping[str, float]:
        """Its keys, with their factors to the unit of the first."""
        return FilterSection.alternatives(self.key)

    def white_density(self, rate_hz: float, values: Mapping[str, Any]) -> float:
        """Return the density of the sensors' white noise, 0 for none or if it is drawn."""
        return self.density(rate_hz, *(values[key] for key in self.white)) or 0.0

    def q(self, rate_hz: float, values: Mapping[str, Any]) -> float:
        """Return the density of the noise that Q states, by default the sensors' own, squared."""
        scale = values["q_scale"] or 1.0
        for form, factor in self.forms.items():
            if values[form] is not None:
                # A study without a reading is refused, by a rule that comes after its schedules.
                per_step = q_unit_factors(1 / rate_hz)[values["q_reading"] or "psd"]
                return (values[form] * factor) ** 2 * per_step * rate_hz * scale
        return self.white_density(rate_hz, values) ** 2 * scale

    def density(self, rate_hz: float, per_sample: Any, density: Any) -> float | None:
        """Return the density of the noisiest sensor, in the unit of ``key`` under 'psd'.

        None if the study gives neither of the values of ``white``, or draws them.
        """
        noise = per_sample if density is None else density
        if noise is None:
            return None
        noisiest = max(noise) if isinstance(noise, tuple) else noise
        if density is None:
            return noisiest / rate_hz**0.5
        return noisiest * (si_factor(self.white[1]) / si_factor(self.key))


ACCEL_NOISE = ProcessNoise(
    "q_accel_ug", "accelerometers", ("accel_noise_ug", "accel_vrw_ug_per_sqrt_hz")
)
GYRO_NOISE = ProcessNoise(
    "q_gyro_deg_per_h", "gyros", ("gyro_noise_deg_per_h", "gyro_arw_deg_per_sqrt_h")
)


class StateKind(NamedTuple):
    """A kind of filter state."""

    # Of its keys after ``p0_`` and ``reset_``, standard deviations at the start and after a
    # reset; None if ``variance`` gives both
    name: str | None
    q: ProcessNoise | None  # its process noise; None of a constant state
    variance: float = 0.0
    sign: float = 1.0  # factor on it when time is reversed
    is_heading: bool = False  # whether it is a state of heading


VELOCITY = StateKind("velocity_m_per_s", ACCEL_NOISE, sign=-1.0)
LEVEL = StateKind("level_deg", GYRO_NOISE)
HEADING = StateKind("yaw_deg", GYRO_NOISE, is_heading=True)
DIRECTION = StateKind(None, GYRO_NOISE, variance=0.5, is_heading=True)
"""Sine or cosine of an unknown heading: all headings are equally likely."""
ACCEL_BIAS = StateKind("accel_bias_ug", None)
GYRO_BIAS = StateKind("gyro_bias_deg_per_h", None, sign=-1.0)
FIVE_STATES = (VELOCITY, VELOCITY, LEVEL, LEVEL, HEADING)
"""Those of [P1] eq. (1)."""


def level_surge(surge: Any) -> float:
    """Return the larger rms velocity of the surge along east and north, m/s; 0 without a surge."""
    axes = surge[:2] if isinstance(surge, tuple | list) else (surge or 0.0,)
    return max(abs(float(value)) for value in axes)


def peak_velocity_density(surge_m_per_s: Any, surge_time_s: float | None) -> float:
    """Return the largest spectral density of the surge velocity, two-sided, m^2/s.

    2 s^2 T: that of a first-order Gauss-Markov velocity at zero frequency, and of a 'third_order'
    one at 1/(2 pi T) Hz. The latter falls to zero at both ends, since its position is bounded; a
    bandwidth B raises it by a factor of 1 + b/(1 + b^2), b = 2 pi B T, which is left out. T is the
    correlation time, s the larger rms velocity along east and north; a base of unknown surge has 0.
    """
    if surge_m_per_s is None or surge_time_s is None:
        return 0.0
    rms = level_surge(surge_m_per_s)
    return 2 * rms * rms * surge_time_s


def update_variance(
    rate_hz: float,
    r_velocity_m_per_s: Scalar | None,
    r_reading: str,
    r_scale: Scalar | None,
    surge_m_per_s: Any = None,
    surge_time_s: float | None = None,
) -> Scalar:
    """Return the variance R of an update, (m/s)^2, from the keys; the default follows the surge."""
    dt = 1 / rate_hz
    sigma = _DEFAULT_R if r_velocity_m_per_s is None else r_velocity_m_per_s
    variance = sigma * sigma / (dt if r_reading == "psd" else 1.0)
    if r_velocity_m_per_s is None:
        variance += peak_velocity_density(surge_m_per_s, surge_time_s) / dt
    return variance * (1.0 if r_scale is None else r_scale)


# Resets


def has_trigger(name: str | None) -> bool:
    """Return whether a value of ``reset_trigger`` names a trigger."""
    return name not in (None, "none")


_RESETS = ("reset_times_s", "reset_count", "reset_trigger")
"""Keys that decide whether P is reset at all, in the order of `_has_resets`."""


def _has_resets(times: Sequence[float] | None, count: int | None, trigger: str | None) -> bool:
    return bool(times or count or has_trigger(trigger))


def _with_resets(key: str, values: Sequence[Any], *keys: str) -> KeyCondition:
    """Return the condition that P is reset and ``key`` has one of some values."""
    return KeyCondition(
        keys, (key, *_RESETS), lambda value, *resets: value in values and _has_resets(*resets)
    )


TRIGGER_KEYS = (
    *("trigger_threshold", "trigger_window_s", "trigger_refractory_s"),
    *("trigger_most", "trigger_until_s"),
)
"""Keys of a trigger."""


class ResetsSection(Section):
    """[resets]: resets of the covariance P."""

    exclusive = tuple(
        ("reset_times_s", key) for key in ("reset_count", "reset_cycle_s", "reset_first_s")
    )
    conditions = (
        KeyCondition(TRIGGER_KEYS, ("reset_trigger",), has_trigger),
        KeyCondition(
            ("heading_bound_deg", "settle_band_arcmin"), ("schedule",), lambda name: name == "law"
        ),
        KeyCondition(("reset_first_s",), ("reset_count",), bool),
        KeyCondition(
            ("reset_cycle_s",),
            ("reset_count", "reset_first_s"),
            lambda count, first_s: (count or 0) > (first_s is not None),
        ),
        KeyCondition(("reset_kind", "reset_at_feedback"), _RESETS, _has_resets),
        KeyCondition(
            ("reset_restarts_feedback",),
            ("reset_at_feedback", *_RESETS),
            lambda waits, *resets: _has_resets(*resets) and (not waits or has_trigger(resets[2])),
        ),
        _with_resets("reset_kind", ("scale",), "reset_scale"),
        _with_resets("reset_kind", ("full", "yaw"), "reset_yaw_deg"),
        _with_resets("reset_kind", ("full",), "reset_velocity_m_per_s", "reset_level_deg"),
        _with_resets("reset_kind", ("full",), "reset_gyro_bias_deg_per_h", "reset_accel_bias_ug"),
    )

    reset_trigger: Literal["none", "innovation", "linearisation"] | None = key_field(
        "score that triggers a reset above trigger_threshold, in addition to the schedule, or"
        " 'none'. 'innovation': normalised squared sum of innovations in a window. 'linearisation':"
        " heading knowledge in excess of a base at rest",
        otherwise="'none'",
    )
    trigger_threshold: vt.NonNegative | None = key_field(
        "score above which P is reset; required with a trigger"
    )
    trigger_window_s: vt.Seconds | None = key_field(
        "window of 'innovation'", default=10.0, beside="reset_trigger"
    )
    trigger_refractory_s: vt.SecondsOrZero | None = key_field(
        "shortest time from start or any reset to a triggered reset",
        default=5.0,
        beside="reset_trigger",
        time="s",
    )
    trigger_most: Annotated[vt.Count, Field(ge=1)] | None = key_field(
        "most triggered resets per run", default=10, beside="reset_trigger"
    )
    trigger_until_s: vt.Seconds | None = key_field(
        "end of triggered resets", otherwise="no limit", time="s"
    )
    schedule: Literal["times", "none", "law", "trigger"] = key_field(
        "'times': reset_times_s or reset_count, and reset_trigger. 'none': no resets. 'law': from"
        " Q, R, P0, latitude, feedback, sensors and surge, see the page reset_law. 'trigger':"
        " reset_trigger alone, by default 'linearisation' with threshold 1.2",
        "times",
    )
    heading_bound_deg: Annotated[vt.Positive, Field(lt=180)] = key_field(
        "largest initial heading error that 'law' settles", 150.0, usual_range=(1, 180)
    )
    settle_band_arcmin: vt.Band = key_field("heading error to which 'law' settles", 10.0)
    reset_count: vt.Count | None = key_field("number of scheduled resets", default=0)
    reset_cycle_s: vt.Seconds | None = key_field(
        "interval of reset_count resets; not needed for one at reset_first_s"
    )
    reset_first_s: vt.Seconds | None = key_field(
        "time of the first of reset_count resets", otherwise="the cycle"
    )
    reset_times_s: vt.Times | None = key_field(
        "times of scheduled resets; alternative to reset_count", whole="sample"
    )
    reset_at_feedback: bool = key_field("whether a scheduled reset waits for feedback", False)
    reset_restarts_feedback: bool = key_field("whether a reset starts a feedback interval", False)
    reset_kind: Literal["full", "yaw", "scale"] = key_field(
        "'full': variances become the values below, covariances zero. 'yaw': the same for heading"
        " only. 'scale': P is multiplied by reset_scale",
        "full",
    )
    reset_scale: vt.Factor = key_field("factor on P with 'scale'", 10.0)
    reset_velocity_m_per_s: vt.SpeedSigma | None = key_field(
        "sigma of velocity errors after a reset",
        otherwise="P0, at least 1 m/s with 'law'",
        same_as="p0_velocity_m_per_s",
    )
    reset_level_deg: vt.AngleSigma | None = key_field(
        "sigma of level errors after a reset", otherwise="P0", same_as="p0_level_deg"
    )
    reset_yaw_deg: vt.HeadingSigma | None = key_field(
        "sigma of heading after a reset", otherwise="P0", same_as="p0_yaw_deg"
    )
    reset_gyro_bias_deg_per_h: vt.GyroSigma | None = key_field(
        "sigma of each gyro's bias after a reset", otherwise="P0", same_as="p0_gyro_bias_deg_per_h"
    )
    reset_accel_bias_ug: vt.AccelSigma | None = key_field(
        "sigma of each accelerometer's bias after a reset",
        otherwise="P0",
        same_as="p0_accel_bias_ug",
    )


def scheduled_reset_times(
    reset_times_s: tuple[Scalar, ...] | None,
    reset_count: int | None,
    reset_cycle_s: Scalar | None,
    reset_first_s: Scalar | None,
) -> tuple[Scalar, ...]:
    """Return the times of scheduled resets as the study gives or counts them, s."""
    if reset_times_s is not None:
        return tuple(reset_times_s)
    numbers, cycle = range(reset_count or 0), 0.0 if reset_cycle_s is None else reset_cycle_s
    if reset_first_s is None:
        return tuple((i + 1) * cycle for i in numbers)
    return tuple(reset_first_s + i * cycle for i in numbers)


def acting_reset_times(
    rate_hz: float,
    reset_times_s: tuple[Scalar, ...] | None,
    reset_count: int | None,
    reset_cycle_s: Scalar | None,
    reset_first_s: Scalar | None,
    reset_at_feedback: bool,
    feedback_interval_s: Scalar,
) -> tuple[Scalar, ...]:
    """Return the times at which scheduled resets act, s; two may wait for the same feedback."""
    times = scheduled_reset_times(reset_times_s, reset_count, reset_cycle_s, reset_first_s)
    if not reset_at_feedback:
        return times
    every = round(feedback_interval_s * rate_hz)
    return tuple(-(-round(time * rate_hz) // every) * every / rate_hz for time in times)


SCHEDULE_KEYS = keys_of(scheduled_reset_times)
"""Keys of the times of scheduled resets."""

RESET_KEYS = keys_of(acting_reset_times)
"""Keys of the times at which resets act."""


def any_trigger(study: StudyKeys) -> bool:
    """Return whether some variant of a study has a trigger."""
    points = study.combinations("reset_trigger") if study.has("resets") else ()
    return any(has_trigger(point["reset_trigger"]) for point in points)


def reset_key_without_gradient(study: StudyKeys, *, smoothed: bool) -> str | None:
    """Return the first setting of resets without a gradient, as ``[section] key``; or None.

    Smoothed, each reset is spread over a window.
    """
    if any_trigger(study):
        return "[resets] reset_trigger"
    if not smoothed or not study.has("resets"):
        return None
    if any(point["reset_kind"] == "scale" for point in study.combinations("reset_kind")):
        return "[resets] reset_kind = 'scale'"
    for key in ("reset_at_feedback", "reset_restarts_feedback"):
        if any(point[key] for point in study.combinations(key)):
            return f"[resets] {key}"
    return None


# Rules


def check_reset_times_and_schedules(study: StudyKeys) -> None:
    """Refuse resets after the end, at the start, or two at one sample."""
    points = [*study.combinations(*RESET_KEYS, "schedule")] if study.has("resets") else []
    names = sorted({point["schedule"] for point in points})
    for key in SCHEDULE_KEYS if names and "times" not in names else ():
        if any(point[key] for point in study.given_combinations(key)):
            shown = " and ".join(map(repr, names))
            study.refuse(key, f"has no effect with schedule = {shown} (drop one of the two)")
    for point in points:
        _refuse_late_or_colliding_resets(study, point)


def _refuse_late_or_colliding_resets(study: StudyKeys, point: Mapping[str, Any]) -> None:
    times_s, count, cycle, first = (point[key] for key in SCHEDULE_KEYS)
    rate, end_s = study.rate_hz, study.run_s * (1 + ROUNDING)
    late = colliding = "schedule" if point["schedule"] == "law" else "reset_times_s"
    if times_s is None:
        if cycle is None and (count or 0) > (first is not None):
            study.refuse("reset_cycle_s", f"required with reset_count = {count}")
        if (count or 0) > end_s * rate:
            study.refuse("reset_count", f"{count} resets are more than the samples of the run")
        late = "reset_cycle_s" if study.given_in("reset_count") == "[resets]" else "reset_count"
        late = late if cycle else "reset_first_s"
        colliding = "reset_cycle_s" if first is None else "reset_first_s"
    taken = {0: "the start"}
    for time in scheduled_reset_times(times_s, count, cycle, first):
        if time > end_s:
            text = f"the reset at {time:.12g} s is after the end of the run ({study.end})"
            study.refuse(late, text)
        reset = f"the reset at {time:.12g} s"
        if (other := taken.setdefault(round(time * rate), reset)) is not reset:
            text = f"{reset} is at the sample of {other} (a sample is {1 / rate:.12g} s)"
            study.refuse(colliding, text)
    last = max(acting_reset_times(rate, *(point[key] for key in RESET_KEYS)), default=0)
    if last > end_s:
        text = f"delays a reset to the feedback at {last:.12g} s, after the end of the run"
        study.refuse("reset_at_feedback", f"{text} ({study.end})")


# Columns, and what all filters have


def _trigger_column(which: str, results: Any, rate_hz: float) -> NDArray:
    """Return the number of resets by a trigger, or the time of one, s; NaN for none."""
    counts = results.trigger_counts
    number = np.asarray(0.0 if counts is None else getattr(counts, which))
    return number if which == "count" else np.where(number > 0, number / rate_hz, np.nan)


FILTER_COLUMNS = (
    OwnColumn(
        column("triggered_count", "resets that the trigger called for", pa.int64()),
        partial(_trigger_column, "count"),
        missing=0.0,
        applies_to=any_trigger,
    ),
    *(
        OwnColumn(
            column(f"triggered_{which}_s", f"time of the {which} of them; null for none"),
            partial(_trigger_column, which),
            applies_to=any_trigger,
        )
        for which in ("first", "last")
    ),
    OwnColumn(
        column("innovation_nis", "mean r' S^-1 r of the filter's velocity innovations r"),
        lambda results, rate_hz: np.asarray(results.innovations.sum / results.innovations.count),
        applies_to=attrgetter("is_recorded"),
    ),
    OwnColumn(
        column("innovation_freedom", "degrees of freedom of their sum: 2 an update"),
        lambda results, rate_hz: 2 * np.asarray(results.innovations.count),
        applies_to=attrgetter("is_recorded"),
    ),
)
"""Columns of triggers, and of innovations in a recorded study (a simulation has the truth to be
judged by); an innovation_nis of 2 is expected of a consistent filter."""


def last_triggered_sample(results: Any) -> NDArray | None:
    """Return the sample of the last reset by a trigger, (runs,), 0 for none; None without one."""
    counts = getattr(results, "trigger_counts", None)
    return None if counts is None else np.asarray(counts.last)


BIAS_KEYS = (
    *("p0_gyro_bias_deg_per_h", "p0_accel_bias_ug"),
    *("reset_gyro_bias_deg_per_h", "reset_accel_bias_ug"),
)
"""The keys of sensor bias states: without effect on a filter that has none."""


def estimates_biases(method: Method) -> bool:
    """Return whether a filter has states of sensor biases."""
    return not {*BIAS_KEYS} <= {*method.without_effect}
