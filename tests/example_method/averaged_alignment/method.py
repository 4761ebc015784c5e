"""The method itself: two faded sums in b, and TRIAD with gravity and Earth rate in n."""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from sinsjax.maths import rotations
from sinsjax.maths.algebra import add, scale
from sinsjax.methods.base import Method, Options, Site, no_covariance
from sinsjax.methods.coarse import two_vectors
from sinsjax.methods.floors import unaided
from sinsjax.methods.parameters import Columns
from sinsjax.strapdown import mechanisation
from sinsjax.types import Navigation, Quat, Sample, Scalar, Vec3


class Numbers(NamedTuple):
    """What share of the sums is left after a sample."""

    kept: Any


class State(NamedTuple):
    """One run under way.

    Attributes:
        nav: what it began with.
        force: sum of velocity increments in b, m/s.
        rate: sum of turns in b, rad.
        earth: Earth rate in n, rad/s; zero before the first sample.
    """

    nav: Navigation
    force: Vec3
    rate: Vec3
    earth: Vec3


def numbers(columns: Columns, site: Any, ug: float) -> Numbers:
    """From the columns of a study."""
    samples = columns.column("averaging_time_s") * columns.rate_hz
    return Numbers(np.exp(-1 / samples))


def averaged(options: Options) -> Method:
    """The method, for the engine."""
    return Method(_init, _step, _turn, _attitude, _covariance, _normalise, _limit)


def _init(params: Numbers, nav: Navigation) -> State:
    zero = Vec3(*(jnp.zeros_like(nav.ve),) * 3)
    return State(nav, zero, zero, zero)


def _step(params: Numbers, site: Site, state: State, sample: Sample, n: Scalar) -> State:
    # Twice the vector part: a sample's turn is small.
    turn = Vec3(2 * sample.turn.x, 2 * sample.turn.y, 2 * sample.turn.z)
    none = jnp.zeros_like(state.earth.x)
    return State(
        state.nav,
        add(scale(params.kept, state.force), sample.dv),
        add(scale(params.kept, state.rate), turn),
        Vec3(none, none + site.place.rate_n, none + site.place.rate_u),
    )


def _attitude(state: State) -> Quat:
    zero = jnp.zeros_like(state.earth.x)
    up = Vec3(zero, zero, zero + 1)
    felt = jnp.stack([jnp.stack(state.force), jnp.stack(state.rate)])
    expected = jnp.stack([jnp.stack(up), jnp.stack(state.earth)])
    found = two_vectors(felt, expected)
    begun = state.earth.y != 0
    return Quat(*(jnp.where(begun, a, b) for a, b in zip(found, state.nav.q, strict=True)))


def _turn(params: Numbers, site: Site, state: State) -> State:
    return state._replace(nav=mechanisation.reverse(state.nav))


def _covariance(state: State) -> Any:
    return no_covariance(state.nav.ve)


def _normalise(state: State) -> State:
    return state._replace(nav=state.nav._replace(q=rotations.normalise(state.nav.q)))


def _limit(params: Numbers, place: Any, biases: Any, ending: Any) -> Any:
    return unaided(place, biases)
