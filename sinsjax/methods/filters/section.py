"""[filter] and [resets]: P0, Q and R of the zero-velocity filters, and resets of P."""

from collections.abc import Sequence
from itertools import combinations
from typing import Annotated, Any, Literal

from pydantic import Field

from sinsjax.methods.description import CheckedStudy
from sinsjax.methods.triggers.config import TriggerKeys, has_trigger
from sinsjax.value_types import (
    ROUNDING,
    AccelNoise,
    AccelSigma,
    AngleSigma,
    Band,
    Count,
    Factor,
    GyroNoise,
    GyroSigma,
    GyroWalk,
    HeadingSigma,
    KeyCondition,
    KeyInfo,
    Positive,
    Seconds,
    Section,
    SpeedSigma,
    Times,
)

Q_DENSITIES = {
    "q_accel_ug": {"q_accel_ug_per_sqrt_hz": 1.0},
    "q_gyro_deg_per_h": {"q_gyro_deg_per_h_per_sqrt_hz": 1.0, "q_gyro_arw_deg_per_sqrt_h": 60.0},
}
"""Keys of Q as noise densities, with their factors to the key in front, under ``psd``."""

WHITE_NOISE = {
    "q_accel_ug": ("accel_noise_ug", "accel_vrw_ug_per_sqrt_hz", 1.0),
    "q_gyro_deg_per_h": ("gyro_noise_deg_per_h", "gyro_arw_deg_per_sqrt_h", 60.0),
}
"""Keys of [sensors] for omitted keys of Q: white noise as the standard deviation of a sample and as
a density, and the factor of the density to the unit of Q."""

OF_R = ("r_velocity_m_per_s", "r_reading", "r_scale")
OF_SURGE = ("surge_m_per_s", "surge_time_s")
"""Keys of R, and of the surge that an omitted R follows, in the order of `update_variance`."""

OF_SCHEDULES = ("reset_times_s", "reset_count", "reset_cycle_s", "reset_first_s")
"""Keys of the times of scheduled resets, in the order of `scheduled_reset_times`."""

OF_RESETS = (*OF_SCHEDULES, "reset_at_feedback", "feedback_interval_s")
"""Keys of the times at which resets act, in the order of `acting_reset_times`."""


_DEFAULT_R = 0.1
"""r_velocity_m_per_s on a base without surge."""


class FilterSection(Section):
    """[filter]: covariance P0, process noise Q (required with a record), measurement noise R."""

    exclusive = tuple(
        pair for key, forms in Q_DENSITIES.items() for pair in combinations((key, *forms), 2)
    )

    p0_velocity_m_per_s: SpeedSigma = Field(
        0.1, description="initial sigma of east and north velocity or level errors, m/s"
    )
    p0_level_deg: AngleSigma = Field(
        15.0, description="initial sigma of east and north velocity or level errors, deg"
    )
    p0_yaw_deg: HeadingSigma = Field(80.0, description="initial sigma of heading, deg")
    p0_gyro_bias_deg_per_h: GyroSigma = Field(0.1, description="initial sigma of biases, deg/h")
    p0_accel_bias_ug: AccelSigma = Field(500.0, description="initial sigma of biases, ug")
    q_accel_ug: AccelNoise | None = Field(
        None,
        description="process noise of velocity errors (accel) or misalignments (gyro), ug; per"
        " sqrt(Hz) with q_reading = 'psd'; default: that of [sensors]",
    )
    q_gyro_deg_per_h: GyroNoise | None = Field(
        None,
        description="process noise of velocity errors (accel) or misalignments (gyro), deg/h; per"
        " sqrt(Hz) with q_reading = 'psd'; default: that of [sensors]",
    )
    q_accel_ug_per_sqrt_hz: AccelNoise | None = Field(
        None,
        description="process noise density, ug/sqrt(Hz); alternative with q_reading = 'psd'",
    )
    q_gyro_deg_per_h_per_sqrt_hz: GyroNoise | None = Field(
        None,
        description="process noise density, deg/h/sqrt(Hz); alternative with q_reading = 'psd'",
    )
    q_gyro_arw_deg_per_sqrt_h: GyroWalk | None = Field(
        None,
        description="angle random walk, deg/sqrt(h), a sixtieth of the number in"
        " deg/h/sqrt(Hz); alternative to q_gyro_deg_per_h with q_reading = 'psd'",
    )
    q_reading: Literal["psd", "per_sample", "per_step"] | None = Field(
        None,
        description="units of the q_ keys, required with them. 'psd': data sheet densities."
        " 'per_sample': sigma of one sample. 'per_step': sigma added per filter step, as"
        " in paper 1; at 100 Hz a hundred times that of 'per_sample'",
    )
    r_velocity_m_per_s: Annotated[SpeedSigma | None, KeyInfo(same_as=_DEFAULT_R)] = Field(
        None,
        description="sigma r of the zero-velocity measurement, m/s; per sqrt(Hz) with r_reading ="
        " 'psd'. If omitted, methods without [surge] add the surge density 2 s^2 T, s"
        " the larger of surge_m_per_s east and north, T surge_time_s; default: 0.1",
    )
    r_reading: Literal["per_update", "psd"] = Field(
        "per_update",
        description="'per_update': the variance R of an update is r squared. 'psd': r squared /"
        " sample time",
    )
    q_scale: Annotated[Factor | None, KeyInfo(same_as=1.0)] = Field(
        None, description="factor on the variance Q or R; default 1"
    )
    r_scale: Annotated[Factor | None, KeyInfo(same_as=1.0)] = Field(
        None, description="factor on the variance Q or R; default 1"
    )


