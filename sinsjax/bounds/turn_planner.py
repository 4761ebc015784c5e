"""The motion that aligns given sensors best: parked, or one of four usual ways to turn them."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from sinsjax.bounds.estimator import heading_variances
from sinsjax.bounds.information import (
    LONGEST_STEP_S,
    BaseMotion,
    HeadingProblem,
    IncrementErrors,
    coloured_errors,
    parked,
)
from sinsjax.errors import InputError
from sinsjax.messages import format_facts
from sinsjax.strapdown import earth, processes
from sinsjax.strapdown.disturbances import Disturbances
from sinsjax.strapdown.sensors import SensorErrors
from sinsjax.units import ARCMIN, ARCSEC, DEG, DEG_PER_H, DEG_PER_SQRT_H, PPM, micro_g

_RATE_DEG_PER_S, _RAMP_S = 10.0, 1.0
_TICK_S = 0.1  # of turns' times
_CAROUSEL_DEG_PER_S, _FASTEST_DEG_PER_S = 12.0, 30.0
_AXES = np.ones(3)
SHORTEST_S, LONGEST_S = 10.0, 7200.0
"""Times for which turns are planned and advice is given."""


class TurnOption(NamedTuple):
    """A motion of the base and the least heading error with it.

    Attributes:
        name: "parked", "half turn", "four positions", "six positions" or "reversing carousel".
        sigma_arcmin: 1 sigma of the heading error at the end, arcmin, in linear theory.
        motion: keys of [motion]; empty for "parked".
    """

    name: str
    sigma_arcmin: float
    motion: dict[str, Any]


class TurnChoice(NamedTuple):
    """Motions of the base, compared by the heading error at the end.

    Attributes:
        options: the motions that fit into the time, "parked" first.

    Examples:
        >>> choice = sinsjax.plan_turns(
        ...     gyro_bias_deg_per_h=1.0,
        ...     gyro_arw_deg_per_sqrt_h=0.02,
        ...     accel_bias_ug=500.0,
        ...     accel_vrw_ug_per_sqrt_hz=50.0,
        ...     latitude_deg=45.0,
        ...     duration_s=300.0,
        ... )
        >>> {option.name: round(option.sigma_arcmin) for option in choice.options}
        {'parked': 324, 'half turn': 24, 'four positions': 24, 'six positions': 24, \
'reversing carousel': 23}
    """

    options: tuple[TurnOption, ...]

    @property
    def best(self) -> TurnOption:
        """The option with the least heading error."""
        return min(self.options, key=lambda option: option.sigma_arcmin)

    @property
    def pays(self) -> bool:
        """Whether some way of turning has a smaller heading error than a parked base."""
        return self.best.name != self.options[0].name

    def __repr__(self) -> str:
        """Return the options in lines, the best one marked."""
        lines = {
            option.name: f"{option.sigma_arcmin:.3g} arcmin{', best' * (option == self.best)}"
            for option in self.options
        }
        return format_facts("Least heading error (1 sigma) by motion", lines)


def plan_turns(  # noqa: PLR0913
    *,
    gyro_bias_deg_per_h: float,
    gyro_arw_deg_per_sqrt_h: float,
    accel_bias_ug: float,
    accel_vrw_ug_per_sqrt_hz: float,
    latitude_deg: float,
    duration_s: float,
    gyro_instability_deg_per_h: float = 0.0,
    gyro_instability_time_s: float = 300.0,
    accel_instability_ug: float = 0.0,
    accel_instability_time_s: float = 300.0,
    gyro_scale_ppm: float = 0.0,
    gyro_misalignment_arcsec: float = 0.0,
) -> TurnChoice:
    """Return the heading errors that sensors allow if they are parked or turned in usual ways.

    The options are a parked base; a half turn in the middle; four positions, by turns of 90 deg
    after each quarter; six positions, by half turns to and fro; and a reversing carousel, by turns
    of 180, -360 and 180 deg again and again, at about 12 deg/s so that the data end after the last
    of them, in the mean direction, where the scale factor costs least. The turns are about the
    vertical of a level base, the others at 10 deg/s, with ramps of 1 s. Those for which the time is
    too short are left out.

    The heading is that of the body at the end of the data, and the error is the information bound
    of `sinsjax.bounds.information`, on the WGS-84 ellipsoid.

    Args:
        gyro_bias_deg_per_h: 1 sigma of the turn-on bias of each gyro, deg/h.
        gyro_arw_deg_per_sqrt_h: angle random walk, deg/sqrt(h).
        accel_bias_ug: 1 sigma of the turn-on bias of each accelerometer, ug.
        accel_vrw_ug_per_sqrt_hz: velocity random walk, ug/sqrt(Hz); not 0.
        latitude_deg: latitude, deg; not a pole.
        duration_s: length of the data, s.
        gyro_instability_deg_per_h: rms of a first-order Gauss-Markov drift, deg/h.
        gyro_instability_time_s: its correlation time, s.
        accel_instability_ug: likewise of the accelerometers, ug.
        accel_instability_time_s: its correlation time, s.
        gyro_scale_ppm: 1 sigma of the scale factor error of each gyro, ppm.
        gyro_misalignment_arcsec: 1 sigma of each of the six misalignment angles of the gyros' axes,
            arcsec.

    Raises:
        InputError: a sigma is negative, or a density, latitude or time is out of range.

    Examples:
        >>> fog = {"gyro_bias_deg_per_h": 0.1, "gyro_arw_deg_per_sqrt_h": 0.005}
        >>> accelerometers = {"accel_bias_ug": 200.0, "accel_vrw_ug_per_sqrt_hz": 30.0}
        >>> choice = sinsjax.plan_turns(
        ...     **fog,
        ...     **accelerometers,
        ...     latitude_deg=45.0,
        ...     duration_s=300.0,
        ...     gyro_scale_ppm=300.0,
        ...     gyro_misalignment_arcsec=206.0,
        ... )
        >>> choice.pays, choice.best.name, round(choice.best.sigma_arcmin, 1)
        (True, 'reversing carousel', 6.5)
        >>> choice.options[1].motion["turn_times_s"]
        [140.5]
    """
    sigmas = {key: value for key, value in locals().items() if key != "latitude_deg"}
    _check_sensor_numbers(sigmas, latitude_deg)
    place, ug = earth.place(earth.wgs84(), latitude_deg * DEG), micro_g()
    matrix = np.full((3, 3), gyro_misalignment_arcsec * ARCSEC)
    np.fill_diagonal(matrix, gyro_scale_ppm * PPM)

    def instability_errors(step_s: float) -> IncrementErrors:
        def drift(rms: float, time_s: float) -> processes.Process | None:
            if rms == 0:
                return None
            return processes.sampled_mean_of_gauss_markov(rms * _AXES, time_s, step_s)

        drifts = Disturbances(
            gyro_instability=drift(gyro_instability_deg_per_h * DEG_PER_H, gyro_instability_time_s),
            accel_instability=drift(accel_instability_ug * ug, accel_instability_time_s),
        )
        return coloured_errors(drifts, step_s)

    dt = duration_s / math.ceil(duration_s / LONGEST_STEP_S)
    errors = SensorErrors(
        gyro_bias=gyro_bias_deg_per_h * DEG_PER_H * _AXES,
        accel_bias=accel_bias_ug * ug * _AXES,
        gyro_noise=gyro_arw_deg_per_sqrt_h * DEG_PER_SQRT_H * math.sqrt(dt) * _AXES,
        accel_noise=accel_vrw_ug_per_sqrt_hz * ug * math.sqrt(dt) * _AXES,
        gyro_matrix=matrix,
        accel_matrix=np.zeros((3, 3)),
    )
    level = partial(parked, np.eye(3), place)
    return compare_turns(HeadingProblem(level, place, dt, errors, instability_errors), duration_s)


def compare_turns(
    problem: HeadingProblem, duration_s: float, unmodelled: Sequence[str] = ()
) -> TurnChoice:
    """Return the heading errors of a base that is turned in usual ways, from its own motion on.

    Args:
        problem: sensors and base, which is turned about the vertical in addition to its motion.
        duration_s: length of the data, s.
        unmodelled: sources of errors without unknowns, see `bounds.estimator`.
    """
    options = []
    for name, turn_keys in _iter_turn_options(duration_s):
        turning = partial(_turn_base, problem, turn_keys, duration_s)
        base = replace(problem, motion=turning) if turn_keys else problem
        variances = heading_variances([duration_s], base, unmodelled)
        sigma = math.sqrt(sum(float(part[0]) for part in variances.values()))
        options.append(TurnOption(name, sigma / ARCMIN, turn_keys))
    return TurnChoice(tuple(options))


def _check_sensor_numbers(values: dict[str, float], latitude_deg: float) -> None:
    """Refuse numbers without meaning."""
    for key, value in values.items():
        positive = key == "accel_vrw_ug_per_sqrt_hz" or key.endswith("_s")
        if not math.isfinite(value) or value < 0 or (positive and value == 0):
            raise InputError(f"{key}: {value} is not {'positive' if positive else '0 or more'}")
    if not SHORTEST_S <= values["duration_s"] <= LONGEST_S:
        text = f"must be {SHORTEST_S:g} to {LONGEST_S:g} s, not {values['duration_s']:g}"
        raise InputError(f"duration_s: {text}")
    if not abs(latitude_deg) < 90:
        raise InputError(f"latitude_deg: {latitude_deg} is not between -90 and 90")


def _iter_turn_options(duration_s: float) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield name and keys of [motion] of each option that fits into the time.

    Times are multiples of 0.1 s, which are samples at most rates, with a gap between turns.
    """
    yield "parked", {}
    for name, positions, angles in (
        ("half turn", 2, [180.0]),
        ("four positions", 4, [90.0] * 3),
        ("six positions", 6, [180.0, -180.0] * 2 + [180.0]),
    ):
        length = abs(angles[0]) / _RATE_DEG_PER_S + _RAMP_S
        if length + 2 * _TICK_S <= duration_s / positions:
            middles = duration_s / positions * np.arange(1, positions)
            times = [round(float(middle - length / 2), 1) for middle in middles]
            yield name, _turn_keys(times, angles, _RATE_DEG_PER_S)
    nominal = 720 / _CAROUSEL_DEG_PER_S + 3 * _RAMP_S
    count = max(1, round(duration_s / nominal))
    ticks = math.floor(duration_s / count / _TICK_S)  # of a repetition
    quarter = (ticks - round(3 * (_RAMP_S + _TICK_S) / _TICK_S)) // 4 * _TICK_S
    if quarter >= 180 / _FASTEST_DEG_PER_S:
        stop = _RAMP_S + _TICK_S
        first = duration_s - count * ticks * _TICK_S  # so that the last repetition ends in time
        times = [first, first + quarter + stop, first + 3 * quarter + 2 * stop]
        times = [math.floor(time / _TICK_S + 1e-6) / 10 for time in times]
        motion = _turn_keys(times, [180.0, -360.0, 180.0], 180 / quarter)
        yield "reversing carousel", motion | {"turn_repeat_s": ticks / 10}


