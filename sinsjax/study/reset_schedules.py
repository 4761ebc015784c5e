"""Reset schedules that a study names, variant by variant: none, by the law, or by a trigger."""

import math
from collections.abc import Callable, Mapping
from functools import lru_cache
from typing import Any, NamedTuple

from sinsjax.errors import InputError
from sinsjax.methods import reset_law
from sinsjax.methods.filters.keys import (
    ACCEL_NOISE,
    GYRO_NOISE,
    SCHEDULE_KEYS,
    peak_velocity_density,
    update_variance,
)
from sinsjax.methods.registry import METHODS
from sinsjax.methods.reset_law import NoSchedule, ResetProblem, ResetSchedule
from sinsjax.units import ARCMIN, DEG, DEG_PER_H, micro_g
from sinsjax.value_types import keys_of

LAW_METHODS = ("kalman5",)
"""Methods for which cells of `docs/reset_law.md` show that the law holds."""

_EARTH = ("earth", "gravity_m_per_s2", "earth_rate_deg_per_h", "latitude_deg")
_NOISE = (*ACCEL_NOISE.white, *GYRO_NOISE.white)
NOISE_KEYS = (*_EARTH, *_NOISE)
"""Keys that `noise_heading_sigma` follows from."""

_FILTER = (
    *(*ACCEL_NOISE.forms, *GYRO_NOISE.forms),
    *("q_reading", "q_scale", *keys_of(update_variance)),
    *("p0_velocity_m_per_s", "p0_level_deg", "p0_yaw_deg", "reset_kind"),
    *("reset_velocity_m_per_s", "reset_level_deg", "reset_yaw_deg"),
)
_LOOP = ("method", "specific_force", "feedback_interval_s")
_BOUNDS = ("schedule", "heading_bound_deg", "settle_band_arcmin")
LAW_KEYS = (*NOISE_KEYS, *_FILTER, *_LOOP, *_BOUNDS)
"""Keys that the times of the law follow from."""

_ONE_VALUE = {"latitude_deg": "earth"} | dict.fromkeys(
    ("p0_velocity_m_per_s", "p0_level_deg", "p0_yaw_deg"), "filter"
)
"""Keys that the law cannot do without, and that are None if they are drawn or in a record."""

_DEFAULT_TRIGGER = {
    "reset_trigger": "linearisation",
    "trigger_threshold": 1.2,
    "trigger_window_s": 10.0,
    "trigger_refractory_s": 2.0,
    "trigger_most": 20,
}
"""The trigger of schedule = 'trigger' for keys that are left out."""

OPEN_VELOCITY = 1.0
"""Standard deviation of velocity after a reset by the law, unless it is given, m/s: with less, P
shrinks before a large heading error has turned (`methods.reset_law`)."""

_VELOCITY = "reset_velocity_m_per_s"

DERIVED = (*SCHEDULE_KEYS, *_DEFAULT_TRIGGER, _VELOCITY)
"""Keys whose values `schedule` decides."""


def expand_named_schedule(rate_hz: float, point: Mapping[str, Any]) -> dict[str, Any]:
    """Return the values of `DERIVED` at a point of a study.

    The point has the values of `LAW_KEYS` and `DERIVED`, None for a key that does not apply. If the
    law has no schedule there, an `InputError` begins ``[section] key``.
    """
    given, schedule = {key: point[key] for key in DERIVED}, point["schedule"]
    if schedule not in ("none", "law", "trigger"):
        return given
    values = given | dict.fromkeys(SCHEDULE_KEYS)
    if schedule == "trigger":
        is_default = given["reset_trigger"] in (None, "none")
        default = _DEFAULT_TRIGGER if is_default else {}
        return values | {key: default[key] for key in default if given[key] in (None, "none")}
    values["reset_trigger"] = "none" if given["reset_trigger"] else None
    if schedule == "law":
        found = schedule_by_law(rate_hz, point)
        times = None if found is None else found.times_s or None
        values |= {"reset_times_s": times, _VELOCITY: _reset_velocity(point)}
    return values


