"""One alignment run, from sensor increments to its outcome, as pure functions.

`draws` makes the samples, `over_a_record` takes a run over those of a record interval and judges it
at the end. `simulate` puts them together for a single run; `batch` maps the same functions over
many.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from sinsjax.alignment import passes
from sinsjax.alignment.base import Ending, Method, Site
from sinsjax.alignment.limits import Biases, Limit
from sinsjax.alignment.methods import METHODS
from sinsjax.engine import metrics
from sinsjax.engine.metrics import Metrics, Observation, Outcome
from sinsjax.engine.realisations import (
    Draw,
    Environment,
    InitialErrors,
    Static,
    attitude,
    attitudes,
    derived,
    ideal,
    measured,
    noise,
    own,
    piece,
)
from sinsjax.engine.stepping import event_by_event, sample_by_sample
from sinsjax.maths import rotations
from sinsjax.strapdown import base_motion, sensors
from sinsjax.types import Array, Count, Flag, Increments, Navigation, Quat, Sample, Scalar, Vec3


class RunParams(NamedTuple):
    """Numbers of one run: all of it can be swept, mapped or differentiated.

    Attributes:
        q: attitude before the study's misalignment is added: true, or coarsely aligned.
        phi: initial misalignment, rotation vector in n, rad.
        ve: initial velocity east, m/s.
        vn: initial velocity north, m/s.
        method: numbers of the method.
        euler: whether ``phi`` are Euler angles yet, where a draw has some of its own.
    """

    q: Quat
    phi: Vec3
    ve: Scalar
    vn: Scalar
    method: Any
    euler: Flag | None = None


class Run(NamedTuple):
    """One run under way: the method's state and the metrics so far."""

    state: Any
    metrics: Metrics


def method_of(static: Static) -> Method:
    """Build the study's method."""
    return METHODS[static.method](static.options)


def begin(static: Static, environment: Environment, site: Site, params: RunParams) -> Run:
    """The run before its first sample."""
    method = method_of(static)
    zero = jnp.zeros_like(params.ve)
    nav = Navigation(
        q=rotations.misalign(params.phi, params.q),
        ve=params.ve,
        vn=params.vn,
        latitude=site.latitude + zero,
        longitude=zero,
    )
    state = method.init(params.method, nav)
    return Run(state, metrics.start(environment.criteria, zero))


def started(params: RunParams, own: InitialErrors, q: Quat | None) -> RunParams:
    """A run's numbers with what its draw begins with, its true attitude included if it has one."""
    angles = Vec3(*(a if b is None else b for a, b in zip(params.phi, own.phi, strict=True)))
    if params.euler is not None:
        vector = rotations.euler_vector(*angles)
        pairs = zip(vector, angles, strict=True)
        angles = Vec3(*(jnp.where(params.euler, v, a) for v, a in pairs))
    return params._replace(
        q=params.q if q is None else q,
        phi=angles,
        ve=params.ve if own.ve is None else own.ve,
        vn=params.vn if own.vn is None else own.vn,
    )


