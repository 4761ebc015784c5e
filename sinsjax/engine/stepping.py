"""The samples of an interval: in which order passes read them, and steps from event to event.

**Passes** over a stored record are forward and backward in turn. A backward pass, [P2] section 2.3,
is navigation in an environment where time is reversed: the samples are read last to first and
reversed (`sensors.reverse_sample`), the Earth rotates the other way, and velocity has the opposite
sign. Method and mechanisation are the same in both directions; the method decides what becomes of
its state at a direction reversal (`Passes.reverse`). Fine alignment that replays the data of coarse
alignment starts from an attitude that is propagated back to the beginning, by the rotation that the
gyros measured and that of the Earth.

**Steps.** Every sample is a step. Closing the loop is an event, due every so many samples or called
for by a run at a sample. The runs of a tile step together to the first event of any of them, at
which all are closed: that leaves the runs for which nothing is due unchanged. The samples
themselves are made in blocks, see `samples`.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from sinsjax.maths import rotations
from sinsjax.maths.algebra import select_tree
from sinsjax.methods.method import Site
from sinsjax.strapdown import earth, sensors
from sinsjax.strapdown.earth import Place
from sinsjax.types import Array, Count, Flag, Increments, Quat, Sample, Scalar, Vec3

# Passes


class IntervalReading(NamedTuple):
    """The samples that one record interval reads.

    Their (n,) numbers in the record are in the order in which they are read. Backward they are one
    ahead of navigation, since a sample is compensated with the one before it; -1 is before the
    record.
    """

    samples: Array
    backward: Flag | None = None  # whether the pass is backward; None of a record read once
    opens_pass: Flag | None = None  # whether it opens the second or a later pass; likewise


def order_samples(interval: Count, pass_intervals: Count | None, count: int) -> IntervalReading:
    """Return the samples of an interval, from 0; of a record read once if no pass has a length."""
    if pass_intervals is None:
        return IntervalReading(interval * count + jnp.arange(count))
    number, place = interval // pass_intervals, interval % pass_intervals
    opens_pass = (place == 0) & (number > 0)
    backward = number % 2 == 1
    first = jnp.where(backward, (pass_intervals - place) * count - 2, place * count)
    samples = first + jnp.where(backward, -1, 1) * jnp.arange(count)
    return IntervalReading(samples, backward, opens_pass)


def site_of_pass(site: Site, backward: Flag | None) -> Site:
    """Return the site, with the Earth rotating the other way in a backward pass."""
    if backward is None:
        return site
    sign = jnp.where(backward, -1.0, 1.0)
    reversed_ = site.earth._replace(rate=sign * site.earth.rate)
    return site._replace(earth=reversed_, place=earth.reverse_rotation(site.place, sign))


def compensate_in_pass(now: Increments, before: Increments, backward: Flag | None) -> Sample:
    """Return the compensated sample in the direction of the pass: ``now``, backward ``before``."""
    if backward is None:
        return sensors.compensate_sample(now, before)
    later, earlier = select_tree(backward, (before, now), (now, before))
    sample = sensors.compensate_sample(later, earlier)
    return select_tree(backward, sensors.reverse_sample(sample), sample)


def accumulate_rotation(rotation: Quat, samples: Sample) -> Quat:
    """Return C_b^{b0}, leaves (...), after further compensated samples, leaves (n, ...)."""

    def over_sample(so_far: Quat, turn: Quat) -> tuple[Quat, None]:
        return rotations.multiply(so_far, turn), None

    return jax.lax.scan(over_sample, rotation, samples.turn)[0]


def rewind_attitude(q: Quat, rotation: Quat, place: Place, time: Scalar) -> Quat:
    """Return the attitude at the beginning of the record from that at a later time, s.

    C(0) = exp(w_ie t x) C(t) C_b^{b0}' of a base that does not travel, with the rotation C_b^{b0}
    of the body since then.
    """
    earth_turn = Vec3(jnp.zeros_like(place.rate_n), place.rate_n * time, place.rate_u * time)
    q = rotations.multiply(rotations.exp(earth_turn), q)
    return rotations.normalise(rotations.multiply(q, rotations.conjugate(rotation)))


# Steps


class Steps(NamedTuple):
    """The effect of samples on the state of runs; ``place`` counts the samples of the interval.

    Attributes:
        step: (state, place of the sample, sample) -> state.
        close: (state, samples taken) -> state after what is due.
        next_event: (state, samples taken) -> their number at the next event. It is None, or
            returns None, if every sample may be an event.
        triggered: (state, samples taken) -> whether the last of them is itself an event; None if
            `next_event` finds all events.
    """

    step: Callable[[Any, Count, Any], Any]
    close: Callable[[Any, Count], Any]
    next_event: Callable[[Any, Count], Scalar | None] | None = None
    triggered: Callable[[Any, Count], Flag] | None = None


class Blocks(NamedTuple):
    """The samples of an interval in blocks.

    Attributes:
        samples: of the interval.
        size: samples per block, a divisor of ``samples``.
        make: (sensor state, number of the block) -> its samples, leaves (size, ...), and the sensor
            state after it.
    """

    samples: int
    size: int
    make: Callable[[Any, Count], tuple[Any, Any]]


def take_samples(
    steps: Steps, state: Any, sensor_state: Any, blocks: Blocks, *, by_event: bool = True
) -> tuple[Any, Any]:
    """Return the states of runs and sensors after all samples of an interval.

    Loops are closed at events only, or else after every sample, by a scan of static length, which
    has derivatives of both modes.
    """
    next_event = steps.next_event and steps.next_event(state, jnp.asarray(0))
    if by_event and next_event is not None:
        return step_event_by_event(steps, state, sensor_state, blocks)
    return step_sample_by_sample(steps, state, sensor_state, blocks)


def step_sample_by_sample(
    steps: Steps, state: Any, sensor_state: Any, blocks: Blocks
) -> tuple[Any, Any]:
    """Close after every sample; arguments as of `take_samples`."""

    def over_sample(state: Any, xs: tuple[Count, Any]) -> tuple[Any, None]:
        place, sample = xs
        return steps.close(steps.step(state, place, sample), place + 1), None

    def over_block(carry: tuple[Any, Any], number: Count) -> tuple[tuple[Any, Any], None]:
        state, sensor_state = carry
        samples, sensor_state = blocks.make(sensor_state, number)
        places = number * blocks.size + jnp.arange(blocks.size)
        return (jax.lax.scan(over_sample, state, (places, samples))[0], sensor_state), None

    numbers = jnp.arange(blocks.samples // blocks.size)
    return jax.lax.scan(over_block, (state, sensor_state), numbers)[0]


def step_event_by_event(
    steps: Steps, state: Any, sensor_state: Any, blocks: Blocks
) -> tuple[Any, Any]:
    """Close at events and at the end of the interval; arguments as of `take_samples`."""
    count, size, make = blocks
    next_event, triggered = steps.next_event, steps.triggered
    assert next_event is not None
    block = None
    if size > 1:
        shapes, _ = jax.eval_shape(make, sensor_state, jnp.asarray(0))
        block = jax.tree.map(lambda a: jnp.zeros(a.shape, a.dtype), shapes)

    def step_until(
        place: Count, end: Count, step: Callable[[Count, Any], Any], carry: Any
    ) -> tuple[Count, Any, Flag]:
        """Step up to ``end`` or the first sample that is itself an event; also whether one was."""
        if triggered is None:
            return end, jax.lax.fori_loop(place, end, step, carry), jnp.asarray(False)

        def unfinished(progress: tuple[Count, Any, Flag]) -> Flag:
            place, _, stopped = progress
            return (place < end) & ~stopped

        def step_next(progress: tuple[Count, Any, Flag]) -> tuple[Count, Any, Flag]:
            place, carry, _ = progress
            carry = step(place, carry)
            return place + 1, carry, triggered(carry[0], place + 1)

        return jax.lax.while_loop(unfinished, step_next, (place, carry, jnp.asarray(False)))

    def make_and_step(place: Count, carry: tuple[Any, Any]) -> tuple[Any, Any]:
        """Make one sample and step over it."""
        state, sensor_state = carry
        samples, sensor_state = make(sensor_state, place)
        sample = jax.tree.map(lambda a: a[0], samples)
        return steps.step(state, place, sample), sensor_state

    def step_to_stop_or_block_end(stop: Count, progress: tuple) -> tuple:
        """Step up to an event or the end of a block, whose samples are made when it begins."""
        place, (state, sensor_state), block, _ = progress
        number = place // size
        # An event may cut a block in two: its second part takes the samples already made.
        is_new = place == number * size
        block, sensor_state = jax.lax.cond(
            is_new, make, lambda sensor_state, _: (block, sensor_state), sensor_state, number
        )
        end = jnp.minimum(stop, (number + 1) * size)

        def step_made(place: Count, carry: tuple[Any]) -> tuple[Any]:
            at = place - number * size
            sample = jax.tree.map(
                lambda a: jax.lax.dynamic_index_in_dim(a, at, keepdims=False), block
            )
            return (steps.step(carry[0], place, sample),)

        place, (state,), stopped = step_until(place, end, step_made, (state,))
        return place, (state, sensor_state), block, stopped

    def step_to_next_event(place_carry_block: tuple[Count, Any, Any]) -> tuple[Count, Any, Any]:
        """Step up to the next event and close the loop there."""
        place, carry, block = place_carry_block
        # Compared as a float, since it is infinite when nothing is due any more.
        stop = jnp.minimum(next_event(carry[0], place), count).astype(place.dtype)
        if size > 1:
            place, carry, block, _ = jax.lax.while_loop(
                lambda progress: (progress[0] < stop) & ~progress[3],
                partial(step_to_stop_or_block_end, stop),
                (place, carry, block, jnp.asarray(False)),
            )
        else:
            place, carry, _ = step_until(place, stop, make_and_step, carry)
        state, sensor_state = carry
        return place, (steps.close(state, place), sensor_state), block

    start = jnp.asarray(0), (state, sensor_state), block
    return jax.lax.while_loop(lambda progress: progress[0] < count, step_to_next_event, start)[1]
