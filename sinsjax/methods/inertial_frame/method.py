"""Alignment in the inertial frame by sums that grow sample by sample.

The gyros transform every specific force to the body frame frozen at the first sample, b0; gravity's
reaction in the navigation frame frozen then, n0, is known and rotates with the Earth. One constant
rotation relates the two:

    C_b^n(t) = C_{n0}^{n(t)} C_{b0}^{n0} C_{b(t)}^{b0},    C_{n0}^{n(t)} = exp(-w_ie t x).

No initial attitude, velocity or covariance enters; the measurements alone decide. C_{b0}^{n0} comes
from least squares of the integrated velocities or positions, or from two weighted means of the
force. The base must not travel, but may sway.

"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from sinsjax.maths import rotations
from sinsjax.maths.algebra import add, scale, select_tree
from sinsjax.methods.coarse import triad_attitude
from sinsjax.methods.floors import BiasFloor, MeanBiases, bias_floor
from sinsjax.methods.inertial_frame.least_squares import (
    VelocitySums,
    add_position,
    add_velocity,
    earth_rate,
    fit_positions,
    fit_velocities,
    no_positions,
    no_velocities,
)
from sinsjax.methods.method import (
    Options,
    Program,
    RunEnd,
    Site,
)
from sinsjax.strapdown.earth import Place
from sinsjax.types import Navigation, Quat, Sample, Scalar, Vec3


class Frames(NamedTuple):
    """Body and navigation frame relative to those at the start.

    Attributes:
        body: C_{b(t)}^{b0}.
        earth: C_{n0}^{n(t)}.
    """

    body: Quat
    earth: Quat


class InertialState(NamedTuple):
    """A run between two samples.

    Attributes:
        nav: initial solution, which is the result before the first sample.
        frames: see `Frames`.
        sums: of velocities, positions or forces, as the method needs them.
        count: samples so far.
    """

    nav: Navigation
    frames: Frames
    sums: Any
    count: Scalar


def _build_from_sums(options: Options, start: Any, add_sample: Any, fit: Any) -> Program:
    """Return the method of one kind of sums.

    Args:
        options: choices that decide the program.
        start: zero -> sums before the first sample.
        add_sample: (sums, velocity increment in b0, place, n, dt) -> sums.
        fit: (sums, samples so far) -> C_{b0}^{n0}.
    """
    dt = options.dt

    def init(params: Any, nav: Navigation) -> InertialState:
        zero = jnp.zeros_like(nav.ve)
        one = Quat(zero + 1, zero, zero, zero)
        return InertialState(nav, Frames(one, one), start(zero), zero)

    def step(
        params: Any, site: Site, state: InertialState, sample: Sample, n: Scalar
    ) -> InertialState:
        force = rotations.rotate(state.frames.body, sample.dv)
        frames = Frames(
            rotations.multiply(state.frames.body, sample.turn),
            rotations.exp(scale(-n * dt, earth_rate(site.place))),
        )
        sums = add_sample(state.sums, force, site.place, n, dt)
        return InertialState(state.nav, frames, sums, n)

    def attitude(state: InertialState) -> Quat:
        frames = state.frames
        q = rotations.multiply(fit(state.sums, state.count), frames.body)
        q = rotations.multiply(frames.earth, q)
        return select_tree(state.count > 0, q, state.nav.q)

    return Program(
        init=init,
        step=step,
        attitude=attitude,
        normalise=_normalise,
        floor=_bias_floor,
    )


def _normalise(state: InertialState) -> InertialState:
    body = rotations.normalise(state.frames.body)
    nav = state.nav._replace(q=rotations.normalise(state.nav.q))
    return state._replace(nav=nav, frames=state.frames._replace(body=body))


def _bias_floor(params: Any, place: Place, biases: MeanBiases, end: RunEnd) -> BiasFloor:
    return bias_floor(place, biases)


def build_optimisation(options: Options) -> Program:
    """Return the method of the rotation from all alpha closest to beta (Davenport's q-method).

    Wu et al., Aerosp. Sci. Technol. 15 (2011), and Wu and Pan, IEEE TAES 49 (2013): the
    eigenvector of the largest eigenvalue of a 4 x 4 matrix, found at record times.
    """
    return _build_from_sums(options, no_velocities, add_velocity, fit_velocities)


def build_optimisation_position(options: Options) -> Program:
    """Return the same for positions, sums of velocities, from an unknown initial velocity.

    On a base that surges only a fraction of the error is left: see `least_squares`.
    """
    return _build_from_sums(options, no_positions, add_position, fit_positions)


def align_by_optimisation(samples: Sample, place: Place, dt: Scalar) -> Quat:
    """Return the attitude at the end of an interval by `optimisation`, as a `coarse.Coarse`.

    Args:
        samples: compensated, leaves (n,).
        place: Earth rates and gravity.
        dt: sample time, s.
    """
    counts = 1 + jnp.arange(samples.dv.x.size, dtype=samples.dv.x.dtype)
    zero = jnp.zeros_like(counts[0])

    def over_sample(
        carry: tuple[Quat, VelocitySums], xs: tuple[Sample, Scalar]
    ) -> tuple[tuple[Quat, VelocitySums], None]:
        (body, sums), (sample, n) = carry, xs
        force = rotations.rotate(body, sample.dv)
        sums = add_velocity(sums, force, place, n, dt)
        return (rotations.multiply(body, sample.turn), sums), None

    start = Quat(zero + 1, zero, zero, zero), no_velocities(zero)
    (body, sums), _ = jax.lax.scan(over_sample, start, (samples, counts))
    earth = rotations.exp(scale(-counts[-1] * dt, earth_rate(place)))
    return rotations.multiply(earth, rotations.multiply(fit_velocities(sums, counts[-1]), body))


class ForceSums(NamedTuple):
    """Sums of m^0, m^1, m^2 and m^3 times a velocity increment, m from mid-sample to mid-sample.

    Attributes:
        measured: in b0, m/s.
        expected: in n0, m/s.
    """

    measured: tuple[Vec3, ...]
    expected: tuple[Vec3, ...]


def build_inertial(options: Options) -> Program:
    """Return the method of `coarse.align_inertially`: weighted mean and slope of the force."""
    return _build_from_sums(options, _no_forces, _add_force, _fit_mean_and_slope)


def _no_forces(zero: Scalar) -> ForceSums:
    none = (Vec3(zero, zero, zero),) * 4
    return ForceSums(none, none)


def _add_force(sums: ForceSums, force: Vec3, place: Place, n: Scalar, dt: float) -> ForceSums:
    """Return the sums with a sample's increment in i0, and the one that gravity leads to."""
    middle = n - 0.5
    up = Vec3(jnp.zeros_like(place.gravity), jnp.zeros_like(place.gravity), place.gravity * dt)
    turn = rotations.exp(scale(middle * dt, earth_rate(place)))

    def add_powers(totals: tuple[Vec3, ...], increment: Vec3) -> tuple[Vec3, ...]:
        return tuple(add(total, scale(middle**k, increment)) for k, total in enumerate(totals))

    return ForceSums(
        add_powers(sums.measured, force), add_powers(sums.expected, rotations.rotate(turn, up))
    )


def _fit_mean_and_slope(sums: ForceSums, count: Scalar) -> Quat:
    """Return the TRIAD of the means with weights 1 - tau^2 and (1 - tau^2) tau, tau = 2 m/n - 1."""
    h = 2 / jnp.maximum(count, 1.0)

    def weighted(totals: tuple[Vec3, ...]) -> Any:
        # 1 - tau^2 = 2 hm - (hm)^2, times tau = -2 hm + 3 (hm)^2 - (hm)^3.
        scaled = [scale(h**k, total) for k, total in enumerate(totals)]
        mean = add(scale(2.0, scaled[1]), scale(-1.0, scaled[2]))
        slope = add(scale(-2.0, scaled[1]), scale(3.0, scaled[2]))
        slope = add(slope, scale(-1.0, scaled[3]))
        return jnp.stack([jnp.stack(mean), jnp.stack(slope)])

    return triad_attitude(weighted(sums.measured), weighted(sums.expected))