def q_unit_factors(dt: float) -> dict[str, float]:
    """Return the factor from a squared q_ key to Q of a step of dt s, per word of ``q_reading``."""
    return {"per_step": 1.0, "psd": dt, "per_sample": dt * dt}


def sensor_noise_density(q_key: str, rate_hz: float, per_sample: Any, density: Any) -> float | None:
    """Return the density of the sensors' white noise, in the unit of a key of Q under 'psd'.

    It is that of the noisiest axis; None if the study gives no noise, or draws it.

    Args:
        q_key: key of `WHITE_NOISE`.
        rate_hz: samples per second.
        per_sample: value of the key for the standard deviation of a sample.
        density: value of the key for the density.
    """
    if density is not None:
        return _noisiest_axis(density) * WHITE_NOISE[q_key][2]
    return None if per_sample is None else _noisiest_axis(per_sample) / rate_hz**0.5


def _noisiest_axis(noise: float | tuple[float, ...]) -> float:
    return max(noise) if isinstance(noise, tuple) else noise


def level_surge(surge: Any) -> float:
    """Return the larger rms velocity of the surge along east and north, m/s.

    Args:
        surge: value of surge_m_per_s, of all axes or along east, north, up; None for no surge.
    """
    axes = surge[:2] if isinstance(surge, tuple | list) else (surge or 0.0,)
    return max(abs(float(value)) for value in axes)


def surge_density(surge: Any, time_s: float | None) -> float:
    """Return the largest spectral density of the surge velocity, two-sided, m^2/s.

    2 s^2 T: that of a first-order Gauss-Markov velocity at zero frequency, and of a 'third_order'
    one at 1/(2 pi T) Hz. The latter falls to zero at both ends, since its position is bounded; a
    bandwidth B raises it by a factor of 1 + b/(1 + b^2), b = 2 pi B T, which is left out.

    Args:
        surge: rms velocity s of all axes or along east, north, up, m/s; the larger one along east
            and north counts. None for a base of unknown surge, which has 0.
        time_s: correlation time T, s; None as for ``surge``.
    """
    if surge is None or time_s is None:
        return 0.0
    rms = level_surge(surge)
    return 2 * rms * rms * time_s


def update_variance(
    rate_hz: float,
    velocity: float | None,
    reading: str,
    scale: float | None,
    surge: Any = None,
    time_s: float | None = None,
) -> float:
    """Return the variance R of an update, (m/s)^2, from the keys of `OF_R` and `OF_SURGE`.

    Args:
        rate_hz: samples per second.
        velocity: r_velocity_m_per_s; None for the default, which follows the surge.
        reading: r_reading.
        scale: r_scale; None for 1.
        surge: see `surge_density`.
        time_s: see `surge_density`.
    """
    dt = 1 / rate_hz
    sigma = _DEFAULT_R if velocity is None else velocity
    variance = sigma * sigma / (dt if reading == "psd" else 1.0)
    if velocity is None:
        variance += surge_density(surge, time_s) / dt
    return variance * (1.0 if scale is None else scale)


_RESETS = ("reset_times_s", "reset_count", "reset_trigger")
"""Keys that determine whether P is reset at all."""

_SET_BY_FULL = (
    "reset_velocity_m_per_s",
    "reset_level_deg",
    "reset_gyro_bias_deg_per_h",
    "reset_accel_bias_ug",
)


def _is_reset(times: Sequence[float] | None, count: int | None, trigger: str | None) -> bool:
    return bool(times or count or has_trigger(trigger))


def _scales_covariance(kind: str, *schedule: Any) -> bool:
    return kind == "scale" and _is_reset(*schedule)


def _sets_heading_variance(kind: str, *schedule: Any) -> bool:
    return kind != "scale" and _is_reset(*schedule)


def _sets_all_variances(kind: str, *schedule: Any) -> bool:
    return kind == "full" and _is_reset(*schedule)


