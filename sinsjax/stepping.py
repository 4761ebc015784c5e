"""Going over the samples of a record interval: one by one, or from one event to the next.

A step is taken for every sample; closing the loop is an event, due every so many samples. Runs of a
tile go together to the first event of any of them, where all are closed: that leaves those for
which nothing is due as they are.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from sinsjax.types import Array, Count, Scalar

Step = Callable[[Any, Count, Any], Any]
"""(carry, place of the sample in the interval, its normal numbers) -> carry."""

Close = Callable[[Any, Count], Any]
"""(carry, samples of the interval gone over) -> carry after what is due."""

NextEvent = Callable[[Any, Count], Scalar]
"""(carry, samples of the interval gone over) -> how many they are at the next event."""

Noise = Callable[[Count], Any]
"""Number of a piece -> normal numbers of its samples, leaves (samples, ...)."""


def sample_by_sample(
    carry: Any, count: int, step: Step, close: Close, noise: Noise, piece: int
) -> Any:
    """Close after every sample, by a static scan: it has derivatives of both modes.

    Args:
        carry: what the steps hand on.
        count: samples of the interval.
        step: see `Step`.
        close: see `Close`.
        noise: see `Noise`.
        piece: samples whose normal numbers are made at a time; it divides ``count``.
    """

    def over_sample(carry: Any, xs: tuple[Count, Any]) -> tuple[Any, None]:
        place, normal = xs
        return close(step(carry, place, normal), place + 1), None

    def over_piece(carry: Any, number: Count) -> tuple[Any, None]:
        places = number * piece + jnp.arange(piece)
        return jax.lax.scan(over_sample, carry, (places, noise(number)))[0], None

    return jax.lax.scan(over_piece, carry, jnp.arange(count // piece))[0]


def event_by_event(
    carry: Any,
    count: int,
    step: Step,
    close: Close,
    noise: Noise,
    piece: int,
    next_event: NextEvent,
) -> Any:
    """Close at events, and at the end of the interval, where that leaves runs as they are.

    Args:
        carry: what the steps hand on.
        count: samples of the interval.
        step: see `Step`.
        close: see `Close`.
        noise: see `Noise`.
        piece: samples whose normal numbers are made at a time; it divides ``count``.
        next_event: see `NextEvent`.
    """
    shapes = jax.eval_shape(noise, jnp.asarray(0))
    in_pieces = piece > 1 and shapes is not None

    def alone(place: Count, carry: Any) -> Any:
        return step(carry, place, None if shapes is None else _at(noise(place), 0))

    def over_piece(stop: Count, progress: tuple[Count, Any, Any]) -> tuple[Count, Any, Any]:
        place, carry, made = progress
        number = place // piece
        # An event may cut a piece in two: its second part takes the numbers of the first.
        made = jax.lax.cond(place == number * piece, noise, lambda number: made, number)
        end = jnp.minimum(stop, (number + 1) * piece)

        def one(place: Count, carry: Any) -> Any:
            return step(carry, place, _at(made, place - number * piece))

        return end, jax.lax.fori_loop(place, end, one, carry), made

    def to_event(progress: tuple[Count, Any, Any]) -> tuple[Count, Any, Any]:
        place, carry, made = progress
        # Compared as it is, and infinite where nothing is due any more.
        stop = jnp.minimum(next_event(carry, place), count).astype(place.dtype)
        if in_pieces:
            _, carry, made = jax.lax.while_loop(
                lambda progress: progress[0] < stop, partial(over_piece, stop), progress
            )
        else:
            carry = jax.lax.fori_loop(place, stop, alone, carry)
        return stop, close(carry, stop), made

    made = jax.tree.map(lambda a: jnp.zeros(a.shape, a.dtype), shapes) if in_pieces else None
    start = jnp.asarray(0), carry, made
    return jax.lax.while_loop(lambda progress: progress[0] < count, to_event, start)[1]


def _at(tree: Any, place: Array | int) -> Any:
    return jax.tree.map(lambda a: jax.lax.dynamic_index_in_dim(a, place, keepdims=False), tree)
