"""When to reset P: the heading that a segment between two resets finds, and the schedule from it.

A reset sets P to P0, feeds the states back and keeps the attitude, so that it restarts the filter
from a smaller error. Levelled, with the heading error phi, the platform tilts at wN sin phi, and
the velocity error grows as g wN sin phi t^2/2. The filter believes in velocity noise of density q
and measurement noise of density r. With start velocity and tilt unknown, a least squares over T
seconds holds the information on the heading, in 1/rad^2,

    J(T) = (g wN)^2 tau^5/r [x^3/12 + x - (x^2/2) coth(x/2)],    tau = sqrt(r/q),  x = T/tau.

With the heading variance s0^2 after a reset, a segment leaves 1/(1 + s0^2 J) of a small error; with
feedback dphi/dt = -k sin phi, so that 2 tan(phi/2) contracts. Segments T_i settle phi0 to a band b
once

    prod (1 + s0^2 J(T_i)) >= 2 tan(phi0/2)/b.

Their least sum has equal segments: limited by Q (J ~ T^3) each contracts 17 times, limited by R
(J ~ T^5) 143 times. With the measured force in A(t), a standing tilt l feigns the information
K l^2 on the heading, which adds to 1/s0^2 and which early resets remove. The noise of the sensors
restarts with each segment, too.

All in SI units; free of JAX.
"""

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from sinsjax.units import ARCMIN, DEG

# Fitted to the cells R1 to R11 and L1 to L5 of `docs/reset_law.md`, not derived.
_LEVELLING = 300.0
"""Variance ratio of level at which the early resets take place."""

_EARLY_RESETS = 3
"""Early resets with the measured force; a single one with the force of gravity."""

_LAG_SHARE, _LAG_TAUS = 0.45, 1.2
"""Lag before a slow feedback, as a share of its interval and in tau, the smaller one."""

_SAFE_SIGMAS, MEDIAN_SIGMAS = 2.0, 0.75
"""1 sigma by which noise narrows the band, for a schedule and to predict a median."""

_LARGE_ERROR = 1.0
"""Heading bound above which a second segment is worth having even if the sum says no, rad."""

_SECOND_SEGMENT = 2.5
"""Length of the first of these two segments, in ell."""

_MOST_SEGMENTS = 4
_MIN_GAIN = 0.02  # of the time, for one more segment
_LONGEST_S = 1e5


class ResetProblem(NamedTuple):
    """A zero-velocity filter and its place, as the law sees them; SI units.

    Attributes:
        velocity_noise: q, density of the velocity noise that Q states, m^2/s^3.
        measurement_noise: r, variance R of an update times its interval, m^2/s.
        level: standard deviation of level after a reset, rad.
        heading: s0, standard deviation of heading after a reset, rad.
        north_rate: wN, horizontal Earth rate, rad/s.
        gravity: m/s^2.
        feedback_s: feedback interval, s.
        is_force_measured: whether A(t) has the measured specific force, not that of gravity.
        accel_noise: density of the accelerometers' own noise, m^2/s^3.
        gyro_noise: density of the gyros' own noise, rad^2/s.
    """

    velocity_noise: float
    measurement_noise: float
    level: float
    heading: float
    north_rate: float
    gravity: float
    feedback_s: float
    is_force_measured: bool
    accel_noise: float = 0.0
    gyro_noise: float = 0.0

    @property
    def tau(self) -> float:
        """Time above which Q limits the information and below which R does, s."""
        return math.sqrt(self.measurement_noise / self.velocity_noise)

    @property
    def ell(self) -> float:
        """Time after which the heading information is that of the reset, J = 1/s0^2, s."""
        return _first_time(lambda t: self.heading**2 * heading_information(t, self) - 1)


def heading_information(time_s: float, problem: ResetProblem) -> float:
    """Return the information J on the heading error after a time since a reset, 1/rad^2.

    Args:
        time_s: time, s.
        problem: the filter and its place.
    """
    tau = problem.tau
    x = time_s / tau
    if x < 0.7:  # the difference below loses its digits
        bracket = x**5 / 720 * (1 - x**2 / 42 + x**4 / 1680)
    else:
        bracket = x**3 / 12 + x - x**2 / 2 / math.tanh(x / 2)
    scale = (problem.gravity * problem.north_rate) ** 2 * tau**5 / problem.measurement_noise
    return scale * bracket


