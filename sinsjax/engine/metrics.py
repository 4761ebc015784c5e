"""What a run is judged by, accumulated as it goes: no curve has to be stored for it.

Everything is observed at record times, for one run. phi is the misalignment that is left in the
*corrected* attitude, what a user would be given. Without a reference attitude phi is NaN.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from sinsjax.maths.algebra import dot, solve3
from sinsjax.maths.rotations import misalignment, to_euler
from sinsjax.methods.base import AttitudeCovariance
from sinsjax.methods.floors import BiasFloor
from sinsjax.methods.schedules import mix
from sinsjax.types import Array, Flag, Quat, Scalar, Vec3


class Observation(NamedTuple):
    """One run at one record time: misalignment (rad, n), its 1 sigma, and Euler angles (rad)."""

    phi: Vec3
    sigma: Vec3
    pitch: Scalar
    roll: Scalar
    yaw: Scalar


FIELDS = 9
"""Numbers of an `Observation`."""


class Criteria(NamedTuple):
    """What the runs of a study are judged against.

    Attributes:
        bands: (B,) half-widths about the floor and about the truth, rad.
        window_start: statistics use record times in (start, end], s.
        window_end: s.
        consistency_after: record times after this one count for the P above error shares, s.
        steady_after: record times after this one are the steady process, s.
        sharpness: None, or how sharp the edge of a band is where settling times are relaxed to be
            differentiated: an error of x times the band is outside with the share
            x^k / (1 + x^k), k being the sharpness.
        report_samples: None, or (T,) numbers of the samples, from 1, at whose record times
            heading error, its sigma and NEES are reported.
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
        count: record times in the window so far.
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
            the last record interval outside it, s.
        window: see `Window`.
        above: (3,) record times at which P_UU exceeded phi_u^2, at which it exceeded
            (phi_u - floor)^2, and phi_u^2 again in the steady process.
        judged: (3,) record times that each of these counts looked at.
        last: the latest observation.
        at_times: None, or (T, 3) phi_u (rad), its 1 sigma (rad) and NEES at the times that are
            reported; NaN until then.
    """

    outside_until: Array
    window: Window
    above: Array
    judged: Array
    last: Observation
    at_times: Array | None = None


class Outcome(NamedTuple):
    """What is left of a run at its end, SI units; angles in rad.

    Attributes:
        last: observation at the last record time.
        outside_until: as in `Metrics`.
        mean: window means of phi (e, n, u), pitch, roll, yaw.
        std: window standard deviations of the same.
        above_share: `Metrics.above` over `Metrics.judged`.
        nees: phi' P^-1 phi over the attitude states.
        nis_u: (phi_u - limit)^2 / P_UU.
        limit: what the run's own sensor biases leave of phi, from which the heading was judged.
        results: what the method tells of itself, see `Method.results`.
        at_times: as in `Metrics`.
    """

    last: Observation
    outside_until: Array
    mean: tuple[Scalar, ...]
    std: tuple[Scalar, ...]
    above_share: tuple[Scalar, Scalar, Scalar]
    nees: Scalar
    nis_u: Scalar
    limit: BiasFloor
    results: Any = None
    at_times: Array | None = None


def observe(q_true: Quat, q_hat: Quat, covariance: AttitudeCovariance) -> Observation:
    """Compare a corrected attitude with the truth."""
    sigma = Vec3(*(jnp.sqrt(v) for v in (covariance.ee, covariance.nn, covariance.uu)))
    return Observation(misalignment(q_true, q_hat), sigma, *to_euler(q_hat))


def as_row(now: Observation) -> Array:
    """An observation as one array (fields, ...), to be stored record by record.

    XLA:CPU would update several arrays side by side by copying them whole, every record.
    """
    return jnp.stack(jax.tree.leaves(now))


def from_rows(rows: Array) -> Observation:
    """Observations with leaves (records, ...) from rows (records, fields, ...) of `as_row`."""
    e, n, u, *sigma, pitch, roll, yaw = (rows[:, i] for i in range(FIELDS))
    return Observation(Vec3(e, n, u), Vec3(*sigma), pitch, roll, yaw)


def start(criteria: Criteria, zero: Scalar) -> Metrics:
    """Accumulators before the first record, in zeros of the type given."""
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
    """Take one observation in.

    Args:
        metrics: so far.
        criteria: of the study.
        now: the observation.
        floor: what phi_u should settle to, rad.
        time: of the observation, s.
    """
    error = now.phi.z - floor
    variance = now.sigma.z**2
    # A comparison with NaN is False, which would count as an error above P.
    known = jnp.isfinite(variance - error)
    after = known & (time > criteria.consistency_after)
    judged = jnp.stack([after, after, known & (time > criteria.steady_after)])
    above = variance > jnp.stack([now.phi.z, error, now.phi.z]) ** 2
    return Metrics(
        outside_until=mix(
            jnp.stack([outside(criteria, error), outside(criteria, now.phi.z)]),
            time,
            metrics.outside_until,
        ),
        window=_widen(
            metrics.window,
            now,
            (time > criteria.window_start) & (time <= criteria.window_end),
        ),
        above=_count(metrics.above, judged & above),
        judged=_count(metrics.judged, judged),
        last=now,
        at_times=metrics.at_times,
    )


def report(
    metrics: Metrics, criteria: Criteria, covariance: AttitudeCovariance, n: Scalar
) -> Metrics:
    """Keep what the latest observation says where its time is one that is reported.

    Args:
        metrics: with the observation taken in.
        criteria: of the study.
        covariance: at the observation.
        n: number of its sample.
    """
    if criteria.report_samples is None:
        return metrics
    phi, sigma = metrics.last.phi, metrics.last.sigma
    now = jnp.stack([phi.z, sigma.z, nees(phi, covariance)])
    due = (criteria.report_samples == n)[:, None]
    return metrics._replace(at_times=jnp.where(due, now[None], metrics.at_times))


def nees(phi: Vec3, covariance: AttitudeCovariance) -> Scalar:
    """NEES, phi' P^-1 phi over the attitude states."""
    return dot(phi, solve3(tuple(covariance), phi))


