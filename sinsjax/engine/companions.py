"""The linear error of given draws beside the noise-free run of each variant.

What a draw's sensors measure beyond noise-free ones drives the error d of the corrected solution in
closed loop (`methods.error_growth`). The run itself and its transition, gains and attitude are
those of the variant, common to its draws: a companion costs a part of a run. The misalignment of
the run with the same noise differs from that of its companion by the nonlinear part.
"""

from functools import lru_cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from sinsjax.engine import simulate, tile
from sinsjax.engine.batch import MOST_PROGRAMS, Program
from sinsjax.engine.lanes import Group, Tiles
from sinsjax.engine.measurements import Read, look_back
from sinsjax.engine.pieces import measurer, piece
from sinsjax.engine.realisations import Draw, Environment, Static, method_of
from sinsjax.engine.sensitivity import sensitivity, starts_beyond
from sinsjax.engine.simulate import Run
from sinsjax.engine.stepping import event_by_event, sample_by_sample
from sinsjax.methods import passes
from sinsjax.methods.error_growth import driven
from sinsjax.strapdown.disturbances import Disturbances
from sinsjax.types import Array, Count, Increments, Sample, Scalar


class Accompanied(NamedTuple):
    """A noise-free run, and the errors of its draws.

    Attributes:
        inner: state of the method.
        errors: d, n arrays (draws,).
    """

    inner: Any
    errors: tuple[Array, ...]


def of_group(group: Group, records: np.ndarray | None = None) -> np.ndarray:
    """Return the misalignments of the companions of a group's runs, computed in one call.

    Args:
        group: some variants by some draws. Variants lie in the lanes of one tile: bits may depend
            on their number.
        records: numbers, from 0, of the records to return; None for all.

    Returns:
        (3, records, variants, draws) of the noise-free run and the linear error, e, n, u, rad.
    """
    call = program(group, records).compiled()
    made: np.ndarray = jax.device_get(call(*_arguments(group, records)))
    return made


def program(group: Group, records: np.ndarray | None = None) -> Program:
    """Return the program of `of_group`, the same for as many variants and draws."""
    leaves, structure = jax.tree.flatten(_arguments(group, records))
    shapes = tuple(jax.ShapeDtypeStruct(np.shape(a), np.asarray(a).dtype) for a in leaves)
    return _trace(group.static, structure, shapes)


@lru_cache(maxsize=MOST_PROGRAMS)
def _trace(static: Static, structure: Any, shapes: tuple) -> Program:
    def call(environment: Environment, tile_: Tiles, draws: Draw, records: Array | None) -> Array:
        phi = companions(static, environment, tile_, draws)
        return phi if records is None else phi[:, records]

    return Program(jax.jit(call).lower(*jax.tree.unflatten(structure, shapes)))


def _arguments(
    group: Group, records: np.ndarray | None
) -> tuple[Environment, Tiles, Draw, np.ndarray | None]:
    """Return the arguments of a program.

    The variants are in the lanes of a tile of one draw: the first, or the mean of what is drawn.
    """
    drawn, variants = group.environment.drawn, group.sizes[1]
    first = group.draws if drawn is None else drawn.mean(group.draws)
    first = jax.tree.map(lambda a: a[:1] if np.ndim(a) else np.full(1, a), first)
    q = np.broadcast_to(group.q[0], (variants, 4)).T
    params = group.variants._replace(q=type(group.variants.q)(*q))
    row = np.zeros(variants, np.int32)
    return group.environment, Tiles(first, row, params), group.draws, records


def companions(static: Static, environment: Environment, variants: Tiles, draws: Draw) -> Array:
    """Return the misalignments of the companions of some draws for each variant of a tile.

    Args:
        static: program of the runs.
        environment: shared by all.
        variants: a single tile, of one draw.
        draws: leaves (draws,), or () for what is the same for all.

    Returns:
        (3, records, lanes, draws) as `of_group`.
    """
    quiet = static._replace(noisy=False)
    setup = tile.set_up(quiet, environment, variants)
    runs = jax.vmap(partial(simulate.begin, quiet, environment), in_axes=(setup.site_axis, 0))(
        setup.site, setup.params
    )
    method, count = method_of(quiet), draws.draw_id.size
    assert method.error_model is not None
    none = jnp.zeros((setup.row.size, count))
    errors = (none,) * len(jax.vmap(method.error_model.angles)(runs.state)[0])
    drawn = sensitivity(quiet, environment, variants.params, setup.site, setup.site_axis)
    if drawn is not None and environment.drawn is not None:
        errors = tuple(jnp.moveaxis(drawn.start @ starts_beyond(environment.drawn, draws), 1, 0))
    reads = (
        tile.nothing_read(quiet, _undisturbed(environment), setup.draws),
        tile.nothing_read(static, environment, draws),
    )
    over = partial(_over_record, (quiet, static), environment, setup, draws)
    begun = runs._replace(state=Accompanied(runs.state, errors)), reads
    _, phi = jax.lax.scan(over, begun, jnp.arange(static.records))
    return jnp.moveaxis(phi, 0, 1)