def feigned_information(tilt: float, problem: ResetProblem) -> float:
    """Return the information K l^2 on the heading that a standing tilt feigns, 1/rad^2.

    Zero with the force of gravity in A(t).

    Args:
        tilt: length of the level error, rad.
        problem: the filter and its place.
    """
    if not problem.is_force_measured:
        return 0.0
    q, r, g = problem.velocity_noise, problem.measurement_noise, problem.gravity
    levelling_s = 1.5 * (24 * r / (g * problem.level) ** 2) ** (1 / 3)
    time_s = max(1.2 * problem.feedback_s, levelling_s)
    return (g * time_s * tilt) ** 2 / (q * time_s + 2 * math.sqrt(q * r))


def contraction(time_s: float, problem: ResetProblem, tilt: float = 0.0) -> float:
    """Return the factor by which a segment contracts 2 tan(phi/2).

    Args:
        time_s: its length, s.
        problem: the filter and its place.
        tilt: length of the level error that stands in the segment, rad.
    """
    prior = problem.heading**-2 + feigned_information(tilt, problem)
    return 1 + heading_information(time_s, problem) / prior


def levelling_time(problem: ResetProblem) -> float:
    """Return the time of the first early reset, s: level is found, heading has not begun."""
    c = _LEVELLING / (problem.gravity * problem.level) ** 2
    time_s = (12 * problem.measurement_noise * c) ** (1 / 3) + problem.velocity_noise * c
    if problem.feedback_s <= time_s:
        return math.ceil(time_s / problem.feedback_s - 1e-9) * problem.feedback_s
    return time_s


def heading_sigma(time_s: float, problem: ResetProblem) -> float:
    """Return the standard deviation of heading by the sensors' own noise, rad.

    Args:
        time_s: since the last reset, s.
        problem: the filter and its place.
    """
    by_force = 12 * problem.accel_noise / (problem.gravity**2 * time_s**3)
    return math.sqrt(by_force + 1.2 * problem.gyro_noise / time_s) / problem.north_rate


def angle_ratio(heading: float, band: float) -> float:
    """Return the contraction of 2 tan(phi/2) that brings a heading error into a band, both rad."""
    return 2 * math.tan(heading / 2) / band


class ResetSchedule(NamedTuple):
    """A schedule by the law.

    Attributes:
        times_s: times of the resets, s.
        settling_s: time within which the bound settles, with two sigma of noise, s.
        segments: lengths of the segments after the early resets, s; the last one ends when the
            bound is in the band.
    """

    times_s: tuple[float, ...]
    settling_s: float
    segments: tuple[float, ...]


class NoSchedule(ValueError):
    """The law has no schedule for a filter; the text says why."""


def schedule(
    problem: ResetProblem,
    heading_bound: float,
    band: float = 10 * ARCMIN,
    segments: int | None = None,
) -> ResetSchedule:
    """Return the times of the resets by the law.

    Args:
        problem: the filter and its place.
        heading_bound: largest initial heading error, rad.
        band: heading error within which a run is settled, rad.
        segments: number of segments after the early resets; None for the best.

    Raises:
        NoSchedule: no reset pays, no heading can be found, or noise exceeds the band.
    """
    _check(problem, heading_bound, band)
    early_s = levelling_time(problem)
    count = _EARLY_RESETS if problem.is_force_measured else 1
    early = [early_s * k for k in range(1, count + 1)]
    found = _best_segments(problem, heading_bound, band, segments)
    if len(found) == 1 and heading_bound > _LARGE_ERROR and segments is None:
        first_s = _SECOND_SEGMENT * problem.ell
        rest = angle_ratio(heading_bound, 1.0) / contraction(first_s, problem)
        found = (first_s, _last_segment(problem, rest, band))
    lag_s = 0.0
    if problem.feedback_s > early_s:
        lag_s = min(_LAG_SHARE * problem.feedback_s, _LAG_TAUS * problem.tau)
    times, begin = early, early[-1]
    for length_s in found[:-1]:
        later = round((times[-1] + length_s) / problem.feedback_s) * problem.feedback_s
        times = [*times, max(later - lag_s, times[-1] + problem.feedback_s)]
    return ResetSchedule(
        tuple(float(f"{time:.9g}") for time in times), begin + sum(found), tuple(found)
    )


def _check(problem: ResetProblem, heading_bound: float, band: float) -> None:
    if problem.velocity_noise <= 0:
        raise NoSchedule("with a Q of zero no reset ever pays (use 'none')")
    if problem.measurement_noise <= 0:
        raise NoSchedule("R of zero has no schedule (give r_velocity_m_per_s)")
    if problem.north_rate <= 1e-3 * 7.292e-5:
        raise NoSchedule("no heading can be found at a pole (give another latitude_deg)")
    if not band < heading_bound < math.pi:
        text = f"a bound of {heading_bound / DEG:.3g} deg is not between the band and 180 deg"
        raise NoSchedule(text)


