"""When to reset P, the schedule by a law, and the settling time that it leads to.

**The law** is of the heading that a segment between two resets finds.

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
(J ~ T^5) 143 times. With the measured force in A(t), a standing tilt feigns information on the
heading, which early resets remove. The noise of the sensors restarts with each segment, too. So
does that of a surge of density rs, which leaves the heading of a least squares over T seconds at
sqrt(720 rs/T^5)/(g wN).

**The prediction** needs more, since the law takes a segment for linear and its estimate for
current: the filter runs, without noise, on the errors that matter, the horizontal velocity v and
the tilt l, complex numbers with east as the real part, and the heading phi, of any size. In the
computed frame

    dv/dt = g l,    dl/dt = i wN (exp(-i phi) - 1).

The filter's own model is linear: dl/dt = wN phi, and, with the measured force in A(t), whose
horizontal part is g l, dv/dt = g l - i g l phi: a tilt feigns information on the heading. Feeding
back a heading turns the computed frame, and the tilt with it.

So it knows what the law does not: P shrinks before a large heading error has turned, the more so if
P0 of velocity is small; a standing tilt can keep a run from ever settling. Tilts are small angles
here: from 20 deg on, or with feedback slower than levelling, it is a guide only.

All in SI units; free of JAX.
"""

import cmath
import math
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from sinsjax.units import ARCMIN, DEG

# Fitted to measured settling times, not derived.
_LEVELLING = 300.0
"""Variance ratio of level at which the early resets take place."""

_EARLY_RESETS = 3
"""Early resets with the measured force; a single one with the force of gravity. Two are enough once
P0 of velocity is open, 1 m/s, see `predict_settling_time`."""

_LAG_SHARE, _LAG_TAUS = 0.45, 1.2
"""Lag before a slow feedback, as a share of its interval and in tau, the smaller one."""

_SAFE_SIGMAS = 2.0
"""1 sigma by which noise narrows the band."""

_LARGE_ERROR = 1.0
"""Heading bound above which a second segment is worth having even if the sum says no, rad."""

_SURGE_SIGMA = 2 * DEG
"""Heading that the surge may leave at the last reset, 1 sigma. Fitted to
`docs/studies/reset_law/reset_surge.toml` with seeds 47 and 48."""

_SECOND_SEGMENT = 2.5
"""Length of the first of these two segments, in `heading_time_to_reset_sigma`; with 2.1 cell L5 is
as soon."""

_MOST_SEGMENTS = 4
_MIN_GAIN = 0.02  # of the time, for one more segment
_LONGEST_S = 1e5


class ResetProblem(NamedTuple):
    """A zero-velocity filter and its place, as the law sees them; SI units."""

    velocity_noise: float  # q, density of the velocity noise that Q states, m^2/s^3
    measurement_noise: float  # r, variance R of an update times its interval, m^2/s
    velocity: float  # standard deviation of velocity after a reset, m/s
    level: float  # standard deviation of level after a reset, rad
    heading: float  # s0, standard deviation of heading after a reset, rad
    north_rate: float  # wN, horizontal Earth rate, rad/s
    gravity: float  # m/s^2
    feedback_s: float  # feedback interval, s
    is_force_measured: bool  # whether A(t) has the measured specific force, not that of gravity
    accel_noise: float = 0.0  # density of the accelerometers' own noise, m^2/s^3
    gyro_noise: float = 0.0  # density of the gyros' own noise, rad^2/s
    tilt_noise: float = 0.0  # density of the tilt noise that Q states, rad^2/s
    surge: float = 0.0  # density of the velocity of the base, m^2/s

    @property
    def tau(self) -> float:
        """Time above which Q limits the information and below which R does, s."""
        return math.sqrt(self.measurement_noise / self.velocity_noise)

    @property
    def heading_time_to_reset_sigma(self) -> float:
        """Time after which the heading information is that of the reset, J = 1/s0^2, s."""

        def is_early(time_s: float) -> bool:
            return bool(self.heading**2 * heading_information(time_s, self) - 1 < 0)

        low, high = 1e-6, 1.0
        while is_early(high):
            low, high = high, 2 * high
            if high > _LONGEST_S:
                return math.inf
        while high - low > 1e-9 * high:
            middle = 0.5 * (low + high)
            low, high = (middle, high) if is_early(middle) else (low, middle)
        return high


