"""Zero-velocity alignment with a linear error model and a standard Kalman filter, [P1].

The filter measures the navigator's velocity, which should be zero, and feeds its estimate back
into velocity and attitude (closed loop, [P1] section 2.3). `KALMAN5` has the states of [P1] eq.
(1); `KALMAN10` adds constant biases of the level accelerometers and the gyros, in b:
dV' += C_b^n nabla^b and phi' -= C_b^n eps^b.
"""

from functools import partial

from sinsjax.maths import rotations
from sinsjax.maths.algebra import Entries
from sinsjax.methods.filters.keys import ACCEL_BIAS, FIVE_STATES, GYRO_BIAS
from sinsjax.methods.filters.loop import (
    FIRST_BIAS,
    LOOP_KEYS,
    Filter,
    FilterParams,
    FilterState,
    filter_method,
    initial_state,
)
from sinsjax.methods.method import Options
from sinsjax.strapdown.earth import Place
from sinsjax.strapdown.mechanisation import PHI_E, PHI_N, PHI_U, VE, VN, five_state_transition
from sinsjax.types import Navigation, Quat, Sample, Scalar, Vec3

TEN_STATES = (*FIVE_STATES, ACCEL_BIAS, ACCEL_BIAS, GYRO_BIAS, GYRO_BIAS, GYRO_BIAS)
NABLA_X, NABLA_Y, EPS_X, EPS_Y, EPS_Z = range(FIRST_BIAS, FIRST_BIAS + 5)


def ten_state_transition(nav: Navigation, place: Place, f_dt: Vec3, dt: Scalar) -> Entries:
    """Return `five_state_transition` with the biases as states."""
    c = rotations.matrix(nav.q)
    entries = dict(five_state_transition(nav, place, f_dt, dt))
    for row, (velocity, angle) in enumerate(((VE, PHI_E), (VN, PHI_N), (None, PHI_U))):
        for axis, bias in enumerate((EPS_X, EPS_Y, EPS_Z)):
            entries[angle, bias] = -dt * c[row][axis]
        if velocity is not None:
            for axis, bias in enumerate((NABLA_X, NABLA_Y)):
                entries[velocity, bias] = dt * c[row][axis]
    return entries


def build_filter(with_biases: bool, options: Options) -> Filter:
    """Return the filter of `KALMAN5`, or with biases of `KALMAN10`."""
    dt = options.dt
    assumes_rest = options.specific_force == "gravity"
    entries = ten_state_transition if with_biases else five_state_transition

    def transition(state: FilterState, here: Place, f_dt: Vec3) -> Entries:
        nav = state.nav
        if assumes_rest:
            nav, f_dt = nav._replace(ve=0.0, vn=0.0), Vec3(0.0, 0.0, here.gravity * dt)
        return entries(nav, here, f_dt, dt)

    def correct(state: FilterState, sample: Sample) -> Sample:
        return subtract_biases(sample, state.bias, dt)

    return Filter(
        transition=transition,
        init=_init,
        correct=correct if with_biases else None,
        shares_covariance=assumes_rest and options.position == "fixed" and not with_biases,
    )


def _init(params: FilterParams, nav: Navigation) -> FilterState:
    state = initial_state(params, nav)
    return state._replace(bias=state.belief.x[FIRST_BIAS:])


def subtract_biases(sample: Sample, bias: tuple[Scalar, ...], dt: Scalar) -> Sample:
    """Return a sample without biases: of the level accelerometers, m/s^2, and gyros, rad/s."""
    nabla_x, nabla_y, *eps = bias
    # The bias rotates the body by about 1e-8 rad per sample: first order is exact to rounding. As
    # in the model, its effect on dv is neglected: eps g dt / 2, 2.5 ng for 0.1 deg/h at 100 Hz.
    turn = rotations.multiply(sample.turn, Quat(1.0, *(-0.5 * dt * e for e in eps)))
    dv = sample.dv
    return Sample(turn, Vec3(dv.x - nabla_x * dt, dv.y - nabla_y * dt, dv.z))


KALMAN5 = filter_method(
    FIVE_STATES,
    partial(build_filter, False),
    name="kalman5",
    summary="Kalman filter of velocity and attitude errors, zero velocity measured",
    source="[P1] eq. (1)",
    reads=(*LOOP_KEYS, "specific_force"),
)

KALMAN10 = filter_method(
    TEN_STATES,
    partial(build_filter, True),
    name="kalman10",
    compile_s=7.0,
    summary="the same with states of gyro and level accelerometer biases",
    source="[P1] eq. (1), biases as states",
    reads=(*LOOP_KEYS, "specific_force"),
    without_effect=(),
    turning="any",
    gyro_bias_keys=(
        ("p0_gyro_bias_deg_per_h", "p0_yaw_deg"),
        ("reset_gyro_bias_deg_per_h", "reset_yaw_deg"),
    ),
)
