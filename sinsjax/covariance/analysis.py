"""Covariance analysis: the errors of all draws from one noise-free run of each variant.

The noise-free run is the mean. Its record intervals give the closed loop F of the error and the
covariance W of the noise that enters (`error_growth`). From record to record S <- F S F' + W is the
covariance of the true error, and e <- F e + chol(W) n are samples of the errors of runs with noise,
which are judged as runs are.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from sinsjax.covariance import coloured_noise
from sinsjax.covariance.coloured_noise import ColouredInputs, IntervalInputs
from sinsjax.covariance.error_growth import (
    ErrorGrowth,
    ErrorInputs,
    IncrementNoise,
    advance_growth,
    initial_growth,
)
from sinsjax.covariance.sensitivity import Sensitivity, derive_sensitivity, floor_by_states
from sinsjax.engine import metrics, run
from sinsjax.engine.environment import Environment, NormalDistributions, Static
from sinsjax.engine.lanes import Group, Tiles
from sinsjax.engine.metrics import Criteria, Observation, Outcome
from sinsjax.engine.run import Run, TileRuns
from sinsjax.engine.samples import SensorState
from sinsjax.engine.stepping import WithCompanion, advance_interval, with_companion
from sinsjax.maths.algebra import Triangle, cholesky, triangle_index
from sinsjax.methods.schedules import interpolate
from sinsjax.strapdown.disturbances import Disturbances
from sinsjax.types import Array, Count, Quat, Sample, Scalar, Vec3

SAMPLES_PER_BLOCK = 256
"""Sampled errors of a block; a larger multiple is computed block by block, else all at once."""


class ErrorCovariance(NamedTuple):
    """Errors of runs about their noise-free run; runs are the last axis of each leaf.

    Attributes:
        phi: (3, records) misalignment of the noise-free run, e, n, u, rad.
        sigma: (3, records) standard deviation of the misalignment about it, rad.
        belief: (3, records) standard deviation by the method's own covariance, rad.
        outside_until: (2, B, samples) as `Metrics.outside_until`, of the sampled errors.
        from_floor: (records,) standard deviation of phi_u from the bias floor of its run, rad; None
            if all runs have the same bias floor.
    """

    phi: Array
    sigma: Array
    belief: Array
    outside_until: Array
    from_floor: Array | None = None

    def select_records(self, records: Array | None) -> "ErrorCovariance":
        """Return the same at some records, None for all, with leaves (3, records, ...)."""
        if records is None:
            return self
        phi, sigma, belief = (a[:, records] for a in self[:3])
        from_floor = None if self.from_floor is None else self.from_floor[records]
        return ErrorCovariance(phi, sigma, belief, self.outside_until, from_floor)


class AnalysisParams(NamedTuple):
    """Params of a method in a covariance analysis.

    Attributes:
        method: of the method.
        inputs: of the error.
    """

    method: Any
    inputs: ErrorInputs


class AnalysisEnvironment(NamedTuple):
    """Environment of a covariance analysis.

    Attributes:
        runs: of the noise-free runs.
        report_at: numbers, from 0, of the records at which the covariance is returned; None for
            all.
        coloured: errors of the increments in addition to white noise.
        drawn: distributions of the drawn numbers; None if there are none.
    """

    runs: Environment
    report_at: Array | None
    coloured: ColouredInputs
    drawn: NormalDistributions | None


class Interval(NamedTuple):
    """Results of one record interval of a run, in numbers that the scan over records stacks.

    Attributes:
        observation: at its end.
        transition: rows of F.
        noise: W.
        angles: rows of phi by the states of d.
        response: rows of d by the coloured states at its beginning.
        cross: rows of the covariance of d with the coloured states.
    """

    observation: Observation
    transition: tuple[tuple[Scalar, ...], ...]
    noise: Triangle
    angles: tuple[tuple[Scalar, ...], ...]
    response: tuple[tuple[Scalar, ...], ...]
    cross: tuple[tuple[Scalar, ...], ...]


def analysis_static(static: Static) -> Static:
    """Return the program of the noise-free runs."""
    return static._replace(sensors=static.sensors._replace(noisy=False), curves=True, stacks=False)


def analysis_group(group: Group, samples: int, records: np.ndarray | None = None) -> Group:
    """Return the group whose calls give the error covariance of a group's variants.

    Args:
        group: of one draw, whose initial errors and biases are replaced by the means.
        samples: sampled errors of a run, an even number; the same random numbers for all runs.
        records: numbers, from 0, of the records at which the covariance is returned; None for all.
    """
    model = group.environment.sensors
    noise = IncrementNoise(
        _variances(model.errors.accel_noise), _variances(model.errors.gyro_noise)
    )
    zeros = np.zeros_like(group.variants.ve)
    drawn = group.drawn
    sigmas = () if drawn is None else (drawn.gyro_bias_sigma, drawn.accel_bias_sigma)
    coloured = coloured_noise.increment_error_processes(
        model.disturbances, group.static.options.dt, *sigmas
    )
    inputs = ErrorInputs(
        jax.tree.map(lambda a: a + zeros, noise),
        jax.tree.map(lambda a: np.broadcast_to(a, (len(zeros), *np.shape(a))), coloured),
    )
    undisturbed = group.environment._replace(sensors=model._replace(disturbances=Disturbances()))
    return group._replace(
        static=analysis_static(group.static),
        environment=AnalysisEnvironment(undisturbed, records, coloured, drawn),
        draws=group.draws if drawn is None else drawn.mean_draw(group.draws),
        variants=group.variants._replace(method=AnalysisParams(group.variants.method, inputs)),
        run=AnalysisRun(samples),
    )


def _variances(sigmas: np.ndarray) -> tuple[np.float64, ...]:
    """Return the variances of the three axes, or one if all are equal."""
    return tuple(np.unique(sigmas) ** 2) if np.ptp(sigmas) == 0 else tuple(sigmas**2)


class AnalysisRun(NamedTuple):
    """The function of a tile of a covariance analysis, see `Group.run`.

    Attributes:
        samples: sampled errors of a run.
    """

    samples: int

    def __call__(
        self,
        static: Static,
        environment: AnalysisEnvironment,
        tile: Tiles,
        curve_lanes: int | None = None,
    ) -> tuple[Outcome, ErrorCovariance]:
        """Return the outcomes of the noise-free runs of a tile, and their error covariance."""
        params: AnalysisParams = tile.params.method
        plain = tile._replace(params=tile.params._replace(method=params.method))
        runs = run.set_up(static, environment.runs, plain)
        start = runs.start()
        n = runs.count_error_states(start.state)
        over_record = partial(_over_record, runs, params, n)
        carry = start, runs.sensors.initial_state()
        (last, _), rows = jax.lax.scan(over_record, carry, runs.records())
        outcome = runs.finish(last)
        derivatives = derive_sensitivity(runs, plain.params, environment.drawn)
        covariance = propagate_over_records(
            static, environment, rows, outcome.floor.phi.z, self.samples, n, derivatives
        )
        return outcome, covariance.select_records(environment.report_at)


def _over_record(
    runs: TileRuns,
    params: AnalysisParams,
    n: int,
    carry: tuple[Run, SensorState],
    record: tuple[Count, Quat | None],
) -> tuple[tuple[Run, SensorState], Array]:
    """Advance the noise-free runs and the growth of their errors by one record interval.

    Returns:
        The runs and the sensors after it, and the numbers of `Interval`, (fields, lanes).
    """
    (runs_before, sensor_state), (number, q_true) = carry, record
    reading, model = runs.read(number), runs.error_model
    growth = jax.vmap(lambda inputs, nav: initial_growth(inputs, n, nav.ve))(
        params.inputs, runs_before.state.nav
    )
    steps = with_companion(
        runs.steps(reading, number), _growth_steps(runs, params, number), lambda sample: sample
    )
    state, sensor_state = advance_interval(
        steps, WithCompanion(runs_before.state, growth), sensor_state, runs.blocks(reading)
    )
    now = runs.observe(Run(state.runs, runs_before.metrics), number, q_true)
    interval = jax.vmap(partial(_describe_interval, model))(now, state.companion)
    # One array: XLA would copy several with every record.
    return (now, sensor_state), jnp.stack(jax.tree.leaves(interval))


def _growth_steps(runs: TileRuns, params: AnalysisParams, number: Count) -> Any:
    """Return the function that advances the growth of all runs' errors by a sample."""
    done = number * runs.static.record_every
    advance = jax.vmap(
        partial(advance_growth, runs.error_model),
        in_axes=(0, 0, runs.site_axis, 0, 0, runs.draw_axis, None),
    )

    def over_sample(growth: ErrorGrowth, state: Any, place: Count, sample: Sample) -> ErrorGrowth:
        n = (done + place + 1).astype(runs.environment.dtype)
        sample = runs.to_runs(sample)
        return advance(params.method, params.inputs, runs.site, growth, state, sample, n)

    return over_sample


