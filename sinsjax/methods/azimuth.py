"""Zero-velocity alignment with a model that is nonlinear in the azimuth and linear in the rest.

The navigator is off by an azimuth a of any size and a small tilt, C_{n'}^n = Rz(a) e (see
`azimuth_and_tilt`); with the tilt t_E, t_N in n' its errors on a base at rest are

    dV_E' =  2 w_U dV_N - g t_N      t_E' = -dV_N/R + w_U t_N - w_N sin a
    dV_N' = -2 w_U dV_E + g t_E      t_N' =  dV_E/R - w_U t_E + w_N (1 - cos a)
    a' = w_N (t_E (1 + cos a) - t_N sin a)/2 + (tan L / R) dV_E

After Yan Gongmin's eq. (4-23), whose w_N (t_E cos a - t_N sin a) in a' is that of Euler angles: the
shortest rotation e itself rotates as the tilt grows at w_N (-sin a, 1 - cos a), which is half of
it. The tests differentiate the navigator.

The loop is that of [P1]. The belief is predicted by the linearised model (extended Kalman filter)
or by an unscented transform. The correction fed back is Rz(a) e itself, since Euler angles of the
same numbers would differ from it by t_E t_N / 2 about the vertical: 3.5 deg of heading at tilts of
20 deg, towards north or away from it depending on the signs of the tilts.
"""

from collections.abc import Callable
from functools import partial

import jax.numpy as jnp

from sinsjax.maths import rotations
from sinsjax.maths.algebra import Entries, Minus, Triangle, congruence, triangle_index
from sinsjax.maths.rotations import sin_cos
from sinsjax.methods.azimuth_and_tilt import rotate_covariance, rotation_from_tilt
from sinsjax.methods.filters.kalman import Belief
from sinsjax.methods.filters.keys import FIVE_STATES
from sinsjax.methods.filters.loop import (
    Filter,
    FilterParams,
    FilterState,
    estimated_misalignment,
    feed_back,
    filter_method,
    misalignment_covariance,
)
from sinsjax.methods.method import AttitudeCovariance, Options
from sinsjax.strapdown.earth import Place
from sinsjax.types import Quat, Scalar, Vec3

VE, VN, TILT_E, TILT_N, AZIMUTH = range(5)

Errors = tuple[Scalar, ...]
"""Velocity errors (m/s), tilt and azimuth (rad)."""


def predict_errors(x: Errors, place: Place, dt: Scalar) -> Errors:
    """Return the errors one step later, to first order in dt (s)."""
    sine, cosine = sin_cos(x[AZIMUTH])
    wn, wu, g = place.rate_n * dt, place.rate_u * dt, place.gravity * dt
    ce, cn = place.curvature_e * dt, place.curvature_n * dt
    ve, vn, tilt_e, tilt_n, azimuth = x
    return (
        ve + (2 * wu * vn - g * tilt_n),
        vn + (g * tilt_e - 2 * wu * ve),
        tilt_e + (wu * tilt_n - cn * vn - wn * sine),
        tilt_n + (ce * ve - wu * tilt_e + wn * (1 - cosine)),
        azimuth
        + (0.5 * wn * (tilt_e * (1 + cosine) - tilt_n * sine) + place.tan_latitude * ce * ve),
    )


def jacobian(x: Errors, place: Place, dt: Scalar) -> Entries:
    """Return the non-zero entries of the derivative of `predict_errors`, less the identity."""
    sine, cosine = sin_cos(x[AZIMUTH])
    wn, wu, g = place.rate_n * dt, place.rate_u * dt, place.gravity * dt
    ce, cn = place.curvature_e * dt, place.curvature_n * dt
    by_east, by_north = wn * cosine, wn * sine
    return {
        (VE, VN): 2 * wu,
        (VE, TILT_N): Minus(g),
        (VN, VE): Minus(2 * wu),
        (VN, TILT_E): g,
        (TILT_E, VN): Minus(cn),
        (TILT_E, TILT_N): wu,
        (TILT_E, AZIMUTH): Minus(by_east),
        (TILT_N, VE): ce,
        (TILT_N, TILT_E): Minus(wu),
        (TILT_N, AZIMUTH): by_north,
        (AZIMUTH, VE): place.tan_latitude * ce,
        (AZIMUTH, TILT_E): 0.5 * (wn + by_east),
        (AZIMUTH, TILT_N): Minus(0.5 * by_north),
        (AZIMUTH, AZIMUTH): Minus(0.5 * (x[TILT_E] * by_north + x[TILT_N] * by_east)),
    }