def limit(static: Static, pass_records: Count, params: RunParams, site: Site, own: Biases) -> Limit:
    """What the sensor biases of a run leave of its misalignment."""
    backward = static.repeats & ((static.records - 1) // pass_records % 2 == 1)
    ending = Ending(float(static.records * static.record_every), backward)
    return method_of(static).limit(params.method, site.place, own, ending)


def end(static: Static, run: Run, limit: Limit) -> Outcome:
    """The outcome of a run after its last record."""
    method = method_of(static)
    results = None if method.results is None else method.results(run.state)
    return metrics.finish(run.metrics, method.covariance(run.state), limit, results)


class BatchMap(NamedTuple):
    """Maps functions of one draw and of one run over many; `ONE_RUN` applies them as they are.

    Attributes:
        over_draws: maps a function of draws, or of what belongs to them.
        over_runs: maps a function of runs, given the axis of each argument that counts them.
        broadcast_to_runs: gives each run what belongs to its draw: leaves (draws,) to (runs,), or
            to () where all runs share one draw.
        shared: axis of what was handed out, for ``over_runs``: 0, or None where all share it.
        earliest: the first of the runs' next events; None to close the loop at every sample, which
            a run taken alone does, so that it can be differentiated in reverse too.
    """

    over_draws: Callable[..., Callable]
    over_runs: Callable[..., Callable]
    broadcast_to_runs: Callable[[Any], Any]
    shared: int | None
    earliest: Callable[[Array], Scalar] | None = None


ONE_RUN = BatchMap(lambda f, *axes: f, lambda f, *axes: f, lambda tree: tree, None)


class Shared(NamedTuple):
    """What runs take as they are or from their draws, and the axis along which runs differ in it.

    Attributes:
        site: Earth and place.
        site_axis: None where all runs share it.
        limit: of each run.
    """

    site: Site
    site_axis: int | None
    limit: Limit


def shared_by(
    static: Static, environment: Environment, draws: Draw, params: RunParams, batch_map: BatchMap
) -> Shared:
    """Site and biases, shared or of draws that have their own; what limit they set."""
    made_of = batch_map.broadcast_to_runs(draws.made)
    site = environment.site if made_of.site is None else made_of.site
    site_axis = None if made_of.site is None else batch_map.shared
    biases = environment.biases if made_of.biases is None else made_of.biases
    biases_axis = None if made_of.biases is None else batch_map.shared
    limits = batch_map.over_runs(
        partial(limit, static, environment.pass_records), 0, site_axis, biases_axis
    )
    return Shared(site, site_axis, limits(params, site, biases))


class RunsUnderWay(NamedTuple):
    """Runs under way, and the last increments of their draws, which compensation looks back at."""

    run: Run
    before: Increments


class RecordInterval(NamedTuple):
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
    static: Static, environment: Environment, shared: Shared, params: RunParams, batch_map: BatchMap
) -> Callable[[Count, Any], RecordInterval]:
    """The function that opens a record interval, and turns the tape where a pass begins.

    Args:
        static: program.
        environment: shared by all.
        shared: site and limits.
        params: as in `simulate`.
        batch_map: as in `simulate`.

    Returns:
        (number of the record, state) -> `RecordInterval`.
    """
    every = static.record_every
    forward = batch_map.over_draws(sensors.compensate, 0, 0)
    either_way = batch_map.over_draws(passes.compensate, 0, 0, None)

    def one_turn(params: RunParams, state: Any, site: Site) -> Any:
        return method_of(static).turn(params.method, site, state)

    turn = batch_map.over_runs(one_turn, 0, 0, shared.site_axis)

    def once_forward(number: Count, state: Any) -> RecordInterval:
        return RecordInterval(state, number * every + jnp.arange(every), shared.site, forward)

    def in_passes(number: Count, state: Any) -> RecordInterval:
        read = passes.reading(number, environment.pass_records, every)
        turned = turn(params, state, passes.site_of_pass(shared.site, ~read.backward))
        return RecordInterval(
            passes.where(read.opens_pass, turned, state),
            read.samples,
            passes.site_of_pass(shared.site, read.backward),
            lambda *pair: either_way(*pair, read.backward),
        )

    return in_passes if static.repeats else once_forward


