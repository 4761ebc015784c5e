"""Zero-velocity alignment of a base that surges: `sincos` with states of the base's own velocity.

On a base that surges a zero-velocity filter takes the base's own velocity for white measurement
noise. The velocity of a base that stays near its place is not white: it changes over seconds, and
cancels over minutes. Four more states model it, on either axis

    s' = v,    v' = -s/T^2 - v/T + w,    V = dV + v,

with a place s that wanders within bounds, correlation time T and rms velocity sigma: w has density
2 sigma^2/T, s starts with variance (sigma T)^2. The measured V is that of the solution, whose error
is dV alone; only dV and the tilt are fed back. With T and sigma of the base, Q of the sensors and a
small R, the heading comes within a few percent of the information bound (`bounds.information`),
and P is true.
"""

from typing import Any

from sinsjax.maths.algebra import Entries, Minus
from sinsjax.methods import sincos
from sinsjax.methods.filters import kalman
from sinsjax.methods.filters.kalman import Innovation
from sinsjax.methods.filters.keys import (
    FilterSection,
    ResetsSection,
    StateKind,
    check_resets,
    has_trigger,
)
from sinsjax.methods.filters.loop import Filter, FilterParams, FilterState
from sinsjax.methods.filters.params import filter_params
from sinsjax.methods.method import Options, StudyKeys
from sinsjax.methods.sincos import VE, VN
from sinsjax.strapdown.earth import Place
from sinsjax.types import Navigation, Scalar
from sinsjax.value_types import Seconds, Section, SpeedSigma, field

PLACE_E, PLACE_N, SURGE_E, SURGE_N = range(6, 10)
PLACE, SPEED = StateKind(None, None), StateKind(None, None, sign=-1.0)
STATES = (*sincos.STATES, PLACE, PLACE, SPEED, SPEED)

_TO_MEASURED: Entries = {(VE, SURGE_E): 1.0, (VN, SURGE_N): 1.0}
_FROM_MEASURED: Entries = {(VE, SURGE_E): Minus(1.0), (VN, SURGE_N): Minus(1.0)}
"""From dV to the measured V, and back."""


def build_filter(options: Options) -> Filter:
    """Return the filter; its extra params and state are 1/T of the surge, 1/s.

    `Options.specific_force` is always that of a base at rest.
    """
    dt = options.dt

    def init(params: FilterParams, nav: Navigation) -> FilterState:
        return sincos.init_unknown_heading(params, nav)._replace(extra=params.extra)

    return sincos.build_filter(options)._replace(
        init=init,
        transition=lambda state, here, f_dt: transition(here, state.extra, dt),
        update=_update_with_surge,
    )


def transition(place: Place, rate: Scalar, dt: Scalar) -> Entries:
    """Return the non-zero entries of A dt with the states of the surge, see the module."""
    damping = rate * dt
    restoring = rate * damping
    return {
        **sincos.transition(place, dt),
        (PLACE_E, SURGE_E): dt,
        (PLACE_N, SURGE_N): dt,
        (SURGE_E, PLACE_E): Minus(restoring),
        (SURGE_N, PLACE_N): Minus(restoring),
        (SURGE_E, SURGE_E): Minus(damping),
        (SURGE_N, SURGE_N): Minus(damping),
    }


def _update_with_surge(params: Any, state: Any) -> tuple[Any, Innovation]:
    """Update with the velocity of the solution, which should be that of the base."""
    measured = state.nav.ve, state.nav.vn
    predicted = kalman.propagate(state.belief, _TO_MEASURED)
    innovation = kalman.innovation(predicted, (VE, VN), measured, params.r)
    updated = kalman.update(predicted, (VE, VN), measured, params.r)
    return state._replace(belief=kalman.propagate(updated, _FROM_MEASURED)), innovation


class SurgeSection(Section):
    """[surge]: assumed surge of the base."""

    r_surge_m_per_s: SpeedSigma = field("rms velocity along east and north", 0.1)
    r_surge_time_s: Seconds = field("correlation time of the velocity", 5.0)


def params(keys: StudyKeys, xp: Any) -> FilterParams:
    """Return the params of the filter with states of the surge, leaves (variants,)."""
    own = filter_params(sincos.STATES, keys, xp, models_surge=True)
    variance = keys.column("r_surge_m_per_s") ** 2
    time = keys.column("r_surge_time_s")
    p0 = (*(variance * time**2,) * 2, *(variance,) * 2)
    q = 2 * variance / time / keys.rate_hz
    return own._replace(
        p0=(*own.p0, *p0),
        q=(*own.q, *(0.0 * q,) * 2, *(q,) * 2),
        reset_to=(*own.reset_to, *p0),
        extra=1 / time,
    )


def check_no_trigger(study: StudyKeys) -> None:
    """Refuse triggers, which assume that the first two states are measured."""
    if not study.has("resets"):
        return
    for point in study.combinations("method", "reset_trigger"):
        if point["method"] == SURGE.name and has_trigger(point["reset_trigger"]):
            text = f"does not apply to method {SURGE.name} (use reset_times_s or reset_count)"
            study.refuse("reset_trigger", text)


SURGE = sincos.describe(
    STATES,
    build_filter,
    name="kalman_surge",
    summary="the same with states for the velocity of a base that surges",
    source="`methods.surge`",
    sections={"filter": FilterSection, "resets": ResetsSection, "surge": SurgeSection},
    params=params,
    rules=(check_no_trigger, check_resets),
    turning="many",
    step_s=25e-9,
    compile_s=9.0,
)