def _moves_feedback(at_feedback: bool, *schedule: Any) -> bool:
    return not at_feedback and _is_reset(*schedule)


def _needs_cycle(count: int | None, first_s: float | None) -> bool:
    return (count or 0) > (0 if first_s is None else 1)


class ResetsSection(TriggerKeys):
    """[resets]: resets of the covariance P."""

    exclusive = tuple(("reset_times_s", key) for key in OF_SCHEDULES[1:])
    conditions = (
        *TriggerKeys.conditions,
        KeyCondition(
            ("heading_bound_deg", "settle_band_arcmin"), ("schedule",), lambda name: name == "law"
        ),
        KeyCondition(("reset_first_s",), ("reset_count",), bool),
        KeyCondition(("reset_cycle_s",), ("reset_count", "reset_first_s"), _needs_cycle),
        KeyCondition(("reset_kind", "reset_at_feedback"), _RESETS, _is_reset),
        KeyCondition(
            ("reset_restarts_feedback",), ("reset_at_feedback", *_RESETS), _moves_feedback
        ),
        KeyCondition(("reset_scale",), ("reset_kind", *_RESETS), _scales_covariance),
        KeyCondition(("reset_yaw_deg",), ("reset_kind", *_RESETS), _sets_heading_variance),
        KeyCondition(_SET_BY_FULL, ("reset_kind", *_RESETS), _sets_all_variances),
    )

    schedule: Literal["times", "none", "law", "trigger"] = Field(
        "times",
        description="'times': reset_times_s or reset_count, and reset_trigger. 'none': no resets."
        " 'law': from Q, R, P0, latitude, feedback, sensors and surge, see"
        " the page reset_law. 'trigger': reset_trigger alone, by default 'linearisation'"
        " with threshold 1.2",
    )
    heading_bound_deg: Annotated[Positive, Field(lt=180), KeyInfo(usual_range=(1, 180))] = Field(
        150.0, description="largest initial heading error that 'law' settles, deg"
    )
    settle_band_arcmin: Band = Field(
        10.0, description="heading error to which 'law' settles, arcmin"
    )
    reset_count: Annotated[Count | None, KeyInfo(default=0)] = Field(
        None, description="number of scheduled resets; default 0"
    )
    reset_cycle_s: Seconds | None = Field(
        None,
        description="interval of reset_count resets, s; not needed for one at reset_first_s",
    )
    reset_first_s: Seconds | None = Field(
        None, description="time of the first of reset_count resets, s; default: the cycle"
    )
    reset_times_s: Annotated[Times | None, KeyInfo(whole="sample", merged=True)] = Field(
        None, description="times of scheduled resets, s; alternative to reset_count"
    )
    reset_at_feedback: bool = Field(
        False, description="whether a reset waits for the next feedback"
    )
    reset_restarts_feedback: bool = Field(
        False, description="whether a reset starts a feedback interval"
    )
    reset_kind: Literal["full", "yaw", "scale"] = Field(
        "full",
        description="'full': variances become the values below, covariances zero. 'yaw': the same"
        " for heading only. 'scale': P is multiplied by reset_scale",
    )
    reset_scale: Factor = Field(10.0, description="factor on P with 'scale'")
    reset_velocity_m_per_s: Annotated[SpeedSigma | None, KeyInfo(same_as="p0_velocity_m_per_s")] = (
        Field(
            None,
            description="sigma of velocity errors after a reset, m/s; default: P0, at least 1"
            " m/s with 'law'",
        )
    )
    reset_level_deg: Annotated[AngleSigma | None, KeyInfo(same_as="p0_level_deg")] = Field(
        None,
        description="sigma of level errors after a reset, deg; default: P0",
    )
    reset_yaw_deg: Annotated[HeadingSigma | None, KeyInfo(same_as="p0_yaw_deg")] = Field(
        None, description="sigma of heading after a reset, deg; default: P0"
    )
    reset_gyro_bias_deg_per_h: Annotated[
        GyroSigma | None, KeyInfo(same_as="p0_gyro_bias_deg_per_h")
    ] = Field(None, description="sigma of biases after a reset, deg/h; default: P0")
    reset_accel_bias_ug: Annotated[AccelSigma | None, KeyInfo(same_as="p0_accel_bias_ug")] = Field(
        None,
        description="sigma of biases after a reset, ug; default: P0",
    )


def counted_reset_times(
    count: int, cycle_s: float | None, first_s: float | None
) -> tuple[float, ...]:
    """Return the times of counted resets, s.

    Args:
        count: number of resets.
        cycle_s: time between two resets; not needed for a single one with ``first_s``.
        first_s: time of the first reset; None for resets at the multiples of the cycle.
    """
    if first_s is None:
        return tuple((i + 1) * (cycle_s or 0.0) for i in range(count))
    return tuple(first_s + i * (cycle_s or 0.0) for i in range(count))


