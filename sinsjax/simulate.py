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

from sinsjax import earth, imu, metrics, rotations, trajectory
from sinsjax.alignment import METHODS, reverse
from sinsjax.alignment.base import Method, Options, Site
from sinsjax.metrics import Criteria, Metrics, Observation, Outcome
from sinsjax.types import Array, Count, Flag, Increments, Navigation, Quat, Sample, Scalar, Vec3


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
        sways: whether a base that draws have for themselves sways; a still one is sensed once.
    """

    method: str
    options: Options
    record_every: int
    records: int
    curves: bool
    noisy: bool
    repeats: bool = False
    sways: bool = True


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
        times: (records,) record times on the tape, s; None where `truth` has all that is needed.
        motion: of the base, where draws have something for themselves.
    """

    site: Site
    tape: Array
    truth: Array
    errors: imu.SensorErrors
    seed: Count
    criteria: Criteria
    floor: Scalar
    pass_records: Count
    times: Array | None = None
    motion: trajectory.Motion | None = None


class Start(NamedTuple):
    """What a draw begins with instead of its runs' `Params`; None for what is theirs.

    Attributes:
        phi: angles of the initial misalignment, rad.
        ve: initial velocity east, m/s.
        vn: initial velocity north, m/s.
    """

    phi: tuple[Scalar | None, Scalar | None, Scalar | None] = (None, None, None)
    ve: Scalar | None = None
    vn: Scalar | None = None


class Made(NamedTuple):
    """What follows from what a draw has for itself; None for what is the world's.

    Attributes:
        site: at its latitude.
        floor: what phi_u of its runs should settle to, rad.
        rest: (6,) ideal increments of its base, where that does not sway.
    """

    site: Site | None = None
    floor: Scalar | None = None
    rest: Array | None = None


class Draw(NamedTuple):
    """One realisation of what is random: noise, and whatever else a study draws.

    What is None is that of the world, or of the run.

    Attributes:
        draw_id: decides its noise.
        start: first sample on the tape; of many draws, one number if it is the same for all.
        row: of `World.truth`.
        begins: what its runs begin with.
        errors: of its sensors.
        motion: of its base; its increments are made sample by sample, in place of the tape's.
        latitude: of its base, which then has a motion too, rad.
        made: what follows from these.
    """

    draw_id: Count
    start: Count
    row: Count
    begins: Start = Start()
    errors: imu.SensorErrors | None = None
    motion: trajectory.Motion | None = None
    latitude: Scalar | None = None
    made: Made = Made()


class Params(NamedTuple):
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


def begin(static: Static, world: World, site: Site, params: Params) -> Run:
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
    return Run(state, metrics.start(world.criteria, zero))


def started(params: Params, own: Start, q: Quat | None) -> Params:
    """A run's numbers with what its draw begins with, its true attitude included if it has one."""
    angles = Vec3(*(a if b is None else b for a, b in zip(params.phi, own.phi, strict=True)))
    if params.euler is not None:
        # [P1] section 1: angles from the ideal to the computed frame, about U, E, N in turn.
        vector = rotations.log(rotations.from_euler(*angles))
        pairs = zip(vector, angles, strict=True)
        angles = Vec3(*(jnp.where(params.euler, v, a) for v, a in pairs))
    return params._replace(
        q=params.q if q is None else q,
        phi=angles,
        ve=params.ve if own.ve is None else own.ve,
        vn=params.vn if own.vn is None else own.vn,
    )


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
    dt = static.options.dt
    if draw.made.rest is not None:
        row = draw.made.rest
    elif draw.motion is not None:
        place = (world.site if draw.made.site is None else draw.made.site).place
        k = jnp.asarray(n, world.tape.dtype)
        row = trajectory.increment(draw.motion, place, 1 / dt, k)
    else:
        row = jnp.asarray(world.tape)[draw.start + n]
    errors = world.errors if draw.errors is None else draw.errors
    put_out = imu.measure(imu.split(row), errors, normal, dt)
    if not static.repeats:
        return put_out
    return reverse.where(n < 0, jax.tree.map(jnp.zeros_like, put_out), put_out)


def made(static: Static, world: World, draw: Draw) -> Made:
    """What follows from what a draw has for itself."""
    if draw.errors is None and draw.motion is None and draw.latitude is None:
        return Made()
    site = world.site
    if draw.latitude is not None:
        site = Site(site.earth, earth.place(site.earth, draw.latitude), draw.latitude)
    errors = world.errors if draw.errors is None else draw.errors
    motion = world.motion if draw.motion is None else draw.motion
    assert motion is not None
    rest = None
    if draw.motion is not None and not static.sways:
        rest = trajectory.increment(motion, site.place, 1 / static.options.dt, 0.0)
    own = None if draw.latitude is None else site
    return Made(own, floor_of(errors, motion, site.place), rest)


def floor_of(errors: imu.SensorErrors, motion: trajectory.Motion, place: earth.Place) -> Scalar:
    """Limit of phi_u for constant biases, -eps_E/omega_N + (nabla_E/g) tan L, rad.

    Biases are turned to n at the attitude swayed about.
    """
    center = rotations.from_euler(*(sway.center for sway in motion))
    eps = rotations.rotate(center, Vec3(*errors.gyro_bias)).x
    nabla = rotations.rotate(center, Vec3(*errors.accel_bias)).x
    return -eps / place.rate_n + nabla / place.gravity * place.tan_latitude


