"""Runs of a program outside sinsjax: the starts that it is given, and its attitudes judged.

The runs are those of a batch with a method of `build_external`. The attitudes take the place of
its own, and pass through the same observation, metrics and criteria as those of any run.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import numpy as np
from numpy.typing import NDArray

from sinsjax.engine.batch import Batch
from sinsjax.engine.inputs import Environment, ProgramSpec, Tiles
from sinsjax.engine.metrics import Outcome
from sinsjax.engine.run import Intervals, Run, prepare_tile
from sinsjax.maths.algebra import select_tree
from sinsjax.maths.rotations import multiply, normalise
from sinsjax.methods.method import AttitudeCovariance, Options, Program, unknown_covariance
from sinsjax.types import Array, Quat


class ExternalState(NamedTuple):
    """The solution of a program: attitude from b to n, and covariance of its misalignment."""

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


class GivenAttitudes(NamedTuple):
    """Attitudes of some runs at record times; leaves (records, runs).

    Attributes:
        present: whether a run is judged at a record time.
        attitude: from b to n; NaN counts as outside every band.
        covariance: of its misalignment; NaN if unknown.
    """

    present: Array
    attitude: Quat
    covariance: AttitudeCovariance

    def select(self, runs: NDArray) -> "GivenAttitudes":
        """Return those of some runs."""
        return jax.tree.map(lambda a: a[:, runs], self)


class RunStarts(NamedTuple):
    """The starts of all runs of a batch by draw and variant, leaves (runs,), and its truth.

    Attributes:
        attitude: misaligned, from b to n.
        velocity: east and north, m/s.
        truth: true attitudes of the draws at record times, leaves (intervals, draws).
    """

    attitude: Quat
    velocity: tuple[Array, Array]
    truth: Quat


def find_starts(batch: Batch) -> RunStarts:
    """Return the first solutions and the true attitudes of the runs of a batch."""
    return _call(_find_starts, batch)


def judge(batch: Batch, given: GivenAttitudes) -> Outcome:
    """Return the outcomes of all runs of a batch of the program, by draw and variant."""
    return _call(_judge, batch, given)


def _call(function: Callable, batch: Batch, *arguments: Any) -> Any:
    """Return a function of one tile with all runs of a batch, in NumPy."""
    row = np.repeat(np.arange(batch.n_draws, dtype=np.int32), batch.n_variants)
    params = jax.tree.map(
        lambda a: np.tile(a, (batch.n_draws, *(1,) * (np.ndim(a) - 1))), batch.params
    )
    tile = Tiles(batch.draws, row, params)
    return jax.tree.map(np.asarray, function(batch.spec, batch.environment, tile, *arguments))


@partial(jax.jit, static_argnums=0)
def _find_starts(spec: ProgramSpec, environment: Environment, tile: Tiles) -> RunStarts:
    runs = prepare_tile(spec, environment, tile)
    truth: Quat = jax.vmap(runs.base_attitudes)(runs.intervals())
    turns = runs.sensors.housing_turns(spec.intervals)
    if turns is not None:
        truth = multiply(truth, jax.tree.map(lambda a: a[1:], turns))
    params, attitude = runs.params, runs.start().state.attitude
    return RunStarts(attitude, (params.ve, params.vn), truth)


@partial(jax.jit, static_argnums=0)
def _judge(
    spec: ProgramSpec, environment: Environment, tile: Tiles, given: GivenAttitudes
) -> Outcome:
    runs = prepare_tile(spec, environment, tile)
    turns = runs.sensors.housing_turns(spec.intervals)

    def observe(run: Run, row: tuple[Intervals, GivenAttitudes]) -> tuple[Run, None]:
        interval, now = row
        state = ExternalState(now.attitude, now.covariance)
        turn = turns and jax.tree.map(lambda a: a[interval.number + 1], turns)
        observed = runs.observe(Run(state, run.metrics), interval, turn)
        return jax.vmap(select_tree)(now.present, observed, run), None

    last, _ = jax.lax.scan(observe, runs.start(), (runs.intervals(), given))
    return runs.finish(last)
