"""Alignment in the inertial frame, as moments that grow sample by sample.

The gyros carry every specific force to the body frame frozen at the first sample, b0; gravity's
reaction in the navigation frame frozen there, n0, is known, and turns with the Earth. One constant
rotation takes one into the other:

    C_b^n(t) = C_{n0}^{n(t)} C_{b0}^{n0} C_{b(t)}^{b0},    C_{n0}^{n(t)} = exp(-w_ie t x).

No initial attitude, velocity or belief enters: what a draw's sensors measure decides alone. Two
ways to find C_{b0}^{n0} stand here: least squares of the integrated velocities, and two of their
weighted means. The base must not travel; that it sways does not matter.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from sinsjax.alignment.base import (
    AttitudeCovariance,
    Ending,
    Method,
    Options,
    Site,
    no_covariance,
)
from sinsjax.alignment.coarse import two_vectors
from sinsjax.alignment.inertial_frame.eigenvector import of_largest
from sinsjax.alignment.limits import Biases, Limit, unaided
from sinsjax.maths import rotations
from sinsjax.maths.algebra import add, cross, dot, scale
from sinsjax.strapdown import mechanisation
from sinsjax.strapdown.earth import Place
from sinsjax.types import Navigation, Quat, Sample, Scalar, Vec3


class Frames(NamedTuple):
    """Where body and navigation frame are, seen from where they were at the start.

    Attributes:
        body: C_{b(t)}^{b0}.
        earth: C_{n0}^{n(t)}.
    """

    body: Quat
    earth: Quat


class InertialState(NamedTuple):
    """One run under way.

    Attributes:
        nav: what it began with, which holds until there is a sample.
        frames: see `Frames`.
        moments: of the velocities, of the method.
        count: samples so far.
    """

    nav: Navigation
    frames: Frames
    moments: Any
    count: Scalar


def _method(options: Options, start: Any, add_sample: Any, to_n0: Any) -> Method:
    """A method from its moments.

    Args:
        options: what decides the program.
        start: zero -> moments before the first sample.
        add_sample: (moments, velocity increment in b0, place, n, dt) -> moments.
        to_n0: (moments, samples so far) -> C_{b0}^{n0}.
    """
    dt = options.dt

    def init(params: Any, nav: Navigation) -> InertialState:
        zero = jnp.zeros_like(nav.ve)
        one = Quat(zero + 1, zero, zero, zero)
        return InertialState(nav, Frames(one, one), start(zero), zero)

    def step(
        params: Any, site: Site, state: InertialState, sample: Sample, n: Scalar
    ) -> InertialState:
        felt = rotations.rotate(state.frames.body, sample.dv)
        frames = Frames(
            rotations.multiply(state.frames.body, sample.turn),
            rotations.exp(scale(-n * dt, _earth_rate(site.place))),
        )
        moments = add_sample(state.moments, felt, site.place, n, dt)
        return InertialState(state.nav, frames, moments, n)

    def attitude(state: InertialState) -> Quat:
        frames = state.frames
        found = rotations.multiply(to_n0(state.moments, state.count), frames.body)
        found = rotations.multiply(frames.earth, found)
        begun = state.count > 0
        return jax.tree.map(lambda a, b: jnp.where(begun, a, b), found, state.nav.q)

    return Method(init, step, _turn, attitude, _covariance, _normalise, _limit)


def _turn(params: Any, site: Site, state: InertialState) -> InertialState:
    return state._replace(nav=mechanisation.reverse(state.nav))  # studies with passes are refused


def _covariance(state: InertialState) -> AttitudeCovariance:
    return no_covariance(state.nav.ve)


def _normalise(state: InertialState) -> InertialState:
    body = rotations.normalise(state.frames.body)
    nav = state.nav._replace(q=rotations.normalise(state.nav.q))
    return state._replace(nav=nav, frames=state.frames._replace(body=body))


def _limit(params: Any, place: Place, biases: Biases, ending: Ending) -> Limit:
    return unaided(place, biases)


def _earth_rate(place: Place) -> Vec3:
    return Vec3(jnp.zeros_like(place.rate_n), place.rate_n, place.rate_u)


class VelocityMoments(NamedTuple):
    """Of the integrated specific forces alpha in b0 and beta in n0, m/s.

    Attributes:
        velocity: alpha, up to the last sample.
        profile: rows of the sum of beta alpha'.
        weight: half the sum of |alpha|^2 + |beta|^2, no less than the largest eigenvalue.
    """

    velocity: Vec3
    profile: tuple[Vec3, Vec3, Vec3]
    weight: Scalar


def optimisation(options: Options) -> Method:
    """The rotation that takes all velocities alpha closest to beta (Davenport's q-method).

    Wu et al., Aerosp. Sci. Technol. 15 (2011), and Wu and Pan, IEEE TAES 49 (2013): the
    eigenvector of the largest eigenvalue of a 4 x 4 matrix, found at record times.
    """
    return _method(options, _no_velocities, _add_velocity, _least_squares)


def _no_velocities(zero: Scalar) -> VelocityMoments:
    none = Vec3(zero, zero, zero)
    return VelocityMoments(none, (none, none, none), zero)


def _add_velocity(
    moments: VelocityMoments, felt: Vec3, place: Place, n: Scalar, dt: Scalar
) -> VelocityMoments:
    alpha, beta = add(moments.velocity, felt), reaction_velocity(place, n * dt)
    rows = zip(moments.profile, beta, strict=True)
    return VelocityMoments(
        alpha,
        tuple(add(row, scale(b, alpha)) for row, b in rows),  # type: ignore[arg-type]
        moments.weight + 0.5 * (dot(alpha, alpha) + dot(beta, beta)),
    )


def reaction_velocity(place: Place, t: Scalar) -> Vec3:
    """Integral over t (s) of gravity's reaction in n0, m/s.

    With e = w_ie / W: g [z sin(Wt)/W + (e x z)(1 - cos Wt)/W + e (e.z)(t - sin(Wt)/W)].
    """
    rate = jnp.sqrt(place.rate_n**2 + place.rate_u**2)
    e = scale(1 / rate, _earth_rate(place))
    up = Vec3(jnp.zeros_like(e.z), jnp.zeros_like(e.z), jnp.ones_like(e.z))
    sine, versine = jnp.sin(rate * t) / rate, 2 * jnp.sin(rate * t / 2) ** 2 / rate
    turned = add(scale(sine, up), scale(versine, cross(e, up)))
    return scale(place.gravity, add(turned, scale(e.z * (t - sine), e)))


def _least_squares(moments: VelocityMoments, count: Scalar) -> Quat:
    """C_{b0}^{n0} by Davenport: K of B = sum of beta alpha', and its largest eigenvalue."""
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = moments.profile
    return of_largest(
        (
            *(xx + yy + zz, zy - yz, xz - zx, yx - xy),
            *(xx - yy - zz, xy + yx, xz + zx),
            *(yy - xx - zz, yz + zy),
            zz - xx - yy,
        ),
        moments.weight,
    )


def optimised(samples: Sample, place: Place, dt: Scalar) -> Quat:
    """`optimisation` of a whole interval, as a `coarse.Coarse`: attitude at its end.

    Args:
        samples: compensated, leaves (n,).
        place: Earth rates and gravity.
        dt: sample time, s.
    """
    counts = 1 + jnp.arange(samples.dv.x.size, dtype=samples.dv.x.dtype)
    zero = jnp.zeros_like(counts[0])

    def over(
        carry: tuple[Quat, VelocityMoments], xs: tuple[Sample, Scalar]
    ) -> tuple[tuple[Quat, VelocityMoments], None]:
        (body, moments), (sample, n) = carry, xs
        felt = rotations.rotate(body, sample.dv)
        moments = _add_velocity(moments, felt, place, n, dt)
        return (rotations.multiply(body, sample.turn), moments), None

    start = Quat(zero + 1, zero, zero, zero), _no_velocities(zero)
    (body, moments), _ = jax.lax.scan(over, start, (samples, counts))
    earth = rotations.exp(scale(-counts[-1] * dt, _earth_rate(place)))
    found = rotations.multiply(_least_squares(moments, counts[-1]), body)
    return rotations.multiply(earth, found)


class ForceMoments(NamedTuple):
    """Sums of m^0, m^1, m^2 and m^3 times a velocity increment, m from mid-sample to mid-sample.

    Attributes:
        felt: in b0, m/s.
        expected: in n0, m/s.
    """

    felt: tuple[Vec3, ...]
    expected: tuple[Vec3, ...]


def inertial(options: Options) -> Method:
    """The rotation by weighted mean and slope of the specific force, `coarse.inertial`."""
    return _method(options, _no_forces, _add_force, _mean_and_slope)


def _no_forces(zero: Scalar) -> ForceMoments:
    none = (Vec3(zero, zero, zero),) * 4
    return ForceMoments(none, none)


def _add_force(
    moments: ForceMoments, felt: Vec3, place: Place, n: Scalar, dt: float
) -> ForceMoments:
    middle = n - 0.5
    up = Vec3(jnp.zeros_like(place.gravity), jnp.zeros_like(place.gravity), place.gravity * dt)
    turn = rotations.exp(scale(middle * dt, _earth_rate(place)))

    def added(sums: tuple[Vec3, ...], one: Vec3) -> tuple[Vec3, ...]:
        return tuple(add(total, scale(middle**k, one)) for k, total in enumerate(sums))

    return ForceMoments(
        added(moments.felt, felt), added(moments.expected, rotations.rotate(turn, up))
    )


def _mean_and_slope(moments: ForceMoments, count: Scalar) -> Quat:
    """TRIAD of the means with weights 1 - tau^2 and (1 - tau^2) tau, tau = 2 m/n - 1."""
    half = 2 / jnp.maximum(count, 1.0)

    def weighted(sums: tuple[Vec3, ...]) -> Any:
        # With h = 2/n: 1 - tau^2 = 2 hm - (hm)^2, times tau = -2 hm + 3 (hm)^2 - (hm)^3.
        scaled = [scale(half**k, total) for k, total in enumerate(sums)]
        mean = add(scale(2.0, scaled[1]), scale(-1.0, scaled[2]))
        slope = add(scale(-2.0, scaled[1]), scale(3.0, scaled[2]))
        slope = add(slope, scale(-1.0, scaled[3]))
        return jnp.stack([jnp.stack(mean), jnp.stack(slope)])

    return two_vectors(weighted(moments.felt), weighted(moments.expected))