def _best_segments(
    problem: ResetProblem, heading_bound: float, band: float, count: int | None
) -> tuple[float, ...]:
    """Return the segments with the least sum; one more only if it gains 2 %."""
    ratio = angle_ratio(heading_bound, 1.0)
    if not math.isfinite(_last_segment(problem, 1.0, band)):
        sigma = heading_sigma(1e3, problem) / ARCMIN
        text = f"noise exceeds a band of {band / ARCMIN:g}': 1 sigma is {sigma:.0f}' after 1000 s"
        raise NoSchedule(f"{text} (give a wider settle_band_arcmin)")
    best: tuple[float, ...] = ()
    for n in [count] if count else range(1, _MOST_SEGMENTS + 1):
        segments = _equal_segments(problem, ratio, band, n)
        if not best or sum(segments) < (1 - _MIN_GAIN) * sum(best):
            best = segments
    return best


def _equal_segments(problem: ResetProblem, ratio: float, band: float, n: int) -> tuple[float, ...]:
    """Return n - 1 equal segments and a last one, of which the sum is least."""
    if n == 1:
        return (_last_segment(problem, ratio, band),)

    def total(log_s: float) -> float:
        length_s = math.exp(log_s)
        rest = ratio / contraction(length_s, problem) ** (n - 1)
        return (n - 1) * length_s + _last_segment(problem, rest, band)

    lengths = np.linspace(math.log(1e-2 * problem.ell), math.log(1e2 * problem.ell), 200)
    place = int(np.argmin([total(length) for length in lengths]))
    low, high = lengths[max(place - 1, 0)], lengths[min(place + 1, len(lengths) - 1)]
    length_s = math.exp(_least(total, float(low), float(high)))
    rest = ratio / contraction(length_s, problem) ** (n - 1)
    return (*([length_s] * (n - 1)), _last_segment(problem, rest, band))


def _last_segment(
    problem: ResetProblem, ratio: float, band: float, sigmas: float = _SAFE_SIGMAS
) -> float:
    """Return the length of a segment that contracts ``ratio`` to a band, apart from noise, s."""

    def excess(time_s: float) -> float:
        left = band - sigmas * heading_sigma(time_s, problem)
        return -1.0 if left <= 0 else contraction(time_s, problem) * left / ratio - 1

    return _first_time(excess)


def predicted_settling_time(
    problem: ResetProblem,
    times_s: Sequence[float],
    heading: float,
    tilt: float = 0.0,
    band: float = 10 * ARCMIN,
    sigmas: float = MEDIAN_SIGMAS,
) -> float:
    """Return the predicted settling time of a run with some resets, s; inf if it never settles.

    Args:
        problem: the filter and its place.
        times_s: times of its resets, s; none for ().
        heading: initial heading error, rad.
        tilt: length of the initial level error, rad, which the first segment removes.
        band: heading error within which a run is settled, rad.
        sigmas: 1 sigma of noise that narrow the band: 0.75 for a median, 2 to be safe.
    """
    ratio = 2 * math.tan(min(abs(heading), math.pi - 1e-6) / 2)
    for begin, end in zip((0.0, *times_s), (*times_s, math.inf), strict=True):
        standing = tilt if begin == 0 else 0.0

        def excess(time_s: float, ratio: float = ratio, standing: float = standing) -> float:
            left = band - sigmas * heading_sigma(time_s, problem)
            if left <= 0:
                return -1.0
            return contraction(time_s, problem, standing) * left - ratio

        length_s = _first_time(excess)
        if begin + length_s <= end:
            return begin + length_s
        ratio /= contraction(end - begin, problem, standing)
    return math.inf


def _first_time(excess: Callable[[float], float]) -> float:
    """Return the first time at which an increasing function is not negative, s; inf for none."""
    low, high = 1e-6, 1.0
    while excess(high) < 0:
        low, high = high, 2 * high
        if high > _LONGEST_S:
            return math.inf
    while high - low > 1e-9 * high:
        middle = 0.5 * (low + high)
        low, high = (middle, high) if excess(middle) < 0 else (low, middle)
    return high


def _least(function: Callable[[float], float], low: float, high: float) -> float:
    """Return the place of the least value between two places, by the golden section."""
    golden = (math.sqrt(5) - 1) / 2
    a, b = high - golden * (high - low), low + golden * (high - low)
    value_a, value_b = function(a), function(b)
    for _ in range(40):
        if value_a < value_b:
            high, b, value_b = b, a, value_a
            a = high - golden * (high - low)
            value_a = function(a)
        else:
            low, a, value_a = a, b, value_b
            b = low + golden * (high - low)
            value_b = function(b)
    return 0.5 * (low + high)