def _turn_keys(times_s: list[float], angles_deg: list[float], rate: float) -> dict[str, Any]:
    return {
        "turn_times_s": times_s,
        "turn_angles_deg": angles_deg,
        "turn_rate_deg_per_s": rate,
        "turn_ramp_s": _RAMP_S,
    }


def _turn_base(
    problem: HeadingProblem, turn_keys: dict[str, Any], end_s: float, times_s: np.ndarray
) -> BaseMotion:
    """Return the motion of a base that turns as well, by keys of [motion] as of `_turn_keys`."""
    angle, speed = np.zeros_like(times_s), np.zeros_like(times_s)
    rate, ramp = turn_keys["turn_rate_deg_per_s"], _RAMP_S
    for again in np.arange(0.0, end_s, turn_keys.get("turn_repeat_s", end_s)):
        for t0, whole in zip(turn_keys["turn_times_s"], turn_keys["turn_angles_deg"], strict=True):
            for sign, start in ((1, t0 + again), (-1, t0 + again + abs(whole) / rate)):
                x = np.clip((times_s - start) / ramp, 0, 1)
                factor = sign * math.copysign(rate, whole) * DEG
                path = ramp * x**4 * (2.5 - 3 * x + x * x) + np.maximum(times_s - start - ramp, 0)
                angle += factor * path
                speed += factor * x**3 * (10 - 15 * x + 6 * x * x)
    sin, cos, zero, one = np.sin(angle), np.cos(angle), 0 * angle, 1 + 0 * angle
    turn = np.stack([cos, -sin, zero, sin, cos, zero, zero, zero, one], -1).reshape(-1, 3, 3)
    attitude, w = problem.motion(times_s)
    turned, earth = turn @ attitude, np.array([0.0, problem.place.rate_n, problem.place.rate_u])
    about_up = speed[:, None] * attitude[:, 2]
    return BaseMotion(turned, w + about_up + earth @ turned - earth @ attitude)
