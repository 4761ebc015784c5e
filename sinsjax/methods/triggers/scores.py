"""The triggers: what each remembers, and the score that it gives a sample."""

import math
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from sinsjax.maths.algebra import Triangle
from sinsjax.methods import kalman
from sinsjax.methods.kalman import Belief, normalised_innovation_squared
from sinsjax.methods.triggers.trigger import (
    AssumedNoise,
    FilterSnapshot,
    Trigger,
    TriggerParams,
)
from sinsjax.strapdown.error_model import VE, VN
from sinsjax.types import Scalar
from sinsjax.units import DEG


class _Block(NamedTuple):
    """Sums over a window that begins anew when it is full."""

    count: Scalar
    sums: tuple[Scalar, ...]


def _start_block(trigger_params: TriggerParams, p: Triangle) -> _Block:
    zero = jnp.zeros_like(trigger_params.threshold)
    return _Block(zero, (zero,) * 5)


def _score_innovation(
    trigger_params: TriggerParams, noise: AssumedNoise, block: _Block, snapshot: FilterSnapshot
) -> Any:
    """Return (sum r)' (sum S)^-1 (sum r) over a window, chi-square with 2 degrees of freedom."""
    again = block.count >= trigger_params.window  # a full window begins anew
    terms = *snapshot.innovation, *snapshot.variance
    sums = tuple(jnp.where(again, 0.0, s) + t for s, t in zip(block.sums, terms, strict=True))
    count = jnp.where(again, 0.0, block.count) + 1
    e, n, *s = sums
    score = normalised_innovation_squared((e, n), s)
    return _Block(count, sums), jnp.where(count >= trigger_params.window, score, 0.0)


_SMALL_LEVEL, _SMALL_HEADING = 0.1 * DEG, 4 * DEG
"""Errors of the linearisation point that do no harm, rad."""


def _score_linearisation(
    trigger_params: TriggerParams, noise: AssumedNoise, p: Triangle, snapshot: FilterSnapshot
) -> Any:
    """Return how far the knowledge of heading in P exceeds that of an honest linear model.

    While the level is wrong, the horizontal specific force enters A(t), and heading seems to show
    in velocity. The honest covariance P* of a base at rest (f = (0, 0, g)) does without. Three
    shares of variance make up the score, the root of 1 and their sum:

    * P*_UU / P_UU - 1: knowledge of heading without basis; as far as the level was
      corrected since the last reset, in full from 0.1 deg: where it was not, the base moves, and
      heading does show;
    * P*_UU (phi_E^2 / P*_EE + phi_N^2 / P*_NN) / 4: the expected jump when the level phi that is
      not yet fed back (in units of 2 sigma) is, as the specific force changes; likewise from
      0.1 deg;
    * (d - sin d)^2 / (P_UU + (4 deg)^2): what a heading correction d since the last reset left
      out, since the tilt that reveals heading goes with sin d; up to 30 deg it is little.
    """
    zeros = tuple(jnp.zeros_like(v) for v in snapshot.belief.x)
    honest = kalman.predict(Belief(zeros, p), snapshot.at_rest, noise.q)
    honest = kalman.update(honest, (VE, VN), (zeros[VE], zeros[VN]), noise.r)
    p_star = snapshot.covariance(honest._replace(x=snapshot.belief.x))
    believed = snapshot.covariance(snapshot.belief).uu
    done, left = snapshot.correction, snapshot.not_fed_back
    known = _weight_of_level(done.x, done.y) * (p_star.uu / believed - 1)
    jump = _weight_of_level(left.x, left.y)
    jump = jump * p_star.uu * (left.x**2 / p_star.ee + left.y**2 / p_star.nn) / 4
    left_out = (done.z - _sine(done.z)) ** 2 / (believed + _SMALL_HEADING**2)
    return honest.p, jnp.sqrt(1 + known + jump + left_out)


def _sine(angle: Scalar) -> Scalar:
    """Return the sine to some 1e-15 by arithmetic alone: XLA:CPU calls the library lane by lane.

    Args:
        angle: rad, of no more than some turns, which it is reduced by.
    """
    within = angle - 2 * np.pi * jnp.round(angle / (2 * np.pi))
    folded = within - 2 * (within - jnp.clip(within, -np.pi / 2, np.pi / 2))
    square, series = folded * folded, 0.0
    for n in range(19, 0, -2):
        series = series * square + (-1) ** (n // 2) / math.factorial(n)
    return series * folded


def _weight_of_level(east: Scalar, north: Scalar) -> Scalar:
    """Return the weight of a level angle: its square over `_SMALL_LEVEL` squared, at most 1."""
    return jnp.minimum(1.0, (east**2 + north**2) / _SMALL_LEVEL**2)


def _start_with_covariance(trigger_params: TriggerParams, p: Triangle) -> Triangle:
    return p


INNOVATION = Trigger(_start_block, _score_innovation)
LINEARISATION = Trigger(_start_with_covariance, _score_linearisation)
