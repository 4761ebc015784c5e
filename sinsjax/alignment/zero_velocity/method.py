"""Zero-velocity alignment with a linear error model and a standard Kalman filter, [P1].

The filter measures the navigator's velocity, which should be zero, and feeds its estimate back
into velocity and attitude (closed loop, [P1] section 2.3).
"""

from functools import partial

from sinsjax.alignment import kalman
from sinsjax.alignment.base import AttitudeCovariance, Ending, Method, Options, Site
from sinsjax.alignment.filters import Filter, FilterParams, FilterState, with_innovations
from sinsjax.alignment.kalman import Belief, Innovation
from sinsjax.alignment.limits import Biases, Limit, unaided
from sinsjax.alignment.schedules import reset_covariance
from sinsjax.alignment.triggers.watched import with_trigger
from sinsjax.maths import rotations
from sinsjax.maths.algebra import Entries, change_signs, triangle_index
from sinsjax.strapdown import earth, mechanisation
from sinsjax.strapdown.error_model import PHI_E, PHI_N, PHI_U, VE, VN, ErrorModel
from sinsjax.types import Navigation, Quat, Sample, Scalar, Vec3

_LEVEL_AND_YAW = (VE, VN, PHI_E, PHI_N, PHI_U)


def build(model: ErrorModel, options: Options) -> Method:
    """The zero-velocity Kalman method for one error model.

    Args:
        model: linear error model; its first five states are those of [P1] eq. (1).
        options: what decides the program.
    """
    plain = filter_of(model, options)
    return with_trigger(with_innovations(plain) if options.innovations else plain, options.trigger)


def filter_of(model: ErrorModel, options: Options) -> Filter:
    """The filter of [P1] for one error model; arguments as of `build`."""
    dt = options.dt
    assumed_at_rest = options.specific_force == "gravity"
    integrated = options.position == "integrated"

    def place(site: Site, nav: Navigation) -> earth.Place:
        return earth.place(site.earth, nav.latitude) if integrated else site.place

    def at_rest(nav: Navigation, place: earth.Place) -> Entries:
        gravity = Vec3(0.0, 0.0, place.gravity * dt)
        return model.transition(nav._replace(ve=0.0, vn=0.0), place, gravity, dt)

    def propagate(
        params: FilterParams, site: Site, state: FilterState, sample: Sample
    ) -> FilterState:
        """Mechanise, then [P1] eqs (8) and (9) but for Q."""
        before, here = state.nav, place(site, state.nav)
        sample = model.correct_sample(sample, state.bias, dt)
        nav, f_dt = mechanisation.step(before, sample, here, dt)
        if integrated:
            nav = mechanisation.travel(nav, here, dt)
        if assumed_at_rest:
            transition = at_rest(before, here)
        else:
            transition = model.transition(before, here, f_dt, dt)
        return state._replace(nav=nav, belief=kalman.propagate(state.belief, transition))

    return Filter(
        dt,
        _init,
        propagate,
        _update,
        _feed_back,
        partial(reset_covariance, yaw=PHI_U),
        partial(_reverse, model),
        place,
        at_rest,
        _misalignment,
        _attitude,
        _covariance,
        _limit,
        common_covariance=assumed_at_rest and not integrated and not model.uses_attitude,
    )


def _init(params: FilterParams, nav: Navigation) -> FilterState:
    belief = kalman.start(params.p0)
    return FilterState(nav, belief, belief.x[len(_LEVEL_AND_YAW) :], params.feedback.every)


def _update(params: FilterParams, state: FilterState) -> tuple[FilterState, Innovation]:
    """Velocity should be zero: [P1] eqs (10)-(12)."""
    measured = state.nav.ve, state.nav.vn
    innovation = kalman.innovation(state.belief, (VE, VN), measured, params.r)
    belief = kalman.update(state.belief, (VE, VN), measured, params.r)
    return state._replace(belief=belief), innovation


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


def _reverse(model: ErrorModel, state: FilterState) -> FilterState:
    signs, (x, p) = model.reversal, state.belief
    biases = zip(signs[len(_LEVEL_AND_YAW) :], state.bias, strict=True)
    return state._replace(
        nav=mechanisation.reverse(state.nav),
        belief=Belief(tuple(s * a for s, a in zip(signs, x, strict=True)), change_signs(signs, p)),
        bias=tuple(s * b for s, b in biases),
    )


def _misalignment(state: FilterState) -> Vec3:
    x = state.belief.x
    return Vec3(x[PHI_E], x[PHI_N], x[PHI_U])


def _attitude(state: FilterState) -> Quat:
    return rotations.correct(_misalignment(state), state.nav.q)


def _covariance(state: FilterState) -> AttitudeCovariance:
    at = triangle_index(len(state.belief.x))
    angles = (PHI_E, PHI_N, PHI_U)
    return AttitudeCovariance(*(state.belief.p[at[i, j]] for i in angles for j in angles if i <= j))


def _limit(params: FilterParams, place: earth.Place, biases: Biases, ending: Ending) -> Limit:
    return unaided(place, biases)
