"""Turns of the base: a smooth ramp to a rate, the rate, and a ramp down, one turn after another.

The ramps have continuous angular acceleration. Turns begin and end at samples, so the samples of
`base_motion` are integrated without a knot inside.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from sinsjax.types import Array, Scalar

_MOST_COMPARED = 64
"""Turns up to which all are compared with a time; of more, the right one is searched."""


class AngleRates(NamedTuple):
    """An angle and its first two time derivatives.

    Attributes:
        angle: rad.
        rate: rad/s.
        acceleration: rad/s^2.
    """

    angle: Scalar
    rate: Scalar
    acceleration: Scalar

    def plus(self, other: "AngleRates | None") -> "AngleRates":
        """Return the sum of two angles; None adds nothing."""
        return self if other is None else AngleRates(*map(jnp.add, self, other))


class Turns(NamedTuple):
    """Turns about one axis, which do not overlap; leaves (n,).

    Attributes:
        begin: of the ramp up, s, increasing.
        length: from there to the beginning of the ramp down: |angle| / rate, s.
        ramp: length of a ramp, s.
        rate: signed rate after the ramp, rad/s.
        before: sum of the angles of earlier turns, modulo a whole turn, rad.
    """

    begin: Array
    length: Array
    ramp: Array
    rate: Array
    before: Array

    def at(self, t: Scalar) -> AngleRates:
        """Return the angle and its derivatives at a time (s)."""
        turn = self._active(self.begin, t)
        return _angle_rates(turn, t - turn.begin, t - turn.begin - turn.length)

    def at_node_of_sample(self, rate_hz: Scalar, k: Scalar) -> Callable[[Scalar], AngleRates]:
        """Return the angle during sample k by node, in half samples from mid-sample.

        Whole numbers of samples keep times within the turn exact, however late it is.
        """
        turn = self._active(jnp.round(self.begin * rate_hz), k)
        since_begin = k - jnp.round(turn.begin * rate_hz)
        since_ramp_down = since_begin - jnp.round(turn.length * rate_hz)

        def at(node: Scalar) -> AngleRates:
            middle = 0.5 + 0.5 * node
            up, down = since_begin + middle, since_ramp_down + middle
            return _angle_rates(turn, up / rate_hz, down / rate_hz)

        return at

    def _active(self, begins: Array, time: Scalar) -> "Turns":
        """Return the last turn that has begun, leaves (); before the first one, the first."""
        if len(begins) <= _MOST_COMPARED:
            begun = jnp.sum(jnp.asarray(begins) <= time)
        else:
            begun = jnp.searchsorted(jnp.asarray(begins), time, side="right")
        place = jnp.maximum(begun - 1, 0)
        return jax.tree.map(lambda a: jnp.asarray(a)[place], self)


def _angle_rates(turn: Turns, since_begin: Scalar, since_ramp_down: Scalar) -> AngleRates:
    up, down = _ramp(turn.ramp, since_begin), _ramp(turn.ramp, since_ramp_down)
    angle, rate, acceleration = (turn.rate * (a - b) for a, b in zip(up, down, strict=True))
    return AngleRates(turn.before + angle, rate, acceleration)


def _ramp(ramp: Scalar, t: Scalar) -> AngleRates:
    """Return a ramp from rate 0 to rate 1 that begins at t = 0, and its derivatives."""
    x = jnp.clip(t / ramp, 0.0, 1.0)
    square = x * x
    return AngleRates(
        ramp * square * square * (2.5 - 3 * x + square) + jnp.maximum(t - ramp, 0.0),
        square * x * (10 - 15 * x + 6 * square),
        30 * square * (1 - x) * (1 - x) / ramp,
    )
