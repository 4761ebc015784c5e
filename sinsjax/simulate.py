"""One alignment run, from sensor increments to its outcome, as pure functions.

`stream` makes the samples of one draw, `advance` takes one run over them, `over_blocks` drives
the two through time. `simulate` puts them together for a single run; `batch` maps the same
functions over many.
"""

from collections.abc import Callable
from math import lcm
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from sinsjax import imu, metrics, rotations
from sinsjax.alignment import METHODS
from sinsjax.alignment.base import Method, Options, Site
from sinsjax.metrics import Criteria, Metrics, Observation, Outcome
from sinsjax.types import Array, Count, Navigation, Quat, Sample, Scalar, Vec3


class Static(NamedTuple):
    """What decides the compiled program; hashable.

    Attributes:
        method: name in `alignment.METHODS`.
        options: of that method.
        record_every: samples a record interval.
        records: record intervals in a run; the run is records * record_every samples long.
        curves: whether observations at all record times are returned.
    """

    method: str
    options: Options
    record_every: int
    records: int
    curves: bool


class World(NamedTuple):
    """What all runs of a batch share.

    Attributes:
        site: Earth and place.
        tape: (T, 6) ideal or recorded increments, rad and m/s.
        truth: (rows, records, 4) true or reference attitude at record times; NaN if unknown.
        errors: of the sensors.
        seed: of the noise.
        criteria: what runs are judged against.
        floor: what phi_u should settle to, rad.
    """

    site: Site
    tape: Array
    truth: Array
    errors: imu.SensorErrors
    seed: Count
    criteria: Criteria
    floor: Scalar


class Draw(NamedTuple):
    """One sensor realisation.

    Attributes:
        draw_id: decides its noise.
        start: first sample on the tape.
        row: of `World.truth`.
    """

    draw_id: Count
    start: Count
    row: Count


class Params(NamedTuple):
    """Numbers of one run: all of it can be swept, mapped or differentiated.

    Attributes:
        q: attitude before the study's misalignment is added: true, or coarsely aligned.
        phi: initial misalignment, rotation vector in n, rad.
        ve: initial velocity east, m/s.
        vn: initial velocity north, m/s.
        method: numbers of the method.
    """

    q: Quat
    phi: Vec3
    ve: Scalar
    vn: Scalar
    method: Any


class Run(NamedTuple):
    """One run under way: the method's state and the metrics so far."""

    state: Any
    metrics: Metrics


def method_of(static: Static) -> Method:
    """Build the study's method."""
    return METHODS[static.method](static.options)


def begin(static: Static, world: World, params: Params) -> Run:
    """The run before its first sample."""
    method = method_of(static)
    zero = jnp.zeros_like(params.ve)
    nav = Navigation(
        q=rotations.misalign(params.phi, params.q),
        ve=params.ve,
        vn=params.vn,
        latitude=world.site.latitude + zero,
        longitude=zero,
    )
    state = method.init(params.method, nav)
    first = metrics.observe(params.q, method.attitude(state), method.covariance(state))
    return Run(state, metrics.start(world.criteria, first))


