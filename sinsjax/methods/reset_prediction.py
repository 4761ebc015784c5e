"""Settling time of a filter with resets, predicted by an alignment reduced to three errors.

The law of `reset_law` takes a segment for linear and its estimate for current. Here the filter
runs, without noise, on the errors that matter: the horizontal velocity v and the tilt l, complex
numbers with east as the real part, and the heading phi, of any size. In the computed frame

    dv/dt = g l,    dl/dt = i wN (exp(-i phi) - 1).

The filter's own model is linear: dl/dt = wN phi, and, with the measured force in A(t), whose
horizontal part is g l, dv/dt = g l - i g l phi: a tilt feigns information on the heading. Feeding
back a heading turns the computed frame, and the tilt with it.

So it knows what the law does not: P shrinks before a large heading error has turned, the more so if
P0 of velocity is small; a standing tilt can keep a run from ever settling. Tilts are small angles
here: from 20 deg on, or with feedback slower than levelling, it is a guide only.

In SI units; free of JAX.
"""

import cmath
import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from sinsjax.methods.reset_law import ResetProblem, heading_sigma, levelling_time
from sinsjax.units import ARCMIN

_MEDIAN_SIGMAS = 0.75  # 1 sigma by which noise narrows the band of a median run
_GROWTH = 0.02  # length of a step, of the time since the last reset
_LAG_STEP, _LAG_REACH = 0.5, 3.0  # no step is longer than tau/2 up to 3 ell, while P shrinks
_MOST_STEPS = 5000  # of such steps in a run


class _Step(NamedTuple):
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
    for end_s, dt, since_s, is_fed, is_reset in _steps(problem, times_s, run_s):
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


def _steps(problem: ResetProblem, times_s: Sequence[float], run_s: float) -> Iterator[_Step]:
    """Yield steps that are short after each reset and grow, up to a feedback or a reset."""
    feedback_s, reach_s = problem.feedback_s, _LAG_REACH * problem.ell
    shortest = max(min(problem.tau / 4, levelling_time(problem) / 20), run_s / 1e5)
    longest = max(_LAG_STEP * problem.tau, shortest, run_s / _MOST_STEPS)
    for begin, end in zip((0.0, *times_s), (*times_s, run_s), strict=True):
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
            yield _Step(later, later - now, later - begin, is_fed or is_last, is_reset)
            now = later
