"""Measured increments of the draws of a tile, made in blocks of samples.

A few draws alone would not fill a vector, and the samples of a whole record interval for many draws
would not fit into the first-level cache. So noise, driving noise and ideal increments are made for
all draws and all samples of a block at once where that is faster, and only what depends on the
sample before follows one by one.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from sinsjax.engine.environment import (
    Draw,
    Environment,
    SensorModel,
    SensorProgram,
    Static,
    build_program,
    has_quantisation,
    select_disturbances,
    select_motion,
    select_site,
    sensor_errors,
)
from sinsjax.maths.algebra import select_tree
from sinsjax.maths.rotations import exp_of_sample
from sinsjax.methods import passes
from sinsjax.methods.method import Site
from sinsjax.methods.passes import BodyRotation, PassReading
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
        rotation: of the body since the record began; None if no attitude is propagated back.
    """

    last: Increments
    processes: Disturbances
    housing: HousingState | None
    remainder: Increments | None
    rotation: BodyRotation | None = None


class BlockInputs(NamedTuple):
    """The inputs of n samples that do not depend on one another; leaves (n, ...).

    Attributes:
        numbers: of the samples in the record; negative before it.
        normal: standard normal numbers of the white noise; None without noise.
        exact: ideal increments; None if they are looked up sample by sample.
        driving: driving noise of the random processes.
    """

    numbers: Array
    normal: Increments | None
    exact: IdealSample | None
    driving: Disturbances


