"""The linear error model of the zero-velocity aligned navigator, [P1] eq. (3).

Its states are level velocity errors and the misalignment phi, defined by
C_b^{n'} = exp(-phi x) C_b^n.

Derivation ([P1], checked in the tests by differentiating the nonlinear mechanisation):
dV' = f^n x phi - (2 w_ie + w_en) x dV - dw_en x V + nabla and phi' = phi x w_in + dw_in - eps.
"""

from sinsjax.maths.algebra import Entries, Minus
from sinsjax.strapdown.earth import Place
from sinsjax.types import Navigation, Scalar, Vec3

VE, VN, PHI_E, PHI_N, PHI_U = range(5)


def five_state_transition(nav: Navigation, place: Place, f_dt: Vec3, dt: Scalar) -> Entries:
    """Non-zero entries of A dt, [P1] eq. (3), for VU = 0.

    Args:
        nav: navigation solution (velocities in m/s).
        place: Earth rates and curvatures at the solution's latitude.
        f_dt: specific force in n times the step, m/s.
        dt: step, s.
    """
    turn_e = nav.ve * place.curvature_e * dt
    turn_n = nav.vn * place.curvature_n * dt
    wn = place.rate_n * dt + turn_e
    wu = place.rate_u * dt + turn_e * place.tan_latitude
    coriolis = wu + place.rate_u * dt
    ce, cn = place.curvature_e * dt, place.curvature_n * dt
    return {
        (VE, VE): nav.vn * place.tan_latitude * ce,
        (VE, VN): coriolis,
        (VE, PHI_N): Minus(f_dt.z),
        (VE, PHI_U): f_dt.y,
        (VN, VE): Minus(coriolis + turn_e * place.tan_latitude),
        (VN, PHI_E): f_dt.z,
        (VN, PHI_U): Minus(f_dt.x),
        (PHI_E, VN): Minus(cn),
        (PHI_E, PHI_N): wu,
        (PHI_E, PHI_U): Minus(wn),
        (PHI_N, VE): ce,
        (PHI_N, PHI_E): Minus(wu),
        (PHI_N, PHI_U): Minus(turn_n),
        (PHI_U, VE): place.tan_latitude * ce,
        (PHI_U, PHI_E): wn,
        (PHI_U, PHI_N): turn_n,
    }
