"""One alignment run, from sensor increments to its outcome, as pure functions.

`noise` and `sense` make the samples of a draw, `over_a_record` takes a run over those of a record
interval and judges it at the end. `simulate` puts them together for a single run; `batch` maps the
same functions over many.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from sinsjax import imu, metrics, rotations
from sinsjax.alignment import METHODS, reverse
from sinsjax.alignment.base import Method, Options, Site
from sinsjax.metrics import Criteria, Metrics, Observation, Outcome
from sinsjax.types import Array, Count, Increments, Navigation, Quat, Sample, Scalar, Vec3


class Static(NamedTuple):
    """What decides the compiled program; hashable.

    Attributes:
        method: name in `alignment.METHODS`.
        options: of that method.
        record_every: samples a record interval.
        records: record intervals in a run; the run is records * record_every samples long.
        curves: whether observations at all record times are returned.
        noisy: whether the sensors have any noise to draw.
        repeats: whether the tape is gone over backward and again; else forward, once.
    """

    method: str
    options: Options
    record_every: int
    records: int
    curves: bool
    noisy: bool
    repeats: bool = False


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
        pass_records: record intervals a pass over the tape; of no effect without repeats.
    """

    site: Site
    tape: Array
    truth: Array
    errors: imu.SensorErrors
    seed: Count
    criteria: Criteria
    floor: Scalar
    pass_records: Count


