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
record times. **Positions** (``optimisation_position``), sums of velocities, leave the initial
velocity unknown: on a base that surges only a fraction of the error is left, see `least_squares`.

**Means** (``inertial``): TRIAD of the weighted mean (level) and the weighted slope (yaw) of the
force, weight 1 - tau^2, tau from -1 to 1 over the interval. The weight makes it, to first order in
the Earth's turn, the least squares fit of all integrated velocities with the initial velocity
unknown: what the base still moves by at the two ends hardly enters. Davenport's q-method on them
differs by under 0.0005 deg on the record below. White accelerometer noise of standard deviation s a
sample leaves a yaw error of sqrt(30/7/n) 2 s / (g omega_N T) over T = n dt. The choice, by yaw
error in deg: 60 s from 0, 30, ..., 330 s of a laser-gyro record on a disturbed parked vehicle,
against a smoother on the same record; and [P1]'s swing and sensor noise, 100 draws of 60 s:

| Method | Vehicle, median | Vehicle, largest | [P1], rms |
|---|---|---|---|
| this | 0.026 | 0.20 | 0.39 |
| weight (1 - tau^2)^2: position fit | 0.033 | 0.29 | 0.49 |
| no weight: specific force fit | 0.21 | 0.59 | 0.31 |
| q-method, velocities from 0 | 0.21 | 0.50 | 0.37 |
| the same, unit vectors | 3.1 | 5.5 | 0.69 |
| TRIAD, velocities at T/2 and T | 0.38 | 0.73 | 0.36 |
| TRIAD, positions at T/2 and T | 0.46 | 0.85 | 0.48 |
| `coarse.align_analytically` | 14 | 64 | 68 |
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from sinsjax.maths import rotations
from sinsjax.maths.algebra import add, scale, select_tree
from sinsjax.methods.coarse import triad_attitude
from sinsjax.methods.least_squares import POSITION_FIT, VELOCITY_FIT, ZERO, Fit, earth_rate
from sinsjax.methods.method import Method, Options, Program, Site, normalise_solution
from sinsjax.strapdown.earth import Place
from sinsjax.types import Array, Navigation, Quat, Sample, Scalar, Vec3


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


_FORCE_FIT = Fit(ForceSums((ZERO,) * 3, (ZERO,) * 3), _add_force, _fit_mean_and_slope)

_method = partial(Method, needs_start=False, turning="many")

OPTIMISATION = _method(
    name="optimisation",
    summary="attitude that takes all integrated velocities closest to gravity's in inertial space",
    source="Wu et al. (2011), Wu and Pan (2013)",
    build=partial(build, VELOCITY_FIT),
    step_s=3e-9,
    compile_s=3.0,
)

OPTIMISATION_POSITION = _method(
    name="optimisation_position",
    summary="the same of integrated positions, from an unknown velocity: for a base that surges",
    source="`methods.least_squares`",
    build=partial(build, POSITION_FIT),
    step_s=4e-9,
    compile_s=3.0,
)

INERTIAL = _method(
    name="inertial",
    summary="attitude from two weighted means of the specific force, as coarse alignment does",
    source="weighted TRIAD, see `methods.inertial_frame`",
    build=partial(build, _FORCE_FIT),
    step_s=5e-9,
    compile_s=3.0,
)
