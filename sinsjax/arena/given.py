"""Runs of a program outside sinsjax: the starts that it is given, and its attitudes judged.

The runs are those of a batch with a method of `build_external`. The attitudes take the place of
its own, and pass through the same observation, metrics and criteria as those of any run.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from sinsjax.engine.batch import Batch
from sinsjax.engine.inputs import Environment, ProgramSpec, Tiles
from sinsjax.engine.metrics import Outcome
from sinsjax.engine.run import Intervals, Run, set_up
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


def find_starts(batch: Batch) -> dict[str, NDArray]:
    """Return the first solutions and the places of all runs of a batch, by draw and variant.

    Quaternions are misaligned, from b to n, velocities in m/s, and the latitude in rad.
    """
    return _call(_find_starts, batch)


def true_attitudes_at_records(batch: Batch) -> Quat:
    """Return the true attitudes of the draws of a batch, leaves (intervals, draws)."""
    return _call(_true_attitudes, batch)


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
def _find_starts(spec: ProgramSpec, environment: Environment, tile: Tiles) -> dict[str, Array]:
    runs = set_up(spec, environment, tile)
    params, attitude = runs.params, runs.start().state.attitude
    place = {
        "latitude": runs.site.latitude,
        "height_m": runs.site.earth.height,
        "gravity_m_per_s2": runs.site.place.gravity,
    }
    return {
        **{f"q_{axis}": part for axis, part in zip("wxyz", attitude, strict=True)},
        "v_east_m_per_s": params.ve,
        "v_north_m_per_s": params.vn,
        **{name: jnp.broadcast_to(value, params.ve.shape) for name, value in place.items()},
    }


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

    last, _ = jax.lax.scan(observe, runs.start(), (runs.intervals(), given))
    return runs.finish(last)
