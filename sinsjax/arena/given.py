"""Runs of a program outside sinsjax: the starts that it is given, and its attitudes judged.

The runs are those of a batch with a method of `build_external`. The attitudes take the place of
its own, and pass through the same observation, metrics and criteria as those of any run.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from sinsjax.engine.batch import Batch
from sinsjax.engine.inputs import Environment, ProgramSpec, Tiles
from sinsjax.engine.metrics import Outcome
from sinsjax.engine.run import Intervals, Run, set_up
from sinsjax.maths.algebra import select_tree
from sinsjax.maths.rotations import multiply, normalise
from sinsjax.methods.method import AttitudeCovariance, Options, Program, unknown_covariance
from sinsjax.types import Array, Quat


class ExternalState(NamedTuple):
    """The solution of a program.

    Attributes:
        attitude: from b to n.
        covariance: of its misalignment; NaN if the program gives none.
    """

    attitude: Quat
    covariance: AttitudeCovariance


def build_external(options: Options) -> Program:
    """Return a method that keeps its first attitude, until others are put into its state.

    Runs are judged from the bias floor of a method that does not estimate the biases.
    """
    return Program(
        init=lambda params, nav: ExternalState(nav.q, unknown_covariance(nav.ve)),
        step=lambda params, site, state, sample, n: state,
        attitude=lambda state: state.attitude,
        covariance=lambda state: state.covariance,
        normalise=lambda state: state._replace(attitude=normalise(state.attitude)),
    )


class Start(NamedTuple):
    """The first solution and the place of some runs; leaves (runs,).

    Attributes:
        attitude: misaligned, from b to n.
        ve: velocity east, m/s.
        vn: velocity north, m/s.
        latitude: rad.
        height: m.
        gravity: m/s^2.
    """

    attitude: Quat
    ve: Array
    vn: Array
    latitude: Array
    height: Array
    gravity: Array


class GivenAttitudes(NamedTuple):
    """Attitudes of some runs at record times; leaves (records, runs).

    Attributes:
        present: whether a run has an attitude at a record time.
        attitude: from b to n.
        covariance: of its misalignment; NaN if unknown.
        unknown_until: (runs,) time up to which a run counts as outside every band, s.
    """

    present: Array
    attitude: Quat
    covariance: AttitudeCovariance
    unknown_until: Array


def find_starts(batch: Batch) -> Start:
    """Return the starts of all runs of a batch, by draw and variant, leaves (draws * variants,)."""
    return jax.tree.map(np.asarray, _find_starts(batch.spec, batch.environment, _tile(batch)))


def true_attitudes_at_records(batch: Batch) -> Quat:
    """Return the true attitudes of the draws of a batch, leaves (intervals, draws)."""
    return jax.tree.map(np.asarray, _true_attitudes(batch.spec, batch.environment, _tile(batch)))


def judge(batch: Batch, given: GivenAttitudes) -> Outcome:
    """Return the outcomes of all runs of a batch of the program, by draw and variant."""
    outcome = _judge(batch.spec, batch.environment, _tile(batch), given)
    return jax.tree.map(np.asarray, outcome)


def _tile(batch: Batch) -> Tiles:
    """Return the arguments of one tile with all runs of a batch."""
    row = np.repeat(np.arange(batch.n_draws, dtype=np.int32), batch.n_variants)
    params = jax.tree.map(
        lambda a: np.tile(a, (batch.n_draws, *(1,) * (np.ndim(a) - 1))), batch.params
    )
    return Tiles(batch.draws, row, params)


@partial(jax.jit, static_argnums=0)
def _find_starts(spec: ProgramSpec, environment: Environment, tile: Tiles) -> Start:
    runs = set_up(spec, environment, tile)
    params, attitude = runs.params, runs.start().state.attitude
    place = (runs.site.latitude, runs.site.earth.height, runs.site.place.gravity)
    of_runs = (jnp.broadcast_to(number, params.ve.shape) for number in place)
    return Start(attitude, params.ve, params.vn, *of_runs)


@partial(jax.jit, static_argnums=0)
def _true_attitudes(spec: ProgramSpec, environment: Environment, tile: Tiles) -> Quat:
    runs = set_up(spec, environment, tile)
    attitudes: Quat = jax.vmap(runs.base_attitudes)(runs.intervals())
    turns = runs.sensors.housing_turns(spec.intervals)
    if turns is None:
        return attitudes
    return multiply(attitudes, jax.tree.map(lambda a: a[1:], turns))


@partial(jax.jit, static_argnums=0)
def _judge(
    spec: ProgramSpec, environment: Environment, tile: Tiles, given: GivenAttitudes
) -> Outcome:
    runs = set_up(spec, environment, tile)
    turns = runs.sensors.housing_turns(spec.intervals)

    def observe(run: Run, row: tuple[Intervals, GivenAttitudes]) -> tuple[Run, None]:
        interval, now = row
        state = ExternalState(now.attitude, now.covariance)
        turn = turns and jax.tree.map(lambda a: a[interval.number + 1], turns)
        observed = runs.observe(Run(state, run.metrics), interval, turn)
        return jax.vmap(select_tree)(now.present, observed, run), None

    first = runs.start()
    until = given.unknown_until[:, None, None] + first.metrics.outside_until
    first = first._replace(metrics=first.metrics._replace(outside_until=until))
    rows = given._replace(unknown_until=jnp.zeros_like(given.present[:, :1]))
    last, _ = jax.lax.scan(observe, first, (runs.intervals(), rows))
    return runs.finish(last)