def schedule_by_law(rate_hz: float, point: Mapping[str, Any]) -> ResetSchedule | None:
    """Return the schedule of a point by the law; None for a method without resets."""
    if "resets" not in METHODS[point["method"]].sections:
        return None
    if point["method"] not in LAW_METHODS:
        raise InputError(
            f"[resets] schedule: 'law' holds for {', '.join(LAW_METHODS)}, not {point['method']} "
            "(give 'trigger' or reset_times_s)"
        )
    if point["reset_kind"] not in (None, "full"):
        raise InputError("[resets] reset_kind: schedule = 'law' needs 'full' resets (drop it)")
    bound, band = point["heading_bound_deg"] * DEG, point["settle_band_arcmin"] * ARCMIN
    try:
        found = _cached_schedule(reset_problem(rate_hz, point), bound, band)
    except NoSchedule as error:
        raise InputError(f"[resets] schedule: {error}") from None
    times = tuple(round(time * rate_hz) / rate_hz for time in found.times_s)
    return found._replace(times_s=times)


_cached_schedule: Callable[..., ResetSchedule] = lru_cache(maxsize=4096)(reset_law.schedule)


def noise_heading_sigma(rate_hz: float, time_s: float, point: Mapping[str, Any]) -> float:
    """Return the sigma of heading that the sensors' white noise leaves after a time, rad."""
    place = _read_place(point)
    accel = (ACCEL_NOISE.white_density(rate_hz, point) * place.ug) ** 2
    gyro = (GYRO_NOISE.white_density(rate_hz, point) * DEG_PER_H) ** 2
    return float(reset_law.noise_sigma(time_s, place.gravity, place.north_rate, accel, gyro))


def reset_problem(rate_hz: float, point: Mapping[str, Any]) -> ResetProblem:
    """Return the filter of a point and its place, as the law sees them."""
    for key, section in _ONE_VALUE.items():
        if point[key] is None:
            raise InputError(f"[resets] schedule: 'law' needs one {key} (give it in [{section}])")
    place = _read_place(point)
    r = update_variance(rate_hz, *(point[key] for key in keys_of(update_variance)))
    return ResetProblem(
        velocity_noise=ACCEL_NOISE.q(rate_hz, point) * place.ug**2,
        measurement_noise=r / rate_hz,
        velocity=_reset_velocity(point),
        level=(point["reset_level_deg"] or point["p0_level_deg"]) * DEG,
        heading=(point["reset_yaw_deg"] or point["p0_yaw_deg"]) * DEG,
        north_rate=place.north_rate,
        gravity=place.gravity,
        feedback_s=point["feedback_interval_s"],
        is_force_measured=point["specific_force"] == "measured",
        accel_noise=(ACCEL_NOISE.white_density(rate_hz, point) * place.ug) ** 2,
        gyro_noise=(GYRO_NOISE.white_density(rate_hz, point) * DEG_PER_H) ** 2,
        tilt_noise=GYRO_NOISE.q(rate_hz, point) * DEG_PER_H**2,
        surge=peak_velocity_density(*(point[key] for key in keys_of(peak_velocity_density))),
    )


def _reset_velocity(point: Mapping[str, Any]) -> float:
    """Return the standard deviation of velocity after a reset, m/s."""
    given, initial = point[_VELOCITY], point["p0_velocity_m_per_s"]
    if given is None and point["schedule"] == "law":
        return max(OPEN_VELOCITY, initial)
    return given or initial


class Place(NamedTuple):
    """Gravity, m/s^2, and horizontal Earth rate, rad/s, of a place; and a ug there, m/s^2."""

    gravity: float
    north_rate: float
    ug: float


def _read_place(point: Mapping[str, Any]) -> Place:
    latitude = point["latitude_deg"] * DEG
    if point["earth"] == "constants":
        gravity = point["gravity_m_per_s2"]
        rate, ug = point["earth_rate_deg_per_h"] * DEG_PER_H, micro_g(gravity)
    else:  # normal gravity to 1e-5, far within the law's
        gravity = 9.780325 * (1 + 0.0053 * math.sin(latitude) ** 2)
        rate, ug = 7.292115e-5, micro_g()
    return Place(gravity, rate * math.cos(latitude), ug)