def heading_information(time_s: Any, problem: ResetProblem) -> Any:
    """Return the information J on the heading error at times (s) since a reset, 1/rad^2."""
    tau = problem.tau
    x = np.asarray(time_s) / tau
    early = x**5 / 720 * (1 - x**2 / 42 + x**4 / 1680)  # the difference below loses its digits
    late = np.maximum(x, 0.7)
    bracket = np.where(x < 0.7, early, late**3 / 12 + late - late**2 / 2 / np.tanh(late / 2))
    scale = (problem.gravity * problem.north_rate) ** 2 * tau**5 / problem.measurement_noise
    return scale * bracket


def contraction(time_s: Any, problem: ResetProblem) -> Any:
    """Return the factor by which segments of a length (s) contract 2 tan(phi/2)."""
    return 1 + heading_information(time_s, problem) / problem.heading**-2


def levelling_time(problem: ResetProblem) -> float:
    """Return the time of the first early reset, s: level is found, heading has not begun."""
    c = _LEVELLING / (problem.gravity * problem.level) ** 2
    time_s = (12 * problem.measurement_noise * c) ** (1 / 3) + problem.velocity_noise * c
    if problem.feedback_s <= time_s:
        return math.ceil(time_s / problem.feedback_s - 1e-9) * problem.feedback_s
    return time_s


def heading_sigma(time_s: Any, problem: ResetProblem) -> Any:
    """Return the sigma of heading by sensor noise and surge at times (s) since a reset, rad."""
    noise = problem.accel_noise, problem.gyro_noise, problem.surge
    return noise_sigma(time_s, problem.gravity, problem.north_rate, *noise)


def noise_sigma(
    time_s: Any, gravity: Any, north_rate: Any, accel_noise: Any, gyro_noise: Any, surge: Any = 0.0
) -> Any:
    """Return the sigma of heading by noise of some densities after a time, rad; all in SI."""
    by_force = 12 * accel_noise / (gravity**2 * time_s**3)
    by_force = by_force + 720 * surge / (gravity**2 * time_s**5)
    return np.sqrt(by_force + 1.2 * gyro_noise / time_s) / north_rate


class ResetSchedule(NamedTuple):
    """A schedule by the law; the last segment ends when the bound is in the band."""

    times_s: tuple[float, ...]  # times of the resets, s
    settling_s: float  # time within which the bound settles, with two sigma of noise, s
    segments: tuple[float, ...]  # lengths of the segments after the early resets, s


class NoSchedule(ValueError):
    """The law has no schedule for a filter; the text says why."""


def schedule(
    problem: ResetProblem, initial_heading: float, band: float = 10 * ARCMIN
) -> ResetSchedule:
    """Return the times of the resets by the law.

    The heading is the largest initial error, the band the error within which a run is settled, rad.

    Raises:
        NoSchedule: no reset pays, no heading can be found, or noise exceeds the band.
    """
    error = _checked_twice_tan_of_half(problem, initial_heading, band)
    found = _equal_segments(problem, error, band, 1)
    for count in range(2, _MOST_SEGMENTS + 1):
        more = _equal_segments(problem, error, band, count)
        if sum(more) < (1 - _MIN_GAIN) * sum(found):
            found = more
    if len(found) == 1 and initial_heading > _LARGE_ERROR:
        found = _two_segments(problem, error, band)
    return _schedule_from_segments(problem, _early_resets(problem), found, error, band)


def schedule_with(
    problem: ResetProblem, initial_heading: float, band: float, resets: int
) -> ResetSchedule:
    """Return the best schedule by the law that has a given number of resets, at least 1.

    With few resets early ones are left out; with many there are more segments, or more early ones.
    Arguments and errors are those of `schedule`.
    """
    error = _checked_twice_tan_of_half(problem, initial_heading, band)
    early_s, found = levelling_time(problem), {}
    for early in range(1, min(_early_resets(problem), resets - 1) + 1):
        segments = _equal_segments(problem, error, band, resets + 1 - early)
        if segments[0] > early_s:  # otherwise the sum favours fewer segments
            found[early] = segments
    if resets == 1 or initial_heading <= _LARGE_ERROR:
        found[resets] = _equal_segments(problem, error, band, 1)
    elif not found:
        found[resets - 1] = _two_segments(problem, error, band)
    schedules = (_schedule_from_segments(problem, *one, error, band) for one in found.items())
    return min(schedules, key=lambda schedule: schedule.settling_s)


