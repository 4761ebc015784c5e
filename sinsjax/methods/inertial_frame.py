"""Alignment in the inertial frame by sums that grow sample by sample; the methods have no keys.

The gyros transform every specific force to the body frame frozen at the first sample, b0; gravity's
reaction in the navigation frame frozen then, n0, is known and rotates with the Earth. One constant
rotation relates the two:

    C_b^n(t) = C_{n0}^{n(t)} C_{b0}^{n0} C_{b(t)}^{b0},    C_{n0}^{n(t)} = exp(-w_ie t x).

No initial attitude, velocity or covariance enters; the measurements alone decide. C_{b0}^{n0} comes
from least squares of the integrated velocities or positions, or from two weighted means of the
force. The base must not travel, but may sway.

**Velocities** (``optimisation``): Wu et al., Aerosp. Sci. Technol. 15 (2011), and Wu and Pan, IEEE
TAES 49 (2013): the eigenvector of the largest eigenvalue of Davenport's 4 x 4 matrix, found at
record times. They take the base to start from rest: on one that surges every integral is off by the
velocity of the first sample, which costs more than all that follows.

**Positions** (``optimisation_position``) a and b, sums of the velocities alpha, of C_b^{b0} f, and
beta, of gravity's reaction, leave the initial velocity v(0) unknown:

    C a_n - b_n = (s_n - s_0)/dt - n v(0) + noise.

On a base that stays near its place s this is bounded except for n v(0), so the part of a and b that
is linear in n is removed from them. Only a fraction of the error by a surge is left.

**Means** (``inertial``): TRIAD of the weighted mean (level) and the weighted slope (yaw) of the
force, weight 1 - tau^2, tau from -1 to 1 over the interval. The weight makes it, to first order in
the Earth's turn, the least squares fit of all integrated velocities with the initial velocity
unknown: what the base still moves by at the two ends hardly enters. Davenport's q-method on them
differs by under 0.0005 deg on the record below. White accelerometer noise of standard deviation s a
sample leaves a yaw error of sqrt(30/7/n) 2 s / (g omega_N T) over T = n dt. Over 60 s of a
laser-gyro record on a disturbed parked vehicle the median yaw error is 0.026 deg, without the
weight 0.21 deg, and of the mean force and the mean rate 14 deg.
"""

from collections.abc import Callable
from functools import partial
from operator import mul
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from sinsjax.maths import rotations
from sinsjax.maths.algebra import Triangle, add, cross, dot, scale, select_tree, triangle_index
from sinsjax.methods.azimuth_and_tilt import rotation_about_vertical
from sinsjax.methods.method import Method, Options, Program, Site, normalise_solution
from sinsjax.strapdown.earth import Place
from sinsjax.types import Array, Navigation, Quat, Sample, Scalar, Vec3

_ZERO = Vec3(0.0, 0.0, 0.0)


def earth_rate(place: Place) -> Vec3:
    """Return w_ie in n, rad/s."""
    return Vec3(jnp.zeros_like(place.rate_n), place.rate_n, place.rate_u)


class Fit(NamedTuple):
    """C_{b0}^{n0} from sums over samples."""

    start: Any  # sums before the first sample, of zeros
    add_sample: Callable[[Any, Vec3, Place, Scalar, float], Any]
    """(sums, velocity increment in b0, m/s, place, n, dt, s) -> sums with the n-th sample."""
    solve: Callable[[Any, Scalar], Quat]
    """(sums, samples so far) -> C_{b0}^{n0}."""


class InertialState(NamedTuple):
    """A run between two samples."""

    nav: Navigation  # initial solution, which is the result before the first sample
    body: Quat  # C_{b(t)}^{b0}
    earth_turn: Vec3  # rotation vector -w_ie t of C_{n0}^{n(t)}, rad
    sums: Any  # of velocities, positions or forces, as the method needs them
    count: Scalar  # samples so far


