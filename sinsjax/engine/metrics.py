"""Metrics of a run, accumulated as it proceeds, so that no curve has to be stored.

All are of one run, observed at output times. phi is the misalignment of the *corrected* attitude,
which a user would be given. Without a reference attitude phi is NaN.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from sinsjax.maths.algebra import dot, solve3
from sinsjax.maths.rotations import misalignment, tilt, to_euler
from sinsjax.methods.floors import BiasFloor
from sinsjax.methods.method import AttitudeCovariance
from sinsjax.methods.schedules import interpolate
from sinsjax.types import Array, Flag, Quat, Scalar, Vec3


class Observation(NamedTuple):
    """One run at one output time: misalignment (rad, n), its 1 sigma, and Euler angles (rad).

    What belongs to the heading is NaN if the method finds none, and phi is then the tilt alone.
    """

    phi: Vec3
    sigma: Vec3
    pitch: Scalar
    roll: Scalar
    yaw: Scalar


class Criteria(NamedTuple):
    """Thresholds and times by which the runs of a study are judged.

    Attributes:
        bands: (B,) half-widths about the floor and about the truth, rad.
        window_start: statistics use output times in (start, end], s.
        window_end: s.
        consistency_after: output times after this one count for the P above error shares, s.
        steady_after: output times after this one are the steady process, s.
        sharpness: sharpness k of the edge of a band if settling times are smoothed for
            differentiation: an error of x times the band counts as outside with the share
            x^k / (1 + x^k); None for a hard edge.
        report_samples: (T,) numbers of the samples, from 1, at whose output times heading error,
            its sigma and NEES are reported; None for none.
    """

    bands: Array
    window_start: Scalar
    window_end: Scalar
    consistency_after: Scalar
    steady_after: Scalar
    sharpness: Scalar | None = None
    report_samples: Array | None = None


class Window(NamedTuple):
    """Sums over the window, of differences from the first value in it (no cancellation).

    Attributes:
        count: output times in the window so far.
        first: (6,) first values of phi (e, n, u), pitch, roll and yaw.
        sums: (6,) of the differences from them.
        squares: (6,) of the squared differences.
    """

    count: Scalar
    first: Array
    sums: Array
    squares: Array


class Metrics(NamedTuple):
    """Accumulators of one run.

    Attributes:
        outside_until: (2, B) for each band about the floor, and for each about the truth, end of
            the last interval outside it, s.
        window: see `Window`.
        above: (3,) output times at which P_UU exceeded phi_u^2, at which it exceeded
            (phi_u - floor)^2, and phi_u^2 again in the steady process.
        judged: (3,) output times included in each of these counts.
        last: the latest observation.
        at_times: (T, 3) phi_u (rad), its 1 sigma (rad) and NEES at the reported times, NaN until
            then; None without such times.
    """

    outside_until: Array
    window: Window
    above: Array
    judged: Array
    last: Observation
    at_times: Array | None = None


class Outcome(NamedTuple):
    """Results of a run, SI units; angles in rad.

    Attributes:
        last: observation at the last output time.
        outside_until: as in `Metrics`.
        mean: window means of phi (e, n, u), pitch, roll, yaw.
        std: window standard deviations of the same.
        above_share: `Metrics.above` over `Metrics.judged`.
        nees: phi' P^-1 phi over the attitude states.
        nis_u: (phi_u - floor)^2 / P_UU.
        floor: bias floor of the run.
        results: basis of the method's own result columns, see `Program.results`.
        at_times: as in `Metrics`.
    """

    last: Observation
    outside_until: Array
    mean: tuple[Scalar, ...]
    std: tuple[Scalar, ...]
    above_share: tuple[Scalar, Scalar, Scalar]
    nees: Scalar
    nis_u: Scalar
    floor: BiasFloor
    results: Any = None
    at_times: Array | None = None


def observe(
    q_true: Quat, q_hat: Quat, covariance: AttitudeCovariance, *, finds_heading: bool = True
) -> Observation:
    """Return the observation of a corrected attitude against the truth, NaN if unknown.

    The covariance is that of its misalignment. If no heading is found, any gives the same.
    """
    sigma = Vec3(*(jnp.sqrt(v) for v in (covariance.ee, covariance.nn, covariance.uu)))
    pitch, roll, yaw = to_euler(q_hat)
    if finds_heading:
        return Observation(misalignment(q_true, q_hat), sigma, pitch, roll, yaw)
    phi, unknown = tilt(q_true, q_hat), jnp.full_like(yaw, jnp.nan)
    return Observation(phi._replace(z=unknown), sigma._replace(z=unknown), pitch, roll, unknown)


def initial_metrics(criteria: Criteria, zero: Scalar) -> Metrics:
    """Return the accumulators before the first interval, in zeros of the given type."""
    nothing = Vec3(zero, zero, zero)
    six, three = jnp.zeros(6) + zero, jnp.zeros(3) + zero
    window = Window(zero, six, six, six)
    last = Observation(nothing, nothing, zero, zero, zero)
    outside_until = jnp.zeros((2, *criteria.bands.shape)) + zero
    at_times = None
    if criteria.report_samples is not None:
        at_times = jnp.full((*criteria.report_samples.shape, 3), jnp.nan) + zero
    return Metrics(outside_until, window, three, three, last, at_times)


def accumulate(
    metrics: Metrics, criteria: Criteria, now: Observation, *, floor: Scalar, time: Scalar
) -> Metrics:
    """Return the accumulators after one more observation at a time, s; floor of phi_u in rad."""
    error = now.phi.z - floor
    variance = now.sigma.z**2
    # A comparison with NaN is False, which would count as an error above P.
    known = jnp.isfinite(variance - error)
    after = known & (time > criteria.consistency_after)
    judged = jnp.stack([after, after, known & (time > criteria.steady_after)])
    above = variance > jnp.stack([now.phi.z, error, now.phi.z]) ** 2
    return Metrics(
        outside_until=interpolate(
            jnp.stack([outside(criteria, error), outside(criteria, now.phi.z)]),
            time,
            metrics.outside_until,
        ),
        window=_add_to_window(
            metrics.window,
            now,
            (time > criteria.window_start) & (time <= criteria.window_end),
        ),
        above=jnp.where(judged & above, metrics.above + 1, metrics.above),
        judged=jnp.where(judged, metrics.judged + 1, metrics.judged),
        last=now,
        at_times=metrics.at_times,
    )


def store_error_at_report_times(
    metrics: Metrics, criteria: Criteria, covariance: AttitudeCovariance, n: Scalar
) -> Metrics:
    """Store the latest observation, that of sample n, if its time is one of those reported."""
    if criteria.report_samples is None:
        return metrics
    phi, sigma = metrics.last.phi, metrics.last.sigma
    now = jnp.stack([phi.z, sigma.z, nees(phi, covariance)])
    due = (criteria.report_samples == n)[:, None]
    return metrics._replace(at_times=jnp.where(due, now[None], metrics.at_times))


def nees(phi: Vec3, covariance: AttitudeCovariance) -> Scalar:
    """Return NEES, phi' P^-1 phi over the attitude states."""
    return dot(phi, solve3(tuple(covariance), phi))