def end(static: Static, run: Run, floor: Scalar) -> Outcome:
    """The outcome of a run after its last record."""
    return metrics.finish(run.metrics, method_of(static).covariance(run.state), floor)


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


class Shared(NamedTuple):
    """What runs take as they are or from their draws, and the axis along which runs differ in it.

    Attributes:
        site: Earth and place.
        site_axis: None where all runs share it.
        floor: what phi_u should settle to, rad.
        floor_axis: likewise.
    """

    site: Site
    site_axis: int | None
    floor: Scalar
    floor_axis: int | None


def shared_by(world: World, draws: Draw, fan: Fan) -> Shared:
    """Site and floor of the world, or of the draws that have their own."""
    site, floor, _ = fan.hand_out(draws.made)
    return Shared(
        *((world.site, None) if site is None else (site, fan.shared)),
        *((world.floor, None) if floor is None else (floor, fan.shared)),
    )


def attitudes(static: Static, world: World, draws: Draw) -> Quat:
    """True attitudes at record times, leaves (records, *draws); NaN if unknown."""
    if draws.motion is None:
        # From (*draws, records, 4) to leaves (records, *draws).
        truth = jnp.asarray(world.truth)[draws.row, : static.records]
        return Quat(*jnp.moveaxis(truth, (-1, -2), (0, 1)))
    times = jnp.asarray(world.times)[: static.records]
    at = jax.vmap(trajectory.attitude, in_axes=(None, 0))
    many = at if draws.draw_id.ndim == 0 else jax.vmap(at, in_axes=(0, None), out_axes=1)
    return many(draws.motion, times)


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
    static: Static, world: World, shared: Shared, params: Params, fan: Fan
) -> Callable[[Count, Any], Interval]:
    """The function that opens a record interval, and turns the tape where a pass begins.

    Args:
        static: program.
        world: shared by all.
        shared: site and floor.
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

    turn = fan.over_runs(one_turn, 0, 0, shared.site_axis)

    def once_forward(number: Count, state: Any) -> Interval:
        return Interval(state, number * every + jnp.arange(every), shared.site, forward)

    def in_passes(number: Count, state: Any) -> Interval:
        read = reverse.reading(number, world.pass_records, every)
        turned = turn(params, state, reverse.site_of_pass(shared.site, ~read.backward))
        return Interval(
            reverse.where(read.opens_pass, turned, state),
            read.samples,
            reverse.site_of_pass(shared.site, read.backward),
            lambda *pair: either_way(*pair, read.backward),
        )

    return in_passes if static.repeats else once_forward


def over_a_record(
    static: Static, world: World, shared: Shared, draws: Draw, params: Params, fan: Fan
) -> Callable[[Progress, tuple[Count, Quat]], tuple[Progress, Array | None]]:
    """The function that takes runs over one record interval.

    Args:
        static: program.
        world: shared by all.
        shared: site and floor.
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

    def one_record(run: Run, q_true: Quat, n: Scalar, floor: Scalar) -> Run:
        state = method.normalise(run.state)
        now = metrics.observe(q_true, method.attitude(state), method.covariance(state))
        so_far = metrics.accumulate(run.metrics, world.criteria, now, floor=floor, time=n * dt)
        return Run(state, so_far)

    axes = jax.tree.map(lambda a: 0 if jnp.ndim(a) else None, draws)
    sensed = fan.over_draws(partial(sense, static, world), axes, None, 0)
    step = fan.over_runs(one_step, 0, 0, shared.site_axis, fan.shared, None)
    record = fan.over_runs(one_record, 0, fan.shared, None, shared.floor_axis)
    opened = reader(static, world, shared, params, fan)

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
        run = record(Run(state, run.metrics), fan.hand_out(q_true), n, shared.floor)
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
    axes = jax.tree.map(lambda a: 0 if jnp.ndim(a) else None, draws)
    draws = draws._replace(made=fan.over_draws(partial(made, static, world), axes)(draws))
    shared = shared_by(world, draws, fan)
    q = None
    if draws.motion is not None:
        q = fan.hand_out(fan.over_draws(lambda m: trajectory.attitude(m, 0.0), 0)(draws.motion))
    own = fan.hand_out(draws.begins)
    params = fan.over_runs(started, 0, fan.shared, fan.shared)(params, own, q)
    run = fan.over_runs(lambda p, site: begin(static, world, site, p), 0, shared.site_axis)(
        params, shared.site
    )
    # A run's first sample has none before it: with zeros nothing is compensated, as with itself.
    zero = jnp.zeros(draws.draw_id.shape, world.tape.dtype)
    before = Increments(Vec3(zero, zero, zero), Vec3(zero, zero, zero))
    record_step = over_a_record(static, world, shared, draws, params, fan)
    records = (jnp.arange(static.records), attitudes(static, world, draws))
    (run, _), curves = jax.lax.scan(record_step, Progress(run, before), records)
    outcome = fan.over_runs(partial(end, static), 0, shared.floor_axis)(run, shared.floor)
    if curves is None:
        return outcome, None
    fields = [curves[:, i] for i in range(curves.shape[1])]
    return outcome, jax.tree.unflatten(jax.tree.structure(outcome.last), fields)