def over_a_record(
    static: Static,
    environment: Environment,
    shared: Shared,
    draws: Draw,
    params: RunParams,
    batch_map: BatchMap,
) -> Callable[[RunsUnderWay, tuple[Count, Quat | None]], tuple[RunsUnderWay, Array | None]]:
    """The function that takes runs over one record interval.

    Args:
        static: program.
        environment: shared by all.
        shared: site and limits.
        draws: as in `simulate`.
        params: as in `simulate`.
        batch_map: as in `simulate`.

    Returns:
        (progress, (number of the record, true attitudes of the draws at its end, or None for those
        of the environment)) -> progress, and observations (fields, *runs) if ``static.curves``.
    """
    every, dt, kind = static.record_every, static.options.dt, environment.dtype
    method = method_of(static)

    def one_step(params: RunParams, state: Any, site: Site, sample: Sample, n: Scalar) -> Any:
        return method.step(params.method, site, state, sample, n)

    def one_record(run: Run, q_true: Quat, n: Scalar, floor: Scalar) -> Run:
        state = method.normalise(run.state)
        now = metrics.observe(q_true, method.attitude(state), method.covariance(state))
        so_far = metrics.accumulate(
            run.metrics, environment.criteria, now, floor=floor, time=n * dt
        )
        return Run(state, so_far)

    def one_close(params: RunParams, state: Any, n: Scalar) -> Any:
        return state if method.close is None else method.close(params.method, state, n)

    def one_next_event(params: RunParams, state: Any, n: Scalar) -> Scalar | None:
        return method.next_event(params.method, state, n) if method.next_event else None

    def one_called(state: Any, n: Scalar) -> Flag:
        assert method.called is not None
        return method.called(state, n)

    axes = jax.tree.map(lambda a: 0 if jnp.ndim(a) else None, draws)
    theirs = None if draws.made.ahead is None else 0  # the axis of increments of their own
    sensed = batch_map.over_draws(partial(measured, static, environment), axes, None, 0, theirs)
    step = batch_map.over_runs(one_step, 0, 0, shared.site_axis, batch_map.shared, None)
    close = batch_map.over_runs(one_close, 0, 0, None)
    next_event = batch_map.over_runs(one_next_event, 0, 0, None)
    calls = batch_map.over_runs(one_called, 0, None)
    record = batch_map.over_runs(one_record, 0, batch_map.shared, None, 0)
    opened = reader(static, environment, shared, params, batch_map)
    size = piece(static, draws)

    def record_step(
        progress: RunsUnderWay, xs: tuple[Count, Quat | None]
    ) -> tuple[RunsUnderWay, Array | None]:
        (run, before), (number, q_true) = progress, xs
        state, samples, site, compensated = opened(number, run.state)
        shared_rows = ideal(static, environment, draws, samples)
        done = number * every  # samples before this interval

        def make(before: Increments, piece: Count) -> tuple[Sample, Increments]:
            places = piece * size + jnp.arange(size)
            numbers = samples[places]
            normal = noise(static, environment, draws, numbers)
            exact = own(static, environment, draws, numbers)
            if shared_rows is not None:
                exact = jax.tree.map(lambda a: a[places], shared_rows)
            now = jax.vmap(partial(sensed, draws))(numbers, normal, exact)
            shifted = jax.tree.map(lambda a, b: jnp.concatenate([b[None], a[:-1]]), now, before)
            return jax.vmap(compensated)(now, shifted), jax.tree.map(lambda a: a[-1], now)

        def step_over(state: Any, place: Count, sample: Sample) -> Any:
            n = (done + place + 1).astype(kind)
            return step(params, state, site, batch_map.broadcast_to_runs(sample), n)

        def closed(state: Any, place: Count) -> Any:
            return close(params, state, (done + place).astype(kind))

        def following(state: Any, place: Count) -> Scalar | None:
            ahead = next_event(params, state, (done + place).astype(kind))
            if ahead is None or batch_map.earliest is None:
                return None
            return batch_map.earliest(ahead) - done.astype(kind)

        def called(state: Any, place: Count) -> Flag:
            return jnp.any(calls(state, (done + place).astype(kind)))

        if following(state, jnp.asarray(0)) is None:
            over = sample_by_sample
        else:
            asked = called if method.called else None
            over = partial(event_by_event, next_event=following, called=asked)
        state, before = over(state, before, every, step_over, closed, make, size)
        n = ((number + 1) * every).astype(kind)
        q_true = attitude(environment, draws, number) if q_true is None else q_true
        run = record(
            Run(state, run.metrics), batch_map.broadcast_to_runs(q_true), n, shared.limit.phi.z
        )
        # One array: XLA:CPU updates several side by side by copying them whole, every record.
        out = jnp.stack(jax.tree.leaves(run.metrics.last)) if static.curves else None
        if out is not None and static.shown is not None:
            out = out[:, : static.shown]
        return RunsUnderWay(run, before), out

    return record_step


def simulate(
    static: Static,
    environment: Environment,
    draws: Draw,
    params: RunParams,
    batch_map: BatchMap = ONE_RUN,
) -> tuple[Outcome, Observation | None]:
    """Whole runs, from first sample to outcome.

    Args:
        static: program.
        environment: shared.
        draws: one draw, or many with a leading axis.
        params: of one run, or of many with a leading axis.
        batch_map: one run or many.

    Returns:
        Outcomes, and, if ``static.curves``, observations with leaves (records,) in front.
    """
    axes = jax.tree.map(lambda a: 0 if jnp.ndim(a) else None, draws)
    draws = draws._replace(
        made=batch_map.over_draws(partial(derived, static, environment), axes)(draws)
    )
    shared = shared_by(static, environment, draws, params, batch_map)
    q = None
    if draws.motion is not None:
        q = batch_map.broadcast_to_runs(
            batch_map.over_draws(lambda m: base_motion.attitude(m, 0.0), 0)(draws.motion)
        )
    own = batch_map.broadcast_to_runs(draws.begins)
    params = batch_map.over_runs(started, 0, batch_map.shared, batch_map.shared)(params, own, q)
    run = batch_map.over_runs(
        lambda p, site: begin(static, environment, site, p), 0, shared.site_axis
    )(params, shared.site)
    # A run's first sample has none before it: with zeros nothing is compensated, as with itself.
    zero = jnp.zeros(draws.draw_id.shape, environment.dtype)
    before = Increments(Vec3(zero, zero, zero), Vec3(zero, zero, zero))
    record_step = over_a_record(static, environment, shared, draws, params, batch_map)
    records = (jnp.arange(static.records), attitudes(static, environment, draws))
    (run, _), curves = jax.lax.scan(record_step, RunsUnderWay(run, before), records)
    outcome = batch_map.over_runs(partial(end, static), 0, 0)(run, shared.limit)
    if curves is None:
        return outcome, None
    fields = [curves[:, i] for i in range(curves.shape[1])]
    return outcome, jax.tree.unflatten(jax.tree.structure(outcome.last), fields)