def build(fit: Fit, options: Options) -> Program:
    """Return the program of a fit."""
    dt = options.dt

    def init(params: Any, nav: Navigation) -> InertialState:
        zero = jnp.zeros_like(nav.ve)
        one, none = Quat(zero + 1, zero, zero, zero), Vec3(zero, zero, zero)
        return InertialState(nav, one, none, jax.tree.map(lambda _: zero, fit.start), zero)

    def step(
        params: Any, site: Site, state: InertialState, sample: Sample, n: Scalar
    ) -> InertialState:
        force = rotations.rotate(state.body, sample.dv)
        return InertialState(
            nav=state.nav,
            body=rotations.multiply(state.body, sample.turn),
            earth_turn=scale(-n * dt, earth_rate(site.place)),
            sums=fit.add_sample(state.sums, force, site.place, n, dt),
            count=n,
        )

    def attitude(state: InertialState) -> Quat:
        q = rotations.multiply(fit.solve(state.sums, state.count), state.body)
        q = rotations.multiply(rotations.exp(state.earth_turn), q)
        return select_tree(state.count > 0, q, state.nav.q)

    def normalise(state: InertialState) -> InertialState:
        return normalise_solution(state)._replace(body=rotations.normalise(state.body))

    return Program(init, step, attitude, normalise)


class ForceSums(NamedTuple):
    """Sums of m, m^2 and m^3 times a velocity increment, m from mid-sample to mid-sample, m/s."""

    measured: tuple[Vec3, ...]  # in b0
    expected: tuple[Vec3, ...]  # in n0


def _add_force(sums: ForceSums, force: Vec3, place: Place, n: Scalar, dt: float) -> ForceSums:
    """Return the sums with a sample's increment in b0, and the one that gravity leads to."""
    middle = n - 0.5
    up = Vec3(jnp.zeros_like(place.gravity), jnp.zeros_like(place.gravity), place.gravity * dt)
    reaction = rotations.rotate(rotations.exp(scale(middle * dt, earth_rate(place))), up)

    def add_powers(totals: tuple[Vec3, ...], increment: Vec3) -> tuple[Vec3, ...]:
        return tuple(add(t, scale(middle**k, increment)) for k, t in enumerate(totals, start=1))

    return ForceSums(add_powers(sums.measured, force), add_powers(sums.expected, reaction))


def _fit_mean_and_slope(sums: ForceSums, count: Scalar) -> Quat:
    """Return the TRIAD of the means with weights 1 - tau^2 and (1 - tau^2) tau, tau = 2 m/n - 1."""
    h = 2 / jnp.maximum(count, 1.0)

    def weigh(totals: tuple[Vec3, ...]) -> Array:
        # 1 - tau^2 = 2 hm - (hm)^2, times tau = -2 hm + 3 (hm)^2 - (hm)^3.
        first, second, third = (scale(h**k, total) for k, total in enumerate(totals, start=1))
        mean = add(scale(2.0, first), scale(-1.0, second))
        slope = add(add(scale(-2.0, first), scale(3.0, second)), scale(-1.0, third))
        return jnp.stack([jnp.stack(mean), jnp.stack(slope)])

    return triad_attitude(weigh(sums.measured), weigh(sums.expected))


def triad_attitude(body: Array, n: Array) -> Quat:
    """Return q_nb by TRIAD from two vectors (2, 3) known in b and in n; the first is met exactly.

    Lengths do not matter. The row of q q' with the largest diagonal element gives q without
    cancellation at any attitude.
    """
    c = _orthonormal_axes(n) @ _orthonormal_axes(body).T
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = c
    outer = jnp.array(
        [
            [1 + xx + yy + zz, zy - yz, xz - zx, yx - xy],
            [zy - yz, 1 + xx - yy - zz, xy + yx, xz + zx],
            [xz - zx, xy + yx, 1 - xx + yy - zz, yz + zy],
            [yx - xy, xz + zx, yz + zy, 1 - xx - yy + zz],
        ]
    )
    row = outer[jnp.argmax(jnp.diagonal(outer))]
    return Quat(*row / jnp.sqrt(row @ row))


def _orthonormal_axes(vectors: Array) -> Array:
    """Return orthonormal axes as columns: along the first vector, normal to both, the third."""
    first = vectors[0] / jnp.sqrt(vectors[0] @ vectors[0])
    normal = jnp.cross(first, vectors[1])
    normal = normal / jnp.sqrt(normal @ normal)
    return jnp.stack([first, normal, jnp.cross(first, normal)], axis=1)


_FORCE_FIT = Fit(ForceSums((_ZERO,) * 3, (_ZERO,) * 3), _add_force, _fit_mean_and_slope)


