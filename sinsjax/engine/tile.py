"""Runs side by side in the lanes of a tile: the functions of `simulate`, mapped over all of them.

Samples are made once for each draw of the tile and broadcast to its runs; `simulate` and this
module take the same way from set-up to outcome. The loops of all runs are closed together, at the
first event of any: that leaves those for which nothing is due as they are.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from sinsjax.engine import metrics, reading, simulate
from sinsjax.engine.covariance import Spread, spread
from sinsjax.engine.lanes import Tiles
from sinsjax.engine.measurements import Read
from sinsjax.engine.metrics import Observation, Outcome
from sinsjax.engine.pieces import axes_of, maker, piece, record_of
from sinsjax.engine.realisations import (
    Draw,
    Environment,
    Static,
    attitude,
    attitudes,
    biases_of,
    derived,
    first_attitude,
    method_of,
    site_of,
)
from sinsjax.engine.sensitivity import sensitivity
from sinsjax.engine.simulate import Run, RunParams
from sinsjax.engine.stages import StageFunctions, over_stages
from sinsjax.engine.stepping import event_by_event, sample_by_sample
from sinsjax.methods import passes
from sinsjax.methods.base import Site
from sinsjax.methods.floors import BiasFloor
from sinsjax.methods.passes import BodyTurn, PassReading
from sinsjax.types import Array, Count, Flag, Increments, Quat, Sample, Scalar


class TileSetup(NamedTuple):
    """`simulate.Setup` of all runs of a tile: each of its draws stands once.

    Attributes:
        draws: with what follows from them, leaves (draws, ...).
        row: (lanes,) which of them each run takes.
        params: with what the draws begin with, leaves (lanes, ...).
        site: leaves (lanes,), or () where all runs share it.
        limit: leaves (lanes,).
        record: leaves (samples, draws).
    """

    draws: Draw
    row: Array
    params: RunParams
    site: Site
    limit: BiasFloor
    record: Increments | None = None

    @property
    def draw_axis(self) -> int | None:
        """Axis, for `jax.vmap`, of what was broadcast to runs; None where all share one draw."""
        return axis_of_draws(self.draws)

    @property
    def site_axis(self) -> int | None:
        """Axis of the site; None where all runs share it."""
        return None if self.draws.made.site is None else self.draw_axis


def axis_of_draws(draws: Draw) -> int | None:
    """Axis, for `jax.vmap`, of what is broadcast from draws to runs; None of a single draw."""
    return None if len(draws.draw_id) == 1 else 0


def broadcast_to_runs(row: Array, tree: Any) -> Any:
    """What belongs to draws for each run: leaves (draws,) to (lanes,), or to () of one draw."""

    def broadcast(a: Array) -> Array:
        if len(a) == 1:
            return a[0]
        if len(a) == row.size:
            return a
        # Without the check of bounds, which would cost as much as the look-up.
        return a.at[row].get(mode="promise_in_bounds")

    return jax.tree.map(broadcast, tree)


def over_draws(function: Callable[[Draw], Any], draws: Draw, *, out_axes: int = 0) -> Any:
    """A function of one draw, applied to all of a tile."""
    return jax.vmap(function, in_axes=(axes_of(draws),), out_axes=out_axes)(draws)


def nothing_read(static: Static, environment: Environment, draws: Draw) -> Read:
    """`reading.nothing_read` of all draws of a tile, leaves (draws,)."""
    return over_draws(partial(reading.nothing_read, static, environment), draws)


def run_tile(
    static: Static, environment: Environment, tile: Tiles, shown: int | None = None
) -> tuple[Outcome, Observation | Spread | None]:
    """All runs of one tile, as `simulate.simulate` for one.

    Args:
        static: program.
        environment: shared by all.
        tile: a single one.
        shown: lanes whose observations are returned, the first ones; None for all.

    Returns:
        Outcomes with leaves (lanes, ...), and if ``static.curves`` observations (records, lanes),
        or, if ``static.sampled_errors``, the spread of runs with noise.
    """
    setup = set_up(static, environment, tile)
    q_true = None  # of draws with a motion of their own; that of others is looked up as runs go
    if setup.draws.motion is not None:
        q_true = over_draws(partial(attitudes, static, environment), setup.draws, out_axes=1)
    runs, rows = over_stages(
        static,
        stage_functions(static, environment, setup, shown),
        nothing_read(static, environment, setup.draws),
        (jnp.arange(static.records), q_true),
    )
    end = jax.vmap(partial(simulate.end, static), in_axes=(setup.site_axis, 0, 0))
    outcome = end(setup.site, runs, setup.limit)
    if rows is None:
        return outcome, None
    if static.sampled_errors:
        drawn = sensitivity(static, environment, tile.params, setup.site, setup.site_axis)
        told = spread(static, environment, rows, outcome.limit.phi.z, drawn)
        return outcome, told.at(environment.spread_at)
    return outcome, metrics.from_rows(rows)


def stage_functions(
    static: Static, environment: Environment, setup: TileSetup, shown: int | None
) -> StageFunctions:
    """The functions of one run's stages, mapped over the runs of a tile."""
    params, site, axis = setup.params, setup.site, setup.site_axis

    def begin(program: Static) -> Run:
        over_runs = jax.vmap(partial(simulate.begin, program, environment), in_axes=(axis, 0))
        return over_runs(site, params)

    def after_coarse(state: Any, turn: BodyTurn | None) -> Any:
        over_runs = jax.vmap(
            partial(simulate.after_coarse, static), in_axes=(0, axis, 0, setup.draw_axis)
        )
        return over_runs(params, site, state, broadcast_to_runs(setup.row, turn))

    def over(program: Static, under_way: Any, record: Any) -> Any:
        return over_record(program, environment, setup, shown, under_way, record)

    return StageFunctions(begin, over, after_coarse)