def _describe_interval(model: Any, now: Run, growth: ErrorGrowth) -> Interval:
    """Return the results of a record interval of one run, all in double precision."""
    like = now.metrics.last.phi.x
    columns, w, coloured = jax.tree.map(lambda a: a.astype(like.dtype), tuple(growth))
    n = len(columns)
    return Interval(
        now.metrics.last,
        tuple(zip(*columns, strict=True)),
        w,
        model.angles(now.state),
        _join_rows([coloured_noise.to_rows(process.response) for process in coloured], n),
        _join_rows([coloured_noise.to_rows(process.cross) for process in coloured], n),
    )


def _join_rows(blocks: list[Any], n: int) -> tuple[tuple[Scalar, ...], ...]:
    """Return n rows with those of all blocks side by side."""
    return tuple(tuple(entry for block in blocks for entry in block[i]) for i in range(n))


def _unpack_interval(row: Array, n: int, m: int) -> Interval:
    """Return the interval whose numbers are stacked in a row, for n states of d and m coloured."""
    square, wide = ((0.0,) * n,) * n, ((0.0,) * m,) * n
    observation = Observation(Vec3(0.0, 0.0, 0.0), Vec3(0.0, 0.0, 0.0), 0.0, 0.0, 0.0)
    triangle = (0.0,) * (n * (n + 1) // 2)
    like = Interval(observation, square, triangle, square[:3], wide, wide)
    interval: Interval = jax.tree.unflatten(jax.tree.structure(like), tuple(row))
    return interval


# From record to record


class _Errors(NamedTuple):
    """Errors of one run at a record.

    Attributes:
        s: covariance of the true error.
        e: half of the sampled errors, (samples / 2,) per state; the other half is their negative.
        outside: (2, B, samples) last time outside each band about floor and truth, s.
    """

    s: Triangle | Array
    e: tuple[Array, ...] | Array
    outside: Array


def propagate_over_records(
    static: Static,
    environment: AnalysisEnvironment,
    rows: Array,
    floor: Array,
    samples: int,
    states: int,
    derivatives: Sensitivity | None = None,
) -> ErrorCovariance:
    """Return mean, covariance and sampled errors from the record intervals of the runs.

    Args:
        static: program.
        environment: of the analysis.
        rows: (records, fields, lanes) numbers of `Interval`.
        floor: (lanes,) bias floor of phi_u, rad.
        samples: sampled errors of a run.
        states: number of states of d.
        derivatives: by the drawn numbers; None if there are none.
    """
    key = jax.random.key(environment.runs.sensors.seed)
    propagate = partial(_propagate_block, static, environment, rows, floor, states, derivatives)
    blocks = 1 if samples % SAMPLES_PER_BLOCK else samples // SAMPLES_PER_BLOCK
    if blocks == 1:
        return propagate(samples, key)
    by_block = jax.lax.map(
        lambda number: propagate(SAMPLES_PER_BLOCK, jax.random.fold_in(key, number)),
        jnp.arange(blocks),
    )
    # The second half of a block has the opposite noise of the first; so has that of all.
    _, sides, bands, _, lanes = by_block.outside_until.shape
    shape = (blocks, sides, bands, 2, SAMPLES_PER_BLOCK // 2, lanes)
    halves = by_block.outside_until.reshape(shape)
    outside = jnp.moveaxis(halves, 0, 3).reshape(sides, bands, samples, lanes)
    first: ErrorCovariance = jax.tree.map(lambda a: a[0], by_block)
    return first._replace(outside_until=outside)


def _propagate_block(
    static: Static,
    environment: AnalysisEnvironment,
    rows: Array,
    floor: Array,
    n: int,
    derivatives: Sensitivity | None,
    samples: int,
    key: Array,
) -> ErrorCovariance:
    """Return `propagate_over_records` with samples from one key."""
    m, criteria = coloured_noise.count_states(environment.coloured), environment.runs.criteria
    lanes, half = len(floor), samples // 2
    normals = jax.random.normal(key, (len(rows), n + m, half), float)
    outside = jnp.zeros((lanes, 2, len(criteria.bands), samples))
    start, floor_slope = jnp.zeros((lanes, n, 0)), None
    if derivatives is not None:
        assert environment.drawn is not None
        start = derivatives.start * jnp.asarray(environment.drawn.initial_sigma)[None, None]
        floor_slope = floor_by_states(derivatives, environment.drawn, m)
    if m:
        inputs = coloured_noise.propagate_processes(environment.coloured, static.record_every)
        first = _Errors(*_initial_errors(inputs.initial, start, half, key), outside)
        over_interval = partial(_over_coloured_interval, criteria, inputs)
    else:
        s, e = _initial_errors(jnp.zeros((0, 0)), start, half, key)
        triangle = tuple(s[:, i, j] for i in range(n) for j in range(i, n))
        first = _Errors(triangle, tuple(jnp.moveaxis(e, 1, 0)), outside)
        over_interval = partial(_over_interval, criteria)
    over_lanes = jax.vmap(over_interval, in_axes=(0, None, None, 0, 0, 0))

    def over_record(errors: _Errors, record: tuple[Scalar, Array, Array]) -> tuple[_Errors, Array]:
        time, row, normal = record
        # Numbers of all lanes in one array: as matrices of each lane they would be gathered.
        interval = _unpack_interval(row, n, m)
        errors, reported = over_lanes(errors, time, tuple(normal), interval, floor, floor_slope)
        return errors, jnp.stack(reported)  # XLA would copy several arrays with every record

    last, reported = jax.lax.scan(over_record, first, (_record_times(static), rows, normals))
    reported = jnp.moveaxis(reported, 0, 1)
    phi, sigma, belief = jnp.split(reported[:9], 3)
    from_floor = None if floor_slope is None else reported[9]
    return ErrorCovariance(phi, sigma, belief, jnp.moveaxis(last.outside, 0, -1), from_floor)


def _initial_errors(processes: Array, start: Array, half: int, key: Array) -> tuple[Array, Array]:
    """Return S and e before the first record: of the starts, and of stationary processes.

    Args:
        processes: (m, m) factor of the covariance of the processes.
        start: (lanes, n, k) factor of that of d.
        half: number of sampled errors.
        key: of the random numbers.

    Returns:
        (lanes, n + m, n + m) and (lanes, n + m, half).
    """
    lanes, n, k = start.shape
    total = n + len(processes)
    numbers = jax.random.normal(jax.random.fold_in(key, 2**31), (len(processes), half), float)
    s, e = jnp.zeros((lanes, total, total)), jnp.zeros((lanes, total, half))
    s = s.at[:, n:, n:].set((processes @ processes.T)[None])
    e = e.at[:, n:].set((processes @ numbers)[None])
    if k:
        normal = jax.random.normal(jax.random.fold_in(key, 2**31 + 1), (k, half), float)
        s = s.at[:, :n, :n].set(start @ jnp.swapaxes(start, 1, 2))
        e = e.at[:, :n].set(start @ normal)
    return s, e


def _over_interval(
    criteria: Criteria,
    errors: _Errors,
    time: Scalar,
    normal: tuple[Array, ...],
    interval: Interval,
    floor: Scalar,
    floor_slope: None,
) -> tuple[_Errors, tuple[Scalar, ...]]:
    """Propagate one run's errors over a record interval with white inputs.

    Returns:
        The errors; the misalignment, its sigma, and the method's own sigma.
    """
    f, w, angles = interval.transition, interval.noise, interval.angles
    n = len(f)
    s, root = _propagate_covariance(f, errors.s, w), cholesky(w, n)
    e = tuple(
        sum(f[i][j] * errors.e[j] for j in range(n))
        + sum(root[i][j] * normal[j] for j in range(i + 1))
        for i in range(n)
    )
    heading = sum(a * error for a, error in zip(angles[2], e, strict=True))
    observation = interval.observation
    outside = _outside_bands(criteria, observation.phi.z, heading, heading, floor)
    sigma = (jnp.sqrt(_variance(row, s)) for row in angles)
    reported = (*observation.phi, *sigma, *observation.sigma)
    return _Errors(s, e, interpolate(outside, time, errors.outside)), reported


def _over_coloured_interval(
    criteria: Criteria,
    inputs: IntervalInputs,
    errors: _Errors,
    time: Scalar,
    normal: tuple[Array, ...],
    interval: Interval,
    floor: Scalar,
    floor_slope: Array | None,
) -> tuple[_Errors, tuple[Scalar, ...]]:
    """Propagate errors over an interval with coloured inputs, which may also move the floor."""
    f, response, cross, rows = (
        jnp.stack([jnp.stack(row) for row in matrix])
        for matrix in (interval.transition, interval.response, interval.cross, interval.angles)
    )
    n = len(f)
    at = triangle_index(n)
    w = jnp.stack([interval.noise[at[i, j]] for i in range(n) for j in range(n)]).reshape(n, n)
    f_all, w_all = coloured_noise.join_with_processes(f, w, response, cross, inputs)
    s = f_all @ errors.s @ f_all.T + w_all
    e = f_all @ errors.e + coloured_noise.semidefinite_factor(w_all) @ jnp.stack(normal)
    from_truth = from_floor = rows[2] @ e[:n]
    sigma = jnp.sqrt(jnp.maximum(jnp.einsum("ij,jk,ik->i", rows, s[:n, :n], rows), 0.0))
    if floor_slope is not None:
        beyond = jnp.concatenate([rows[2], -floor_slope])
        from_floor = beyond @ e
        sigma = jnp.append(sigma, jnp.sqrt(jnp.maximum(beyond @ s @ beyond, 0.0)))
    observation = interval.observation
    outside = _outside_bands(criteria, observation.phi.z, from_floor, from_truth, floor)
    reported = (*observation.phi, *sigma[:3], *observation.sigma, *sigma[3:])
    return _Errors(s, e, interpolate(outside, time, errors.outside)), reported


def _outside_bands(
    criteria: Criteria, mean: Scalar, from_floor: Array, from_truth: Array, floor: Scalar
) -> Array:
    """Return whether errors about a mean are outside the bands, (2, B, samples).

    Args:
        criteria: with the bands.
        mean: of phi_u, rad.
        from_floor: (samples / 2,) deviations from the mean relative to the floor, rad; the other
            half has the opposite sign.
        from_truth: likewise, relative to the truth.
        floor: bias floor of the mean, rad.
    """
    about_floor, about_truth = (mean + jnp.concatenate([a, -a]) for a in (from_floor, from_truth))
    outside = jnp.vectorize(partial(metrics.outside, criteria), signature="()->(b)")
    return jnp.stack(
        [jnp.moveaxis(outside(error), -1, 0) for error in (about_floor - floor, about_truth)]
    )


def _record_times(static: Static) -> Array:
    """Return the record times, (records,), s."""
    return jnp.arange(1.0, static.records + 1) * (static.record_every * static.options.dt)


def _propagate_covariance(f: tuple[tuple[Scalar, ...], ...], s: Triangle, w: Triangle) -> Triangle:
    """Return F S F' + W."""
    n = len(f)
    at = triangle_index(n)
    fs = [[sum(f[i][k] * s[at[k, j]] for k in range(n)) for j in range(n)] for i in range(n)]
    return tuple(
        sum(fs[i][k] * f[j][k] for k in range(n)) + w[at[i, j]]
        for i in range(n)
        for j in range(i, n)
    )


def _variance(row: tuple[Scalar, ...], s: Triangle) -> Scalar:
    """Return a S a' of a row a."""
    n = len(row)
    at = triangle_index(n)
    terms = (row[i] * row[j] * s[at[i, j]] for i in range(n) for j in range(n))
    return jnp.maximum(sum(terms), 0.0)
