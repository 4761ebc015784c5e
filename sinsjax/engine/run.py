"""The loop of a run: environment -> samples -> step -> close loop -> observe -> outcome.

A run starts at a misaligned attitude. In each interval its increments are measured and
compensated, the method steps sample by sample, and its loop is closed whenever feedback or a reset
is due; at the output time the corrected attitude is compared with the truth. After the last
interval the run has its outcome.

A run alone is a tile of one lane. `RunFunctions` are those of one run; `TileRuns` maps them over
the lanes of a tile, whose samples are made once per draw.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from sinsjax.engine import metrics, stepping
from sinsjax.engine.inputs import (
    Environment,
    ProgramSpec,
    RunParams,
    Tiles,
    derive_inputs,
    map_draws,
)
from sinsjax.engine.metrics import Metrics, Observation, Outcome
from sinsjax.engine.samples import SensorState, TileSensors
from sinsjax.engine.stepping import IntervalReading, Steps, take_samples
from sinsjax.maths import rotations
from sinsjax.maths.algebra import select_tree
from sinsjax.methods.floors import BiasFloor, MeanBiases
from sinsjax.methods.method import (
    AttitudeCovariance,
    Program,
    Site,
    earth_floor,
    unknown_covariance,
)
from sinsjax.methods.registry import METHODS
from sinsjax.strapdown import base_motion
from sinsjax.types import Array, Count, Flag, Increments, Navigation, Quat, Sample, Scalar, Vec3


class Run(NamedTuple):
    """A run between two intervals: the state of its method, and its metrics so far."""

    state: Any
    metrics: Metrics


class Intervals(NamedTuple):
    """Intervals of runs, leaves (intervals, ...).

    Attributes:
        number: of the interval, from 0.
        q_true: attitudes of bases that draws move, at its end, leaves (intervals, draws); None to
            look them up as the interval ends, since all together would fill the memory.
    """

    number: Array
    q_true: Quat | None


class TileState(NamedTuple):
    """The runs of a tile between two intervals, and the sensors of their draws."""

    run: Run
    sensors: SensorState


class TileResults(NamedTuple):
    """Outcomes of a tile, leaves (lanes, ...), and its observations, leaves (intervals, lanes)."""

    outcome: Outcome
    curves: Observation | None


def run_tile(
    spec: ProgramSpec,
    environment: Environment,
    tile: Tiles,
    curve_lanes: int | None = None,
    *,
    by_event: bool = True,
) -> TileResults:
    """Run all runs of a tile, from the first sample to the outcome.

    Args:
        spec: program.
        environment: shared by all runs.
        tile: its draws and params.
        curve_lanes: lanes whose observations are returned, the first ones; None for all.
        by_event: see `take_samples`; False to differentiate in reverse mode.
    """
    runs = prepare_tile(spec, environment, tile)._replace(
        curve_lanes=curve_lanes, by_event=by_event
    )
    start = TileState(runs.start(), runs.sensors.start())
    if spec.coarse is None:
        (run, _), rows = jax.lax.scan(partial(advance_interval, runs), start, runs.record_periods())
    else:
        run, rows = _coarse_then_fine(runs, start)
    if rows is None:
        return TileResults(runs.finish(run), None)
    fields = [rows[:, i] for i in range(rows.shape[1])]
    curves = jax.tree.unflatten(jax.tree.structure(run.metrics.last), fields)
    return TileResults(runs.finish(run), curves)


def advance_interval(
    runs: "TileRuns", tile: TileState, interval: Intervals
) -> tuple[TileState, Array | None]:
    """Advance all runs of a tile by one interval.

    Returns:
        The tile after the interval, and if ``spec.curves`` the observations as rows, (fields,
        lanes).
    """
    spec, environment = runs.one.spec, runs.one.environment
    pass_intervals = environment.pass_intervals if spec.reverses else None
    reading = stepping.order_samples(interval.number, pass_intervals, spec.interval_samples)
    state, sensor_state = take_samples(
        runs.interval_steps(reading, interval.number),
        runs.begin_pass(tile.run.state, reading),
        tile.sensors,
        runs.sensors.interval_blocks(reading, runs.record),
        by_event=runs.by_event,
    )
    turn = runs.vibrating_housing_rotation(interval.number, sensor_state)
    run = runs.observe(Run(state, tile.run.metrics), interval, turn)
    return TileState(run, sensor_state), runs.curve_row(run)


def _coarse_then_fine(runs: "TileRuns", start: TileState) -> tuple[Run, Array | None]:
    """Run the intervals of coarse alignment, then those of the method.

    Fine alignment goes on where coarse alignment ends, or replays all samples from the first.
    """
    coarse, all_ = runs.one.spec.coarse, runs.record_periods()
    assert coarse is not None
    first, later = (
        jax.tree.map(lambda a, part=part: a[part], all_)
        for part in (slice(None, coarse.intervals), slice(coarse.intervals, None))
    )
    coarse_runs = runs._replace(one=runs.one._replace(spec=runs.one.spec.of_coarse_stage()))
    coarse_start = start._replace(run=coarse_runs.start())
    (run, sensor_state), rows = jax.lax.scan(
        partial(advance_interval, coarse_runs), coarse_start, first
    )
    run = run._replace(state=runs.state_after_coarse(run.state, sensor_state.rotation))
    if not coarse.replays:
        (run, _), fine_rows = jax.lax.scan(
            partial(advance_interval, runs), TileState(run, sensor_state), later
        )
        return run, None if rows is None else jnp.concatenate([rows, fine_rows])

    def replay(tile: TileState, interval: Intervals) -> tuple[TileState, Array | None]:
        """An interval whose observation counts only after the coarse stage."""
        (run, sensor_state), row = advance_interval(runs, tile, interval)
        is_later = interval.number >= coarse.intervals
        counted = select_tree(is_later, run.metrics, tile.run.metrics)
        return TileState(run._replace(metrics=counted), sensor_state), row

    (run, _), fine_rows = jax.lax.scan(replay, TileState(run, start.sensors), all_)
    return run, None if rows is None else jnp.concatenate([rows, fine_rows[coarse.intervals :]])


class RunFunctions(NamedTuple):
    """The functions of one run, in the order in which they are called.

    Attributes:
        spec: program.
        environment: shared by all runs.
    """

    spec: ProgramSpec
    environment: Environment

    @property
    def method(self) -> Program:
        """The functions of its method."""
        return self.spec.program

    def floor(self, params: RunParams, site: Site, biases: MeanBiases) -> BiasFloor:
        """Return the bias floor at the end of the run; none if that of the method is not known."""
        number = (self.spec.intervals - 1) // self.environment.pass_intervals
        backward = self.spec.reverses & (number % 2 == 1)
        last = float(self.spec.intervals * self.spec.interval_samples)
        if self.method.floor is None:
            biases = jax.tree.map(jnp.zeros_like, biases)
        floor = self.method.floor or earth_floor
        return floor(params.method, site.place, biases, last, backward)

    def start(self, params: RunParams, site: Site, q: Quat) -> Run:
        """Return the run before its first sample, from the attitude before its misalignment."""
        nav = initial_solution(site, rotations.misalign(params.phi, q), params.ve, params.vn)
        first = metrics.initial_metrics(self.environment.criteria, nav.longitude)
        return Run(self.method.init(params.method, nav), first)

    def start_after_coarse(
        self, params: RunParams, site: Site, q: Quat, rotation_over_coarse: Quat | None
    ) -> Any:
        """Return the state of the method after the coarse stage: at rest, with P0.

        The attitude is that at the end of the stage, the rotation that of the body over it.
        """
        coarse, zero = self.spec.coarse, jnp.zeros_like(params.ve)
        assert coarse is not None
        samples = zero + float(coarse.intervals * self.spec.interval_samples)
        if rotation_over_coarse is not None and coarse.replays:
            time = samples * self.spec.options.dt
            q = stepping.rewind_attitude(q, rotation_over_coarse, site.place, time)
            return self.method.init(params.method, initial_solution(site, q, zero, zero))
        nav = initial_solution(site, rotations.normalise(q), zero, zero)
        state = self.method.init(params.method, nav)
        begin_after = self.method.passes and self.method.passes.begin_after
        return begin_after(state, samples) if begin_after else state

    def observe(self, run: Run, q_true: Quat, floor: Scalar, n: Scalar) -> Run:
        """Return the run after its observation at an output time, that of the n-th sample.

        The true or reference attitude is NaN if unknown, the floor that of phi_u, rad.
        """
        state, criteria = self.method.normalise(run.state), self.environment.criteria
        attitude, covariance = self.method.attitude(state), self.covariance(state)
        finds_heading = METHODS[self.spec.method].finds_heading
        now = metrics.observe(q_true, attitude, covariance, finds_heading=finds_heading)
        time = n * self.spec.options.dt
        so_far = metrics.accumulate(run.metrics, criteria, now, floor=floor, time=time)
        return Run(state, metrics.store_error_at_report_times(so_far, criteria, covariance, n))

    def finish(self, run: Run, site: Site, floor: BiasFloor) -> Outcome:
        """Return the outcome of the run after its last interval."""
        results = None if self.method.results is None else self.method.results(site, run.state)
        return metrics.finish(run.metrics, self.covariance(run.state), floor, results)

    def covariance(self, state: Any) -> AttitudeCovariance:
        """Return the covariance of the attitude; NaN of a method without one."""
        if self.method.covariance is None:
            return unknown_covariance(state.nav.ve)
        return self.method.covariance(state)


def initial_solution(site: Site, q: Quat, ve: Scalar, vn: Scalar) -> Navigation:
    """Return the navigation solution at the beginning of the record."""
    zero = jnp.zeros_like(ve)
    return Navigation(q=q, ve=ve, vn=vn, latitude=site.latitude + zero, longitude=zero)


class TileRuns(NamedTuple):
    """The runs of a tile: all that stays the same over them, and the functions of one run, mapped.

    Attributes:
        one: functions of one run.
        sensors: of the draws.
        row: (lanes,) the draw of each run.
        params: with the initial errors of the draws, leaves (lanes, ...).
        q: attitude of each run before its initial misalignment, leaves (lanes,), or () if all
            runs share it.
        site: leaves (lanes,), or () if all runs share it.
        floor: bias floor of each run, leaves (lanes,).
        record: kept increments of the draws, leaves (samples, draws); None to measure.
        turns: rotations from the housing to the base at the boundaries of the intervals of kept
            increments, leaves (intervals + 1, draws); None if it does not rotate.
        curve_lanes: lanes whose observations are kept, the first ones; None for all.
        by_event: see `take_samples`.
    """

    one: RunFunctions
    sensors: TileSensors
    row: Array
    params: RunParams
    q: Quat
    site: Site
    floor: BiasFloor
    record: Increments | None = None
    turns: Quat | None = None
    curve_lanes: int | None = None
    by_event: bool = True

    @property
    def site_axis(self) -> int | None:
        """Axis of the site; None if all runs share it."""
        return None if self.sensors.draws.site is None else self.sensors.draws.run_axis

    def record_periods(self) -> Intervals:
        """Return all intervals of the runs."""
        q_true, count = None, self.one.spec.intervals
        if self.sensors.draws.motion is not None:
            times = jnp.asarray(self.one.environment.end_times)[:count]
            q_true = map_draws(
                lambda draw: jax.vmap(partial(base_motion.attitude, draw.motion))(times),
                self.sensors.draws,
                out_axes=1,
            )
        return Intervals(jnp.arange(count), q_true)

    def start(self) -> Run:
        """Return the runs before their first sample."""
        start = jax.vmap(self.one.start, in_axes=(0, self.site_axis, self.sensors.draws.run_axis))
        return start(self.params, self.site, self.q)

    def begin_pass(self, state: Any, reading: IntervalReading) -> Any:
        """Return the states of the method as an interval begins, which may open a pass."""
        passes = self.one.method.passes
        if reading.backward is None or passes is None:  # one pass
            return state
        before = stepping.site_of_pass(self.site, ~reading.backward)
        reverse = jax.vmap(passes.reverse, in_axes=(0, self.site_axis, 0))
        changed = reverse(self.params.method, before, state)
        return select_tree(reading.opens_pass, changed, state)

    def state_after_coarse(self, coarse_state: Any, rotation: Quat | None) -> Any:
        """Return the states of the method as fine alignment begins."""
        after = jax.vmap(
            self.one.start_after_coarse, in_axes=(0, self.site_axis, 0, self.sensors.draws.run_axis)
        )
        q = jax.vmap(self.one.spec.of_coarse_stage().program.attitude)(coarse_state)
        return after(self.params, self.site, q, copy_draws_to_runs(self.row, rotation))

    def interval_steps(self, reading: IntervalReading, number: Count) -> Steps:
        """Return the effect of the samples of an interval on the state of all runs."""
        method, params, axis = self.one.method, self.params.method, self.site_axis
        site = stepping.site_of_pass(self.site, reading.backward)
        done = number * self.one.spec.interval_samples  # samples before this interval
        step = jax.vmap(method.step, in_axes=(0, axis, 0, self.sensors.draws.run_axis, None))

        def n(place: Count) -> Scalar:
            return (done + place).astype(self.one.environment.dtype)

        def take(state: Any, place: Count, sample: Sample) -> Any:
            return step(params, site, state, copy_draws_to_runs(self.row, sample), n(place + 1))

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
            return jnp.min(events) - done.astype(self.one.environment.dtype)

        def any_triggered(state: Any, place: Count) -> Flag:
            assert triggered is not None
            return jnp.any(triggered(state, n(place)))

        return Steps(
            take,
            lambda state, place: close(params, state, n(place)),
            first_event,
            any_triggered if triggered else None,
        )

    def vibrating_housing_rotation(self, interval: Count, sensor_state: SensorState) -> Quat | None:
        """Return the rotation from the housing to the base at the end of an interval.

        Leaves (draws,); None if the housing does not rotate.
        """
        if self.turns is None:
            return sensor_state.housing and sensor_state.housing.turn
        pass_number, place = jnp.divmod(interval, self.one.environment.pass_intervals)
        backward = pass_number % 2 == 1
        end = jnp.where(backward, self.one.environment.pass_intervals - place - 1, place + 1)
        turn: Quat = jax.tree.map(lambda a: a[end], self.turns)
        return turn

    def observe(self, run: Run, interval: Intervals, turn: Quat | None = None) -> Run:
        """Return the runs after their observation at the end of an interval.

        The rotations ``turn`` are those from the draws' housings to their bases.
        """
        number, q_true = interval.number, self.base_attitudes(interval)
        run = run._replace(state=self.fit_at_end_of_interval(run.state, number))
        if turn is not None:
            q_true = rotations.multiply(q_true, turn)
        observe = jax.vmap(self.one.observe, in_axes=(0, self.sensors.draws.run_axis, 0, None))
        return observe(
            run, copy_draws_to_runs(self.row, q_true), self.floor.phi.z, self.end_of(number)
        )

    def base_attitudes(self, interval: Intervals) -> Quat:
        """Return the attitudes of the draws' bases at the end of an interval; NaN if unknown."""
        if interval.q_true is not None:
            return interval.q_true
        stored = jnp.asarray(self.one.environment.attitudes)[
            self.sensors.draws.row, interval.number
        ]
        return Quat(*jnp.moveaxis(stored, -1, 0))

    def end_of(self, number: Count) -> Scalar:
        """Return the number of the last sample of an interval, from 1."""
        return ((number + 1) * self.one.spec.interval_samples).astype(self.one.environment.dtype)

    def fit_at_end_of_interval(self, state: Any, number: Count) -> Any:
        """Return the state of a method after its fit at the end of an interval, if it has."""
        blocks = self.one.method.block_fit
        if blocks is None:
            return state
        end, times = self.end_of(number), self.one.environment.criteria.report_samples
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
        if not self.one.spec.curves:
            return None
        # One array: of several, XLA would copy each whole.
        return jnp.stack(jax.tree.leaves(run.metrics.last))[:, : self.curve_lanes]

    def finish(self, run: Run) -> Outcome:
        """Return the outcomes of the runs after their last interval."""
        return jax.vmap(self.one.finish, in_axes=(0, self.site_axis, 0))(run, self.site, self.floor)


