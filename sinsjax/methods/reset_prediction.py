"""Settling times of a filter with resets, predicted by an alignment reduced to three errors.

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

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sinsjax.methods.reset_law import MEDIAN_SIGMAS, ResetProblem, heading_sigma, levelling_time
from sinsjax.units import ARCMIN

_GROWTH = 0.02  # length of a step, of the time since the last reset
_LAG_STEP, _LAG_REACH = 0.5, 3.0  # no step is longer than tau/2 up to 3 ell, while P shrinks
_MOST_STEPS = 5000  # of such steps in a run
_SIDE_BY_SIDE = 256  # runs of similar length that step together


class Lane(NamedTuple):
    """A run to predict."""

    problem: ResetProblem  # the filter and its place
    times_s: tuple[float, ...]  # times of its resets, s
    heading: float  # initial heading error, rad
    tilt: complex = 0j  # initial level error, east and north as a complex number, rad


def predict_settling_times(
    lanes: Sequence[Lane],
    run_s: float | Sequence[float],
    band: float | Sequence[float] = 10 * ARCMIN,
    sigmas: float | Sequence[float] = MEDIAN_SIGMAS,
) -> NDArray:
    """Return the settling times of runs, s; inf for one that does not settle within the run.

    All runs step side by side, so that a thousand cost little more than one.

    Args:
        lanes: the runs.
        run_s: duration of all runs or of each, s.
        band: heading error within which a run is settled, of all runs or of each, rad.
        sigmas: how many sigma of the sensors' noise narrow the band, of all runs or of each: 0.75
            for a median run.
    """
    durations, bands, by_run = (np.broadcast_to(a, len(lanes)) for a in (run_s, band, sigmas))
    ends = zip(lanes, durations.tolist(), strict=True)
    runs = [(lane.problem, lane.times_s, duration) for lane, duration in ends]
    steps = {run: _steps(*run) for run in set(runs)}
    order = np.argsort([len(steps[run]) for run in runs], kind="stable")
    settled = np.empty(len(lanes))
    for begin in range(0, len(lanes), _SIDE_BY_SIDE):
        block = order[begin : begin + _SIDE_BY_SIDE]
        chosen = [lanes[k] for k in block], [steps[runs[k]] for k in block]
        settled[block] = _settle(*chosen, bands[block], by_run[block])
    return settled


def _settle(
    lanes: Sequence[Lane], steps: Sequence[NDArray], bands: NDArray, sigmas: NDArray
) -> NDArray:
    """Return the times from which headings and noise stay within their bands, s; inf for never."""
    problem = _stack_problems(lanes)
    now, settled = np.zeros(len(lanes)), np.full(len(lanes), math.inf)
    before = np.full(len(lanes), math.inf)
    for dt, since, heading in _headings(lanes, steps):
        outside = np.abs(heading) + sigmas * heading_sigma(since, problem) - bands
        now = now + dt
        is_entry = (outside <= 0) & (before > 0)
        crossing = now - dt * outside / np.where(is_entry, outside - before, -1.0)
        settled = np.where(outside > 0, math.inf, np.where(is_entry, crossing, settled))
        before = np.where(dt > 0, outside, before)
    return settled


def _headings(
    lanes: Sequence[Lane], steps: Sequence[NDArray]
) -> Iterator[tuple[NDArray, NDArray, NDArray]]:
    """Yield length, time since the last reset, s, and heading error, rad, after each step."""
    problem = _stack_problems(lanes)
    g, north, level = problem.gravity, problem.north_rate, problem.level
    densities = (*[problem.velocity_noise] * 2, *[problem.tilt_noise] * 2)
    start = np.zeros((5, 5, len(lanes)))
    start[range(5), range(5)] = np.square([*[problem.velocity] * 2, level, level, problem.heading])
    p, x = start.copy(), np.zeros((5, len(lanes)))  # velocity and tilt, east and north; heading
    v = np.zeros(len(lanes), complex)
    tilt = np.array([lane.tilt for lane in lanes], complex)
    heading = np.array([lane.heading for lane in lanes], float)
    since = np.zeros(len(lanes))
    together = np.zeros((max(map(len, steps)), 3, len(lanes)))  # a run that is over stands still
    for lane, steps_of_run in enumerate(steps):
        together[: len(steps_of_run), :, lane] = steps_of_run
    for dt, is_fed, is_reset in together:
        rate = 1j * north * (np.exp(-1j * heading) - 1)
        force_dt = g * dt * (tilt + rate * dt / 2)
        v, tilt = v + force_dt, tilt + rate * dt
        tilt_dt, heading_dt = g * dt, north * dt
        feigned_dt = -1j * problem.is_force_measured * force_dt + tilt_dt * heading_dt / 2
        for m in (p, p.transpose(1, 0, 2), x):
            m[0] += tilt_dt * m[2] + feigned_dt.real * m[4]
            m[1] += tilt_dt * m[3] + feigned_dt.imag * m[4]
            m[2] += heading_dt * m[4]
        for state, density in enumerate(densities):
            p[state, state] += density * dt
        for axis, velocity in enumerate((v.real, v.imag)):
            gain = p[axis] * (dt / (p[axis, axis] * dt + problem.measurement_noise))
            x += gain * (velocity - x[axis])
            p -= gain[:, None] * p[axis]
        fed = np.where(is_fed, x, 0.0)
        x -= fed
        v = v - fed[0] - 1j * fed[1]
        tilt = (tilt - fed[2] - 1j * fed[3]) * np.exp(1j * fed[4])
        heading = np.remainder(heading - fed[4] + math.pi, 2 * math.pi) - math.pi
        since = since + dt
        yield dt, since, heading
        if is_reset.any():
            p = np.where(is_reset, start, p)
            since = np.where(is_reset, 0.0, since)


def _stack_problems(lanes: Sequence[Lane]) -> ResetProblem:
    """Return the problems as one, its fields (lanes,)."""
    return ResetProblem(*np.array([lane.problem for lane in lanes], float).T)


def _steps(problem: ResetProblem, times_s: Sequence[float], run_s: float) -> NDArray:
    """Return steps that are short after each reset and grow, up to a feedback or a reset, (n, 3).

    A row has its length in s and whether a feedback, and whether a reset, ends it.
    """
    steps = []
    feedback_s, reach_s = problem.feedback_s, _LAG_REACH * problem.ell
    shortest = max(min(problem.tau / 4, levelling_time(problem) / 20), run_s / 1e5)
    longest = max(_LAG_STEP * problem.tau, shortest, run_s / _MOST_STEPS)
    for begin, end in zip((0.0, *times_s), (*times_s, run_s), strict=True):
        now = begin
        while now < end:
            since = now - begin
            step = max(shortest, _GROWTH * since)
            step = min(step, longest) if since < reach_s else step
            is_fed = step >= feedback_s
            later = now + step
            if not is_fed:
                feedback = (math.floor(now / feedback_s + 1e-6) + 1) * feedback_s
                is_fed = later >= feedback - 0.1 * step
                later = feedback if is_fed else later
            is_last = later >= end - 0.1 * step
            later = end if is_last else later
            steps.append((later - now, is_fed or is_last, is_last and end != run_s))
            now = later
    return np.array(steps, float)