def measured(world: World, draw: Draw, first: Count, *, samples: int, dt: float) -> Array:
    """What the sensors of one draw put out.

    Args:
        world: shared.
        draw: whose sensors.
        first: number of the first sample, a multiple of the noise block.
        samples: how many.
        dt: sample time, s.

    Returns:
        (samples, 6) measured increments, rad and m/s.
    """
    ideal = jax.lax.dynamic_slice(world.tape, (draw.start + first, 0), (samples, 6))
    blocks = -(-samples // imu.NOISE_BLOCK)
    numbers = first // imu.NOISE_BLOCK + jnp.arange(blocks)

    def drawn() -> Array:
        normal = jax.vmap(imu.noise, in_axes=(None, None, 0))(world.seed, draw.draw_id, numbers)
        return normal.reshape(-1, 6)[:samples]

    def silent() -> Array:
        return jnp.zeros((samples, 6), jnp.float32)

    noisy = jnp.any(world.errors.gyro_noise > 0) | jnp.any(world.errors.accel_noise > 0)
    return imu.measure(ideal, world.errors, jax.lax.cond(noisy, drawn, silent), dt)


def stream(
    world: World, draw: Draw, previous: Array, first: Count, *, samples: int, dt: float
) -> tuple[Sample, Array]:
    """Compensated samples of one draw.

    Args:
        world: shared.
        draw: whose samples.
        previous: (6,) increments before the first sample.
        first: number of the first sample, a multiple of the noise block.
        samples: how many.
        dt: sample time, s.

    Returns:
        `Sample` with leaves (samples,), and the last increments (6,) for the next call.
    """
    increments = measured(world, draw, first, samples=samples, dt=dt)
    # A run starts with nothing: its first sample stands in for the one before.
    before = jnp.where(first == 0, increments[0], previous)
    return imu.compensate(increments, before), increments[-1]


def end(static: Static, world: World, run: Run) -> Outcome:
    """The outcome of a run after its last record."""
    return metrics.finish(run.metrics, method_of(static).covariance(run.state), world.floor)


class Fan(NamedTuple):
    """How functions of one draw and of one run are applied to many; `ONE` applies them as they are.

    Attributes:
        over_draws: maps a function of (draw, previous increments).
        over_runs: maps a function of runs, given the axis of each argument that counts them.
        hand_out: gives each run its draw's samples, or true attitudes: leaves (draws, n, ...) to
            (n, runs, ...), or to (n, ...) where all runs share them.
        shared: axis of what was handed out, for ``over_runs``: 0, or None where all share it.
    """

    over_draws: Callable[[Callable], Callable]
    over_runs: Callable[..., Callable]
    hand_out: Callable[[Any], Any]
    shared: int | None


ONE = Fan(lambda f: f, lambda f, *axes: f, lambda tree: tree, None)


def advance(
    static: Static, world: World, params: Params, run: Run, *, block: Any, fan: Fan
) -> tuple[Run, Array | None]:
    """Take runs over a block of whole record intervals.

    Args:
        static: program.
        world: shared.
        params: of the runs.
        run: states and metrics so far.
        block: samples with leaves (records, every), true attitudes (records, 4) and sample counts
            (records, every); samples and attitudes may have an axis of runs behind these.
        fan: one run or many.

    Returns:
        The runs after the block, and observations as (records, fields) or None.
    """
    method = method_of(static)

    def one_step(params: Params, state: Any, sample: Sample, n: Scalar) -> Any:
        return method.step(params.method, world.site, state, sample, n)

    def one_record(run: Run, q_true: Array, n: Scalar) -> Run:
        state = method.normalise(run.state)
        now = metrics.observe(Quat(*q_true), method.attitude(state), method.covariance(state))
        time = n * static.options.dt
        return Run(
            state,
            metrics.accumulate(run.metrics, world.criteria, now, floor=world.floor, time=time),
        )

    step = fan.over_runs(one_step, 0, 0, fan.shared, None)
    record = fan.over_runs(one_record, 0, fan.shared, None)

    def record_step(run: Run, xs: tuple[Sample, Array, Array]) -> tuple[Run, Any]:
        samples, q_true, counts = xs
        state, _ = jax.lax.scan(
            lambda state, x: (step(params, state, *x), None), run.state, (samples, counts)
        )
        run = record(Run(state, run.metrics), q_true, counts[-1])
        # One array: XLA:CPU updates several side by side by copying them whole, every record.
        return run, jnp.stack(jax.tree.leaves(run.metrics.last)) if static.curves else None

    return jax.lax.scan(record_step, run, block)


def over_blocks(
    static: Static, step: Callable[[Any, Count, int], tuple[Any, Any]], carry: Any
) -> tuple[Any, Any]:
    """Drive ``step(carry, number of the first record, records) -> carry, out`` through a run.

    A block is the shortest stretch that holds whole noise blocks and whole record intervals, so
    that the same noise is drawn whatever the record interval. The last one may be shorter.

    Returns:
        The last carry, and the outputs stacked along a leading axis of records.
    """
    size = lcm(static.record_every, imu.NOISE_BLOCK) // static.record_every
    whole, rest = divmod(static.records, size)
    pieces = []
    if whole:
        carry, out = jax.lax.scan(
            lambda c, block: step(c, block * size, size), carry, jnp.arange(whole)
        )
        pieces.append(jax.tree.map(lambda a: a.reshape(-1, *a.shape[2:]), out))
    if rest:
        carry, out = step(carry, jnp.asarray(whole * size), rest)
        pieces.append(out)
    return carry, jax.tree.map(lambda *parts: jnp.concatenate(parts), *pieces)


def simulate(
    static: Static, world: World, draws: Draw, params: Params, fan: Fan = ONE
) -> tuple[Outcome, Observation | None]:
    """Whole runs, from first sample to outcome.

    Args:
        static: program.
        world: shared.
        draws: one draw, or many with a leading axis.
        params: of one run, or of many with a leading axis.
        fan: one run or many.

    Returns:
        Outcomes, and, if ``static.curves``, observations with leaves (records,) in front.
    """
    every = static.record_every

    def step(carry: tuple[Run, Array], record: Count, records: int) -> Any:
        run, previous = carry
        first, n = record * every, records * every

        def one_stream(draw: Draw, previous: Array) -> tuple[Sample, Array]:
            return stream(world, draw, previous, first, samples=n, dt=static.options.dt)

        def one_truth(draw: Draw, previous: Array) -> Array:
            return jax.lax.dynamic_slice_in_dim(jnp.asarray(world.truth)[draw.row], record, records)

        samples, previous = fan.over_draws(one_stream)(draws, previous)
        samples = fan.hand_out(samples)
        truth = fan.hand_out(fan.over_draws(one_truth)(draws, previous))
        counts = (first + 1 + jnp.arange(n)).astype(world.tape.dtype)
        cut = jax.tree.map(lambda a: a.reshape(records, every, *a.shape[1:]), (samples, counts))
        run, out = advance(static, world, params, run, block=(cut[0], truth, cut[1]), fan=fan)
        return (run, previous), out

    run = fan.over_runs(lambda p: begin(static, world, p), 0)(params)
    nothing = jnp.zeros((*draws.draw_id.shape, 6), world.tape.dtype)
    (run, _), curves = over_blocks(static, step, (run, nothing))
    outcome = fan.over_runs(lambda r: end(static, world, r), 0)(run)
    if curves is None:
        return outcome, None
    fields = [curves[:, i] for i in range(curves.shape[1])]
    return outcome, jax.tree.unflatten(jax.tree.structure(outcome.last), fields)