def scheduled_reset_times(
    times_s: tuple[float, ...] | None,
    count: int | None,
    cycle_s: float | None,
    first_s: float | None,
) -> tuple[float, ...]:
    """Return the times of scheduled resets as the study gives or counts them, s."""
    return counted_reset_times(count or 0, cycle_s, first_s) if times_s is None else tuple(times_s)


def acting_reset_times(rate_hz: float, *values: Any) -> tuple[float, ...]:
    """Return the times at which scheduled resets act, s; two may wait for the same feedback.

    Args:
        rate_hz: samples per second.
        values: values of the keys of `OF_RESETS`.
    """
    *schedule, at_feedback, interval_s = values
    times = scheduled_reset_times(*schedule)
    if not at_feedback:
        return times
    every = round(interval_s * rate_hz)
    return tuple(-(-round(time * rate_hz) // every) * every / rate_hz for time in times)


def check_resets(study: CheckedStudy) -> None:
    """Refuse resets after the end, at the start, or two at one sample."""
    points = [*study.combinations(*OF_RESETS, "schedule")] if study.has("resets") else []
    names = sorted({point["schedule"] for point in points})
    for key in OF_SCHEDULES if names and "times" not in names else ():
        if any(point[key] for point in study.given_combinations(key)):
            shown = " and ".join(map(repr, names))
            study.refuse(key, f"has no effect with schedule = {shown} (drop one of the two)")
    for point in points:
        times, count, cycle, first = (point[key] for key in OF_SCHEDULES)
        if times is not None:
            _check_reset_times(
                study, times, "schedule" if point["schedule"] == "law" else "reset_times_s"
            )
        elif count:
            _check_counted_resets(study, count, cycle, first)
        if point["reset_at_feedback"]:
            _check_delayed_resets(study, [point[key] for key in OF_RESETS])


def _check_delayed_resets(study: CheckedStudy, values: Sequence[Any]) -> None:
    """Refuse a reset that waits for a feedback after the end."""
    written = scheduled_reset_times(*values[: len(OF_SCHEDULES)])
    for time, later in zip(written, acting_reset_times(study.rate_hz, *values), strict=True):
        if later > study.run_s * (1 + ROUNDING):
            text = f"delays the reset at {time:.12g} s to the feedback at {later:.12g} s"
            study.refuse("reset_at_feedback", f"{text}, after the end of the run ({study.end})")


def _check_reset_times(
    study: CheckedStudy, times: tuple[float, ...], key: str = "reset_times_s"
) -> None:
    """Refuse given reset times after the end, at the start, or two at one sample."""
    rate = study.rate_hz
    earlier, taken = 0.0, 0
    for time in times:
        if time > study.run_s * (1 + ROUNDING):
            study.refuse(key, f"{time:.12g} s is after the end of the run ({study.end})")
        sample = round(time * rate)
        if sample == taken:
            other = f"the reset at {earlier:.12g} s" if taken else "the start"
            text = f"{time:.12g} s is at the sample of {other} (a sample is {1 / rate:.12g} s)"
            study.refuse(key, text)
        earlier, taken = time, sample


def _check_counted_resets(
    study: CheckedStudy, count: int, cycle: float | None, first: float | None
) -> None:
    """Refuse counted resets after the end, at the start, or two at one sample."""
    alone = 0 if first is None else 1  # resets that need no cycle
    if cycle is None and count > alone:
        study.refuse("reset_cycle_s", f"required with reset_count > {alone} (it is {count})")
    if first is not None:
        _check_reset_times(study, (first,), key="reset_first_s")
    if cycle is None or count <= alone:
        return
    rate = study.rate_hz
    begin, last = ("", count * cycle)
    if first is not None:
        begin, last = f" from {first:.12g} s", first + (count - 1) * cycle
    if last > study.run_s * (1 + ROUNDING):
        key = "reset_cycle_s" if study.place("reset_count") == "[resets]" else "reset_count"
        text = f"{count} resets{begin} every {cycle:.12g} s take {last:.12g} s"
        study.refuse(key, f"{text}, longer than the run ({study.end})")
    if cycle * rate < 1 - ROUNDING:
        text = f"{cycle:.12g} s is shorter than a sample of {1 / rate:.12g} s"
        study.refuse("reset_cycle_s", text)
    if first is not None and cycle * rate < 2:
        # Halves are rounded to even: both 1.5 and 2.5 samples become 2.
        samples = [round(time * rate) for time in counted_reset_times(count, cycle, first)]
        if len(set(samples)) < count:
            text = f"{first:.12g} s and a cycle of {cycle:.12g} s put two resets at one sample"
            study.refuse("reset_first_s", f"{text} (a sample is {1 / rate:.12g} s)")
