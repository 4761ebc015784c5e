"""Zero-velocity alignment with a linear error model and a standard Kalman filter, [P1].

The filter measures the navigator's velocity, which should be zero, and feeds its estimate back
into velocity and attitude (closed loop, [P1] section 2.3).
"""

from functools import partial

from sinsjax.maths import rotations
from sinsjax.maths.algebra import Entries
from sinsjax.methods import kalman
from sinsjax.methods.base import Method, Options, Site
from sinsjax.methods.filters import attitude
from sinsjax.methods.filters.closed_loop import (
    Filter,
    FilterParams,
    FilterState,
    closed_loop,
    initial_state,
    mechanise_function,
    reverse_time,
    subtract_fed_back,
    update_with_velocity,
)
from sinsjax.methods.schedules import reset_covariance
from sinsjax.strapdown import earth, mechanisation
from sinsjax.strapdown.error_model import PHI_E, PHI_N, PHI_U, VE, VN, LinearModel
from sinsjax.types import Navigation, Sample, Scalar, Vec3

_FIRST_BIAS = PHI_U + 1


def build(model: LinearModel, options: Options) -> Method:
    """Return the zero-velocity Kalman method of one error model.

    Args:
        model: linear error model; its first five states are those of [P1] eq. (1).
        options: choices that decide the program.
    """
    return closed_loop(build_filter(model, options), options)


def build_filter(model: LinearModel, options: Options) -> Filter:
    """Return the filter of [P1] for one error model; arguments as of `build`."""
    dt = options.dt
    assumes_rest = options.specific_force == "gravity"
    mechanise = mechanise_function(options)

    def at_rest(state: FilterState, place: earth.Place) -> Entries:
        gravity = Vec3(0.0, 0.0, place.gravity * dt)
        return model.transition(state.nav._replace(ve=0.0, vn=0.0), place, gravity, dt)

    def propagate(
        params: FilterParams, site: Site, state: FilterState, sample: Sample
    ) -> FilterState:
        """Mechanise, then [P1] eqs (8) and (9) without Q."""
        before, sample = state.nav, model.correct_sample(sample, state.bias, dt)
        nav, f_dt, here = mechanise(site, before, sample)
        if assumes_rest:
            transition = at_rest(state, here)
        else:
            transition = model.transition(before, here, f_dt, dt)
        belief = kalman.propagate(state.belief, transition)
        return state._replace(nav=nav, belief=belief)

    return Filter(
        init=_init,
        propagate=propagate,
        update=update_with_velocity,
        feed_back=_feed_back,
        reset=partial(reset_covariance, heading=(PHI_U,)),
        reverse=partial(_reverse, model),
        place=options.place,
        at_rest=at_rest,
        misalignment=attitude.estimated_misalignment,
        attitude=attitude.corrected_attitude,
        covariance=attitude.misalignment_covariance,
        shares_covariance=assumes_rest and options.position == "fixed" and not model.uses_attitude,
        keep=_keep_biases,
        gyro_bias=partial(_gyro_bias, model) if _estimates_gyro_bias(model) else None,
    )


def _estimates_gyro_bias(model: LinearModel) -> bool:
    return "eps_x" in model.states


def _init(params: FilterParams, nav: Navigation) -> FilterState:
    state = initial_state(params, nav)
    return state._replace(bias=state.belief.x[_FIRST_BIAS:])


def _feed_back(state: FilterState, share: Scalar) -> tuple[FilterState, Vec3]:
    """[P1] section 2.3: V <- V - dV, C <- exp(phi x) C, and x loses the part fed back."""
    fed_back = tuple(share * estimate for estimate in state.belief.x)
    nav = mechanisation.correct_velocity(state.nav, fed_back[VE], fed_back[VN])
    phi = Vec3(fed_back[PHI_E], fed_back[PHI_N], fed_back[PHI_U])
    biases = zip(state.bias, fed_back[_FIRST_BIAS:], strict=True)
    corrected = state._replace(
        nav=nav._replace(q=rotations.correct(phi, nav.q)),
        belief=subtract_fed_back(state.belief, fed_back),
        bias=tuple(bias + correction for bias, correction in biases),
    )
    return corrected, phi


def _estimated_biases(state: FilterState) -> tuple[Scalar, ...]:
    """Return the sensor biases as estimated: fed back, and not yet fed back."""
    not_fed_back = state.belief.x[_FIRST_BIAS:]
    return tuple(bias + x for bias, x in zip(state.bias, not_fed_back, strict=True))


def _keep_biases(first: FilterState, last: FilterState) -> FilterState:
    return first._replace(bias=_estimated_biases(last))


def _gyro_bias(model: LinearModel, state: FilterState) -> Vec3:
    bias = dict(zip(model.states[_FIRST_BIAS:], _estimated_biases(state), strict=True))
    return Vec3(bias["eps_x"], bias["eps_y"], bias["eps_z"])


def _reverse(model: LinearModel, state: FilterState) -> FilterState:
    biases = zip(model.reversal[_FIRST_BIAS:], state.bias, strict=True)
    reversed_ = reverse_time(model.reversal, state)
    return reversed_._replace(bias=tuple(sign * bias for sign, bias in biases))
