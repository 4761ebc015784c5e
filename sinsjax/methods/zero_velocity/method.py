"""Zero-velocity alignment with a linear error model and a standard Kalman filter, [P1].

The filter measures the navigator's velocity, which should be zero, and feeds its estimate back
into velocity and attitude (closed loop, [P1] section 2.3).
"""

from functools import partial

from sinsjax.maths import rotations
from sinsjax.maths.algebra import Entries
from sinsjax.methods import kalman
from sinsjax.methods.base import Method, Options, Site
from sinsjax.methods.filters import misalignment
from sinsjax.methods.filters.stages import (
    Filter,
    FilterParams,
    FilterState,
    begin,
    mechaniser,
    place_of,
    reversed_by,
    unaided,
    update_by_velocity,
)
from sinsjax.methods.schedules import reset_covariance
from sinsjax.methods.triggers.watched import method_of
from sinsjax.strapdown import earth, mechanisation
from sinsjax.strapdown.error_model import PHI_E, PHI_N, PHI_U, VE, VN, ErrorModel
from sinsjax.types import Navigation, Sample, Scalar, Vec3

_LEVEL_AND_YAW = (VE, VN, PHI_E, PHI_N, PHI_U)


def build(model: ErrorModel, options: Options) -> Method:
    """The zero-velocity Kalman method for one error model.

    Args:
        model: linear error model; its first five states are those of [P1] eq. (1).
        options: what decides the program.
    """
    return method_of(filter_of(model, options), options)


def filter_of(model: ErrorModel, options: Options) -> Filter:
    """The filter of [P1] for one error model; arguments as of `build`."""
    dt = options.dt
    assumed_at_rest = options.specific_force == "gravity"
    mechanise = mechaniser(options)

    def at_rest(state: FilterState, place: earth.Place) -> Entries:
        gravity = Vec3(0.0, 0.0, place.gravity * dt)
        return model.transition(state.nav._replace(ve=0.0, vn=0.0), place, gravity, dt)

    def propagate(
        params: FilterParams, site: Site, state: FilterState, sample: Sample
    ) -> tuple[FilterState, Entries]:
        """Mechanise, then [P1] eqs (8) and (9) but for Q."""
        before, sample = state.nav, model.correct_sample(sample, state.bias, dt)
        nav, f_dt, here = mechanise(site, before, sample)
        if assumed_at_rest:
            transition = at_rest(state, here)
        else:
            transition = model.transition(before, here, f_dt, dt)
        belief = kalman.propagate(state.belief, transition)
        return state._replace(nav=nav, belief=belief), transition

    return Filter(
        dt,
        _init,
        propagate,
        update_by_velocity,
        _feed_back,
        partial(reset_covariance, heading=(PHI_U,)),
        partial(_reverse, model),
        place_of(options.position),
        at_rest,
        misalignment.estimated,
        misalignment.corrected,
        misalignment.covariance,
        unaided,
        misalignment.inputs,
        misalignment.start_error,
        common_covariance=assumed_at_rest
        and options.position == "fixed"
        and not model.uses_attitude,
        keep=_keep_biases,
        gyro_bias=partial(_gyro_bias, model) if "eps_x" in model.states else None,
    )


def _init(params: FilterParams, nav: Navigation) -> FilterState:
    state = begin(params, nav)
    return state._replace(bias=state.belief.x[len(_LEVEL_AND_YAW) :])


def _feed_back(state: FilterState, share: Scalar) -> tuple[FilterState, Vec3]:
    """[P1] section 2.3: V <- V - dV, C <- exp(phi x) C, and x gives up what was fed back."""
    x = state.belief.x
    fed = tuple(share * one for one in x)
    nav = mechanisation.correct_velocity(state.nav, fed[VE], fed[VN])
    phi = Vec3(fed[PHI_E], fed[PHI_N], fed[PHI_U])
    biases = zip(state.bias, fed[len(_LEVEL_AND_YAW) :], strict=True)
    corrected = state._replace(
        nav=nav._replace(q=rotations.correct(phi, nav.q)),
        belief=state.belief._replace(x=tuple(a - b for a, b in zip(x, fed, strict=True))),
        bias=tuple(b + f for b, f in biases),
    )
    return corrected, phi


def _biases(state: FilterState) -> tuple[Scalar, ...]:
    """Sensor biases as estimated: fed back, and not yet."""
    left = state.belief.x[len(_LEVEL_AND_YAW) :]
    return tuple(b + x for b, x in zip(state.bias, left, strict=True))


def _keep_biases(begun: FilterState, ended: FilterState) -> FilterState:
    return begun._replace(bias=_biases(ended))


def _gyro_bias(model: ErrorModel, state: FilterState) -> Vec3:
    of = dict(zip(model.states[len(_LEVEL_AND_YAW) :], _biases(state), strict=True))
    return Vec3(of["eps_x"], of["eps_y"], of["eps_z"])


def _reverse(model: ErrorModel, state: FilterState) -> FilterState:
    biases = zip(model.reversal[len(_LEVEL_AND_YAW) :], state.bias, strict=True)
    turned = reversed_by(model.reversal, state)
    return turned._replace(bias=tuple(s * b for s, b in biases))