def outside(criteria: Criteria, error: Scalar) -> Array:
    """Return whether an error is outside each band, NaN being outside; or the smoothed share."""
    if criteria.sharpness is None:
        return ~(jnp.abs(error) <= criteria.bands)
    # The square, and never zero, where the logarithm has no derivative; nor so near to zero that
    # the derivative overflows.
    ratio = error * error / criteria.bands**2 + 1e-24
    return jax.nn.sigmoid(criteria.sharpness / 2 * jnp.log(ratio))


def _add_to_window(window: Window, now: Observation, inside: Flag) -> Window:
    """Return the window with an observation added, if it is inside."""
    opening = inside & (window.count == 0)
    values = jnp.stack([*now.phi, now.pitch, now.roll, now.yaw])
    first = jnp.where(opening, values, window.first)
    step = _wrap_angle(values - first)
    return Window(
        count=jnp.where(inside, window.count + 1, window.count),
        first=first,
        sums=jnp.where(inside, window.sums + step, window.sums),
        squares=jnp.where(inside, window.squares + step * step, window.squares),
    )


def _wrap_angle(angle: Array) -> Array:
    """Return the angle in [-pi, pi]."""
    return angle - 2 * jnp.pi * jnp.round(angle / (2 * jnp.pi))


def finish(
    metrics: Metrics, covariance: AttitudeCovariance, floor: BiasFloor, results: Any = None
) -> Outcome:
    """Return the outcome of a run.

    The standard deviation is over the output times in the window (divisor n - 1). An empty window,
    or a method without covariance, gives NaN.
    """
    window, phi = metrics.window, metrics.last.phi
    n, sums = window.count, window.sums
    mean = _wrap_angle(window.first + sums / n)
    std = jnp.sqrt(jnp.maximum(window.squares - sums * sums / n, 0.0) / (n - 1))
    return Outcome(
        last=metrics.last,
        outside_until=metrics.outside_until,
        mean=tuple(mean),
        std=tuple(std),
        above_share=tuple(metrics.above / metrics.judged),
        nees=nees(phi, covariance),
        nis_u=(phi.z - floor.phi.z) ** 2 / covariance.uu,
        floor=floor,
        results=results,
        at_times=metrics.at_times,
    )