def prepare_tile(spec: ProgramSpec, environment: Environment, tile: Tiles) -> TileRuns:
    """Return the runs of a tile with all that follows from environment, draws and params."""
    draws, one = derive_inputs(spec, environment, tile.draws), RunFunctions(spec, environment)
    axis, to_runs = draws.run_axis, partial(copy_draws_to_runs, tile.row)
    params = jax.vmap(with_initial_errors, in_axes=(0, axis, axis, axis))(
        tile.params, *map(to_runs, (draws.phi, draws.ve, draws.vn))
    )
    sensors, q = TileSensors(spec, environment, draws), draws.q
    if draws.motion is not None:
        q = map_draws(lambda draw: base_motion.attitude(draw.motion, 0.0), draws)
    if (housing := sensors.start().housing) is not None and housing.turn is not None:
        q = rotations.multiply(q, housing.turn)
    site = environment.site if draws.site is None else to_runs(draws.site)
    biases = environment.biases if draws.biases is None else to_runs(draws.biases)
    axes = (None if a is None else axis for a in (draws.site, draws.biases))
    floor = jax.vmap(one.floor, in_axes=(0, *axes))(params, site, biases)
    record = turns = None
    if spec.kept:
        record = sensors.make_record()
        turns = sensors.housing_vibration_rotations(spec.kept // spec.interval_samples)
    return TileRuns(one, sensors, tile.row, params, to_runs(q), site, floor, record, turns)


def with_initial_errors(
    params: RunParams, phi: tuple[Scalar | None, ...], ve: Scalar | None, vn: Scalar | None
) -> RunParams:
    """Return the params of a run with the initial errors that its draw has."""
    angles = Vec3(*(a if b is None else b for a, b in zip(params.phi, phi, strict=True)))
    if params.euler is not None:
        vector = rotations.euler_vector(*angles)
        pairs = zip(vector, angles, strict=True)
        angles = Vec3(*(jnp.where(params.euler, v, a) for v, a in pairs))
    ve, vn = params.ve if ve is None else ve, params.vn if vn is None else vn
    return params._replace(phi=angles, ve=ve, vn=vn)


def copy_draws_to_runs(draw_of_run: Array, tree: Any) -> Any:
    """Return what belongs to draws for each run: leaves (draws,) to (lanes,), or () of one draw."""

    def broadcast(a: Array) -> Array:
        if len(a) == 1:
            return a[0]
        if len(a) == draw_of_run.size:
            return a
        # Without the check of bounds, which would cost as much as the look-up.
        return a.at[draw_of_run].get(mode="promise_in_bounds")

    return jax.tree.map(broadcast, tree)


def map_tiles(spec: ProgramSpec, run: Callable[[Tiles], Any], tiles: Tiles, blocks: Count) -> Any:
    """Return a function's results for the first ``blocks`` of tiles, or sets of stacked tiles.

    The others' are zero. The loop has a fixed length: another costs the compass 10 % of its speed.
    """
    if spec.shares_covariance:  # only what belongs to draws differs between the sets
        draws = jax.tree.map(lambda a: 0 if a.ndim > 2 else None, tiles.draws)
        axes: Any = (draws, None, None)
        run = jax.vmap(run, in_axes=(Tiles(*axes),))
    run = jax.jit(run)  # traced once

    def add(place: Count, results: Any) -> Any:
        found = run(jax.tree.map(lambda a: a[place], tiles))
        return jax.tree.map(lambda all_, one: all_.at[place].set(one), results, found)

    def add_used(place: Count, results: Any) -> Any:
        return jax.lax.cond(place < blocks, add, lambda _, kept: kept, place, results)

    one = jax.eval_shape(run, jax.tree.map(lambda a: a[0], tiles))
    blank = jax.tree.map(lambda a: jnp.zeros((len(tiles.row), *a.shape), a.dtype), one)
    return jax.lax.fori_loop(0, len(tiles.row), add_used, blank)