def _checked_twice_tan_of_half(problem: ResetProblem, initial_heading: float, band: float) -> float:
    """Check that the law has a schedule, and return 2 tan(phi0/2)."""
    if problem.velocity_noise <= 0:
        raise NoSchedule("with a Q of zero no reset ever pays (use 'none')")
    if problem.measurement_noise <= 0:
        raise NoSchedule("R of zero has no schedule (give r_velocity_m_per_s)")
    if problem.north_rate <= 1e-3 * 7.292e-5:
        raise NoSchedule("no heading can be found at a pole (give another latitude_deg)")
    if not band < initial_heading < math.pi:
        bound = f"a bound of {initial_heading / DEG:.3g} deg"
        raise NoSchedule(f"{bound} is not between the band and 180 deg")
    if not math.isfinite(_last_segment(problem, 1.0, band)):
        sigma = heading_sigma(1e3, problem) / ARCMIN
        text = f"noise exceeds a band of {band / ARCMIN:g}': 1 sigma is {sigma:.0f}' after 1000 s"
        raise NoSchedule(f"{text} (give a wider settle_band_arcmin)")
    return 2 * math.tan(initial_heading / 2)


def _early_resets(problem: ResetProblem) -> int:
    return _EARLY_RESETS if problem.is_force_measured else 1


def _equal_segments(problem: ResetProblem, error: float, band: float, n: int) -> tuple[float, ...]:
    """Return n - 1 equal segments and a last one that contract an error to a band in least time."""
    if n == 1:
        return (_last_segment(problem, error, band),)
    lengths_s = problem.heading_time_to_reset_sigma * np.geomspace(1e-2, 1e2, 2000)
    rests = error / contraction(lengths_s, problem) ** (n - 1)
    place = int(np.argmin((n - 1) * lengths_s + _last_segment(problem, rests, band)))
    return (*[lengths_s[place]] * (n - 1), _last_segment(problem, rests[place], band))


def _two_segments(problem: ResetProblem, error: float, band: float) -> tuple[float, ...]:
    """Return two segments that settle a large heading error, though the sum favours one."""
    first_s = _SECOND_SEGMENT * problem.heading_time_to_reset_sigma
    return first_s, _last_segment(problem, error / contraction(first_s, problem), band)


def _schedule_from_segments(
    problem: ResetProblem, early_count: int, lengths_s: tuple[float, ...], error: float, band: float
) -> ResetSchedule:
    """Return the schedule of some early resets and segments, its resets at feedbacks."""
    lengths_s = _lengthen_last_but_one_segment_for_surge(problem, lengths_s, error, band)
    early_s, lag_s = levelling_time(problem), 0.0
    if problem.feedback_s > early_s:
        lag_s = min(_LAG_SHARE * problem.feedback_s, _LAG_TAUS * problem.tau)
    times = [early_s * k for k in range(1, early_count + 1)]
    begin = times[-1]
    for length_s in lengths_s[:-1]:
        later = round((times[-1] + length_s) / problem.feedback_s) * problem.feedback_s
        times = [*times, max(later - lag_s, times[-1] + problem.feedback_s)]
    rounded = tuple(float(f"{time:.9g}") for time in times)
    return ResetSchedule(rounded, float(begin + sum(lengths_s)), lengths_s)


def _lengthen_last_but_one_segment_for_surge(
    problem: ResetProblem, segments: tuple[float, ...], error: float, band: float
) -> tuple[float, ...]:
    """Return the segments with a longer one before the last reset, if the surge requires it.

    A surge throws the heading of a filter that is reset too early so far that it may never settle.
    """
    scale = problem.gravity * problem.north_rate * _SURGE_SIGMA
    shortest_s = (720 * problem.surge / scale**2) ** 0.2
    *before, _ = segments
    if not before or before[-1] >= shortest_s:
        return segments
    before[-1] = shortest_s
    for length_s in before:
        error /= contraction(length_s, problem)
    return (*before, _last_segment(problem, error, band))


def _last_segment(problem: ResetProblem, error: Any, band: float) -> Any:
    """Return the lengths of segments that contract errors to a band less noise, s; inf for none."""
    times_s = np.geomspace(1e-6, _LONGEST_S, 4000)
    left = np.maximum(band - _SAFE_SIGMAS * heading_sigma(times_s, problem), 1e-300)
    reached = np.log(np.maximum.accumulate(contraction(times_s, problem) * left))
    return np.exp(np.interp(np.log(error), reached, np.log(times_s), right=math.inf))


# The settling time

