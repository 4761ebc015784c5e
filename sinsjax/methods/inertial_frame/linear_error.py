"""The linear part of the fit of velocities: how errors of increments turn the attitude it finds.

Gyros turn the body frame b0 that is carried along by a small angle psi, and so every specific force
that is taken there; alpha, the integrated force, is off by this and by what the accelerometers add.
With both in n0, p = C psi and a = C d(alpha) for C = C_{b0}^{n0}, a sample of force f dt does

    a <- a + p x f dt + w_a,    p <- p + w_g.

C is that of Wahba's problem, the least sum of |C alpha - beta|^2. Turned by a small angle theta,
and with C alpha = beta where there is no noise, the sum is that of |a - beta x theta|^2, so that

    M theta = -m,    m = sum of beta x a,    M = sum of (|beta|^2 I - beta beta').

The attitude C_{n0}^n C C_b^{b0} is then turned by theta + p, and its misalignment is

    phi = C_{n0}^n (M^-1 m - p).

p, a and m are the nine states of d. After the first samples, whose beta are all parallel, C has no
heading yet; what they add to m is as short as they are.
"""

from typing import Any

import jax.numpy as jnp

from sinsjax.maths import rotations
from sinsjax.maths.algebra import Entries, Minus, cross, dot, scale
from sinsjax.methods.base import ErrorStep, Site, StartChange
from sinsjax.methods.inertial_frame.least_squares import of_velocities, reaction_velocity
from sinsjax.types import Sample, Scalar, Vec3

TURN, VELOCITY, MOMENT = 0, 3, 6
"""First of the three states p, a and m."""

_AXES = range(3)
_TURNED: Entries = {(TURN + i, 3 + i): 1.0 for i in _AXES}
_ADDED: Entries = {(VELOCITY + i, i): 1.0 for i in _AXES}


def error_step(
    dt: Scalar, params: Any, site: Site, state: Any, sample: Sample, n: Scalar
) -> ErrorStep:
    """`Method.error_step` of `optimisation`; dt is the sample time, s."""
    to_n0 = rotations.multiply(of_velocities(state.moments, state.count), state.frames.body)
    force, beta = rotations.rotate(to_n0, sample.dv), reaction_velocity(site.place, n * dt)
    along, by_beta = dot(beta, force), _across(beta)
    # beta x (p x f) = (beta f) p - f (beta p)
    carried: Entries = {
        (MOMENT + i, TURN + j): (along if i == j else 0.0) - force[i] * beta[j]
        for i in _AXES
        for j in _AXES
    }
    return ErrorStep(
        {
            **{(VELOCITY + i, TURN + j): Minus(v) for (i, j), v in _across(force).items()},
            **{(MOMENT + i, VELOCITY + j): v for (i, j), v in by_beta.items()},
            **carried,
        },
        {**_TURNED, **_ADDED, **{(MOMENT + i, j): v for (i, j), v in by_beta.items()}},
        (),
        (),
        to_n0,
    )


def _across(v: Vec3) -> dict[tuple[int, int], Scalar]:
    """Non-zero entries of v x."""
    return {(0, 1): -v.z, (0, 2): v.y, (1, 0): v.z, (1, 2): -v.x, (2, 0): -v.y, (2, 1): v.x}


def error_angles(state: Any) -> tuple[tuple[Scalar, ...], ...]:
    """`Method.error_angles`: C_{n0}^n (M^-1 m - p)."""
    zero = jnp.zeros_like(state.count)
    found = of_velocities(state.moments, state.count)
    # C alpha stands for beta: sum of beta (C alpha)'.
    rows = [rotations.rotate(found, row) for row in state.moments.profile]
    weight = rows[0].x + rows[1].y + rows[2].z
    m = [
        [(weight if i == j else zero) - 0.5 * (rows[i][j] + rows[j][i]) for j in _AXES]
        for i in _AXES
    ]
    inverse = _inverse([Vec3(*row) for row in m])
    return tuple(
        (-to_n.x, -to_n.y, -to_n.z, *(zero,) * 3, *(dot(to_n, column) for column in inverse))
        for to_n in rotations.matrix(state.frames.earth)
    )


def _inverse(rows: list[Vec3]) -> list[Vec3]:
    """Columns of the inverse of a symmetric matrix; of a singular one they are not finite."""
    x, y, z = rows
    adjugate = (cross(y, z), cross(z, x), cross(x, y))
    one = 1 / dot(x, adjugate[0])
    return [scale(one, column) for column in adjugate]


def start_error(state: Any, change: StartChange) -> tuple[Scalar, ...]:
    """`Method.start_error`: no start enters."""
    return (jnp.zeros_like(change.ve),) * 9
