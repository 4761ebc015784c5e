"""One alignment run, from sensor increments to outcome, as pure functions.

A run begins at a misaligned attitude. In a record interval its increments are measured and
compensated, the method takes them in sample by sample, and its loop is closed wherever feedback or
a reset is due; at the record time the corrected attitude is held against the truth. After the last
record the run is judged.

Nothing here knows of other runs. `tile` maps the same functions over many.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from sinsjax.engine import measurements, metrics
from sinsjax.engine.measurements import Read
from sinsjax.engine.metrics import Metrics, Observation, Outcome
from sinsjax.engine.reading import as_pass_begins, nothing_read, reading, turned_on
from sinsjax.engine.realisations import (
    Draw,
    Environment,
    InitialErrors,
    Static,
    attitudes,
    biases_of,
    derived,
    first_attitude,
    method_of,
    site_of,
)
from sinsjax.engine.stages import StageFunctions, coarse_program, over_stages
from sinsjax.maths import rotations
from sinsjax.methods import passes
from sinsjax.methods.base import RunEnd, Site
from sinsjax.methods.floors import BiasFloor, MeanBiases
from sinsjax.methods.passes import BodyTurn, PassReading
from sinsjax.types import (
    Array,
    Count,
    Flag,
    Increments,
    Navigation,
    Quat,
    Sample,
    Scalar,
    Vec3,
)


class RunParams(NamedTuple):
    """Numbers of one run: all of it can be swept, mapped or differentiated.

    Attributes:
        q: attitude before the study's misalignment is added: true, or coarsely aligned.
        phi: initial misalignment, rotation vector in n, rad.
        ve: initial velocity east, m/s.
        vn: initial velocity north, m/s.
        method: numbers of the method.
        euler: whether ``phi`` are still Euler angles, where a draw has some of its own.
    """

    q: Quat
    phi: Vec3
    ve: Scalar
    vn: Scalar
    method: Any
    euler: Flag | None = None


class Setup(NamedTuple):
    """What stays the same from the first sample of a run to its outcome.

    Attributes:
        draw: its realisation, with what follows from it.
        params: with what the draw begins with.
        site: Earth and place.
        limit: what the sensor biases leave of the misalignment.
        record: measured increments of its draw, leaves (samples,), where `Static.kept`.
    """

    draw: Draw
    params: RunParams
    site: Site
    limit: BiasFloor
    record: Increments | None = None


class Run(NamedTuple):
    """One run under way: the method's state and the metrics so far."""

    state: Any
    metrics: Metrics


def simulate(
    static: Static, environment: Environment, draw: Draw, params: RunParams
) -> tuple[Outcome, Observation | None]:
    """One run, from first sample to outcome; it can be differentiated in both modes.

    Args:
        static: program.
        environment: what all runs share.
        draw: the run's realisation of what is random.
        params: its numbers.

    Returns:
        The outcome, and, if ``static.curves``, the observations, leaves (records,).
    """
    setup = set_up(static, environment, draw, params)
    functions = StageFunctions(
        lambda program: begin(program, environment, setup.site, setup.params),
        lambda program, *given: over_record(program, environment, setup, *given),
        partial(after_coarse, static, setup.params, setup.site),
    )
    records = (jnp.arange(static.records), attitudes(static, environment, setup.draw))
    run, curves = over_stages(static, functions, nothing_read(static, environment, draw), records)
    return end(static, setup.site, run, setup.limit), metrics.from_rows(
        curves
    ) if static.curves else None


def set_up(static: Static, environment: Environment, draw: Draw, params: RunParams) -> Setup:
    """What a run has from its environment, its draw and its own numbers."""
    draw = draw._replace(made=derived(static, environment, draw))
    site, biases = site_of(environment, draw), biases_of(environment, draw)
    params = starting(params, draw.begins, first_attitude(draw))
    limits = limit(static, environment.pass_records, params, site, biases)
    record = None
    if static.kept:
        nothing, numbers = nothing_read(static, environment, draw), jnp.arange(static.kept)
        record, _ = measurements.measured(static, environment, draw, nothing, numbers)
    return Setup(draw, params, site, limits, record)