ALPHA = 0.5
"""Spread of the sigma points: alpha sqrt(5) standard deviations."""

BETA = 2.0
"""Weight of the central point, for a normal distribution (Wan and van der Merwe 2000)."""


def predict_linearised(belief: Belief, place: Place, dt: Scalar) -> Belief:
    """Predict as an extended Kalman filter: mean by the model, P by its Jacobian at the mean."""
    x, p = belief
    return Belief(predict_errors(x, place, dt), congruence(jacobian(x, place, dt), p, len(x)))


def predict_unscented(belief: Belief, place: Place, dt: Scalar, alpha: Scalar = ALPHA) -> Belief:
    """Predict by the scaled unscented transform (Julier 2002): the model at 2 n + 1 sigma points.

    The sums are over differences from the central point, whose large weight then drops out: with
    the differences d_i and s = sum d_i / (2 h^2), h = alpha sqrt(n), the mean moves by s, and
    P = sum d_i d_i' / (2 h^2) + (beta - alpha^2) s s'.
    """
    x, p = belief
    n = len(x)
    h = alpha * n**0.5
    weight = 1 / (2 * h * h)
    middle = predict_errors(x, place, dt)
    differences: list[Errors] = []
    for column in _cholesky_columns(p, n):
        for side in (1.0, -1.0):
            point = tuple(a + side * h * b for a, b in zip(x, column, strict=True))
            moved = predict_errors(point, place, dt)
            differences.append(tuple(a - b for a, b in zip(moved, middle, strict=True)))
    shift = [weight * sum(d[i] for d in differences) for i in range(n)]
    spread = tuple(
        weight * sum(d[i] * d[j] for d in differences) + (BETA - alpha**2) * shift[i] * shift[j]
        for i in range(n)
        for j in range(i, n)
    )
    return Belief(tuple(a + b for a, b in zip(middle, shift, strict=True)), spread)


def _cholesky_columns(p: Triangle, n: int) -> list[Errors]:
    """Return the columns of the lower triangular L with P = L L'."""
    at, zero = triangle_index(n), jnp.zeros_like(p[0])
    rows: list[list[Scalar]] = [[zero] * n for _ in range(n)]
    for j in range(n):
        left = p[at[j, j]] - sum(rows[j][k] ** 2 for k in range(j))
        # Rounding may leave a variance of zero, or less.
        rows[j][j] = jnp.sqrt(jnp.maximum(left, jnp.finfo(zero.dtype).tiny))
        for i in range(j + 1, n):
            off = p[at[i, j]] - sum(rows[i][k] * rows[j][k] for k in range(j))
            rows[i][j] = off / rows[j][j]
    return [tuple(rows[i][j] for i in range(n)) for j in range(n)]


def build_filter(predict: Callable[[Belief, Place, Scalar], Belief], options: Options) -> Filter:
    """Return the filter; `Options.specific_force` is always that of a base at rest.

    Args:
        predict: (belief, place, dt) -> belief one sample later, without its process noise.
        options: those of the method.
    """
    dt = options.dt

    def predict_belief(
        params: FilterParams, state: FilterState, here: Place, f_dt: Vec3
    ) -> FilterState:
        return state._replace(belief=predict(state.belief, here, dt))

    return Filter(
        transition=lambda state, here, f_dt: jacobian(state.belief.x, here, dt),
        predict=predict_belief,
        feed_back=partial(feed_back, rotate=_rotate),
        attitude=_attitude,
        covariance=_covariance,
    )


def _rotate(phi: Vec3, q: Quat) -> Quat:
    """Return the attitude corrected by tilt and azimuth, rad."""
    return rotations.multiply(rotation_from_tilt(phi.x, phi.y, *sin_cos(phi.z)), q)


def _attitude(state: FilterState) -> Quat:
    return _rotate(estimated_misalignment(state), state.nav.q)


def _covariance(state: FilterState) -> AttitudeCovariance:
    return rotate_covariance(
        misalignment_covariance(state), *rotations.sin_cos(state.belief.x[AZIMUTH])
    )


EKF_AZIMUTH = filter_method(
    FIVE_STATES,
    partial(build_filter, predict_linearised),
    name="ekf_azimuth",
    summary="extended Kalman filter, its model nonlinear in the azimuth",
    source="after Yan, Strapdown Inertial Navigation, eq. (4-23)",
    step_s=25e-9,
)

UNSCENTED = filter_method(
    FIVE_STATES,
    partial(build_filter, predict_unscented),
    name="unscented",
    summary="the same model with an unscented transform",
    source="Julier (2002); Wan and van der Merwe (2000)",
    step_s=60e-9,
)