def set_up(static: Static, environment: Environment, tile: Tiles) -> TileSetup:
    """What the runs of a tile have from environment, draws and their own numbers."""
    draws, to_runs = tile.draws, partial(broadcast_to_runs, tile.row)
    draws = draws._replace(made=over_draws(partial(derived, static, environment), draws))
    axis = axis_of_draws(draws)
    starting = jax.vmap(simulate.starting, in_axes=(0, axis, axis))
    q_true = to_runs(over_draws(first_attitude, draws))
    params = starting(tile.params, to_runs(draws.begins), q_true)
    of_runs = draws._replace(made=to_runs(draws.made))
    site, biases = site_of(environment, of_runs), biases_of(environment, of_runs)
    own = (None if a is None else axis for a in (draws.made.site, draws.made.biases))
    limit = partial(simulate.limit, static, environment.pass_records)
    limits = jax.vmap(limit, in_axes=(0, *own))(params, site, biases)
    record = record_of(static, environment, draws) if static.kept else None
    return TileSetup(draws, tile.row, params, site, limits, record)


def over_record(
    static: Static,
    environment: Environment,
    setup: TileSetup,
    shown: int | None,
    under_way: tuple[Run, Read],
    record: tuple[Count, Quat | None],
) -> tuple[tuple[Run, Read], Array | None]:
    """One record interval of all runs, as `simulate.over_record` for one.

    Args:
        static: program.
        environment: shared by all.
        setup: of the tile.
        shown: as for `run_tile`.
        under_way: the runs, and what their draws have read.
        record: number of the record, and the true attitudes of the draws at its time; None for
            those of the environment.

    Returns:
        Both, and if ``static.curves`` observations (fields, lanes).
    """
    (runs, before), (number, q_true) = under_way, record
    read = reading.reading(static, environment, number)
    turn = broadcast_to_runs(setup.row, before.turn)
    open_pass = jax.vmap(
        partial(simulate.open_pass, static, environment.pass_records),
        in_axes=(0, setup.site_axis, 0, (None, setup.draw_axis)),
    )
    state = open_pass(setup.params, setup.site, runs.state, (read, turn))
    nothing = partial(nothing_read, static, environment, setup.draws)
    before = reading.as_pass_begins(static, read, before, nothing)
    state, before = over_samples(static, environment, setup, read, number, (state, before))
    runs = observe(static, environment, setup, Run(state, runs.metrics), number, q_true)
    runs, observed = jax.vmap(partial(simulate.told, static), out_axes=(0, -1))(runs)
    return (runs, before), None if observed is None else observed[:, :shown]