def over_record(
    static: Static,
    environment: Environment,
    setup: Setup,
    under_way: tuple[Run, Read],
    record: tuple[Count, Quat],
) -> tuple[tuple[Run, Read], Array | None]:
    """One record interval: samples, steps, closed loop, and the observation at its end.

    Args:
        static: program.
        environment: what all runs share.
        setup: of the run.
        under_way: the run, and what its draw has read.
        record: number of the record from 0, and the true attitude at its time.

    Returns:
        The run and what its draw has read, and if ``static.curves`` the observation, see `as_row`.
    """
    (run, before), (number, q_true) = under_way, record
    draw, params, every = setup.draw, setup.params, static.record_every
    read = reading(static, environment, number)
    open_ = partial(open_pass, static, environment.pass_records)
    state = open_(params, setup.site, run.state, (read, before.turn))
    nothing = partial(nothing_read, static, environment, draw)
    before = as_pass_begins(static, read, before, nothing)
    site = passes.site_of_pass(setup.site, read.backward)
    if setup.record is None:
        increments, later = measurements.measured(static, environment, draw, before, read.samples)
    else:
        increments, later = measurements.read_back(static, setup.record, read.samples), before
    earlier, last = measurements.look_back(increments, before.last)
    samples = jax.vmap(partial(passes.compensate, backward=read.backward))(increments, earlier)
    before = later._replace(last=last, turn=turned_on(static, before.turn, samples))

    def over_sample(state: Any, xs: tuple[Scalar, Sample]) -> tuple[Any, None]:
        n, sample = xs
        state = step(static, params, site, state, sample, n)
        return close_loop(static, params, state, n), None

    n = (number * every + 1 + jnp.arange(every)).astype(environment.dtype)
    state, _ = jax.lax.scan(over_sample, state, (n, samples))
    run = observe(static, environment, Run(state, run.metrics), q_true, setup.limit.phi.z, n[-1])
    run, observed = told(static, run)
    return (run, before), observed


def after_coarse(
    static: Static, params: RunParams, site: Site, state: Any, turn: BodyTurn | None
) -> Any:
    """The method's state as the coarse method leaves it: at rest, with P0.

    Args:
        static: program.
        params: of the run.
        site: Earth and place.
        state: of the coarse method.
        turn: of the body since the record began; None where fine alignment does not go back there.
    """
    assert static.coarse is not None
    method, zero = method_of(static), jnp.zeros_like(params.ve)
    samples = float(static.coarse.records * static.record_every)
    q = method_of(coarse_program(static)).attitude(state)
    if not static.coarse.replays:
        begun = method.init(params.method, solution(site, rotations.normalise(q), zero, zero))
        begin_after = method.passes and method.passes.begin_after
        return begun if begin_after is None else begin_after(begun, zero + samples)
    assert turn is not None
    q = passes.wound_back(q, turn, site.place, zero + samples * static.options.dt, None)
    return method.init(params.method, solution(site, q, zero, zero))


def starting(params: RunParams, own: InitialErrors, q: Quat | None) -> RunParams:
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


def limit(
    static: Static, pass_records: Count, params: RunParams, site: Site, own: MeanBiases
) -> BiasFloor:
    """What the sensor biases of a run leave of its misalignment."""
    number = (static.records - 1) // pass_records
    backward = (static.repeats and not static.rewinds) & (number % 2 == 1)
    ending = RunEnd(float(static.records * static.record_every), backward)
    return method_of(static).floor(params.method, site.place, own, ending)


def begin(static: Static, environment: Environment, site: Site, params: RunParams) -> Run:
    """The run before its first sample."""
    method = method_of(static)
    nav = solution(site, rotations.misalign(params.phi, params.q), params.ve, params.vn)
    state = method.init(params.method, nav)
    return Run(state, metrics.start(environment.criteria, nav.longitude))