def reaction_velocity(place: Place, t: Scalar) -> Vec3:
    """Return the integral of gravity's reaction in n0 over t (s), m/s.

    With e = w_ie / W: g [z sin(Wt)/W + (e x z)(1 - cos Wt)/W + e (e.z)(t - sin(Wt)/W)].
    """
    rate = jnp.sqrt(place.rate_n**2 + place.rate_u**2)
    e = scale(1 / rate, earth_rate(place))
    up = Vec3(jnp.zeros_like(e.z), jnp.zeros_like(e.z), jnp.ones_like(e.z))
    sine, versine = jnp.sin(rate * t) / rate, 2 * jnp.sin(rate * t / 2) ** 2 / rate
    across = add(scale(sine, up), scale(versine, cross(e, up)))
    return scale(place.gravity, add(across, scale(e.z * (t - sine), e)))


class PairSums(NamedTuple):
    """Sums over pairs of vectors, y in b0 and x in n0, of which C_{b0}^{n0} rotates y to x."""

    products: tuple[Vec3, ...]  # rows of the sum of x y'
    weight: Scalar  # half the sum of |x|^2 + |y|^2, an upper bound of the largest eigenvalue


def _add_pair(sums: PairSums, x: Vec3, y: Vec3, divisor: Scalar = 1.0) -> PairSums:
    """Return the sums with a pair of weight 1/divisor."""
    rows = zip(sums.products, scale(1 / divisor, x), strict=True)
    weight = sums.weight + 0.5 * (dot(y, y) + dot(x, x)) / divisor
    return PairSums(tuple(add(row, scale(entry, y)) for row, entry in rows), weight)


class VelocitySums(NamedTuple):
    """Velocity alpha up to the last sample, m/s, and sums over pairs of beta and alpha."""

    velocity: Vec3
    pairs: PairSums


def _add_velocity(
    sums: VelocitySums, force: Vec3, place: Place, n: Scalar, dt: float
) -> VelocitySums:
    alpha, beta = add(sums.velocity, force), reaction_velocity(place, n * dt)
    return VelocitySums(alpha, _add_pair(sums.pairs, beta, alpha))


class PositionSums(NamedTuple):
    """Sums of the velocities up to the last sample, m/s, and over pairs of b and a."""

    velocity: Vec3  # alpha
    measured: Vec3  # a
    expected: Vec3  # b
    measured_trend: Vec3  # sum of n a
    expected_trend: Vec3  # sum of n b
    pairs: PairSums


def _add_position(
    sums: PositionSums, force: Vec3, place: Place, n: Scalar, dt: float
) -> PositionSums:
    alpha = add(sums.velocity, force)
    a, b = add(sums.measured, alpha), add(sums.expected, reaction_velocity(place, n * dt))
    a_trend, b_trend = add(sums.measured_trend, scale(n, a)), add(sums.expected_trend, scale(n, b))
    return PositionSums(alpha, a, b, a_trend, b_trend, _add_pair(sums.pairs, b, a))


def _fit_positions(sums: PositionSums, count: Scalar) -> Quat:
    """Return C_{b0}^{n0} from a and b without their linear trends, as a pair that is taken away."""
    squares = jnp.maximum(count * (count + 1) * (2 * count + 1) / 6, 1.0)
    a, b = sums.measured_trend, sums.expected_trend
    return _solve_wahba(_add_pair(sums.pairs, b, a, -squares))


_NO_PAIRS = PairSums((_ZERO, _ZERO, _ZERO), 0.0)
_VELOCITY_FIT = Fit(
    VelocitySums(_ZERO, _NO_PAIRS), _add_velocity, lambda sums, count: _solve_wahba(sums.pairs)
)
_POSITION_FIT = Fit(PositionSums(*(_ZERO,) * 5, _NO_PAIRS), _add_position, _fit_positions)


def _solve_wahba(sums: PairSums) -> Quat:
    """Return C_{b0}^{n0} by Davenport: the dominant eigenvector of K of B = sum of x y'."""
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = sums.products
    first = xx + yy + zz, zy - yz, xz - zx, yx - xy
    second, third = (xx - yy - zz, xy + yx, xz + zx), (yy - xx - zz, yz + zy)
    return dominant_eigenvector((*first, *second, *third, zz - xx - yy), sums.weight)


_STARTS = ((1.0, 2.0, -3.0, 5.0), (-2.0, 3.0, 5.0, 1.0))
_AT = triangle_index(4)
_ABOVE = 1 + 1e-12
"""Keeps the shift above the largest eigenvalue if that equals the bound."""

_Vector = list[Scalar]  # four scalars, which are contiguous over runs


