"""Coarse alignment: an attitude from sensors at rest, gravity and the rotation of the Earth.

Both methods compare two vectors measured in the body frame with the same two known in n, and return
the attitude at the *end* of the interval, from which fine alignment continues. The base must not
travel; how it sways decides the method. No initial attitude is needed.

Constant sensor biases remain in both: phi_E = -nabla_N/g, phi_N = nabla_E/g and phi_U =
-eps_E/omega_N + (nabla_E/g) tan L.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp

from sinsjax.maths.algebra import scale
from sinsjax.maths.rotations import conjugate, exp, log, multiply, rotate
from sinsjax.strapdown.earth import Place
from sinsjax.types import Array, Quat, Sample, Scalar, Vec3

Coarse = Callable[[Sample, Place, Scalar], Quat]
"""(samples, place, dt) -> attitude at the end of the samples."""


def align_analytically(samples: Sample, place: Place, dt: Scalar) -> Quat:
    """Return the attitude of a *static* base from mean specific force and mean angular rate.

    The two mean vectors are gravity's reaction and the Earth rate; level comes from the first, yaw
    from the second (TRIAD). Any rotation of the base enters the mean rate undiminished: 0.01 deg
    over 60 s is 2.8 deg of yaw at 34 deg latitude, and a parked vehicle with people in it is off
    by tens of degrees. On a rigid mount it is the better one: accelerometer noise hardly
    enters yaw, and white gyro noise of standard deviation s a sample (as a rate) leaves
    s / (sqrt(n) omega_N).

    Args:
        samples: compensated samples of the whole interval, leaves (n,), n >= 1.
        place: Earth rates and gravity; not at a pole, where the Earth's turn shows no north.
        dt: sample time, s.

    Returns:
        q_nb at the end of the samples: their mean attitude, since it should not change.
    """
    rate = _earth_rate(place)
    # A sample's dv is seen from the body at its start; on average it turned half a step since.
    reaction = rotate(exp(scale(0.5 * dt, rate)), _reaction_increment(place, dt))
    turns = jax.vmap(log)(samples.turn)
    felt = jnp.stack([_mean_vector(samples.dv), _mean_vector(turns)])
    return triad_attitude(felt, jnp.stack([jnp.stack(reaction), jnp.stack(rate)]))


def align_inertially(samples: Sample, place: Place, dt: Scalar) -> Quat:
    """Return the attitude of a swaying base from the rotation of gravity in inertial space.

    The gyros carry every specific force into the body frame frozen at the end, where sway is gone
    and gravity is left to turn with the Earth; the same vectors in n frozen at the end are known:
    C_b^n(t) = C_i0^n(t) C_ib0^i0 C_b^ib0(t) with both inertial frames taken at the end. TRIAD of
    their weighted mean (level) and weighted slope (yaw), weight 1 - tau^2, tau from -1 to 1 over
    the interval.

    The weight makes it, to first order in the Earth's turn, the least squares fit of all
    integrated velocities with the initial velocity unknown: what the base still moves by at the
    two ends hardly enters. Davenport's q-method on them differs by under 0.0005 deg on the record
    below.
    White accelerometer noise of standard deviation s a sample leaves a yaw error of
    sqrt(30/7/n) 2 s / (g omega_N T) over T = n dt. The choice, by yaw error in deg: 60 s from 0,
    30, ..., 330 s of a laser-gyro record on a disturbed parked vehicle, against a smoother on the
    same record; and [P1]'s swing and sensor noise, 100 draws of 60 s:

    | Method | Vehicle, median | Vehicle, largest | [P1], rms |
    |---|---|---|---|
    | this | 0.026 | 0.20 | 0.39 |
    | weight (1 - tau^2)^2: position fit | 0.033 | 0.29 | 0.49 |
    | no weight: specific force fit | 0.21 | 0.59 | 0.31 |
    | q-method, velocities from 0 | 0.21 | 0.50 | 0.37 |
    | the same, unit vectors | 3.1 | 5.5 | 0.69 |
    | TRIAD, velocities at T/2 and T | 0.38 | 0.73 | 0.36 |
    | TRIAD, positions at T/2 and T | 0.46 | 0.85 | 0.48 |
    | `align_analytically` | 14 | 64 | 68 |

    Args:
        samples: compensated samples of the whole interval, leaves (n,), n >= 2.
        place: Earth rates and gravity; not at a pole, where the Earth's turn shows no north.
        dt: sample time, s.

    Returns:
        q_nb at the end of the samples.
    """
    felt = _measured_increments(samples)
    n = len(felt)
    middle = jnp.arange(n, dtype=felt.dtype) + 0.5
    tau = 2 * middle / n - 1
    weight = 1 - tau * tau
    moments = jnp.stack([weight, weight * tau])
    return triad_attitude(
        moments @ felt, moments @ _expected_increments(place, dt, (middle - n) * dt)
    )


COARSE: dict[str, Coarse] = {"analytic": align_analytically, "inertial": align_inertially}
"""Coarse alignment methods by the name a study gives them."""


def _measured_increments(samples: Sample) -> Array:
    """Return velocity increments (n, 3) in the body frame frozen at the end, m/s."""

    def back(later: Quat, sample: Sample) -> tuple[Quat, Array]:
        q = multiply(later, conjugate(sample.turn))
        return q, jnp.stack(rotate(q, sample.dv))

    end = Quat(*jnp.eye(4, dtype=jnp.result_type(samples.turn.w))[0])
    return jax.lax.scan(back, end, samples, reverse=True)[1]


def _expected_increments(place: Place, dt: Scalar, times: Array) -> Array:
    """Return the velocity increments of gravity's reaction, (n, 3) in n frozen at the end, m/s.

    Args:
        place: Earth rates and gravity.
        dt: sample time, s.
        times: (n,) middle of each sample from the end, s. It stands for the sample's integral,
            off by (w_ie dt)^2 / 24, below rounding.
    """
    rate, reaction = _earth_rate(place), _reaction_increment(place, dt)
    return jax.vmap(lambda t: jnp.stack(rotate(exp(scale(t, rate)), reaction)))(times)


def _earth_rate(place: Place) -> Vec3:
    return Vec3(jnp.zeros_like(place.rate_n), place.rate_n, place.rate_u)


def _reaction_increment(place: Place, dt: Scalar) -> Vec3:
    up = place.gravity * dt
    return Vec3(jnp.zeros_like(up), jnp.zeros_like(up), up)


def _mean_vector(rows: Vec3) -> Array:
    return jnp.stack(rows).mean(axis=1)


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
