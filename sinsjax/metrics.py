"""What a run is judged by, accumulated as it goes: no curve has to be stored for it.

Everything is observed at record times, for one run. phi is the misalignment that is left in the
*corrected* attitude, what a user would be given. Without a reference attitude phi is NaN.
"""

from typing import NamedTuple

import jax.numpy as jnp

from sinsjax.algebra import dot, solve3
from sinsjax.alignment.base import AttitudeCovariance
from sinsjax.rotations import misalignment, to_euler
from sinsjax.types import Array, Flag, Quat, Scalar, Vec3


class Observation(NamedTuple):
    """One run at one record time: misalignment (rad, n), its 1 sigma, and Euler angles (rad)."""

    phi: Vec3
    sigma: Vec3
    pitch: Scalar
    roll: Scalar
    yaw: Scalar


class Criteria(NamedTuple):
    """What the runs of a study are judged against.

    Attributes:
        bands: (B,) half-widths about the floor, rad.
        window_start: statistics use record times in (start, end], s.
        window_end: s.
        consistency_after: record times after this one count for the P above error shares, s.
        steady_after: record times after this one are the steady process, s.
    """

    bands: Array
    window_start: Scalar
    window_end: Scalar
    consistency_after: Scalar
    steady_after: Scalar


class Window(NamedTuple):
    """Sums over the window, of differences from the first value in it (no cancellation)."""

    count: Scalar
    first: tuple[Scalar, ...]
    sums: tuple[Scalar, ...]
    squares: tuple[Scalar, ...]


class Metrics(NamedTuple):
    """Accumulators of one run.

    Attributes:
        outside_until: for each band, end of the last record interval outside it, s.
        window: sums of phi (e, n, u), pitch, roll and yaw.
        above: record times at which P_UU exceeded phi_u^2, at which it exceeded
            (phi_u - floor)^2, and phi_u^2 again in the steady process.
        judged: record times that each of these counts looked at.
        last: the latest observation.
    """

    outside_until: Array
    window: Window
    above: tuple[Scalar, Scalar, Scalar]
    judged: tuple[Scalar, Scalar, Scalar]
    last: Observation


class Outcome(NamedTuple):
    """What is left of a run at its end, SI units; angles in rad.

    Attributes:
        last: observation at the last record time.
        outside_until: as in `Metrics`.
        mean: window means of phi (e, n, u), pitch, roll, yaw.
        std: window standard deviations of the same.
        above_share: `Metrics.above` over `Metrics.judged`.
        nees: phi' P^-1 phi over the attitude states.
        nis_u: (phi_u - floor)^2 / P_UU.
        floor: rad, the floor phi_u was compared with.
    """

    last: Observation
    outside_until: Array
    mean: tuple[Scalar, ...]
    std: tuple[Scalar, ...]
    above_share: tuple[Scalar, Scalar, Scalar]
    nees: Scalar
    nis_u: Scalar
    floor: Scalar


def observe(q_true: Quat, q_hat: Quat, covariance: AttitudeCovariance) -> Observation:
    """Compare a corrected attitude with the truth."""
    sigma = Vec3(*(jnp.sqrt(v) for v in (covariance.ee, covariance.nn, covariance.uu)))
    return Observation(misalignment(q_true, q_hat), sigma, *to_euler(q_hat))


def start(criteria: Criteria, first: Observation) -> Metrics:
    """Accumulators before the first record."""
    zero = jnp.zeros_like(first.phi.x)
    six = (zero,) * 6
    window = Window(zero, six, six, six)
    three = (zero,) * 3
    return Metrics(jnp.zeros_like(criteria.bands) + zero, window, three, three, first)


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
    judged = (after, after, known & (time > criteria.steady_after))
    above = (variance > now.phi.z**2, variance > error**2, variance > now.phi.z**2)
    # NaN is outside every band.
    inside = jnp.abs(error) <= criteria.bands
    return Metrics(
        outside_until=jnp.where(inside, metrics.outside_until, time),
        window=_widen(
            metrics.window,
            now,
            (time > criteria.window_start) & (time <= criteria.window_end),
        ),
        above=tuple(_count(n, j & a) for n, j, a in zip(metrics.above, judged, above, strict=True)),
        judged=tuple(_count(n, j) for n, j in zip(metrics.judged, judged, strict=True)),
        last=now,
    )


def _widen(window: Window, now: Observation, inside: Flag) -> Window:
    opening = inside & (window.count == 0)
    values = (*now.phi, now.pitch, now.roll, now.yaw)
    first = tuple(jnp.where(opening, v, f) for v, f in zip(values, window.first, strict=True))
    steps = tuple(_wrap(v - f) for v, f in zip(values, first, strict=True))
    return Window(
        count=_count(window.count, inside),
        first=first,
        sums=tuple(jnp.where(inside, s + d, s) for s, d in zip(window.sums, steps, strict=True)),
        squares=tuple(
            jnp.where(inside, s + d * d, s) for s, d in zip(window.squares, steps, strict=True)
        ),
    )


def _count(so_far: Scalar, happened: Flag) -> Scalar:
    return jnp.where(happened, so_far + 1, so_far)


def _wrap(angle: Scalar) -> Scalar:
    """Into [-pi, pi]."""
    return angle - 2 * jnp.pi * jnp.round(angle / (2 * jnp.pi))


def finish(metrics: Metrics, covariance: AttitudeCovariance, floor: Scalar) -> Outcome:
    """What a run is reported with.

    The standard deviation is that of the record times in the window (divisor n - 1). An empty
    window, or a method without covariance, gives NaN.
    """
    window, phi = metrics.window, metrics.last.phi
    n = window.count
    mean = tuple(_wrap(f + s / n) for f, s in zip(window.first, window.sums, strict=True))
    spread = zip(window.sums, window.squares, strict=True)
    std = tuple(jnp.sqrt(jnp.maximum(q - s * s / n, 0.0) / (n - 1)) for s, q in spread)
    return Outcome(
        last=metrics.last,
        outside_until=metrics.outside_until,
        mean=mean,
        std=std,
        above_share=tuple(a / n for a, n in zip(metrics.above, metrics.judged, strict=True)),
        nees=dot(phi, solve3(tuple(covariance), phi)),
        nis_u=(phi.z - floor) ** 2 / covariance.uu,
        floor=floor,
    )
