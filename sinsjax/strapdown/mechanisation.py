"""Strapdown mechanisation in ENU, one step at constant height, and the linear model of its errors.

Quaternion attitude, velocity with Coriolis and transport rate, zero vertical velocity.

The errors, [P1] eq. (3), are those of level velocity and the misalignment phi, defined by
C_b^{n'} = exp(-phi x) C_b^n (derived in [P1], checked in the tests by differentiating the step):
dV' = f^n x phi - (2 w_ie + w_en) x dV - dw_en x V + nabla and phi' = phi x w_in + dw_in - eps.
"""

from sinsjax.maths.algebra import Entries, Minus, add, cross, scale
from sinsjax.maths.rotations import multiply, rotate, rotate_small
from sinsjax.strapdown.earth import Place
from sinsjax.types import Navigation, Sample, Scalar, Vec3


def advance_navigation(
    nav: Navigation, sample: Sample, place: Place, dt: Scalar, control: Vec3 | None = None
) -> tuple[Navigation, Vec3]:
    """Advance attitude and velocity by one sample; the position is left alone.

    dV = C_b^n dv - (2 w_ie + w_en) x V dt + g dt, with C_b^n dv rotated back by half the rotation
    of the navigation frame over the sample; C <- exp(-w_in dt) C exp(dtheta).

    The same step navigates backward in time, given reversed samples (`sensors.reverse_sample`), an
    Earth that rotates the other way (`earth.reverse_rotation`) and the negative velocity, [P2] eqs
    (12)-(14).

    Args:
        nav: solution at the start of the sample.
        sample: compensated sample.
        place: Earth at the solution's latitude.
        dt: sample time, s.
        control: commanded rate of the mathematical platform in addition to w_in, in n, rad/s.

    Returns:
        The solution at the end of the sample, and the specific force in n times dt, m/s.
    """
    turn_e = nav.ve * place.curvature_e
    wu = place.rate_u + turn_e * place.tan_latitude
    rate = Vec3(-nav.vn * place.curvature_n, place.rate_n + turn_e, wu)
    half_turn = scale(-0.5 * dt, rate if control is None else add(rate, control))
    f_dt = rotate(nav.q, sample.dv)
    f_dt = add(f_dt, cross(half_turn, f_dt))
    coriolis = (place.rate_u + wu) * dt
    q = rotate_small(half_turn, multiply(nav.q, sample.turn))
    ve = nav.ve + f_dt.x + coriolis * nav.vn
    vn = nav.vn + f_dt.y - coriolis * nav.ve
    return nav._replace(q=q, ve=ve, vn=vn), f_dt


def advance_position(nav: Navigation, place: Place, dt: Scalar) -> Navigation:
    """Advance the position at the current velocity over dt (s)."""
    secant = (1 + place.tan_latitude**2) ** 0.5
    return nav._replace(
        latitude=nav.latitude + nav.vn * place.curvature_n * dt,
        longitude=nav.longitude + nav.ve * place.curvature_e * dt * secant,
    )


def correct_velocity(nav: Navigation, dve: Scalar, dvn: Scalar) -> Navigation:
    """Subtract estimated velocity errors (m/s) from the solution."""
    return nav._replace(ve=nav.ve - dve, vn=nav.vn - dvn)


def reverse_velocity(nav: Navigation) -> Navigation:
    """Return the solution in reversed time: same position and attitude, opposite velocity."""
    return nav._replace(ve=-nav.ve, vn=-nav.vn)


# The linear error model


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