_MEDIAN_SIGMAS = 0.75  # 1 sigma by which noise narrows the band of a median run
_GROWTH = 0.02  # length of a step, of the time since the last reset
_LAG_STEP, _LAG_REACH = 0.5, 3.0  # no step is longer than tau/2 up to 3 heading times
_MOST_STEPS = 5000  # of such steps in a run


class _FilterStep(NamedTuple):
    """A step of the filter and what ends it."""

    end_s: float
    length_s: float
    since_s: float  # the last reset, at its end
    is_fed: bool  # whether a feedback ends it
    is_reset: bool  # whether a reset ends it


def predict_settling_time(
    problem: ResetProblem,
    times_s: Sequence[float],
    run_s: float,
    heading: float,
    tilt: complex = 0j,
    band: float = 10 * ARCMIN,
) -> float:
    """Return the settling time of a median run, s; inf if it does not settle within the run.

    Args:
        problem: the filter and its place.
        times_s: times of its resets, s.
        run_s: duration of the run, s.
        heading: initial heading error, rad.
        tilt: initial level error, east and north as a complex number, rad.
        band: heading error within which the run is settled, rad.
    """
    g, north, level = problem.gravity, problem.north_rate, problem.level
    start = np.diag(np.square([*[problem.velocity] * 2, level, level, problem.heading]))
    noise = np.diag([*[problem.velocity_noise] * 2, *[problem.tilt_noise] * 2, 0.0])
    p, x = start.copy(), np.zeros(5)  # velocity and tilt, east and north; heading
    v, settled_s, before = 0j, math.inf, math.inf
    for end_s, dt, since_s, is_fed, is_reset in _iter_time_steps(problem, times_s, run_s):
        tilt_dt, heading_dt = g * dt, north * dt
        rate = 1j * north * (cmath.exp(-1j * heading) - 1)
        force_dt = tilt_dt * (tilt + rate * dt / 2)
        v, tilt = v + force_dt, tilt + rate * dt
        feigned_dt = -1j * problem.is_force_measured * force_dt + tilt_dt * heading_dt / 2
        for m in (p, p.T, x):
            m[0] += tilt_dt * m[2] + feigned_dt.real * m[4]
            m[1] += tilt_dt * m[3] + feigned_dt.imag * m[4]
            m[2] += heading_dt * m[4]
        p += noise * dt
        for axis, velocity in enumerate((v.real, v.imag)):
            gain = p[axis] * (dt / (p[axis, axis] * dt + problem.measurement_noise))
            x += gain * (velocity - x[axis])
            p -= np.outer(gain, p[axis])
        if is_fed:
            v -= complex(x[0], x[1])
            tilt = (tilt - complex(x[2], x[3])) * cmath.exp(1j * x[4])
            heading = math.remainder(heading - x[4], 2 * math.pi)
            x = np.zeros(5)
        sigma = heading_sigma(since_s, problem)
        outside = float(abs(heading) + _MEDIAN_SIGMAS * sigma - band)
        if outside > 0:
            settled_s = math.inf
        elif before > 0:
            settled_s = end_s - dt * outside / (outside - before)
        before = outside
        p = start.copy() if is_reset else p
    return settled_s


def _iter_time_steps(
    problem: ResetProblem, reset_times_s: Sequence[float], run_s: float
) -> Iterator[_FilterStep]:
    """Yield steps that are short after each reset and grow, up to a feedback or a reset."""
    feedback_s, reach_s = problem.feedback_s, _LAG_REACH * problem.heading_time_to_reset_sigma
    shortest = max(min(problem.tau / 4, levelling_time(problem) / 20), run_s / 1e5)
    longest = max(_LAG_STEP * problem.tau, shortest, run_s / _MOST_STEPS)
    for begin, end in zip((0.0, *reset_times_s), (*reset_times_s, run_s), strict=True):
        now = begin
        while now < end:
            since = now - begin
            step = max(shortest, _GROWTH * since)
            step = min(step, longest) if since < reach_s else step
            later, is_fed = now + step, step >= feedback_s
            if not is_fed:
                feedback = (math.floor(now / feedback_s + 1e-6) + 1) * feedback_s
                is_fed = later >= feedback - 0.1 * step
                later = feedback if is_fed else later
            is_last = later >= end - 0.1 * step
            later = end if is_last else later
            is_reset = is_last and end != run_s
            yield _FilterStep(later, later - now, later - begin, is_fed or is_last, is_reset)
            now = later