def solution(site: Site, q: Quat, ve: Scalar, vn: Scalar) -> Navigation:
    """The navigation solution at the beginning of the record."""
    zero = jnp.zeros_like(ve)
    return Navigation(q=q, ve=ve, vn=vn, latitude=site.latitude + zero, longitude=zero)


def open_pass(
    static: Static,
    pass_records: Count,
    params: RunParams,
    site: Site,
    state: Any,
    reads: tuple[PassReading, BodyTurn | None],
) -> Any:
    """The method's state as a record interval begins, which may open another pass.

    Args:
        static: program.
        pass_records: record intervals a pass.
        params: of the run.
        site: Earth and place.
        state: at the end of the interval before.
        reads: how the interval reads the record, and how the body has turned since it began.
    """
    read, turn = reads
    passes_of_method = method_of(static).passes
    if read.opens_pass is None or passes_of_method is None:  # such a method has one pass
        return state
    if read.backward is None:
        assert turn is not None
        opened = wound_back(static, pass_records, params, site, state, turn)
    else:
        site_before = passes.site_of_pass(site, ~read.backward)
        opened = passes_of_method.turn(params.method, site_before, state)
    return passes.where(read.opens_pass, opened, state)


def wound_back(
    static: Static, records: Count, params: RunParams, site: Site, state: Any, turn: BodyTurn
) -> Any:
    """The method's state that begins the record again, from that after some record intervals."""
    method = method_of(static)
    time = jnp.asarray(records, params.ve.dtype) * (static.record_every * static.options.dt)
    assert method.passes is not None and method.passes.rewind is not None
    gyro_bias = method.passes.gyro_bias
    bias = None if gyro_bias is None else gyro_bias(state)
    q = passes.wound_back(method.attitude(state), turn, site.place, time, bias)
    zero = jnp.zeros_like(params.ve)
    return method.passes.rewind(params.method, solution(site, q, zero, zero), state)


def step(
    static: Static, params: RunParams, site: Site, state: Any, sample: Sample, n: Scalar
) -> Any:
    """The method's state after the ``n``-th sample, from 1, its loop not yet closed."""
    return method_of(static).step(params.method, site, state, sample, n)


def close_loop(static: Static, params: RunParams, state: Any, n: Scalar) -> Any:
    """The method's state after the feedback and reset that are due after the ``n``-th sample."""
    method = method_of(static)
    feedback = method.feedback
    return state if feedback is None else feedback.close(params.method, state, n)


def observe(
    static: Static, environment: Environment, run: Run, q_true: Quat, floor: Scalar, n: Scalar
) -> Run:
    """The run after its observation at a record time, that of the ``n``-th sample.

    Args:
        static: program.
        environment: what all runs share.
        run: under way.
        q_true: true or reference attitude, NaN if unknown.
        floor: what the azimuth misalignment should settle to, rad.
        n: number of the sample.
    """
    method = method_of(static)
    state = method.normalise(run.state)
    attitude, covariance = method.attitude(state), method.covariance(state)
    now = metrics.observe(q_true, attitude, covariance)
    criteria, time = environment.criteria, n * static.options.dt
    taken_in = metrics.accumulate(run.metrics, criteria, now, floor=floor, time=time)
    return Run(state, metrics.report(taken_in, criteria, covariance, n))


def told(static: Static, run: Run) -> tuple[Run, Array | None]:
    """The run that begins the next record interval, and what is kept of this one, see `as_row`."""
    if not static.curves:
        return run, None
    observed, model = metrics.as_row(run.metrics.last), method_of(static).error_model
    per_record = None if model is None else model.per_record
    if per_record is None:
        return run, observed
    state, more = per_record(run.state)
    return run._replace(state=state), jnp.concatenate([observed, jnp.stack(more)])


def end(static: Static, site: Site, run: Run, limit: BiasFloor) -> Outcome:
    """The outcome of a run after its last record."""
    method = method_of(static)
    results = None if method.results is None else method.results(site, run.state)
    return metrics.finish(run.metrics, method.covariance(run.state), limit, results)