class DrawSensors(NamedTuple):
    """The sensors of some draws, or of one.

    Attributes:
        dt: sample time, s.
        program: see `SensorProgram`.
        model: base and sensors of all draws.
        site: Earth and place of all draws.
        draws: with derived inputs; leaves (draws,), or () of what all share.
        dtype: of all numbers.
        starts_with_zeros: whether samples before the record are read, as zeros.
        rotation: initial rotation of the body; None if no attitude is propagated back.
    """

    dt: float
    program: SensorProgram
    model: SensorModel
    site: Site
    draws: Draw
    dtype: jnp.dtype
    starts_with_zeros: bool = False
    rotation: BodyRotation | None = None

    def initial_state(self) -> SensorState:
        """Return the state before the first sample, leaves (draws,)."""
        return self._map_draws(DrawSensors._initial_state_of_one)

    def make_sampler(self, samples: Array) -> Callable[[SensorState, Array], Any]:
        """Return the function that measures some of the given samples for all draws.

        Args:
            samples: numbers of samples in the record.

        Returns:
            (state before n samples, (n,) their places in ``samples``) -> measured increments with
            leaves (n, draws), and the state after them.
        """
        shared = self._integrate_shared_motion(samples)
        exact_axis = None if self.draws.derived.nodes is None else 0
        step = jax.vmap(
            lambda draw, *inputs: self._replace(draws=draw).next_sample(*inputs),
            in_axes=(leaf_axes(self.draws), 0, None, 0, exact_axis, 0),
        )

        def measure(state: SensorState, places: Array) -> tuple[Increments, SensorState]:
            numbers = samples[places]
            exact = self._integrate_swaying_motions(numbers)
            if shared is not None:
                exact = jax.tree.map(lambda a: a[places], shared)
            inputs = BlockInputs(
                numbers,
                self.normal_numbers(numbers),
                exact,
                disturbances.driving_noise(
                    select_disturbances(self.model, self.draws),
                    self.model.seed,
                    self.draws.draw_id,
                    numbers,
                ),
            )
            return self._scan_samples(partial(step, self.draws), state, inputs)

        return measure

    def normal_numbers(self, numbers: Array) -> Increments | None:
        """Return standard normal numbers of n samples, leaves (n, draws); None without noise."""
        if not self.program.noisy:
            return None
        return sensors.draw_normal_numbers(self.model.seed, self.draws.draw_id, numbers)

    def make_record(self, block: int) -> Increments:
        """Return the kept records of all draws, made block by block, leaves (samples, draws)."""
        kept = self.program.kept
        measure = self.make_sampler(jnp.arange(kept))

        def over_block(state: SensorState, number: Count) -> tuple[SensorState, Array]:
            now, state = measure(state, number * block + jnp.arange(block))
            # One array: XLA would copy several with every block.
            return state, jnp.stack(jax.tree.leaves(now), axis=1)

        start = self._replace(rotation=None).initial_state()
        _, rows = jax.lax.scan(over_block, start, jnp.arange(kept // block))
        return _increments_from_rows(rows.reshape(kept, *rows.shape[2:]))

    def housing_turns(self, intervals: int, every: int) -> Quat | None:
        """Return the rotation from the housing to the base at record times, leaves (times, draws).

        Args:
            intervals: record intervals; their ends follow the beginning of the record.
            every: samples per interval.

        Returns:
            None if the housing does not rotate.
        """
        rocking = select_disturbances(self.model, self.draws).rocking
        if rocking is None:
            return None
        alone = Disturbances(rocking=rocking)
        model, draws = self.model._replace(disturbances=alone), self.draws
        if draws.disturbances is not None:
            draws = draws._replace(disturbances=alone)
        source = self._replace(model=model, draws=draws)
        axes = leaf_axes(draws)

        def advance(draw: Draw, state: Disturbances, normal: Disturbances) -> Disturbances:
            them = select_disturbances(model, draw)
            return disturbances.advance_processes(them, state, normal, self.dt)[0]

        def over_interval(state: Disturbances, number: Count) -> tuple[Disturbances, Array]:
            numbers = number * every + jnp.arange(every)
            normal = disturbances.driving_noise(alone, model.seed, draws.draw_id, numbers)
            step = jax.vmap(advance, in_axes=(axes, 0, 0))
            state, _ = jax.lax.scan(lambda s, w: (step(draws, s, w), None), state, normal)
            return state, turns(state)

        def turns(state: Disturbances) -> Array:
            def turn(draw: Draw, state: Disturbances) -> Array:
                motion = disturbances.housing_motion(select_disturbances(model, draw), state)
                assert motion is not None and motion.angle is not None
                return jnp.stack(exp_of_sample(motion.angle))

            return jax.vmap(turn, in_axes=(axes, 0))(draws, state)

        first = source.initial_state().processes
        _, rows = jax.lax.scan(over_interval, first, jnp.arange(intervals))
        return Quat(*jnp.moveaxis(jnp.concatenate([turns(first)[None], rows]), -1, 0))

    def read_record(self, record: Increments, numbers: Array) -> Increments:
        """Return n samples of kept records, leaves (n, draws)."""
        return jax.vmap(
            lambda n: self._zero_before_record(n, jax.tree.map(lambda a: a[n], record))
        )(numbers)

    # The sensors of one draw

    def next_sample(
        self,
        state: SensorState,
        n: Count,
        normal: Increments | None,
        exact: IdealSample | None,
        driving: Disturbances,
    ) -> tuple[SensorState, Increments]:
        """Measure the next sample of one draw.

        Args:
            state: before it.
            n: its number in the record.
            normal: see `BlockInputs`, for one sample.
            exact: likewise.
            driving: likewise.

        Returns:
            The state after it, and its increments; zeros before the record, which compensate
            nothing.
        """
        errors, dt = sensor_errors(self.model, self.draws), self.dt
        exact = self._ideal_sample(n) if exact is None else exact
        processes, disturbed = disturbances.advance_processes(
            select_disturbances(self.model, self.draws), state.processes, driving, dt
        )
        place = select_site(self.site, self.draws).place
        moved = disturbances.disturb_motion(exact, disturbed, place, dt)
        vibrating = state.housing
        if vibrating is not None and disturbed.housing is not None:
            rigid = exact._replace(increments=moved)
            vibrating, moved = housing.sense_in_housing(
                vibrating, rigid, disturbed.housing, self._lever(), place, dt
            )
        now = sensors.measure_increments(
            moved, errors, normal, dt, distorted=self.program.distorted
        )
        now, remainder = disturbances.add_drifts(now, disturbed), state.remainder
        if remainder is not None:
            now, remainder = sensors.quantise(now, errors, remainder)
        state = state._replace(processes=processes, housing=vibrating, remainder=remainder)
        return state, self._zero_before_record(n, now)

    def _initial_state_of_one(self) -> SensorState:
        zero = jnp.zeros((), self.dtype)
        zeros = Increments(Vec3(zero, zero, zero), Vec3(zero, zero, zero))
        them = select_disturbances(self.model, self.draws)
        begin = disturbances.initial_states(them, self.model.seed, self.draws.draw_id)
        vibrating, moving = None, disturbances.housing_motion(them, begin)
        if moving is not None:
            vibrating = housing.start_housing(moving, self._lever(), self._initial_rate(), zeros)
        remainder = zeros if has_quantisation(self.model, self.draws) else None
        return SensorState(zeros, begin, vibrating, remainder, self.rotation)

    def _lever(self) -> Vec3 | None:
        """Return the lever arm of a draw whose housing rotates, m; None without one."""
        motion = select_motion(self.model, self.draws)
        rocks = select_disturbances(self.model, self.draws).rocking is not None
        return motion.lever if motion is not None and rocks else None

    def _initial_rate(self) -> Vec3:
        """Return the angular rate of the base as the record begins, rad/s; zero without a lever."""
        motion = select_motion(self.model, self.draws)
        if motion is None or self._lever() is None:
            return Vec3(*(jnp.zeros((), self.dtype),) * 3)
        place = select_site(self.site, self.draws).place
        return base_motion.rate_and_force(motion, place, jnp.zeros((), self.dtype))[0]

    def _ideal_sample(self, n: Count) -> IdealSample:
        """Return what ideal sensors measure over sample n: stored, or of the draw's own base."""
        draw = self.draws
        if draw.derived.rest is not None:
            return draw.derived.rest
        if draw.motion is None:
            place = draw.start + n
            stored = sensors.split_record_row(jnp.asarray(self.model.increments)[place])
            if self.model.axes is None:
                return IdealSample(stored, None)
            row = jnp.asarray(self.model.axes)[place]
            return IdealSample(
                stored, base_motion.Axes(*(Vec3(*row[3 * i :][:3]) for i in range(3)))
            )
        assert draw.derived.nodes is not None
        here = select_site(self.site, draw).place
        k = jnp.asarray(n, self.dtype)
        return base_motion.ideal_sample(draw.motion, draw.derived.nodes, here, 1 / self.dt, k)

    def _zero_before_record(self, n: Count, increments: Increments) -> Increments:
        if not self.starts_with_zeros:
            return increments
        return select_tree(n < 0, jax.tree.map(jnp.zeros_like, increments), increments)

    # The sensors of many draws

    def _map_draws(self, function: Callable[["DrawSensors"], Any]) -> Any:
        return jax.vmap(
            lambda draw: function(self._replace(draws=draw)), in_axes=(leaf_axes(self.draws),)
        )(self.draws)

    def _integrate_shared_motion(self, numbers: Array) -> IdealSample | None:
        """Return ideal increments of n samples of the base that all draws share, leaves (n,).

        None if they are stored, or if each draw has its own base.
        """
        if self.model.increments is not None or self.draws.motion is not None:
            return None
        assert self.model.motion is not None
        motion, place, rate_hz = self.model.motion, self.site.place, 1 / self.dt
        nodes = base_motion.integration_nodes(motion, rate_hz)
        sense = partial(base_motion.ideal_sample, motion, nodes, place, rate_hz)
        k = jnp.asarray(numbers, self.dtype)
        if k.size <= SAMPLES_PER_CALL:
            return jax.vmap(sense)(k)
        return jax.lax.map(sense, k, batch_size=SAMPLES_PER_CALL)

    def _integrate_swaying_motions(self, numbers: Array) -> IdealSample | None:
        """Return ideal increments of n samples on the draws' swaying bases, leaves (n, draws).

        All are made in one row. None if draws have no swaying base.
        """
        if self.draws.derived.nodes is None:
            return None
        shape = (numbers.size, self.draws.draw_id.size)

        def tile(a: Array) -> Array:
            return jnp.tile(a, (len(numbers), *(1 for _ in a.shape[1:]))) if jnp.ndim(a) else a

        row = jax.vmap(
            lambda draw, n: self._replace(draws=draw)._ideal_sample(n),
            in_axes=(leaf_axes(self.draws), 0),
        )(jax.tree.map(tile, self.draws), jnp.repeat(numbers, shape[1]))
        return jax.tree.map(lambda a: a.reshape(shape), row)

    def _scan_samples(
        self,
        step: Callable[..., tuple[SensorState, Increments]],
        state: SensorState,
        inputs: BlockInputs,
    ) -> tuple[Increments, SensorState]:
        """Measure the samples of a block, one after the other only if they depend on one another.

        Args:
            step: `next_sample`, of all draws.
            state: before the block.
            inputs: of its samples.
        """
        disturbed = jax.tree.leaves(select_disturbances(self.model, self.draws))
        if not disturbed and not has_quantisation(self.model, self.draws):
            return jax.vmap(lambda *sample: step(state, *sample)[1])(*inputs), state
        if inputs.numbers.size == 1:  # of many draws, which fill the vectors by themselves
            state, now = step(state, *jax.tree.map(lambda a: a[0], inputs))
            return jax.tree.map(lambda a: a[None], now), state

        def over_sample(state: SensorState, sample: BlockInputs) -> tuple[SensorState, Array]:
            state, now = step(state, *sample)
            return state, jnp.stack(jax.tree.leaves(now))  # XLA would copy several arrays

        state, rows = jax.lax.scan(over_sample, state, inputs)
        return _increments_from_rows(rows), state


def build_sensors(static: Static, environment: Environment, draws: Draw) -> DrawSensors:
    """Return the sensors of some draws; these have their derived inputs."""
    rotation = None
    if static.rewinds_attitude:
        zero = jnp.zeros((), environment.dtype)
        rotation = passes.initial_rotation(build_program(static), zero)
    return DrawSensors(
        dt=static.options.dt,
        program=static.sensors,
        model=environment.sensors,
        site=environment.site,
        draws=draws,
        dtype=environment.dtype,
        starts_with_zeros=static.passes == "alternate",
        rotation=rotation,
    )


def block_size(record_every: int, draws: Draw) -> int:
    """Return the samples per block; a record interval is cut into equal blocks."""
    most = SAMPLES_PER_BLOCK // draws.draw_id.size
    return max(n for n in range(1, max(1, min(most, record_every)) + 1) if record_every % n == 0)


def sample_blocks(
    source: DrawSensors,
    reading: PassReading,
    block: int,
    record: Increments | None = None,
) -> Callable[[SensorState, Count], tuple[Sample, SensorState]]:
    """Return the function that makes the blocks of samples of a record interval.

    Args:
        source: sensors of the draws.
        reading: order in which the interval reads the record.
        block: samples per block.
        record: kept records, leaves (samples, draws); None to measure.

    Returns:
        (state before a block, its number) -> compensated samples with leaves (samples, draws), and
        the state after it.
    """
    measure = source.make_sampler(reading.samples)
    compensate = jax.vmap(jax.vmap(partial(passes.compensate, backward=reading.backward)))

    def make(state: SensorState, number: Count) -> tuple[Sample, SensorState]:
        places = number * block + jnp.arange(block)
        if record is None:
            now, later = measure(state, places)
        else:
            now, later = source.read_record(record, reading.samples[places]), state
        previous, last = previous_increments(now, state.last)
        samples = compensate(now, previous)
        rotation = state.rotation
        if rotation is not None:
            rotation = passes.accumulate_rotation(rotation, samples, source.dt)
        return samples, later._replace(last=last, rotation=rotation)

    return make


def previous_increments(now: Increments, last: Increments) -> tuple[Increments, Increments]:
    """Return for each sample of a row the increments read before it, and the last of the row.

    Args:
        now: increments of the row, leaves (n, ...).
        last: increments read before the first of them, leaves (...).
    """
    shifted = jax.tree.map(lambda a, b: jnp.concatenate([b[None], a[:-1]]), now, last)
    return shifted, jax.tree.map(lambda a: a[-1], now)


def leaf_axes(draws: Draw) -> Any:
    """Return the axis of draws in each leaf, for `jax.vmap`; None for what all share."""
    return jax.tree.map(lambda a: 0 if jnp.ndim(a) else None, draws)


def _increments_from_rows(rows: Array) -> Increments:
    """Return increments with leaves (n, ...) from rows (n, 6, ...)."""
    return sensors.split_record_row(jnp.moveaxis(rows, 1, 0))