def dominant_eigenvector(k: Triangle, bound: Scalar) -> Quat:
    """Return the unit eigenvector of a symmetric 4 x 4 matrix's largest eigenvalue.

    The ``bound``, a close upper one of that eigenvalue, is > 0, or all entries are zero. The two
    largest eigenvalues may be close: since all vectors within a minute, such as the directions of
    gravity, are close to one another, they differ by 1e-8 of their size. Power iteration does not
    converge then, and the roots of the characteristic polynomial lose half their digits. The two
    smaller eigenvalues are far away, so two inverse iterations find the plane of the two larger
    eigenvectors, in which the matrix is 2 x 2.
    """
    inverse = 1 / jnp.where(bound > 0, bound, 1.0)
    k = tuple(entry * inverse for entry in k)
    diagonal = [_AT[i, i] for i in range(4)]
    solve = _ldl_solver([_ABOVE - a if at in diagonal else -a for at, a in enumerate(k)])
    one, other = ([jnp.full_like(bound, v) for v in start] for start in _STARTS)
    for _ in range(2):
        one = _unit(solve(one))
        # Twice, since the vectors are nearly parallel and the first leaves rounding errors.
        other = _orthogonal_unit(one, _orthogonal_unit(one, solve(other)))
    by_one, by_other = (
        [sum(k[_AT[i, j]] * v[j] for j in range(4)) for i in range(4)] for v in (one, other)
    )
    a, b, c = _dot(one, by_one), _dot(one, by_other), _dot(other, by_other)
    # The larger eigenvalue's eigenvector of [[a, b], [b, c]], by half the angle of (a - c, 2b).
    half = 0.5 * (a - c)
    radius = jnp.sqrt(jnp.maximum(half * half + b * b, jnp.finfo(bound.dtype).tiny))
    first, _, _, second = rotation_about_vertical(b / radius, half / radius)
    return Quat(*_unit([first * x + second * y for x, y in zip(one, other, strict=True)]))


def _dot(a: _Vector, b: _Vector) -> Scalar:
    return sum(map(mul, a, b))


def _unit(v: _Vector) -> _Vector:
    inverse = 1 / jnp.sqrt(_dot(v, v))
    return [inverse * x for x in v]


def _orthogonal_unit(one: _Vector, other: _Vector) -> _Vector:
    """Return the unit vector of the part of ``other`` orthogonal to the unit vector ``one``."""
    along = _dot(one, other)
    return _unit([b - along * a for a, b in zip(one, other, strict=True)])


def _ldl_solver(m: _Vector) -> Callable[[_Vector], _Vector]:
    """Return b -> x of M x = b for a positive definite M = L D L', L with a unit diagonal."""
    below, d = dict[tuple[int, int], Scalar](), _Vector()
    for j in range(4):
        d.append(m[_AT[j, j]] - sum(below[j, k] ** 2 * d[k] for k in range(j)))
        for i in range(j + 1, 4):
            off = m[_AT[j, i]] - sum(below[i, k] * below[j, k] * d[k] for k in range(j))
            below[i, j] = off / d[j]
    inverse_d = [1 / one for one in d]

    def solve(b: _Vector) -> _Vector:
        x = list(b)
        for (i, k), entry in below.items():
            x[i] = x[i] - entry * x[k]
        x = [*map(mul, x, inverse_d)]
        for i in reversed(range(4)):
            for k in range(i + 1, 4):
                x[i] = x[i] - below[k, i] * x[k]
        return x

    return solve


_inertial_method = partial(Method, needs_start=False, turning="many")

OPTIMISATION = _inertial_method(
    name="optimisation",
    summary="attitude that takes all integrated velocities closest to gravity's in inertial space",
    source="Wu et al. (2011), Wu and Pan (2013)",
    build=partial(build, _VELOCITY_FIT),
    step_s=3e-9,
    compile_s=3.0,
)

OPTIMISATION_POSITION = _inertial_method(
    name="optimisation_position",
    summary="the same of integrated positions, from an unknown velocity: for a base that surges",
    source="`methods.inertial_frame`",
    build=partial(build, _POSITION_FIT),
    step_s=4e-9,
    compile_s=3.0,
)

INERTIAL = _inertial_method(
    name="inertial",
    summary="attitude from two weighted means of the specific force, as coarse alignment does",
    source="weighted TRIAD, see `methods.inertial_frame`",
    build=partial(build, _FORCE_FIT),
    step_s=5e-9,
    compile_s=3.0,
)
