"""Attitude from running averages: the mean force points up, the mean rate to the north of it."""

from typing import Any, NamedTuple

import jax.numpy as jnp

from sinsjax.maths.algebra import add, scale
from sinsjax.maths.rotations import log, normalise
from sinsjax.methods.base import Method, Options, unknown_covariance
from sinsjax.methods.coarse import triad_attitude
from sinsjax.methods.floors import bias_floor
from sinsjax.types import Navigation, Sample, Vec3


class _State(NamedTuple):
    nav: Navigation  # solution
    force: Vec3  # faded sum of the velocity increments in b, m/s
    turn: Vec3  # faded sum of the rotation vectors in b, rad


def parameters(columns: Any, site: Any, ug: float) -> Any:
    """Return the share of the sums that is kept at each sample, (variants,)."""
    return 1 - 1 / (1 + columns.column("averaging_time_s", columns.rate_hz))


def build(options: Options) -> Method:
    """Return the method, whose params are the share ``kept``."""

    def step(kept: Any, site: Any, state: _State, sample: Sample, n: Any) -> _State:
        force = add(scale(kept, state.force), sample.dv)
        turn = add(scale(kept, state.turn), log(sample.turn))
        q = triad_attitude(jnp.array([force, turn]), jnp.array([[0.0, 0, 1], [0, 1, 0]]))
        return _State(state.nav._replace(q=q), force, turn)

    return Method(
        init=lambda kept, nav: _State(nav, *[Vec3(*[jnp.zeros_like(nav.ve)] * 3)] * 2),
        step=step,
        attitude=lambda state: state.nav.q,
        covariance=lambda state: unknown_covariance(state.nav.ve),
        normalise=lambda state: state._replace(nav=state.nav._replace(q=normalise(state.nav.q))),
        floor=lambda kept, place, biases, end: bias_floor(place, biases),
    )
