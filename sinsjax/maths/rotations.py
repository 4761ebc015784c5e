"""Attitude as unit quaternions, scalar first, and conversions to vectors, angles and matrices.

Conventions: `q_nb` takes body vectors to navigation vectors. Euler angles follow
C_b^n = Rz(yaw) Rx(pitch) Ry(roll), yaw counter-clockwise from north.
"""

import math

import jax.numpy as jnp

from sinsjax.maths.algebra import add, cross, dot, scale
from sinsjax.types import Quat, Scalar, Vec3

_ARCSINE = ((1, 1), (1, 6), (3, 40), (5, 112), (35, 1152), (63, 2816), (231, 13312))
"""Coefficients of arcsin(s)/s in powers of s^2."""


def multiply(a: Quat, b: Quat) -> Quat:
    """Hamilton product a b: rotation b followed by a."""
    return Quat(
        a.w * b.w - a.x * b.x - a.y * b.y - a.z * b.z,
        a.w * b.x + a.x * b.w + a.y * b.z - a.z * b.y,
        a.w * b.y - a.x * b.z + a.y * b.w + a.z * b.x,
        a.w * b.z + a.x * b.y - a.y * b.x + a.z * b.w,
    )


def conjugate(q: Quat) -> Quat:
    """The inverse rotation."""
    return Quat(q.w, -q.x, -q.y, -q.z)


def normalise(q: Quat) -> Quat:
    """Scale to unit length."""
    inverse = 1 / jnp.sqrt(q.w * q.w + q.x * q.x + q.y * q.y + q.z * q.z)
    return Quat(q.w * inverse, q.x * inverse, q.y * inverse, q.z * inverse)


def rotate(q: Quat, v: Vec3) -> Vec3:
    """The vector q v q*, for a unit quaternion."""
    u = Vec3(q.x, q.y, q.z)
    t = scale(2.0, cross(u, v))
    return add(add(v, scale(q.w, t)), cross(u, t))


def rotate_small(half_rotation: Vec3, q: Quat) -> Quat:
    """Rotate q by the tiny rotation vector 2 h (rad), of half h: (1 - |h|^2 / 2, h) q.

    Terms of order |h|^3 are neglected: for the Earth rate over one sample |h| is 4e-7, so they are
    below rounding error. Without the squared term the norm would drift by 1e-13 per sample.
    """
    c = 1 - 0.5 * dot(half_rotation, half_rotation)
    return Quat(
        c * q.w - (half_rotation.x * q.x + half_rotation.y * q.y + half_rotation.z * q.z),
        c * q.x + (half_rotation.x * q.w + half_rotation.y * q.z - half_rotation.z * q.y),
        c * q.y + (half_rotation.y * q.w + half_rotation.z * q.x - half_rotation.x * q.z),
        c * q.z + (half_rotation.z * q.w + half_rotation.x * q.y - half_rotation.y * q.x),
    )


def exp(phi: Vec3) -> Quat:
    """Quaternion of the rotation vector ``phi`` (rad), accurate to rounding for |phi| <= 2 pi.

    A power series in a quarter of the half angle, doubled twice: without calls of sin, cos or sqrt
    it is vectorised inside a scan, and it is smooth at zero.
    """
    return _exp_by_series(phi, terms=8)


def exp_of_sample(phi: Vec3) -> Quat:
    """`exp` of what a body turns within one sample, with half the terms.

    Accurate to rounding for |phi| <= 0.6 rad, to 1e-10 rad up to 2 rad: far below what coning
    compensation leaves of such a turn.
    """
    return _exp_by_series(phi, terms=4)


def _exp_by_series(phi: Vec3, terms: int) -> Quat:
    s = scale(0.125, phi)
    g = -dot(s, s)
    cos, sinc = 1 / math.factorial(2 * terms), 1 / math.factorial(2 * terms + 1)
    for n in reversed(range(terms)):
        cos = cos * g + 1 / math.factorial(2 * n)
        sinc = sinc * g + 1 / math.factorial(2 * n + 1)
    # q -> q q twice: (w, v) -> (2 w^2 - 1, 2 w v)
    double = 2 * cos * cos - 1
    gain = 4 * double * cos * sinc
    return Quat(2 * double * double - 1, gain * s.x, gain * s.y, gain * s.z)


def log(q: Quat) -> Vec3:
    """Rotation vector (rad, length at most pi) of a unit quaternion; smooth at the identity."""
    sign = jnp.where(q.w < 0, -1.0, 1.0)
    w, x, y, z = sign * q.w, sign * q.x, sign * q.y, sign * q.z
    square = x * x + y * y + z * z
    tiny = square < 1e-16
    sine = jnp.sqrt(jnp.where(tiny, 1.0, square))
    factor = jnp.where(tiny, 2.0, 2 * jnp.arctan2(sine, w) / sine)
    return Vec3(factor * x, factor * y, factor * z)


