"""Alignment in the inertial frame, as moments that grow sample by sample.

The gyros carry every specific force to the body frame frozen at the first sample, b0; gravity's
reaction in the navigation frame frozen there, n0, is known, and turns with the Earth. One constant
rotation takes one into the other:

    C_b^n(t) = C_{n0}^{n(t)} C_{b0}^{n0} C_{b(t)}^{b0},    C_{n0}^{n(t)} = exp(-w_ie t x).

No initial attitude, velocity or belief enters: what a draw's sensors measure decides alone. Three
ways to find C_{b0}^{n0} stand here: least squares of the integrated velocities or positions, and
two weighted means of the force. The base must not travel; that it sways does not matter.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from sinsjax.maths import rotations
from sinsjax.maths.algebra import add, scale
from sinsjax.methods.base import (
    AttitudeCovariance,
    Ending,
    Method,
    Options,
    Site,
    no_covariance,
)
from sinsjax.methods.coarse import two_vectors
from sinsjax.methods.inertial_frame import linear_error
from sinsjax.methods.inertial_frame.least_squares import (
    VelocityMoments,
    add_position,
    add_velocity,
    earth_rate,
    no_positions,
    no_velocities,
    of_positions,
    of_velocities,
)
from sinsjax.methods.limits import Biases, Limit, unaided
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
            rotations.exp(scale(-n * dt, earth_rate(site.place))),
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


def optimisation(options: Options) -> Method:
    """The rotation that takes all velocities alpha closest to beta (Davenport's q-method).

    Wu et al., Aerosp. Sci. Technol. 15 (2011), and Wu and Pan, IEEE TAES 49 (2013): the
    eigenvector of the largest eigenvalue of a 4 x 4 matrix, found at record times.
    """
    return _method(options, no_velocities, add_velocity, of_velocities)._replace(
        error_step=partial(linear_error.error_step, options.dt),
        error_angles=linear_error.error_angles,
        start_error=linear_error.start_error,
    )


def optimisation_position(options: Options) -> Method:
    """The same of positions, sums of velocities, from an initial velocity that is unknown.

    On a base that surges it is left with a fraction of the error: see `least_squares`.
    """
    return _method(options, no_positions, add_position, of_positions)


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
        moments = add_velocity(moments, felt, place, n, dt)
        return (rotations.multiply(body, sample.turn), moments), None

    start = Quat(zero + 1, zero, zero, zero), no_velocities(zero)
    (body, moments), _ = jax.lax.scan(over, start, (samples, counts))
    earth = rotations.exp(scale(-counts[-1] * dt, earth_rate(place)))
    found = rotations.multiply(of_velocities(moments, counts[-1]), body)
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
    turn = rotations.exp(scale(middle * dt, earth_rate(place)))

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
