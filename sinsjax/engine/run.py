"""The loop of a run: environment -> samples -> step -> close loop -> observe -> outcome.

A run starts at a misaligned attitude. In each record interval its increments are measured and
compensated, the method steps sample by sample, and its loop is closed whenever feedback or a reset
is due; at the record time the corrected attitude is compared with the truth. After the last record
interval the run has its outcome.

A run alone is a tile of one lane. The functions at the end are those of one run; `TileRuns` maps
them over the lanes of a tile, whose samples are made once per draw.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from sinsjax.engine import metrics
from sinsjax.engine.environment import (
    Draw,
    Environment,
    InitialErrors,
    RunParams,
    Static,
    build_program,
    coarse_static,
    computed_attitudes,
    derive_inputs,
    initial_true_attitude,
    select_biases,
    select_site,
    stored_attitude,
)
from sinsjax.engine.lanes import Tiles
from sinsjax.engine.metrics import Criteria, Metrics, Observation, Outcome
from sinsjax.engine.samples import (
    DrawSensors,
    SensorState,
    block_size,
    build_sensors,
    leaf_axes,
    sample_blocks,
)
from sinsjax.engine.stepping import Blocks, Steps, advance_interval
from sinsjax.maths import rotations
from sinsjax.maths.algebra import select_tree
from sinsjax.methods import passes
from sinsjax.methods.floors import BiasFloor, MeanBiases
from sinsjax.methods.method import (
    AttitudeCovariance,
    Program,
    RunEnd,
    Site,
    bias_floor,
    unknown_covariance,
)
from sinsjax.methods.passes import BodyRotation, PassReading
from sinsjax.strapdown.earth import Place
from sinsjax.types import Array, Count, Flag, Increments, Navigation, Quat, Sample, Scalar, Vec3


class Run(NamedTuple):
    """A run between two record intervals: the state of its method, and its metrics so far."""

    state: Any
    metrics: Metrics


def run_tile(
    static: Static,
    environment: Environment,
    tile: Tiles,
    curve_lanes: int | None = None,
    *,
    by_event: bool = True,
) -> tuple[Outcome, Observation | None]:
    """Run all runs of a tile, from the first sample to the outcome.

    Args:
        static: program.
        environment: shared by all runs.
        tile: its draws and params.
        curve_lanes: lanes whose observations are returned, the first ones; None for all.
        by_event: see `advance_interval`; False to differentiate in reverse mode.

    Returns:
        Outcomes with leaves (lanes, ...), and if ``static.curves`` observations (records, lanes).
    """
    runs = set_up(static, environment, tile)._replace(curve_lanes=curve_lanes, by_event=by_event)
    start = runs.start(), runs.sensors.initial_state()
    if static.coarse is None:
        (run, _), rows = jax.lax.scan(partial(advance_record, runs), start, runs.records())
    else:
        run, rows = _coarse_then_fine(runs, start)
    return runs.finish(run), None if rows is None else metrics.unpack_observations(rows)


def advance_record(
    runs: "TileRuns", carry: tuple[Run, SensorState], record: tuple[Count, Quat | None]
) -> tuple[tuple[Run, SensorState], Array | None]:
    """Advance all runs of a tile by one record interval.

    Args:
        runs: of the tile.
        carry: the runs, and the sensors of their draws.
        record: number of the interval, and the attitudes of the draws' bases at its end; None to
            look them up.

    Returns:
        Both after the interval, and if ``static.curves`` the observations as rows, (fields, lanes).
    """
    (run, sensor_state), (number, q_true) = carry, record
    reading = runs.read(number)
    state, sensor_state = runs.begin_pass(run.state, sensor_state, reading)
    state, sensor_state = advance_interval(
        runs.steps(reading, number),
        state,
        sensor_state,
        runs.blocks(reading),
        by_event=runs.by_event,
    )
    turn = runs.housing_turn(number, sensor_state)
    run = runs.observe(Run(state, run.metrics), number, q_true, turn)
    return (run, sensor_state), runs.curve_row(run)


def _coarse_then_fine(runs: "TileRuns", start: tuple[Run, SensorState]) -> tuple[Run, Array | None]:
    """Run the record intervals of coarse alignment, then those of the method.

    Fine alignment goes on where coarse alignment ends, or replays all samples from the first.
    """
    coarse = runs.static.coarse
    assert coarse is not None
    count, records = coarse.records, runs.records()
    first, later = (
        jax.tree.map(lambda a, part=part: a[part], records)
        for part in (slice(None, count), slice(count, None))
    )
    coarse_runs = runs.with_program(coarse_static(runs.static))
    coarse_start = coarse_runs.start(), start[1]
    (run, sensor_state), rows = jax.lax.scan(
        partial(advance_record, coarse_runs), coarse_start, first
    )
    run = run._replace(state=runs.state_after_coarse(run.state, sensor_state.rotation))
    if not coarse.replays:
        (run, _), fine_rows = jax.lax.scan(
            partial(advance_record, runs), (run, sensor_state), later
        )
        return run, None if rows is None else jnp.concatenate([rows, fine_rows])

    def replay(carry: Any, record: Any) -> Any:
        """A record interval whose observation counts only after the coarse stage."""
        (run, sensor_state), row = advance_record(runs, carry, record)
        counted = select_tree(record[0] >= count, run.metrics, carry[0].metrics)
        return (run._replace(metrics=counted), sensor_state), row

    (run, _), fine_rows = jax.lax.scan(replay, (run, start[1]), records)
    return run, None if rows is None else jnp.concatenate([rows, fine_rows[count:]])


class TileRuns(NamedTuple):
    """The runs of a tile: all that stays the same over them, and the functions of one run, mapped.

    Attributes:
        static: program.
        environment: shared by all runs.
        method: of the program.
        draws: with derived inputs, leaves (draws, ...).
        row: (lanes,) the draw of each run.
        params: with the initial errors of the draws, leaves (lanes, ...).
        site: leaves (lanes,), or () if all runs share it.
        floor: bias floor of each run, leaves (lanes,).
        sensors: of the draws.
        record: kept increments of the draws, leaves (samples, draws); None to measure.
        turns: rotations from the housing to the base at the boundaries of the record intervals of
            kept increments, leaves (intervals + 1, draws); None if it does not rotate.
        curve_lanes: lanes whose observations are kept, the first ones; None for all.
        by_event: see `advance_interval`.
    """

    static: Static
    environment: Environment
    method: Program
    draws: Draw
    row: Array
    params: RunParams
    site: Site
    floor: BiasFloor
    sensors: DrawSensors
    record: Increments | None = None
    turns: Quat | None = None
    curve_lanes: int | None = None
    by_event: bool = True

    @property
    def draw_axis(self) -> int | None:
        """Axis, for `jax.vmap`, of what is broadcast to runs; None if all share one draw."""
        return _draw_axis(self.draws)

    @property
    def site_axis(self) -> int | None:
        """Axis of the site; None if all runs share it."""
        return None if self.draws.derived.site is None else self.draw_axis

    def with_program(self, static: Static) -> "TileRuns":
        """Return the same runs with another method and way of reading the record."""
        return self._replace(static=static, method=build_program(static))

    def records(self) -> tuple[Array, Quat | None]:
        """Return the numbers of the record intervals, and the attitudes of bases that draws move.

        Stored attitudes of all records and draws would fill the memory: they are looked up later.
        """
        q_true = None
        if self.draws.motion is not None:
            truth, count = self.environment.truth, self.static.records
            q_true = jax.vmap(
                lambda draw: computed_attitudes(truth, draw, count),
                in_axes=(leaf_axes(self.draws),),
                out_axes=1,
            )(self.draws)
        return jnp.arange(self.static.records), q_true

    def start(self) -> Run:
        """Return the runs before their first sample."""
        over_runs = jax.vmap(
            partial(start_run, self.method, self.environment.criteria), in_axes=(self.site_axis, 0)
        )
        return over_runs(self.site, self.params)

    def read(self, number: Count) -> PassReading:
        """Return the samples that a record interval reads."""
        every, pass_records = self.static.record_every, self.environment.pass_records
        if self.static.passes == "alternate":
            return passes.read_alternately(number, pass_records, every)
        if self.static.passes == "rewind":
            return passes.read_forward(number, pass_records, every)
        return passes.read_once(number, every)

    def begin_pass(
        self, state: Any, sensor_state: SensorState, reading: PassReading
    ) -> tuple[Any, SensorState]:
        """Return the states of runs and sensors as a record interval begins, maybe a new pass."""
        if reading.opens_pass is None or self.method.passes is None:  # such a method has one pass
            return state, sensor_state
        if reading.backward is not None:
            turn = jax.vmap(
                partial(reverse_state, self.method), in_axes=(0, self.site_axis, 0, None)
            )
            turned = turn(self.params, self.site, state, reading.backward)
            return select_tree(reading.opens_pass, turned, state), sensor_state
        record_s = self.static.record_every * self.static.options.dt
        rewind = jax.vmap(
            partial(rewind_state, self.method, record_s),
            in_axes=(None, 0, self.site_axis, 0, self.draw_axis),
        )
        rotation, pass_records = self.to_runs(sensor_state.rotation), self.environment.pass_records
        rewound = rewind(pass_records, self.params, self.site, state, rotation)
        state = select_tree(reading.opens_pass, rewound, state)
        first = self.sensors.initial_state()
        return state, select_tree(reading.opens_pass, first, sensor_state)

    def state_after_coarse(self, coarse_state: Any, rotation: BodyRotation | None) -> Any:
        """Return the state of the method after the coarse stage."""
        assert self.static.coarse is not None
        attitude = build_program(coarse_static(self.static)).attitude
        after_coarse = jax.vmap(
            partial(
                start_after_coarse,
                self.method,
                attitude,
                self.static.coarse.records * self.static.record_every,
                self.static.options.dt,
                self.static.coarse.replays,
            ),
            in_axes=(0, self.site_axis, 0, self.draw_axis),
        )
        return after_coarse(self.params, self.site, coarse_state, self.to_runs(rotation))

    def steps(self, reading: PassReading, number: Count) -> Steps:
        """Return the effect of the samples of a record interval on the state of all runs."""
        method, params, axis = self.method, self.params.method, self.site_axis
        site = passes.site_of_pass(self.site, reading.backward)
        done = number * self.static.record_every  # samples before this interval
        step = jax.vmap(method.step, in_axes=(0, axis, 0, self.draw_axis, None))

        def n(place: Count) -> Scalar:
            return (done + place).astype(self.environment.dtype)

        def take(state: Any, place: Count, sample: Sample) -> Any:
            return step(params, site, state, self.to_runs(sample), n(place + 1))

        if method.feedback is None:
            return Steps(take, lambda state, place: state)
        close = jax.vmap(method.feedback.close, in_axes=(0, 0, None))
        next_event = jax.vmap(method.feedback.next_event, in_axes=(0, 0, None))
        triggered = method.feedback.triggered and jax.vmap(
            method.feedback.triggered, in_axes=(0, None)
        )

        def first_event(state: Any, place: Count) -> Scalar | None:
            events = next_event(params, state, n(place))
            if events is None:
                return None
            return jnp.min(events) - done.astype(self.environment.dtype)

        def any_triggered(state: Any, place: Count) -> Flag:
            assert triggered is not None
            return jnp.any(triggered(state, n(place)))

        return Steps(
            take,
            lambda state, place: close(params, state, n(place)),
            first_event,
            any_triggered if triggered else None,
        )

    def blocks(self, reading: PassReading) -> Blocks:
        """Return the samples of a record interval, made in blocks for all draws."""
        size = block_size(self.static.record_every, self.draws)
        make = sample_blocks(self.sensors, reading, size, self.record)
        return Blocks(self.static.record_every, size, make)

    def housing_turn(self, number: Count, sensor_state: SensorState) -> Quat | None:
        """Return the rotation from the housing to the base at the end of a record interval.

        Leaves (draws,); None if the housing does not rotate.
        """
        if self.turns is None:
            return sensor_state.housing and sensor_state.housing.turn
        pass_number, place = jnp.divmod(number, self.environment.pass_records)
        backward = pass_number % 2 == 1
        end = jnp.where(backward, self.environment.pass_records - place - 1, place + 1)
        turn: Quat = jax.tree.map(lambda a: a[end], self.turns)
        return turn

    def observe(
        self, run: Run, number: Count, q_true: Quat | None, turn: Quat | None = None
    ) -> Run:
        """Return the runs after their observation at the end of a record interval.

        Args:
            run: at that time.
            number: of the interval.
            q_true: attitudes of the draws' bases; None to look them up.
            turn: rotations from the draws' housings to their bases; None without.
        """
        run = run._replace(state=self.fit_blocks(run.state, number))
        if q_true is None:
            q_true = stored_attitude(self.environment.truth, self.draws, number)
        if turn is not None:
            q_true = rotations.multiply(q_true, turn)
        observe = partial(
            observe_run,
            self.method,
            self.environment.criteria,
            self.static.options.dt,
            self.static.finds_heading,
        )
        over_runs = jax.vmap(observe, in_axes=(0, self.draw_axis, 0, None))
        n = ((number + 1) * self.static.record_every).astype(self.environment.dtype)
        return over_runs(run, self.to_runs(q_true), self.floor.phi.z, n)

    def fit_blocks(self, state: Any, number: Count) -> Any:
        """Return the state of a method after its fit at the end of a record interval, if it has."""
        blocks = self.method.block_fit
        if blocks is None:
            return state
        end = ((number + 1) * self.static.record_every).astype(self.environment.dtype)
        times = self.environment.criteria.report_samples
        reported = jnp.asarray(False) if times is None else jnp.any(times == end)
        state = jax.vmap(blocks.store, in_axes=(0, None))(state, number)
        fit = jax.vmap(blocks.fit, in_axes=(0, self.site_axis, 0, None))
        # Of one predicate for all runs: a fit takes as long as hundreds of samples.
        fitted = jax.lax.cond(
            blocks.is_due(number, reported),
            lambda: fit(self.params.method, self.site, state, number),
            lambda: blocks.previous(state),
        )
        return blocks.merge(state, fitted)

    def curve_row(self, run: Run) -> Array | None:
        """Return the latest observations as (fields, lanes) if the program keeps curves."""
        if not self.static.curves:
            return None
        return metrics.pack_observation(run.metrics.last)[:, : self.curve_lanes]

    def finish(self, run: Run) -> Outcome:
        """Return the outcomes of the runs after their last record interval."""
        over_runs = jax.vmap(partial(finish_run, self.method), in_axes=(self.site_axis, 0, 0))
        return over_runs(self.site, run, self.floor)

    def to_runs(self, tree: Any) -> Any:
        """Return what belongs to draws for each run."""
        return broadcast_to_runs(self.row, tree)


def set_up(static: Static, environment: Environment, tile: Tiles) -> TileRuns:
    """Return the runs of a tile with all that follows from environment, draws and params."""
    draws, method = tile.draws, build_program(static)
    derived = jax.vmap(partial(derive_inputs, static, environment), in_axes=(leaf_axes(draws),))(
        draws
    )
    draws = draws._replace(derived=derived)
    to_runs = partial(broadcast_to_runs, tile.row)
    axis = _draw_axis(draws)
    q_true = to_runs(jax.vmap(initial_true_attitude, in_axes=(leaf_axes(draws),))(draws))
    params = jax.vmap(with_initial_errors, in_axes=(0, axis, axis))(
        tile.params, to_runs(draws.initial), q_true
    )
    of_runs = draws._replace(derived=to_runs(derived))
    site, biases = (
        select_site(environment.site, of_runs),
        select_biases(environment.biases, of_runs),
    )
    sensors = build_sensors(static, environment, draws)
    if (housing := sensors.initial_state().housing) is not None and housing.turn is not None:
        params = params._replace(q=rotations.multiply(params.q, to_runs(housing.turn)))
    end = end_of_run(static, environment.pass_records)
    find_floor = method.floor or _no_floor
    floor = jax.vmap(
        lambda params, site, biases: find_floor(params.method, site.place, biases, end),
        in_axes=(0, *(None if a is None else axis for a in (derived.site, derived.biases))),
    )(params, site, biases)
    record = turns = None
    if kept := static.sensors.kept:
        every = static.record_every
        record = sensors.make_record(block_size(every, draws))
        turns = sensors.housing_turns(kept // every, every)
    return TileRuns(
        static, environment, method, draws, tile.row, params, site, floor, sensors, record, turns
    )


def _draw_axis(draws: Draw) -> int | None:
    """Return the axis of what is broadcast from draws to runs; None for a single draw."""
    return None if len(draws.draw_id) == 1 else 0


def broadcast_to_runs(row: Array, tree: Any) -> Any:
    """Return what belongs to draws for each run: leaves (draws,) to (lanes,), or () of one draw."""

    def broadcast(a: Array) -> Array:
        if len(a) == 1:
            return a[0]
        if len(a) == row.size:
            return a
        # Without the check of bounds, which would cost as much as the look-up.
        return a.at[row].get(mode="promise_in_bounds")

    return jax.tree.map(broadcast, tree)


def map_stacked_tiles(
    static: Static, run: Callable[[Tiles], Any], tiles: Tiles
) -> Callable[[Tiles], Any]:
    """Return the function of one tile, mapped over the sets of stacked tiles if there are such.

    Args:
        static: program.
        run: function of a tile.
        tiles: that it will be applied to, one after the other.
    """
    if not static.shares_covariance:
        return run
    # Only what belongs to draws differs between the sets.
    axes: Any = jax.tree.map(lambda a: None, tiles)
    draws = jax.tree.map(lambda a: 0 if a.ndim > 1 else None, tiles.draws)
    q = jax.tree.map(lambda a: 0, tiles.params.q)
    return jax.vmap(run, in_axes=(axes._replace(draws=draws, params=axes.params._replace(q=q)),))


# The functions of one run


def with_initial_errors(params: RunParams, initial: InitialErrors, q: Quat | None) -> RunParams:
    """Return the params of a run with the initial errors and the true attitude of its draw."""
    angles = Vec3(*(a if b is None else b for a, b in zip(params.phi, initial.phi, strict=True)))
    if params.euler is not None:
        vector = rotations.euler_vector(*angles)
        pairs = zip(vector, angles, strict=True)
        angles = Vec3(*(jnp.where(params.euler, v, a) for v, a in pairs))
    return params._replace(
        q=params.q if q is None else q,
        phi=angles,
        ve=params.ve if initial.ve is None else initial.ve,
        vn=params.vn if initial.vn is None else initial.vn,
    )


def end_of_run(static: Static, pass_records: Count) -> RunEnd:
    """Return the last sample of a run and the direction of its last pass."""
    number = (static.records - 1) // pass_records
    backward = (static.passes == "alternate") & (number % 2 == 1)
    return RunEnd(float(static.records * static.record_every), backward)


def initial_solution(site: Site, q: Quat, ve: Scalar, vn: Scalar) -> Navigation:
    """Return the navigation solution at the beginning of the record."""
    zero = jnp.zeros_like(ve)
    return Navigation(q=q, ve=ve, vn=vn, latitude=site.latitude + zero, longitude=zero)


def start_run(method: Program, criteria: Criteria, site: Site, params: RunParams) -> Run:
    """Return a run before its first sample."""
    q = rotations.misalign(params.phi, params.q)
    nav = initial_solution(site, q, params.ve, params.vn)
    return Run(method.init(params.method, nav), metrics.start(criteria, nav.longitude))


def start_after_coarse(
    method: Program,
    coarse_attitude: Callable[[Any], Quat],
    samples: int,
    dt: float,
    replays: bool,
    params: RunParams,
    site: Site,
    coarse_state: Any,
    rotation: BodyRotation | None,
) -> Any:
    """Return the state of a method after the coarse stage: at rest, with P0.

    Args:
        method: of fine alignment.
        coarse_attitude: state of the coarse method -> attitude.
        samples: length of the coarse stage.
        dt: sample time, s.
        replays: whether fine alignment starts at the first sample.
        params: of the run.
        site: Earth and place.
        coarse_state: last state of the coarse method.
        rotation: of the body over the coarse stage; None without a replay.
    """
    zero, q = jnp.zeros_like(params.ve), coarse_attitude(coarse_state)
    if not replays:
        nav = initial_solution(site, rotations.normalise(q), zero, zero)
        state = method.init(params.method, nav)
        begin_after = method.passes and method.passes.begin_after
        return begin_after(state, zero + float(samples)) if begin_after else state
    assert rotation is not None
    q = passes.rewind_attitude(q, rotation, site.place, zero + float(samples) * dt, None)
    return method.init(params.method, initial_solution(site, q, zero, zero))


def reverse_state(
    method: Program, params: RunParams, site: Site, state: Any, backward: Flag
) -> Any:
    """Return the state of a method after a direction reversal that opens a pass."""
    assert method.passes is not None
    return method.passes.reverse(params.method, passes.site_of_pass(site, ~backward), state)


def rewind_state(
    method: Program,
    record_s: float,
    pass_records: Count,
    params: RunParams,
    site: Site,
    state: Any,
    rotation: BodyRotation,
) -> Any:
    """Return the state that starts the record again, from that at the end of a pass."""
    assert method.passes is not None and method.passes.rewind is not None
    time = jnp.asarray(pass_records, params.ve.dtype) * record_s
    bias = method.passes.gyro_bias and method.passes.gyro_bias(state)
    q = passes.rewind_attitude(method.attitude(state), rotation, site.place, time, bias)
    zero = jnp.zeros_like(params.ve)
    return method.passes.rewind(params.method, initial_solution(site, q, zero, zero), state)


def observe_run(
    method: Program,
    criteria: Criteria,
    dt: float,
    finds_heading: bool,
    run: Run,
    q_true: Quat,
    floor: Scalar,
    n: Scalar,
) -> Run:
    """Return a run after its observation at a record time, that of the n-th sample.

    Args:
        method: of the run.
        criteria: by which it is judged.
        dt: sample time, s.
        finds_heading: whether the method finds a heading.
        run: at the record time.
        q_true: true or reference attitude, NaN if unknown.
        floor: bias floor of phi_u, rad.
        n: number of the sample.
    """
    state = method.normalise(run.state)
    attitude, covariance = method.attitude(state), _covariance(method, state)
    now = metrics.observe(q_true, attitude, covariance, finds_heading=finds_heading)
    so_far = metrics.accumulate(run.metrics, criteria, now, floor=floor, time=n * dt)
    return Run(state, metrics.store_reported_times(so_far, criteria, covariance, n))


def finish_run(method: Program, site: Site, run: Run, floor: BiasFloor) -> Outcome:
    """Return the outcome of a run after its last record interval."""
    results = None if method.results is None else method.results(site, run.state)
    return metrics.finish(run.metrics, _covariance(method, run.state), floor, results)


def _covariance(method: Program, state: Any) -> AttitudeCovariance:
    """Return the covariance of the attitude; NaN of a method without one."""
    if method.covariance is None:
        return unknown_covariance(state.nav.ve)
    return method.covariance(state)


def _no_floor(params: Any, place: Place, biases: MeanBiases, end: RunEnd) -> BiasFloor:
    """Return no floor, of a method whose floor is not known."""
    return bias_floor(params, place, jax.tree.map(jnp.zeros_like, biases), end)