def _over_record(
    programs: tuple[Static, Static],
    environment: Environment,
    setup: tile.TileSetup,
    draws: Draw,
    under_way: tuple[Run, tuple[Read, Read]],
    number: Count,
) -> tuple[tuple[Run, tuple[Read, Read]], Array]:
    """One record interval, and the misalignments at its end, (3, lanes, draws)."""
    quiet, noisy = programs
    (runs, before), method = under_way, method_of(quiet)
    done = number * quiet.record_every
    samples = done + jnp.arange(quiet.record_every)
    size = piece(quiet, draws)
    make = _maker(
        measurer(quiet, _undisturbed(environment), setup.draws, samples),
        measurer(noisy, environment, draws, samples),
        size,
    )
    over_lanes = jax.vmap(partial(_step, quiet), in_axes=(0, setup.site_axis, 0, None, None))
    close_loop = jax.vmap(partial(simulate.close_loop, quiet), in_axes=(0, 0, None))

    def n(place: Count) -> Scalar:
        return (done + place).astype(environment.dtype)

    def take(state: Accompanied, place: Count, made: tuple[Sample, Increments]) -> Accompanied:
        return over_lanes(setup.params, setup.site, state, made, n(place + 1))

    def close(state: Accompanied, place: Count) -> Accompanied:
        return state._replace(inner=close_loop(setup.params, state.inner, n(place)))

    def due(state: Accompanied, place: Count) -> Scalar | None:
        if method.feedback is None:
            return None
        ahead = jax.vmap(method.feedback.next_event, in_axes=(0, 0, None))
        first = ahead(setup.params.method, state.inner, n(place))
        return None if first is None else jnp.min(first) - done.astype(environment.dtype)

    going = runs.state, before, quiet.record_every, take, close, make, size
    if due(runs.state, jnp.asarray(0)) is None:
        state, before = sample_by_sample(*going)
    else:
        state, before = event_by_event(*going, next_event=due)
    inner = tile.observe(
        quiet, environment, setup, Run(state.inner, runs.metrics), number, q_true=None
    )
    assert method.error_model is not None
    angles = jax.vmap(method.error_model.angles)(inner.state)
    phi = jnp.stack(
        [
            mean[:, None] + sum(a[:, None] * d for a, d in zip(row, state.errors, strict=True))
            for mean, row in zip(inner.metrics.last.phi, angles, strict=True)
        ]
    )
    return (inner._replace(state=state._replace(inner=inner.state)), before), phi


def _step(
    static: Static,
    params: simulate.RunParams,
    site: Any,
    state: Accompanied,
    made: tuple[Sample, Increments],
    n: Scalar,
) -> Accompanied:
    """The run of one lane and the errors of all draws after the ``n``-th sample."""
    method, (sample, excess) = method_of(static), made
    assert method.error_model is not None
    given = params.method, site, state.inner, sample, n
    moved = partial(driven, method.error_model.step(*given), state.inner.nav.q)
    errors = jax.vmap(moved)(excess, state.errors)
    return Accompanied(method.step(*given), errors)


def _maker(quiet: Any, noisy: Any, size: int) -> Any:
    """See `stepping.Make`: the sample without noise, and what each draw measures beyond it."""
    compensate = jax.vmap(partial(passes.compensate, backward=None))

    def make(before: tuple[Read, Read], number: Count) -> Any:
        places = number * size + jnp.arange(size)
        without, later = quiet(before[0], places)
        with_, own_later = noisy(before[1], places)
        excess = jax.tree.map(jnp.subtract, with_, without)
        now = jax.tree.map(lambda a: a[:, 0], without)
        earlier, last = look_back(now, jax.tree.map(lambda a: a[0], before[0].last))
        last = jax.tree.map(lambda a: a[None], last)
        return (compensate(now, earlier), excess), (later._replace(last=last), own_later)

    return make


def _undisturbed(environment: Environment) -> Environment:
    """What runs share on a base and with sensors that nothing disturbs."""
    errors = environment.errors._replace(gyro_quantum=None, accel_quantum=None)
    return environment._replace(errors=errors, disturbances=Disturbances())
