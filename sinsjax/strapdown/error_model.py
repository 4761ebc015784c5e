"""Linear error models of the zero-velocity aligned navigator.

A model names its states and gives the non-zero entries of A dt by state number. The first five
states are always those of [P1] eq. (3): level velocity errors and the misalignment phi, defined by
C_b^{n'} = exp(-phi x) C_b^n. Further states are sensor biases in the body frame.

Derivation ([P1], checked in the tests by differentiating the nonlinear mechanisation):
dV' = f^n x phi - (2 w_ie + w_en) x dV - dw_en x V + nabla and phi' = phi x w_in + dw_in - eps.
"""

from collections.abc import Callable
from typing import NamedTuple

from sinsjax.maths.algebra import Entries, Minus
from sinsjax.maths.rotations import matrix, multiply
from sinsjax.strapdown.earth import Place
from sinsjax.types import Navigation, Quat, Sample, Scalar, Vec3

VE, VN, PHI_E, PHI_N, PHI_U = range(5)
NABLA_X, NABLA_Y, EPS_X, EPS_Y, EPS_Z = range(5, 10)


class LinearModel(NamedTuple):
    """A linear error model.

    Attributes:
        states: names of the states, in order.
        transition: (navigation, place, f dt in n, dt) -> non-zero entries of A dt.
        correct_sample: (sample, fed-back biases, dt) -> bias-corrected sample.
        uses_attitude: whether the transition depends on the attitude.
        reversal: sign of each state under time reversal: -1 for velocity errors and gyro biases.
    """

    states: tuple[str, ...]
    transition: Callable[[Navigation, Place, Vec3, Scalar], Entries]
    correct_sample: Callable[[Sample, tuple[Scalar, ...], Scalar], Sample]
    uses_attitude: bool
    reversal: tuple[float, ...]


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


def ten_state_transition(nav: Navigation, place: Place, f_dt: Vec3, dt: Scalar) -> Entries:
    """`five_state_transition` with two level accelerometer biases and three gyro biases in b.

    The biases are constant; dV' += C_b^n nabla^b and phi' -= C_b^n eps^b.
    """
    c = matrix(nav.q)
    entries = dict(five_state_transition(nav, place, f_dt, dt))
    for row, (velocity, angle) in enumerate(((VE, PHI_E), (VN, PHI_N), (None, PHI_U))):
        for axis, bias in enumerate((EPS_X, EPS_Y, EPS_Z)):
            entries[angle, bias] = -dt * c[row][axis]
        if velocity is not None:
            for axis, bias in enumerate((NABLA_X, NABLA_Y)):
                entries[velocity, bias] = dt * c[row][axis]
    return entries


def _no_biases(sample: Sample, bias: tuple[Scalar, ...], dt: Scalar) -> Sample:
    return sample


def _subtract_biases(sample: Sample, bias: tuple[Scalar, ...], dt: Scalar) -> Sample:
    nabla_x, nabla_y, *eps = bias
    # The bias rotates the body by about 1e-8 rad per sample: first order is exact to rounding. As
    # in the model, its effect on dv is neglected: eps g dt / 2, 2.5 ng for 0.1 deg/h at 100 Hz.
    turn = multiply(sample.turn, Quat(1.0, *(-0.5 * dt * e for e in eps)))
    dv = sample.dv
    return Sample(turn, Vec3(dv.x - nabla_x * dt, dv.y - nabla_y * dt, dv.z))


_FIVE = {"dve": -1.0, "dvn": -1.0, "phi_e": 1.0, "phi_n": 1.0, "phi_u": 1.0}
_BIASES = {"nabla_x": 1.0, "nabla_y": 1.0, "eps_x": -1.0, "eps_y": -1.0, "eps_z": -1.0}
_TEN = _FIVE | _BIASES
MODELS = {
    "kalman5": LinearModel(
        tuple(_FIVE),
        five_state_transition,
        _no_biases,
        uses_attitude=False,
        reversal=tuple(_FIVE.values()),
    ),
    "kalman10": LinearModel(
        tuple(_TEN),
        ten_state_transition,
        _subtract_biases,
        uses_attitude=True,
        reversal=tuple(_TEN.values()),
    ),
}
"""Error models by the name of the method that uses them."""
