"""Attitude from running averages: the mean force points up, the mean rate to the north of it."""

from typing import Any, NamedTuple

import jax.numpy as jnp
from pydantic import Field

from sinsjax.maths.algebra import add, scale
from sinsjax.maths.rotations import log
from sinsjax.methods.inertial_frame import triad_attitude
from sinsjax.methods.method import Method, Options, Program, StudyKeys
from sinsjax.types import Navigation, Sample, Vec3
from sinsjax.value_types import Seconds, Section


class AveragedSection(Section):
    """[averaged]: memory of the averages."""

    averaging_time_s: Seconds = Field(1e4, description="time constant of the averages, s")


class _State(NamedTuple):
    nav: Navigation  # solution
    force: Vec3  # faded sum of the velocity increments in b, m/s
    turn: Vec3  # faded sum of the rotation vectors in b, rad


def params(keys: StudyKeys, xp: Any) -> Any:
    """Return the share of the sums that is kept at each sample, (variants,)."""
    return 1 - 1 / (1 + keys.column("averaging_time_s", keys.rate_hz))


def build(options: Options) -> Program:
    """Return the functions of the method, whose params are the share ``kept``."""

    def step(kept: Any, site: Any, state: _State, sample: Sample, n: Any) -> _State:
        force = add(scale(kept, state.force), sample.dv)
        turn = add(scale(kept, state.turn), log(sample.turn))
        q = triad_attitude(jnp.array([force, turn]), jnp.array([[0.0, 0, 1], [0, 1, 0]]))
        return _State(state.nav._replace(q=q), force, turn)

    return Program(
        init=lambda kept, nav: _State(nav, *[Vec3(*[jnp.zeros_like(nav.ve)] * 3)] * 2),
        step=step,
        attitude=lambda state: state.nav.q,
    )


AVERAGED = Method(
    name="averaged",
    summary="attitude of a base at rest from running averages of specific force and rate",
    source="TRIAD; Britting (1971)",
    build=build,
    params=params,
    sections={"averaged": AveragedSection},
    needs_start=False,
)