def observe(
    static: Static,
    environment: Environment,
    setup: TileSetup,
    runs: Run,
    number: Count,
    q_true: Quat | None,
) -> Run:
    """All runs after their observation at the end of a record interval; see `over_record`."""
    # Looked up here: those of all records, draw by draw, would fill the memory.
    q_true = attitude(environment, setup.draws, number) if q_true is None else q_true
    over_runs = jax.vmap(
        partial(simulate.observe, static, environment), in_axes=(0, setup.draw_axis, 0, None)
    )
    n = ((number + 1) * static.record_every).astype(environment.dtype)
    return over_runs(runs, broadcast_to_runs(setup.row, q_true), setup.limit.phi.z, n)


def over_samples(
    static: Static,
    environment: Environment,
    setup: TileSetup,
    read: PassReading,
    number: Count,
    carry: tuple[Any, Read],
) -> tuple[Any, Read]:
    """The samples of a record interval, and closed loops: from event to event, if these are known.

    Args:
        static: program.
        environment: shared by all.
        setup: of the tile.
        read: how the interval is read.
        number: of the record.
        carry: the runs' state, and what their draws have read.

    Returns:
        Both after the interval.
    """
    method, params, every = method_of(static), setup.params, static.record_every
    site = passes.site_of_pass(setup.site, read.backward)
    done = number * every  # samples before this interval
    step = jax.vmap(
        partial(simulate.step, static), in_axes=(0, setup.site_axis, 0, setup.draw_axis, None)
    )
    close_loop = jax.vmap(partial(simulate.close_loop, static), in_axes=(0, 0, None))

    def n(place: Count) -> Scalar:
        return (done + place).astype(environment.dtype)

    def take(state: Any, place: Count, sample: Sample) -> Any:
        return step(params, site, state, broadcast_to_runs(setup.row, sample), n(place + 1))

    def close(state: Any, place: Count) -> Any:
        return close_loop(params, state, n(place))

    def due(state: Any, place: Count) -> Scalar | None:
        if method.feedback is None:
            return None
        ahead = jax.vmap(method.feedback.next_event, in_axes=(0, 0, None))(
            params.method, state, n(place)
        )
        return None if ahead is None else jnp.min(ahead) - done.astype(environment.dtype)

    def called(state: Any, place: Count) -> Flag:
        assert method.feedback is not None and method.feedback.called is not None
        return jnp.any(jax.vmap(method.feedback.called, in_axes=(0, None))(state, n(place)))

    make = maker(static, environment, setup.draws, read, setup.record)
    size = piece(static, setup.draws)
    samples = (*carry, every, take, close, make, size)
    if due(carry[0], jnp.asarray(0)) is None:
        return sample_by_sample(*samples)
    return event_by_event(
        *samples,
        next_event=due,
        called=called if method.feedback and method.feedback.called else None,
    )


def over_stacked_tiles(
    static: Static, one: Callable[[Tiles], Any], tiles: Tiles
) -> Callable[[Tiles], Any]:
    """A function of one tile, mapped over the sets of stacked ones where the method has such.

    Args:
        static: program.
        one: of a tile.
        tiles: that it will be applied to, one after the other.
    """
    if not method_of(static).shares_covariance:
        return one
    # Only what belongs to draws differs between the sets.
    axes: Any = jax.tree.map(lambda a: None, tiles)
    draws = jax.tree.map(lambda a: 0 if a.ndim > 1 else None, tiles.draws)
    q = jax.tree.map(lambda a: 0, tiles.params.q)
    return jax.vmap(one, in_axes=(axes._replace(draws=draws, params=axes.params._replace(q=q)),))
