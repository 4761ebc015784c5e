"""Measured increments of the draws of a tile, made in blocks of samples.

A few draws alone would not fill a vector, and the samples of a whole interval for many draws would
not fit into the first-level cache. So noise, driving noise and ideal increments are made for all
draws and all samples of a block at once where that is faster, and only what depends on the sample
before follows one by one.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from sinsjax.engine.inputs import Draw, Environment, ProgramSpec, complete, map_draws
from sinsjax.engine.stepping import Blocks, IntervalReading, accumulate_rotation, compensate_in_pass
from sinsjax.maths.algebra import select_tree
from sinsjax.maths.rotations import exp_of_sample
from sinsjax.strapdown import base_motion, disturbances, housing, sensors
from sinsjax.strapdown.base_motion import IdealSample
from sinsjax.strapdown.disturbances import Disturbances
from sinsjax.strapdown.housing import HousingState
from sinsjax.types import Array, Count, Increments, Quat, Sample, Vec3

SAMPLES_PER_BLOCK = 64
"""Samples times draws made at once: fewer leave the vector units idle, more leave the cache."""

SAMPLES_PER_CALL = 1000
"""Samples whose ideal increments are computed at once if none are stored."""


class SensorState(NamedTuple):
    """The sensors of a draw between two samples.

    Attributes:
        last: the increments measured last, with which the next sample is compensated.
        processes: states of the random processes that disturb the draw.
        housing: of the sensors; None if it does not vibrate.
        remainder: rest of the integrals after quantisation; None without.
        rotation: C_b^{b0} of the body since the record began; None if no attitude is propagated
            back.
    """

    last: Increments
    processes: Disturbances
    housing: HousingState | None
    remainder: Increments | None
    rotation: Quat | None = None


class SampleInputs(NamedTuple):
    """The inputs of a sample of a draw, or of n samples of all draws, leaves (n, ...).

    Attributes:
        number: of the sample in the record; negative before it.
        normal: standard normal numbers of the white noise; None without noise.
        exact: ideal increments; None if they are looked up sample by sample.
        driving: driving noise of the random processes.
    """

    number: Count
    normal: Increments | None
    exact: IdealSample | None
    driving: Disturbances


class Measured(NamedTuple):
    """Measured increments of some samples, and the sensors after them."""

    increments: Increments
    state: SensorState


class DrawSensors(NamedTuple):
    """The sensors of one draw.

    Attributes:
        spec: program.
        environment: of all draws.
        draw: with its derived inputs.
    """

    spec: ProgramSpec
    environment: Environment
    draw: Draw

    @property
    def whole(self) -> Any:
        """The draw with all that it shares with others."""
        return complete(self.environment, self.draw)

    def start(self) -> SensorState:
        """Return the state before the first sample."""
        zero = jnp.zeros((), self.environment.dtype)
        zeros = Increments(Vec3(zero, zero, zero), Vec3(zero, zero, zero))
        whole, seed = self.whole, self.environment.seed
        begin = disturbances.initial_states(whole.disturbances, seed, whole.draw_id)
        vibrating, moving = None, disturbances.housing_motion(whole.disturbances, begin)
        if moving is not None:
            rate, lever = Vec3(zero, zero, zero), _lever_of_housing(whole)
            if lever is not None:
                rate, _ = base_motion.rate_and_force(whole.motion, whole.site.place, zero)
            vibrating = housing.start_housing(moving, lever, rate, zeros)
        replays = self.spec.coarse is not None and self.spec.coarse.replays
        rotation = Quat(zero + 1, zero, zero, zero) if replays else None
        remainder = None if whole.errors.gyro_quantum is None else zeros
        return SensorState(zeros, begin, vibrating, remainder, rotation)

    def measure(self, state: SensorState, sample: SampleInputs) -> Measured:
        """Return the increments of the next sample; zeros before the record, to compensate with."""
        whole, dt = self.whole, self.spec.options.dt
        exact = self.ideal_sample(sample.number) if sample.exact is None else sample.exact
        processes, disturbed = disturbances.advance_processes(
            whole.disturbances, state.processes, sample.driving, dt
        )
        place = whole.site.place
        moved = disturbances.add_surge(exact, disturbed, place, dt)
        vibrating = state.housing
        if vibrating is not None and disturbed.housing is not None:
            rigid, lever = exact._replace(increments=moved), _lever_of_housing(whole)
            vibrating, moved = housing.vibrate_housing(
                vibrating, rigid, disturbed.housing, lever, place, dt
            )
        now = sensors.measure_increments(
            moved, whole.errors, sample.normal, dt, distorted=self.spec.distorted
        )
        now, remainder = disturbances.add_drifts(now, disturbed), state.remainder
        if remainder is not None:
            now, remainder = sensors.quantise(now, whole.errors, remainder)
        state = state._replace(processes=processes, housing=vibrating, remainder=remainder)
        return Measured(self.zero_before_record(sample.number, now), state)

    def ideal_sample(self, n: Count) -> IdealSample:
        """Return what ideal sensors measure over sample n: stored, or on the draw's own base."""
        draw, shared = self.draw, self.environment
        if draw.rest is not None:
            return draw.rest
        if draw.motion is None:
            at = draw.start + n
            stored = sensors.split_record_row(jnp.asarray(shared.increments)[at])
            if shared.axes is None:
                return IdealSample(stored, None)
            row = jnp.asarray(shared.axes)[at]
            axes = base_motion.Axes(*(Vec3(*row[3 * i :][:3]) for i in range(3)))
            return IdealSample(stored, axes)
        assert draw.nodes is not None
        k, rate_hz = jnp.asarray(n, shared.dtype), 1 / self.spec.options.dt
        return base_motion.ideal_sample(draw.motion, draw.nodes, self.whole.site.place, rate_hz, k)

    def zero_before_record(self, n: Count, increments: Increments) -> Increments:
        """Return increments, or zeros where a backward pass reads beyond the record's beginning."""
        if not self.spec.reverses:
            return increments
        return select_tree(n < 0, jax.tree.map(jnp.zeros_like, increments), increments)


