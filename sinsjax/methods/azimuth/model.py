"""Errors of a navigator off by an azimuth of any size and a small tilt, on a base at rest.

C_{n'}^n = Rz(a) e, see `filters.tilt`; t_E, t_N are the tilt in n':

    dV_E' =  2 w_U dV_N - g t_N      t_E' = -dV_N/R + w_U t_N - w_N sin a
    dV_N' = -2 w_U dV_E + g t_E      t_N' =  dV_E/R - w_U t_E + w_N (1 - cos a)
    a' = w_N (t_E (1 + cos a) - t_N sin a)/2 + (tan L / R) dV_E

After Yan Gongmin's eq. (4-23), whose w_N (t_E cos a - t_N sin a) in a' is that of Euler angles: the
shortest turn e is turned itself as the tilt grows at w_N (-sin a, 1 - cos a), which is half of it.
The tests differentiate the navigator.
"""

from sinsjax.maths.algebra import Entries, Minus
from sinsjax.maths.rotations import sin_cos
from sinsjax.strapdown.earth import Place
from sinsjax.types import Scalar

STATES = ("dve", "dvn", "tilt_e", "tilt_n", "heading")
VE, VN, TILT_E, TILT_N, AZIMUTH = range(5)
REVERSAL = (-1.0, -1.0, 1.0, 1.0, 1.0)
"""Sign of each state under time reversal."""

Errors = tuple[Scalar, ...]
"""Values of the `STATES`: m/s and rad."""


def after(x: Errors, place: Place, dt: Scalar) -> Errors:
    """The errors a step later, to first order in dt (s)."""
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


def derivative(x: Errors, place: Place, dt: Scalar) -> Entries:
    """Derivative of `after` by the errors, less the identity: its non-zero entries."""
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
