"""Linear errors of given draws about the noise-free run of each variant.

The deviation of a draw's measured increments from noise-free ones drives the error d of the
corrected solution in closed loop (`error_growth`). The run itself, with its transition, gains and
attitude, is shared by all draws of a variant, so a linear draw costs a fraction of a run. The run
with the same noise differs from its linear draw by the nonlinear part.
"""

from functools import lru_cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from sinsjax.covariance.error_growth import propagate_error
from sinsjax.covariance.sensitivity import derive_sensitivity, start_deviations
from sinsjax.engine import run
from sinsjax.engine.batch import MOST_PROGRAMS, Program
from sinsjax.engine.environment import Draw, Environment, NormalDistributions, Static
from sinsjax.engine.lanes import Group, Tiles
from sinsjax.engine.run import Run, TileRuns
from sinsjax.engine.samples import (
    DrawSensors,
    SensorState,
    block_size,
    build_sensors,
    previous_increments,
)
from sinsjax.engine.stepping import Blocks, WithCompanion, advance_interval, with_companion
from sinsjax.methods import passes
from sinsjax.methods.base import ErrorModel, Site
from sinsjax.strapdown.disturbances import Disturbances
from sinsjax.types import Array, Count, Increments, Sample, Scalar


class _Inputs(NamedTuple):
    """Arguments of a program.

    Attributes:
        environment: of the runs.
        tile: one variant per lane, of a single draw: the first, or the mean of drawn numbers.
        draws: whose linear errors are returned, leaves (draws,), or () of what all share.
        drawn: distributions of the drawn numbers; None if there are none.
        records: numbers, from 0, of the records to return; None for all.
    """

    environment: Environment
    tile: Tiles
    draws: Draw
    drawn: NormalDistributions | None
    records: np.ndarray | None


def linear_misalignments(group: Group, records: np.ndarray | None = None) -> np.ndarray:
    """Return the misalignments of a group's runs by linear error theory, computed in one call.

    Args:
        group: some variants by some draws. Variants lie in the lanes of one tile: bits may depend
            on their number.
        records: numbers, from 0, of the records to return; None for all.

    Returns:
        (3, records, variants, draws) of the noise-free run plus the linear error, e, n, u, rad.
    """
    call = linear_program(group, records).compiled()
    phi: np.ndarray = jax.device_get(call(_inputs(group, records)))
    return phi


def linear_program(group: Group, records: np.ndarray | None = None) -> Program:
    """Return the program of `linear_misalignments`, the same for as many variants and draws."""
    leaves, structure = jax.tree.flatten(_inputs(group, records))
    shapes = tuple(jax.ShapeDtypeStruct(np.shape(a), np.asarray(a).dtype) for a in leaves)
    return _trace(group.static, structure, shapes)


@lru_cache(maxsize=MOST_PROGRAMS)
def _trace(static: Static, structure: Any, shapes: tuple) -> Program:
    call = jax.jit(partial(_run_linear_draws, static))
    return Program(call.lower(jax.tree.unflatten(structure, shapes)))


def _inputs(group: Group, records: np.ndarray | None) -> _Inputs:
    drawn, variants = group.drawn, group.sizes[1]
    first = group.draws if drawn is None else drawn.mean_draw(group.draws)
    first = jax.tree.map(lambda a: a[:1] if np.ndim(a) else np.full(1, a), first)
    q = np.broadcast_to(group.q[0], (variants, 4)).T
    params = group.variants._replace(q=type(group.variants.q)(*q))
    tile = Tiles(first, np.zeros(variants, np.int32), params)
    return _Inputs(group.environment, tile, group.draws, drawn, records)


