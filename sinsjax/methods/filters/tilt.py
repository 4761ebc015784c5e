"""Attitude by azimuth and tilt: C_{n'}^n = Rz(a) e, for any azimuth and a tilt of any size.

e is the shortest rotation of the true vertical, seen in n' as (-t_N, t_E, u_z), to z.
"""

import jax
import jax.numpy as jnp

from sinsjax.maths import rotations
from sinsjax.maths.algebra import scale
from sinsjax.methods.base import AttitudeCovariance, StartChange
from sinsjax.types import Quat, Scalar


def shortest_turn(tilt_e: Scalar, tilt_n: Scalar) -> Quat:
    """E of a tilt: the rotation of (-t_N, t_E, u_z) to z."""
    u_z = jnp.sqrt(jnp.maximum(1 - tilt_e * tilt_e - tilt_n * tilt_n, 0.0))
    w = jnp.sqrt((1 + u_z) / 2)
    return Quat(w, tilt_e / (2 * w), tilt_n / (2 * w), jnp.zeros_like(w))


def about_vertical(sine: Scalar, cosine: Scalar) -> Quat:
    """Rz(a) of the angle with this sine and cosine."""
    ahead = cosine >= 0
    # The larger of cos(a/2) and |sin(a/2)| by a root, the other from sin a.
    larger = jnp.sqrt((1 + jnp.abs(cosine)) / 2)
    smaller = jnp.abs(sine) / (2 * larger)
    side = jnp.where(sine < 0, -1.0, 1.0)
    zero = jnp.zeros_like(sine)
    return Quat(
        jnp.where(ahead, larger, smaller), zero, zero, side * jnp.where(ahead, smaller, larger)
    )


def turned(tilt_e: Scalar, tilt_n: Scalar, sine: Scalar, cosine: Scalar) -> Quat:
    """Rz(a) e."""
    return rotations.multiply(about_vertical(sine, cosine), shortest_turn(tilt_e, tilt_n))


def of_attitude(q: Quat) -> tuple[Scalar, Scalar, Scalar, Scalar]:
    """Tilt east and north, rad, and sine and cosine of the azimuth of Rz(a) e."""
    vertical = rotations.matrix(q)[2]
    tilt_e, tilt_n = vertical.y, -vertical.x
    about = rotations.multiply(q, rotations.conjugate(shortest_turn(tilt_e, tilt_n)))
    return tilt_e, tilt_n, 2 * about.w * about.z, about.w * about.w - about.z * about.z


def changed(change: StartChange) -> tuple[Scalar, Scalar, Scalar, Scalar]:
    """What the numbers of `of_attitude` change by."""
    q, half = change.attitude, scale(0.5, change.phi)
    rate = rotations.multiply(q, Quat(jnp.zeros_like(half.x), *half))
    _, changes = jax.jvp(of_attitude, (q,), (rate,))
    return changes


def turned_covariance(
    of_tilt: AttitudeCovariance, sine: Scalar, cosine: Scalar
) -> AttitudeCovariance:
    """The covariance of tilt (in n') and azimuth as that of the misalignment in n."""
    ee, en, eu, nn, nu, uu = of_tilt
    c, s = cosine, sine
    return AttitudeCovariance(
        ee=c * c * ee - 2 * c * s * en + s * s * nn,
        en=c * s * (ee - nn) + (c * c - s * s) * en,
        eu=c * eu - s * nu,
        nn=s * s * ee + 2 * c * s * en + c * c * nn,
        nu=s * eu + c * nu,
        uu=uu,
    )
