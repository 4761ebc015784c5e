"""Coarse alignment: an attitude from sensors at rest, gravity and the rotation of the Earth.

It returns the attitude at the *end* of an interval, from which fine alignment continues. The base
must not travel; no initial attitude is needed. `align_analytically` needs a base that does not sway
either; on all others any method that finds north without a start serves, see `align_by_program`.

Constant sensor biases leave the misalignment of `floors.bias_floor`.
"""

from typing import Any

import jax
import jax.numpy as jnp

from sinsjax.maths.algebra import scale
from sinsjax.maths.rotations import exp, log, rotate
from sinsjax.methods.method import Program, Site
from sinsjax.strapdown.earth import Place
from sinsjax.types import Array, Navigation, Quat, Sample, Scalar, Vec3

ZERO = Vec3(0.0, 0.0, 0.0)


def earth_rate(place: Place) -> Vec3:
    """Return w_ie in n, rad/s."""
    return Vec3(jnp.zeros_like(place.rate_n), place.rate_n, place.rate_u)


def align_analytically(samples: Sample, site: Site, dt: float) -> Quat:
    """Return q_nb of a *static* base, not at a pole, from compensated samples, leaves (n,), n >= 1.

    The mean specific force is gravity's reaction, the mean angular rate that of the Earth; level
    comes from the first, yaw from the second (TRIAD). Any rotation of the base enters the mean rate
    undiminished: 0.01 deg over 60 s is 2.8 deg of yaw at 34 deg latitude, and a parked vehicle with
    people in it is off by tens of degrees. On a rigid mount it is the better one: accelerometer
    noise hardly enters yaw, and white gyro noise of standard deviation s a sample (as a rate)
    leaves s / (sqrt(n) omega_N).
    """
    rate, up = earth_rate(site.place), site.place.gravity * dt
    # A sample's dv is seen from the body at its start; on average it turned half a step since.
    reaction = rotate(exp(scale(0.5 * dt, rate)), ZERO._replace(z=up))
    turns = jax.vmap(log)(samples.turn)
    felt = jnp.stack([jnp.stack(rows).mean(axis=1) for rows in (samples.dv, turns)])
    return triad_attitude(felt, jnp.stack([jnp.stack(reaction), jnp.stack(rate)]))


def align_by_program(program: Program, samples: Sample, site: Site) -> Quat:
    """Return q_nb at the end of compensated samples, leaves (n,), by a method without params."""
    counts = 1 + jnp.arange(samples.dv.x.size, dtype=samples.dv.x.dtype)
    zero = jnp.zeros_like(counts[0])
    start = Navigation(Quat(zero + 1, zero, zero, zero), zero, zero, site.latitude + zero, zero)

    def over_sample(state: Any, numbered: tuple[Sample, Scalar]) -> tuple[Any, None]:
        sample, n = numbered
        return program.step((), site, state, sample, n), None

    state, _ = jax.lax.scan(over_sample, program.init((), start), (samples, counts))
    return program.attitude(program.normalise(state))


def triad_attitude(body: Array, n: Array) -> Quat:
    """Return q_nb by TRIAD from two vectors (2, 3) known in b and in n; the first is met exactly.

    Lengths do not matter. The row of q q' with the largest diagonal element gives q without
    cancellation at any attitude.
    """
    c = _triad(n) @ _triad(body).T
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = c
    outer = jnp.array(
        [
            [1 + xx + yy + zz, zy - yz, xz - zx, yx - xy],
            [zy - yz, 1 + xx - yy - zz, xy + yx, xz + zx],
            [xz - zx, xy + yx, 1 - xx + yy - zz, yz + zy],
            [yx - xy, xz + zx, yz + zy, 1 - xx - yy + zz],
        ]
    )
    return Quat(*_unit(outer[jnp.argmax(jnp.diagonal(outer))]))


def _triad(vectors: Array) -> Array:
    """Return orthonormal axes as columns: along the first vector, normal to both, the third."""
    first = _unit(vectors[0])
    normal = _unit(jnp.cross(first, vectors[1]))
    return jnp.stack([first, normal, jnp.cross(first, normal)], axis=1)


def _unit(v: Array) -> Array:
    return v / jnp.sqrt(v @ v)