def outside(criteria: Criteria, error: Scalar) -> Array:
    """Whether an error is outside each band, NaN being outside; or which share of it is."""
    if criteria.sharpness is None:
        return ~(jnp.abs(error) <= criteria.bands)
    # Of the square, and never of zero, where the logarithm has no slope; nor so near to it that
    # the slope overflows.
    ratio = error * error / criteria.bands**2 + 1e-24
    return jax.nn.sigmoid(criteria.sharpness / 2 * jnp.log(ratio))


def _widen(window: Window, now: Observation, inside: Flag) -> Window:
    opening = inside & (window.count == 0)
    values = jnp.stack([*now.phi, now.pitch, now.roll, now.yaw])
    first = jnp.where(opening, values, window.first)
    step = _wrap(values - first)
    return Window(
        count=_count(window.count, inside),
        first=first,
        sums=jnp.where(inside, window.sums + step, window.sums),
        squares=jnp.where(inside, window.squares + step * step, window.squares),
    )


def _count(so_far: Array, happened: Array) -> Array:
    return jnp.where(happened, so_far + 1, so_far)


def _wrap(angle: Array) -> Array:
    """Into [-pi, pi]."""
    return angle - 2 * jnp.pi * jnp.round(angle / (2 * jnp.pi))


def finish(
    metrics: Metrics,
    covariance: AttitudeCovariance,
    limit: BiasFloor,
    results: Any = None,
) -> Outcome:
    """What a run is reported with.

    The standard deviation is that of the record times in the window (divisor n - 1). An empty
    window, or a method without covariance, gives NaN.
    """
    window, phi = metrics.window, metrics.last.phi
    n, sums = window.count, window.sums
    mean = _wrap(window.first + sums / n)
    std = jnp.sqrt(jnp.maximum(window.squares - sums * sums / n, 0.0) / (n - 1))
    return Outcome(
        last=metrics.last,
        outside_until=metrics.outside_until,
        mean=tuple(mean),
        std=tuple(std),
        above_share=tuple(metrics.above / metrics.judged),
        nees=nees(phi, covariance),
        nis_u=(phi.z - limit.phi.z) ** 2 / covariance.uu,
        limit=limit,
        results=results,
        at_times=metrics.at_times,
    )
