"""The filter of `method` on a base that surges: the velocity of the base stands beside its states.

A zero-velocity filter takes what the base does for noise of its measurement, white from sample to
sample. The velocity of a base that stays about its place is anything but: it changes over seconds,
and over minutes it takes itself back. Four more states tell it apart, on either axis

    s' = v,    v' = -s/T^2 - v/T + w,    V = dV + v,

of a place s that wanders within bounds, of correlation time T and rms velocity sigma: w has density
2 sigma^2/T, s begins with variance (sigma T)^2. The measured V is that of the solution, whose error
is dV alone. Only dV and the tilt are fed back. With T and sigma of the base, Q that of the sensors
and R small, the heading comes within a few percent of the information bound, see `information`, and
P is true.
"""

from functools import partial
from typing import Any, NamedTuple

from sinsjax.maths.algebra import Entries, Minus
from sinsjax.methods import kalman
from sinsjax.methods.base import Method, Options, Site
from sinsjax.methods.filters.stages import (
    Filter,
    FilterParams,
    FilterState,
    mechaniser,
    reversed_by,
)
from sinsjax.methods.kalman import Innovation
from sinsjax.methods.sincos import method as still
from sinsjax.methods.sincos.method import VE, VN
from sinsjax.methods.triggers.watched import method_of
from sinsjax.strapdown.earth import Place
from sinsjax.types import Navigation, Sample, Scalar

STATES = (*still.STATES, "place_e", "place_n", "surge_e", "surge_n")
PLACE_E, PLACE_N, SURGE_E, SURGE_N = range(6, 10)
REVERSAL = (*still.REVERSAL, 1.0, 1.0, -1.0, -1.0)

_TOGETHER: Entries = {(VE, SURGE_E): 1.0, (VN, SURGE_N): 1.0}
_APART: Entries = {(VE, SURGE_E): Minus(1.0), (VN, SURGE_N): Minus(1.0)}
"""dV as the measured V, and back."""


class SurgeParams(NamedTuple):
    """`FilterParams.own`, which is `FilterState.own` too.

    Attributes:
        rate: 1/T of the surge, 1/s.
    """

    rate: Scalar


def build(options: Options) -> Method:
    """The method; `Options.specific_force` is always that of a base at rest."""
    method = method_of(filter_of(options), options)
    # What is told of a step takes the first two states for what is measured.
    return method._replace(error_step=None, error_angles=None, start_error=None)


def filter_of(options: Options) -> Filter:
    """Its filter; arguments as of `build`."""
    dt, mechanise = options.dt, mechaniser(options)

    def init(params: FilterParams, nav: Navigation) -> FilterState:
        return still.begun_anywhere(params, nav)._replace(own=params.own)

    def propagate(
        params: FilterParams, site: Site, state: FilterState, sample: Sample
    ) -> tuple[FilterState, Entries]:
        nav, _, here = mechanise(site, state.nav, sample)
        entries = transition(here, state.own, dt)
        return state._replace(nav=nav, belief=kalman.propagate(state.belief, entries)), entries

    return still.filter_of(options)._replace(
        init=init,
        propagate=propagate,
        update=_update,
        reverse=partial(reversed_by, REVERSAL),
        at_rest=lambda state, here: transition(here, state.own, dt),
    )


def transition(place: Place, surge: SurgeParams, dt: Scalar) -> Entries:
    """Non-zero entries of A dt, see the module."""
    lost = surge.rate * dt
    pulled = surge.rate * lost
    return {
        **still.transition(place, dt),
        (PLACE_E, SURGE_E): dt,
        (PLACE_N, SURGE_N): dt,
        (SURGE_E, PLACE_E): Minus(pulled),
        (SURGE_N, PLACE_N): Minus(pulled),
        (SURGE_E, SURGE_E): Minus(lost),
        (SURGE_N, SURGE_N): Minus(lost),
    }


def _update(params: Any, state: Any) -> tuple[Any, Innovation]:
    """The velocity of the solution should be that of the base."""
    measured = state.nav.ve, state.nav.vn
    together = kalman.propagate(state.belief, _TOGETHER)
    innovation = kalman.innovation(together, (VE, VN), measured, params.r)
    updated = kalman.update(together, (VE, VN), measured, params.r)
    return state._replace(belief=kalman.propagate(updated, _APART)), innovation