class Draw(NamedTuple):
    """One sensor realisation.

    Attributes:
        draw_id: decides its noise.
        start: first sample on the tape; of many draws, one number if it is the same for all.
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
    return Run(state, metrics.start(world.criteria, zero))


def noise(static: Static, world: World, draws: Draw, numbers: Array) -> Increments | None:
    """Standard normal numbers, leaves (n, *draws), for n samples; None if no sensor has noise."""
    return imu.noise(world.seed, draws.draw_id, numbers) if static.noisy else None


NOISE_ROW = 64
"""Samples times draws whose noise is made at a time: fewer leave the vector units idle, more leave
the first-level cache."""


def piece(static: Static, draws: Draw) -> int:
    """Samples whose noise is made at a time; a record interval is cut into equal pieces."""
    every = static.record_every
    most = NOISE_ROW // draws.draw_id.size if static.noisy else every
    return max(n for n in range(1, max(1, min(most, every)) + 1) if every % n == 0)


def sense(
    static: Static, world: World, draw: Draw, n: Count, normal: Increments | None
) -> Increments:
    """What the sensors of one draw put out over its sample number ``n`` (from 0): rad, m/s.

    Zeros for a negative number, before the tape: with them nothing is compensated.
    """
    ideal = imu.split(jnp.asarray(world.tape)[draw.start + n])
    put_out = imu.measure(ideal, world.errors, normal, static.options.dt)
    if not static.repeats:
        return put_out
    return reverse.where(n < 0, jax.tree.map(jnp.zeros_like, put_out), put_out)


def end(static: Static, world: World, run: Run) -> Outcome:
    """The outcome of a run after its last record."""
    return metrics.finish(run.metrics, method_of(static).covariance(run.state), world.floor)


class Fan(NamedTuple):
    """How functions of one draw and of one run are applied to many; `ONE` applies them as they are.

    Attributes:
        over_draws: maps a function of draws, or of what belongs to them.
        over_runs: maps a function of runs, given the axis of each argument that counts them.
        hand_out: gives each run what belongs to its draw: leaves (draws,) to (runs,), or to ()
            where all runs share one draw.
        shared: axis of what was handed out, for ``over_runs``: 0, or None where all share it.
    """

    over_draws: Callable[..., Callable]
    over_runs: Callable[..., Callable]
    hand_out: Callable[[Any], Any]
    shared: int | None


ONE = Fan(lambda f, *axes: f, lambda f, *axes: f, lambda tree: tree, None)


class Progress(NamedTuple):
    """Runs under way, and the last increments of their draws, which compensation looks back at."""

    run: Run
    before: Increments


class Interval(NamedTuple):
    """How one record interval is gone over.

    Attributes:
        state: with which it begins.
        samples: numbers on the tape, in the order in which they are read.
        site: in the direction of the pass.
        compensated: (increments, those read before) -> compensated samples of the draws.
    """

    state: Any
    samples: Array
    site: Site
    compensated: Callable[[Increments, Increments], Sample]


def reader(
    static: Static, world: World, params: Params, fan: Fan
) -> Callable[[Count, Any], Interval]:
    """The function that opens a record interval, and turns the tape where a pass begins.

    Args:
        static: program.
        world: shared.
        params: as in `simulate`.
        fan: as in `simulate`.

    Returns:
        (number of the record, state) -> `Interval`.
    """
    every = static.record_every
    forward = fan.over_draws(imu.compensate, 0, 0)
    either_way = fan.over_draws(reverse.compensate, 0, 0, None)

    def one_turn(params: Params, state: Any, site: Site) -> Any:
        return method_of(static).turn(params.method, site, state)

    turn = fan.over_runs(one_turn, 0, 0, None)

    def once_forward(number: Count, state: Any) -> Interval:
        return Interval(state, number * every + jnp.arange(every), world.site, forward)

    def in_passes(number: Count, state: Any) -> Interval:
        read = reverse.reading(number, world.pass_records, every)
        turned = turn(params, state, reverse.site_of_pass(world.site, ~read.backward))
        return Interval(
            reverse.where(read.opens_pass, turned, state),
            read.samples,
            reverse.site_of_pass(world.site, read.backward),
            lambda *pair: either_way(*pair, read.backward),
        )

    return in_passes if static.repeats else once_forward


def over_a_record(
    static: Static, world: World, draws: Draw, params: Params, fan: Fan
) -> Callable[[Progress, tuple[Count, Quat]], tuple[Progress, Array | None]]:
    """The function that takes runs over one record interval.

    Args:
        static: program.
        world: shared.
        draws: as in `simulate`.
        params: as in `simulate`.
        fan: as in `simulate`.

    Returns:
        (progress, (number of the record, true attitudes of the draws at its end)) -> progress, and
        observations (fields, *runs) if ``static.curves``.
    """
    every, dt, kind = static.record_every, static.options.dt, world.tape.dtype
    method = method_of(static)

    def one_step(params: Params, state: Any, site: Site, sample: Sample, n: Scalar) -> Any:
        return method.step(params.method, site, state, sample, n)

    def one_record(run: Run, q_true: Quat, n: Scalar) -> Run:
        state = method.normalise(run.state)
        now = metrics.observe(q_true, method.attitude(state), method.covariance(state))
        so_far = metrics.accumulate(
            run.metrics, world.criteria, now, floor=world.floor, time=n * dt
        )
        return Run(state, so_far)

    axes = jax.tree.map(lambda a: 0 if jnp.ndim(a) else None, draws)
    sensed = fan.over_draws(partial(sense, static, world), axes, None, 0)
    step = fan.over_runs(one_step, 0, 0, None, fan.shared, None)
    record = fan.over_runs(one_record, 0, fan.shared, None)
    opened = reader(static, world, params, fan)

    def record_step(progress: Progress, xs: tuple[Count, Quat]) -> tuple[Progress, Array | None]:
        (run, before), (number, q_true) = progress, xs
        state, samples, site, compensated = opened(number, run.state)

        def sample_step(
            carry: tuple[Any, Increments], xs: tuple[Count, Count, Any]
        ) -> tuple[Any, None]:
            (state, before), (n, place, normal) = carry, xs
            now = sensed(draws, place, normal)
            sample = fan.hand_out(compensated(now, before))
            return (step(params, state, site, sample, (n + 1).astype(kind)), now), None

        def piece_step(carry: tuple[Any, Increments], xs: tuple[Array, Array]) -> tuple[Any, None]:
            updates, samples = xs
            normal = noise(static, world, draws, samples)
            return jax.lax.scan(sample_step, carry, (updates, samples, normal))[0], None

        updates = number * every + jnp.arange(every)
        pieces = tuple(a.reshape(-1, piece(static, draws)) for a in (updates, samples))
        (state, before), _ = jax.lax.scan(piece_step, (state, before), pieces)
        n = ((number + 1) * every).astype(kind)
        run = record(Run(state, run.metrics), fan.hand_out(q_true), n)
        # One array: XLA:CPU updates several side by side by copying them whole, every record.
        out = jnp.stack(jax.tree.leaves(run.metrics.last)) if static.curves else None
        return Progress(run, before), out

    return record_step


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
    run = fan.over_runs(lambda p: begin(static, world, p), 0)(params)
    # A run's first sample has none before it: with zeros nothing is compensated, as with itself.
    zero = jnp.zeros(draws.draw_id.shape, world.tape.dtype)
    before = Increments(Vec3(zero, zero, zero), Vec3(zero, zero, zero))
    # From (*draws, records, 4) to leaves (records, *draws).
    truth = jnp.asarray(world.truth)[draws.row, : static.records]
    truth = Quat(*jnp.moveaxis(truth, (-1, -2), (0, 1)))
    record_step = over_a_record(static, world, draws, params, fan)
    records = (jnp.arange(static.records), truth)
    (run, _), curves = jax.lax.scan(record_step, Progress(run, before), records)
    outcome = fan.over_runs(lambda r: end(static, world, r), 0)(run)
    if curves is None:
        return outcome, None
    fields = [curves[:, i] for i in range(curves.shape[1])]
    return outcome, jax.tree.unflatten(jax.tree.structure(outcome.last), fields)