def _run_linear_draws(static: Static, inputs: _Inputs) -> Array:
    """Return the misalignments of `linear_misalignments`."""
    environment, draws = inputs.environment, inputs.draws
    noise_free = static._replace(sensors=static.sensors._replace(noisy=False))
    runs = run.set_up(noise_free, _undisturbed(environment), inputs.tile)
    start = runs.start()
    states = runs.count_error_states(start.state)
    errors = (jnp.zeros((runs.row.size, draws.draw_id.size)),) * states
    derivatives = derive_sensitivity(runs, inputs.tile.params, inputs.drawn)
    if derivatives is not None and inputs.drawn is not None:
        deviations = derivatives.start @ start_deviations(inputs.drawn, draws)
        errors = tuple(jnp.moveaxis(deviations, 1, 0))
    noisy = build_sensors(static, environment, draws)
    first = start._replace(state=WithCompanion(start.state, errors))
    sensor_states = runs.sensors.initial_state(), noisy.initial_state()
    _, phi = jax.lax.scan(
        partial(_over_record, runs, noisy), (first, sensor_states), jnp.arange(static.records)
    )
    phi = jnp.moveaxis(phi, 0, 1)
    return phi if inputs.records is None else phi[:, inputs.records]


def _over_record(
    runs: TileRuns,
    noisy: DrawSensors,
    carry: tuple[Run, tuple[SensorState, SensorState]],
    number: Count,
) -> tuple[tuple[Run, tuple[SensorState, SensorState]], Array]:
    """Advance by one record interval; also the misalignments at its end, (3, lanes, draws)."""
    now, sensor_states = carry
    reading, every = runs.read(number), runs.static.record_every
    size = block_size(every, noisy.draws)
    make = _make_block_function(runs.sensors, noisy, reading.samples, size)
    over_lanes = jax.vmap(
        partial(_propagate_errors_of_lane, runs.error_model),
        in_axes=(0, runs.site_axis, 0, 0, None, None, None),
    )

    def advance(errors: Any, state: Any, place: Count, block: tuple[Sample, Increments]) -> Any:
        n = (number * every + place + 1).astype(runs.environment.dtype)
        return over_lanes(runs.params.method, runs.site, errors, state, *block, n)

    steps = with_companion(
        runs.steps(reading, number),
        advance,
        lambda block: jax.tree.map(lambda a: a[None], block[0]),
    )
    state, sensor_states = advance_interval(
        steps, now.state, sensor_states, Blocks(every, size, make)
    )
    observed = runs.observe(Run(state.runs, now.metrics), number, None)
    angles = jax.vmap(runs.error_model.angles)(observed.state)
    phi = jnp.stack(
        [
            mean[:, None] + sum(a[:, None] * d for a, d in zip(row, state.companion, strict=True))
            for mean, row in zip(observed.metrics.last.phi, angles, strict=True)
        ]
    )
    observed = observed._replace(state=state._replace(runs=observed.state))
    return (observed, sensor_states), phi


def _propagate_errors_of_lane(
    model: ErrorModel,
    params: Any,
    site: Site,
    errors: tuple[Array, ...],
    state: Any,
    sample: Sample,
    excess: Increments,
    n: Scalar,
) -> tuple[Array, ...]:
    """Return the errors of all draws, (draws,) each, after the n-th sample of one run."""
    step = model.step(params, site, state, sample, n)
    propagate = partial(propagate_error, step, state.nav.q)
    later: tuple[Array, ...] = jax.vmap(propagate)(excess, errors)
    return later


def _make_block_function(
    noise_free: DrawSensors, noisy: DrawSensors, samples: Array, size: int
) -> Any:
    """Return `Blocks.make`: noise-free samples, and the excess of each draw's increments."""
    measure, measure_noisy = noise_free.make_sampler(samples), noisy.make_sampler(samples)
    compensate = jax.vmap(partial(passes.compensate, backward=None))

    def make(states: tuple[SensorState, SensorState], number: Count) -> Any:
        places = number * size + jnp.arange(size)
        exact, later = measure(states[0], places)
        measured, later_noisy = measure_noisy(states[1], places)
        excess = jax.tree.map(jnp.subtract, measured, exact)
        now = jax.tree.map(lambda a: a[:, 0], exact)
        last = jax.tree.map(lambda a: a[0], states[0].last)
        previous, last = previous_increments(now, last)
        last = jax.tree.map(lambda a: a[None], last)
        return (compensate(now, previous), excess), (later._replace(last=last), later_noisy)

    return make


def _undisturbed(environment: Environment) -> Environment:
    """Return the environment without random processes and quantisation."""
    model = environment.sensors
    errors = model.errors._replace(gyro_quantum=None, accel_quantum=None)
    return environment._replace(sensors=model._replace(errors=errors, disturbances=Disturbances()))
