"""The attitude as azimuth and tilt, C_{n'}^n = Rz(a) e for any azimuth and a tilt of any size.

e is the shortest rotation of the true vertical, seen in n' as (-t_N, t_E, u_z), to z.
"""

import jax.numpy as jnp

from sinsjax.maths.rotations import multiply
from sinsjax.methods.method import AttitudeCovariance
from sinsjax.types import Quat, Scalar


def shortest_rotation(tilt_e: Scalar, tilt_n: Scalar) -> Quat:
    """Return the shortest rotation e of (-t_N, t_E, u_z), the vertical seen at a tilt, to z."""
    u_z = jnp.sqrt(jnp.maximum(1 - tilt_e * tilt_e - tilt_n * tilt_n, 0.0))
    w = jnp.sqrt((1 + u_z) / 2)
    return Quat(w, tilt_e / (2 * w), tilt_n / (2 * w), jnp.zeros_like(w))


def rotation_about_vertical(sine: Scalar, cosine: Scalar) -> Quat:
    """Return Rz(a) for the angle with this sine and cosine."""
    # The larger of cos(a/2) and |sin(a/2)| by a root, the other from sin a.
    larger = jnp.sqrt((1 + jnp.abs(cosine)) / 2)
    smaller = jnp.abs(sine) / (2 * larger)
    ahead, side = cosine >= 0, jnp.where(sine < 0, -1.0, 1.0)
    w, z = jnp.where(ahead, larger, smaller), side * jnp.where(ahead, smaller, larger)
    zero = jnp.zeros_like(sine)
    return Quat(w, zero, zero, z)


def rotation_from_tilt(tilt_e: Scalar, tilt_n: Scalar, sine: Scalar, cosine: Scalar) -> Quat:
    """Return Rz(a) e of a tilt and the sine and cosine of an azimuth."""
    turn = rotation_about_vertical(sine, cosine)
    return multiply(turn, shortest_rotation(tilt_e, tilt_n))


def rotate_covariance(
    covariance: AttitudeCovariance, sine: Scalar, cosine: Scalar
) -> AttitudeCovariance:
    """Return the covariance of the misalignment in n from that of tilt (in n') and azimuth."""
    (ee, en, eu, nn, nu, uu), c, s = covariance, cosine, sine
    return AttitudeCovariance(
        ee=c * c * ee - 2 * c * s * en + s * s * nn,
        en=c * s * (ee - nn) + (c * c - s * s) * en,
        eu=c * eu - s * nu,
        nn=s * s * ee + 2 * c * s * en + c * c * nn,
        nu=s * eu + c * nu,
        uu=uu,
    )