def log_of_sample(q: Quat) -> Vec3:
    """`log` of what a body turns within one sample: a power series, which is vectorised.

    Accurate to rounding for rotations up to 0.2 rad, to 1e-10 rad up to 0.6 rad.
    """
    square = q.x * q.x + q.y * q.y + q.z * q.z
    factor = 0.0
    for numerator, denominator in reversed(_ARCSINE):
        factor = factor * square + 2 * numerator / denominator
    return Vec3(factor * q.x, factor * q.y, factor * q.z)


def from_euler(pitch: Scalar, roll: Scalar, yaw: Scalar) -> Quat:
    """Quaternion of C = Rz(yaw) Rx(pitch) Ry(roll), angles in rad."""
    zero = jnp.zeros_like(jnp.asarray(pitch) + roll + yaw)
    qz = Quat(jnp.cos(yaw / 2) + zero, zero, zero, jnp.sin(yaw / 2) + zero)
    qx = Quat(jnp.cos(pitch / 2) + zero, jnp.sin(pitch / 2) + zero, zero, zero)
    qy = Quat(jnp.cos(roll / 2) + zero, zero, jnp.sin(roll / 2) + zero, zero)
    return multiply(multiply(qz, qx), qy)


def to_euler(q: Quat) -> tuple[Scalar, Scalar, Scalar]:
    """Pitch, roll, yaw (rad) of a unit quaternion; pitch within +-90 deg, the others +-180 deg."""
    c = matrix(q)
    pitch = jnp.arcsin(jnp.clip(c[2][1], -1.0, 1.0))
    return pitch, jnp.arctan2(-c[2][0], c[2][2]), jnp.arctan2(-c[0][1], c[1][1])


def matrix(q: Quat) -> tuple[Vec3, Vec3, Vec3]:
    """Rows of the rotation matrix of a unit quaternion."""
    w, x, y, z = q
    return (
        Vec3(1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        Vec3(2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        Vec3(2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )


def misalign(phi: Vec3, q: Quat) -> Quat:
    """Attitude in error by the misalignment phi (rad, n): exp(-phi x) C."""
    return multiply(exp(scale(-1.0, phi)), q)


def correct(phi: Vec3, q: Quat) -> Quat:
    """Attitude corrected for an estimated misalignment phi (rad, n): exp(+phi x) C."""
    return multiply(exp(phi), q)


def misalignment(q_true: Quat, q_hat: Quat) -> Vec3:
    """Rotation vector (rad, n) of C_true C_hat^T: the phi for which C_hat = exp(-phi x) C_true."""
    return log(multiply(q_true, conjugate(q_hat)))


def tilt(q_true: Quat, q_hat: Quat) -> Vec3:
    """Horizontal phi (rad, n) for which C_hat = Rz exp(-phi x) C_true, with a heading error Rz."""
    error = multiply(q_true, conjugate(q_hat))
    zero = jnp.zeros_like(error.w)
    return log(normalise(multiply(error, Quat(error.w, zero, zero, -error.z))))


def euler_vector(pitch: Scalar, roll: Scalar, yaw: Scalar) -> Vec3:
    """Rotation vector of Euler angles, rad.

    [P1] section 1 defines a misalignment this way: angles from the ideal to the computed frame,
    about U, E and N in turn.
    """
    return log(from_euler(pitch, roll, yaw))


_HALF_PI = (1.57079632673412561417, 6.07710050630396597660e-11, 2.02226624879595063154e-21)
_SIN = (
    1.58969099521155010221e-10,
    -2.50507602534068634195e-08,
    2.75573137070700676789e-06,
    -1.98412698298579493134e-04,
    8.33333333332248946124e-03,
    -1.66666666666666324348e-01,
)
_COS = (
    -1.13596475577881948265e-11,
    2.08757232129817482790e-09,
    -2.75573143513906633035e-07,
    2.48015872894767294178e-05,
    -1.38888888888741095749e-03,
    4.16666666666666019037e-02,
)


def sin_cos(x: Scalar) -> tuple[Scalar, Scalar]:
    """Sine and cosine by polynomials, within 2 ulp up to 1e5 rad.

    XLA:CPU calls a scalar library function for each number, ten times slower than these vectorised
    polynomials. The split of pi/2 and the coefficients are those of fdlibm (Sun Microsystems).
    """
    quarter = jnp.round(x * (2 / jnp.pi))
    r = x
    for part in _HALF_PI:
        r = r - quarter * part
    sin, cos = sin_cos_near_zero(r)
    quadrant = quarter - 4 * jnp.floor(0.25 * quarter)
    swapped = (quadrant == 1) | (quadrant == 3)
    first, second = jnp.where(swapped, cos, sin), jnp.where(swapped, sin, cos)
    return (
        jnp.where(quadrant >= 2, -first, first),
        jnp.where((quadrant == 1) | (quadrant == 2), -second, second),
    )


def sin_cos_near_zero(x: Scalar) -> tuple[Scalar, Scalar]:
    """Sine and cosine without range reduction, to 1 ulp up to pi/4 rad and 1e-12 up to 1 rad."""
    z = x * x
    sin, cos = jnp.zeros_like(z), jnp.zeros_like(z)
    for a, b in zip(_SIN, _COS, strict=True):
        sin, cos = sin * z + a, cos * z + b
    return x + x * z * sin, 1 - 0.5 * z + z * z * cos