def _lever_of_housing(whole: Any) -> Vec3 | None:
    """Return the lever arm of a draw whose housing rotates, m; None without one."""
    if whole.motion is None or whole.disturbances.rocking is None:
        return None
    lever: Vec3 | None = whole.motion.lever
    return lever


class TileSensors(NamedTuple):
    """The sensors of all draws of a tile.

    Attributes:
        spec: program.
        environment: of all draws.
        draws: with derived inputs; leaves (draws,), or () of what all share.
    """

    spec: ProgramSpec
    environment: Environment
    draws: Draw

    @property
    def disturbances(self) -> Disturbances:
        """Random processes of all draws."""
        found: Disturbances = complete(self.environment, self.draws).disturbances
        return found

    def of_one(self, draw: Draw) -> DrawSensors:
        """Return the sensors of one of the draws."""
        return DrawSensors(self.spec, self.environment, draw)

    def start(self) -> SensorState:
        """Return the state before the first sample, leaves (draws,)."""
        state: SensorState = map_draws(lambda draw: self.of_one(draw).start(), self.draws)
        return state

    def make_block_sampler(self, sample_numbers: Array) -> Callable[[SensorState, Array], Measured]:
        """Return the function that measures some of the given samples for all draws.

        It takes the state before n samples and their places among the given ones, and returns
        measured increments with leaves (n, draws), and the state after them.
        """
        shared = self._integrate_shared_motion(sample_numbers)

        def measure(state: SensorState, places: Array) -> Measured:
            numbers = sample_numbers[places]
            exact = self._integrate_swaying_motions(numbers)
            if shared is not None:
                exact = jax.tree.map(lambda a: a[places], shared)
            seed, ids = self.environment.seed, self.draws.draw_id
            driving = disturbances.driving_noise(self.disturbances, seed, ids, numbers)
            normal = sensors.draw_normal_numbers(seed, ids, numbers) if self.spec.noisy else None
            return self._measure_block(state, SampleInputs(numbers, normal, exact, driving))

        return measure

    @property
    def block_size(self) -> int:
        """Samples per block: an interval is cut into equal blocks."""
        samples = self.spec.interval_samples
        most = max(1, min(SAMPLES_PER_BLOCK // self.draws.draw_id.size, samples))
        return max(n for n in range(1, most + 1) if samples % n == 0)

    def interval_blocks(self, reading: IntervalReading, record: Increments | None = None) -> Blocks:
        """Return the compensated samples of an interval in blocks, leaves (block, draws).

        Args:
            reading: order in which the interval reads the record.
            record: kept records, leaves (samples, draws); None to measure.
        """
        measure, size = self.make_block_sampler(reading.samples), self.block_size
        compensated = jax.vmap(jax.vmap(partial(compensate_in_pass, backward=reading.backward)))

        def read(n: Count) -> Increments:
            kept = jax.tree.map(lambda a: a[n], record)
            return self.of_one(self.draws).zero_before_record(n, kept)

        def read_block(state: SensorState, block: Count) -> tuple[Sample, SensorState]:
            places = block * size + jnp.arange(size)
            if record is None:
                now, later = measure(state, places)
            else:
                now, later = jax.vmap(read)(reading.samples[places]), state
            # What was read before each sample of the row, and the last of the row.
            before, last = (
                jax.tree.map(lambda a, b: jnp.concatenate([b[None], a[:-1]]), now, state.last),
                jax.tree.map(lambda a: a[-1], now),
            )
            samples, rotation = compensated(now, before), state.rotation
            if rotation is not None:
                rotation = accumulate_rotation(rotation, samples)
            return samples, later._replace(last=last, rotation=rotation)

        return Blocks(self.spec.interval_samples, size, read_block)

    def make_record(self) -> Increments:
        """Return the kept records of all draws, made block by block, leaves (samples, draws)."""
        kept, block = self.spec.kept, self.block_size
        measure = self.make_block_sampler(jnp.arange(kept))

        def over_block(state: SensorState, number: Count) -> tuple[SensorState, Array]:
            now, state = measure(state, number * block + jnp.arange(block))
            # One array: XLA would copy several with every block.
            return state, jnp.stack(jax.tree.leaves(now), axis=1)

        start = self.start()._replace(rotation=None)
        _, rows = jax.lax.scan(over_block, start, jnp.arange(kept // block))
        return _increments_from_rows(rows.reshape(kept, *rows.shape[2:]))

    def housing_vibration_rotations(self, intervals: int) -> Quat | None:
        """Return the rotations from the housing to the base, leaves (intervals + 1, draws).

        They are those at the beginning of the record and at the end of each interval; None if the
        housing does not rotate.
        """
        every, dt = self.spec.interval_samples, self.spec.options.dt
        if self.disturbances.rocking is None:
            return None

        def rocking_of(draw: Draw) -> Disturbances:
            return Disturbances(rocking=self.of_one(draw).whole.disturbances.rocking)

        def advance(draw: Draw, state: Disturbances, normal: Disturbances) -> Disturbances:
            return disturbances.advance_processes(rocking_of(draw), state, normal, dt)[0]

        def turn(draw: Draw, state: Disturbances) -> Array:
            motion = disturbances.housing_motion(rocking_of(draw), state)
            assert motion is not None and motion.angle is not None
            return jnp.stack(exp_of_sample(motion.angle))

        def over_sample(state: Disturbances, normal: Disturbances) -> tuple[Disturbances, None]:
            return map_draws(advance, self.draws, state, normal), None

        def over_interval(state: Disturbances, number: Count) -> tuple[Disturbances, Array]:
            numbers, present = number * every + jnp.arange(every), rocking_of(self.draws)
            normal = disturbances.driving_noise(
                present, self.environment.seed, self.draws.draw_id, numbers
            )
            state, _ = jax.lax.scan(over_sample, state, normal)
            return state, map_draws(turn, self.draws, state)

        def begin(draw: Draw) -> Disturbances:
            return disturbances.initial_states(
                rocking_of(draw), self.environment.seed, draw.draw_id
            )

        first = map_draws(begin, self.draws)
        _, rows = jax.lax.scan(over_interval, first, jnp.arange(intervals))
        rows = jnp.concatenate([map_draws(turn, self.draws, first)[None], rows])
        return Quat(*jnp.moveaxis(rows, -1, 0))

    def _integrate_shared_motion(self, numbers: Array) -> IdealSample | None:
        """Return ideal increments of n samples of the base that all draws share, leaves (n,).

        None if they are stored, or if each draw has its own base.
        """
        if self.environment.increments is not None or self.draws.motion is not None:
            return None
        assert self.environment.motion is not None
        motion, place = self.environment.motion, self.environment.site.place
        rate_hz = 1 / self.spec.options.dt
        nodes = base_motion.integration_nodes(motion, rate_hz)
        sense = partial(base_motion.ideal_sample, motion, nodes, place, rate_hz)
        k = jnp.asarray(numbers, self.environment.dtype)
        if k.size <= SAMPLES_PER_CALL:
            return jax.vmap(sense)(k)
        return jax.lax.map(sense, k, batch_size=SAMPLES_PER_CALL)

    def _integrate_swaying_motions(self, numbers: Array) -> IdealSample | None:
        """Return ideal increments of n samples on the draws' swaying bases, leaves (n, draws).

        All are made in one row. None if draws have no swaying base.
        """
        if self.draws.nodes is None:
            return None
        shape = (numbers.size, self.draws.draw_id.size)

        def tile(a: Array) -> Array:
            return jnp.tile(a, (len(numbers), *(1 for _ in a.shape[1:]))) if jnp.ndim(a) else a

        draws, all_numbers = jax.tree.map(tile, self.draws), jnp.repeat(numbers, shape[1])
        row = map_draws(lambda draw, n: self.of_one(draw).ideal_sample(n), draws, all_numbers)
        return jax.tree.map(lambda a: a.reshape(shape), row)

    def _measure_block(self, state: SensorState, inputs: SampleInputs) -> Measured:
        """Measure a block of samples, one after the other only if they depend on one another."""
        exact_axis = None if self.draws.nodes is None else 0
        of_sample: Any = (None, 0, exact_axis, 0)

        def measure(state: SensorState, sample: SampleInputs) -> Measured:
            measured: Measured = map_draws(
                lambda draw, *of_draw: self.of_one(draw).measure(*of_draw),
                *(self.draws, state, sample),
                axes=(0, SampleInputs(*of_sample)),
            )
            return measured

        quantised = complete(self.environment, self.draws).errors.gyro_quantum is not None
        if not quantised and not jax.tree.leaves(self.disturbances):
            return Measured(jax.vmap(lambda sample: measure(state, sample)[0])(inputs), state)
        if inputs.number.size == 1:  # of many draws, which fill the vectors by themselves
            now, state = measure(state, jax.tree.map(lambda a: a[0], inputs))
            return Measured(jax.tree.map(lambda a: a[None], now), state)

        def over_sample(state: SensorState, sample: SampleInputs) -> tuple[SensorState, Array]:
            now, state = measure(state, sample)
            return state, jnp.stack(jax.tree.leaves(now))  # XLA would copy several arrays

        state, rows = jax.lax.scan(over_sample, state, inputs)
        return Measured(_increments_from_rows(rows), state)


def _increments_from_rows(rows: Array) -> Increments:
    """Return increments with leaves (n, ...) from rows (n, 6, ...)."""
    return sensors.split_record_row(jnp.moveaxis(rows, 1, 0))
