"""The samples of a record interval: one by one, or from one event to the next.

A step is taken for every sample; closing the loop is an event, due every so many samples, or called
for by a run at a sample. Runs of a tile go together to the first event of any of them, where all
are closed: that leaves those for which nothing is due as they are. The samples themselves are made
some at a time, since few draws alone would not fill a vector.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from sinsjax.types import Count, Flag, Scalar

Step = Callable[[Any, Count, Any], Any]
"""(state, place of the sample in the interval, sample) -> state."""

Close = Callable[[Any, Count], Any]
"""(state, samples of the interval taken) -> state after what is due."""

NextEvent = Callable[[Any, Count], Scalar]
"""(state, samples of the interval taken) -> how many they are at the next event."""

Called = Callable[[Any, Count], Flag]
"""(state, samples of the interval taken) -> whether the last of them is an event by itself."""

Make = Callable[[Any, Count], tuple[Any, Any]]
"""(what samples look back at, number of a piece) -> its samples, leaves (samples, ...), and what
the next piece looks back at."""


def sample_by_sample(
    state: Any, before: Any, count: int, step: Step, close: Close, make: Make, piece: int
) -> tuple[Any, Any]:
    """Close after every sample, by a static scan: it has derivatives of both modes.

    Args:
        state: what the steps hand on.
        before: what the first samples look back at.
        count: samples of the interval.
        step: see `Step`.
        close: see `Close`.
        make: see `Make`.
        piece: samples that are made at a time; it divides ``count``.

    Returns:
        The state, and what the next interval looks back at.
    """

    def over_sample(state: Any, xs: tuple[Count, Any]) -> tuple[Any, None]:
        place, sample = xs
        return close(step(state, place, sample), place + 1), None

    def over_piece(carry: tuple[Any, Any], number: Count) -> tuple[tuple[Any, Any], None]:
        state, before = carry
        samples, before = make(before, number)
        places = number * piece + jnp.arange(piece)
        return (jax.lax.scan(over_sample, state, (places, samples))[0], before), None

    return jax.lax.scan(over_piece, (state, before), jnp.arange(count // piece))[0]


def event_by_event(
    state: Any,
    before: Any,
    count: int,
    step: Step,
    close: Close,
    make: Make,
    piece: int,
    next_event: NextEvent,
    called: Called | None = None,
) -> tuple[Any, Any]:
    """Close at events, and at the end of the interval, where that leaves runs as they are.

    Args:
        state: what the steps hand on.
        before: what the first samples look back at.
        count: samples of the interval.
        step: see `Step`.
        close: see `Close`.
        make: see `Make`.
        piece: samples that are made at a time; it divides ``count``.
        next_event: see `NextEvent`.
        called: see `Called`; None where no sample is.

    Returns:
        The state, and what the next interval looks back at.
    """
    shapes = jax.eval_shape(make, before, jnp.asarray(0))[0]
    made = jax.tree.map(lambda a: jnp.zeros(a.shape, a.dtype), shapes) if piece > 1 else None

    def over(
        place: Count, end: Count, one: Callable[[Count, Any], Any], carry: Any
    ) -> tuple[Count, Any, Flag]:
        """Samples up to ``end``, or to the first that is an event by itself; whether it is one."""
        if called is None:
            return end, jax.lax.fori_loop(place, end, one, carry), jnp.asarray(False)

        def further(progress: tuple[Count, Any, Flag]) -> Flag:
            place, _, stopped = progress
            return (place < end) & ~stopped

        def on(progress: tuple[Count, Any, Flag]) -> tuple[Count, Any, Flag]:
            place, carry, _ = progress
            carry = one(place, carry)
            return place + 1, carry, called(carry[0], place + 1)

        return jax.lax.while_loop(further, on, (place, carry, jnp.asarray(False)))

    def alone(place: Count, carry: tuple[Any, Any]) -> tuple[Any, Any]:
        state, before = carry
        samples, before = make(before, place)
        return step(state, place, jax.tree.map(lambda a: a[0], samples)), before

    def over_piece(stop: Count, progress: tuple) -> tuple:
        place, (state, before), made, _ = progress
        number = place // piece
        # An event may cut a piece in two: its second part takes the samples of the first.
        fresh = place == number * piece
        made, before = jax.lax.cond(fresh, make, lambda before, _: (made, before), before, number)
        end = jnp.minimum(stop, (number + 1) * piece)

        def one(place: Count, carry: tuple[Any]) -> tuple[Any]:
            at = place - number * piece
            sample = jax.tree.map(
                lambda a: jax.lax.dynamic_index_in_dim(a, at, keepdims=False), made
            )
            return (step(carry[0], place, sample),)

        place, (state,), stopped = over(place, end, one, (state,))
        return place, (state, before), made, stopped

    def to_event(progress: tuple[Count, Any, Any]) -> tuple[Count, Any, Any]:
        place, carry, made = progress
        # Compared as it is, and infinite where nothing is due any more.
        stop = jnp.minimum(next_event(carry[0], place), count).astype(place.dtype)
        if piece > 1:
            place, carry, made, _ = jax.lax.while_loop(
                lambda progress: (progress[0] < stop) & ~progress[3],
                partial(over_piece, stop),
                (place, carry, made, jnp.asarray(False)),
            )
        else:
            place, carry, _ = over(place, stop, alone, carry)
        state, before = carry
        return place, (close(state, place), before), made

    start = jnp.asarray(0), (state, before), made
    return jax.lax.while_loop(lambda progress: progress[0] < count, to_event, start)[1]
