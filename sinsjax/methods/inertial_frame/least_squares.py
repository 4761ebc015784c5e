"""Least squares of integrated specific forces: sums over samples, and the rotation they give.

C_{b0}^{n0} takes the velocities alpha, the integral of C_b^{b0} f, closest to beta, that of
gravity's reaction: Davenport's matrix of the sum of beta alpha'. The fit takes the base to begin at
rest. On one that surges every alpha is off by the velocity v(0) of the first sample, which costs
more than all that comes later. The fit of the positions takes a and b, sums of alpha and beta:

    C a_n - b_n = (s_n - s_0)/dt - n v(0) + noise.

On a base that stays about its place s this is bounded but for n v(0). So that v(0) may be anything,
what n explains of a and b is taken out of them.
"""

from typing import NamedTuple

import jax.numpy as jnp

from sinsjax.maths.algebra import add, cross, dot, scale
from sinsjax.methods.inertial_frame.eigenvector import of_largest
from sinsjax.strapdown.earth import Place
from sinsjax.types import Quat, Scalar, Vec3

Profile = tuple[Vec3, Vec3, Vec3]
"""Rows of a sum of products x y'."""


def earth_rate(place: Place) -> Vec3:
    """w_ie in n, rad/s."""
    return Vec3(jnp.zeros_like(place.rate_n), place.rate_n, place.rate_u)


class VelocityMoments(NamedTuple):
    """Of the integrated specific forces alpha in b0 and beta in n0, m/s.

    Attributes:
        velocity: alpha, up to the last sample.
        profile: rows of the sum of beta alpha'.
        weight: half the sum of |alpha|^2 + |beta|^2, no less than the largest eigenvalue.
    """

    velocity: Vec3
    profile: Profile
    weight: Scalar


def no_velocities(zero: Scalar) -> VelocityMoments:
    """Before the first sample."""
    none = Vec3(zero, zero, zero)
    return VelocityMoments(none, (none, none, none), zero)


def add_velocity(
    moments: VelocityMoments, felt: Vec3, place: Place, n: Scalar, dt: Scalar
) -> VelocityMoments:
    """A sample more: its velocity increment in b0, m/s, its number n, and dt, s."""
    alpha, beta = add(moments.velocity, felt), reaction_velocity(place, n * dt)
    return VelocityMoments(
        alpha,
        _with_product(moments.profile, beta, alpha),
        moments.weight + 0.5 * (dot(alpha, alpha) + dot(beta, beta)),
    )


def reaction_velocity(place: Place, t: Scalar) -> Vec3:
    """Integral over t (s) of gravity's reaction in n0, m/s.

    With e = w_ie / W: g [z sin(Wt)/W + (e x z)(1 - cos Wt)/W + e (e.z)(t - sin(Wt)/W)].
    """
    rate = jnp.sqrt(place.rate_n**2 + place.rate_u**2)
    e = scale(1 / rate, earth_rate(place))
    up = Vec3(jnp.zeros_like(e.z), jnp.zeros_like(e.z), jnp.ones_like(e.z))
    sine, versine = jnp.sin(rate * t) / rate, 2 * jnp.sin(rate * t / 2) ** 2 / rate
    turned = add(scale(sine, up), scale(versine, cross(e, up)))
    return scale(place.gravity, add(turned, scale(e.z * (t - sine), e)))


def of_velocities(moments: VelocityMoments, count: Scalar) -> Quat:
    """C_{b0}^{n0} after so many samples."""
    return _rotation(moments.profile, moments.weight)


class PositionMoments(NamedTuple):
    """Of the sums a of alpha and b of beta, of all samples up to each, m/s.

    Attributes:
        velocity: alpha, up to the last sample.
        felt: a, likewise.
        expected: b, likewise.
        felt_trend: sum of n a.
        expected_trend: sum of n b.
        profile: rows of the sum of b a'.
        weight: half the sum of |a|^2 + |b|^2.
    """

    velocity: Vec3
    felt: Vec3
    expected: Vec3
    felt_trend: Vec3
    expected_trend: Vec3
    profile: Profile
    weight: Scalar


def no_positions(zero: Scalar) -> PositionMoments:
    """Before the first sample."""
    none = Vec3(zero, zero, zero)
    return PositionMoments(none, none, none, none, none, (none, none, none), zero)


def add_position(
    moments: PositionMoments, felt: Vec3, place: Place, n: Scalar, dt: Scalar
) -> PositionMoments:
    """A sample more, see `add_velocity`."""
    alpha = add(moments.velocity, felt)
    a, b = add(moments.felt, alpha), add(moments.expected, reaction_velocity(place, n * dt))
    return PositionMoments(
        alpha,
        a,
        b,
        add(moments.felt_trend, scale(n, a)),
        add(moments.expected_trend, scale(n, b)),
        _with_product(moments.profile, b, a),
        moments.weight + 0.5 * (dot(a, a) + dot(b, b)),
    )


def of_positions(moments: PositionMoments, count: Scalar) -> Quat:
    """C_{b0}^{n0} after so many samples, of what is left of a and b beside n."""
    squares = jnp.maximum(count * (count + 1) * (2 * count + 1) / 6, 1.0)
    felt, expected = moments.felt_trend, moments.expected_trend
    profile = _with_product(moments.profile, scale(-1 / squares, expected), felt)
    explained = 0.5 * (dot(felt, felt) + dot(expected, expected)) / squares
    return _rotation(profile, moments.weight - explained)


def _with_product(profile: Profile, x: Vec3, y: Vec3) -> Profile:
    east, north, up = (add(row, scale(one, y)) for row, one in zip(profile, x, strict=True))
    return east, north, up


def _rotation(profile: Profile, weight: Scalar) -> Quat:
    """C_{b0}^{n0} by Davenport: K of B = sum of beta alpha', and its largest eigenvalue."""
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = profile
    return of_largest(
        (
            *(xx + yy + zz, zy - yz, xz - zx, yx - xy),
            *(xx - yy - zz, xy + yx, xz + zx),
            *(yy - xx - zz, yz + zy),
            zz - xx - yy,
        ),
        weight,
    )
