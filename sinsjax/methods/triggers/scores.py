"""The triggers: what each remembers, and the score that it gives a sample."""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from sinsjax.maths.algebra import Triangle, triangle_index
from sinsjax.methods import kalman
from sinsjax.methods.kalman import Belief, normalised_innovation_squared
from sinsjax.methods.triggers.trigger import (
    AssumedNoise,
    FilterSnapshot,
    Pair,
    Trigger,
    TriggerParams,
)
from sinsjax.strapdown.error_model import VE, VN
from sinsjax.types import Flag, Scalar
from sinsjax.units import DEG


class _Block(NamedTuple):
    """Sums over a window that begins anew when it is full."""

    count: Scalar
    sums: tuple[Scalar, ...]


def _start_block(terms: int) -> Callable[[TriggerParams, Triangle], _Block]:
    def start(trigger_params: TriggerParams, p: Triangle) -> _Block:
        zero = jnp.zeros_like(trigger_params.threshold)
        return _Block(zero, tuple(zero for _ in range(terms)))

    return start


def _add_to_block(
    trigger_params: TriggerParams, block: _Block, terms: tuple[Scalar, ...]
) -> tuple[_Block, Flag]:
    """Return the window with one sample added, and whether it is full; a full one starts again."""
    again = block.count >= trigger_params.window
    sums = tuple(jnp.where(again, 0.0, s) + t for s, t in zip(block.sums, terms, strict=True))
    count = jnp.where(again, 0.0, block.count) + 1
    return _Block(count, sums), count >= trigger_params.window


def _score_innovation(
    trigger_params: TriggerParams, noise: AssumedNoise, block: _Block, snapshot: FilterSnapshot
) -> Any:
    """Return (sum r)' (sum S)^-1 (sum r) over a window, chi-square with 2 degrees of freedom."""
    block, full = _add_to_block(trigger_params, block, (*snapshot.innovation, *snapshot.variance))
    e, n, *s = block.sums
    return block, jnp.where(full, normalised_innovation_squared((e, n), s), 0.0)


def _score_nis(
    trigger_params: TriggerParams, noise: AssumedNoise, memory: Any, snapshot: FilterSnapshot
) -> Any:
    """Return the normalised innovation squared r' S^-1 r, chi-square with 2 degrees."""
    return memory, normalised_innovation_squared(snapshot.innovation, snapshot.variance)


def _score_whiteness(
    trigger_params: TriggerParams, noise: AssumedNoise, memory: Any, snapshot: FilterSnapshot
) -> Any:
    """Return sqrt(N) |rho|, rho the lag-one correlation of the innovations in a window of N."""
    block, before = memory
    e, n = snapshot.innovation
    block, full = _add_to_block(
        trigger_params, block, (e * before[0] + n * before[1], e * e + n * n)
    )
    lagged, power = block.sums
    rho = jnp.abs(lagged) / jnp.maximum(power, jnp.finfo(power.dtype).tiny)
    return (block, snapshot.innovation), jnp.where(full, jnp.sqrt(block.count) * rho, 0.0)


def _start_whiteness(trigger_params: TriggerParams, p: Triangle) -> Any:
    zero = jnp.zeros_like(trigger_params.threshold)
    return _start_block(2)(trigger_params, p), (zero, zero)


class _Levels(NamedTuple):
    """A window over the corrections of the level: samples so far, and where it began, rad."""

    count: Scalar
    east: Scalar
    north: Scalar


def _start_levels(trigger_params: TriggerParams, p: Triangle) -> _Levels:
    zero = jnp.zeros_like(trigger_params.threshold)
    return _Levels(zero, zero, zero)


def _level_correction_rates(
    trigger_params: TriggerParams, levels: _Levels, snapshot: FilterSnapshot
) -> tuple[_Levels, Flag, Pair]:
    """Return the window, whether it is full, and the rates of level correction over it, rad/s."""
    count = levels.count + 1
    full, span = count >= trigger_params.window, count * snapshot.dt
    e, n, _ = snapshot.correction
    begun = _Levels(
        jnp.where(full, 0.0, count),
        jnp.where(full, e, levels.east),
        jnp.where(full, n, levels.north),
    )
    return begun, full, ((e - levels.east) / span, (n - levels.north) / span)


def _score_tilt_drift(
    trigger_params: TriggerParams, noise: AssumedNoise, levels: _Levels, snapshot: FilterSnapshot
) -> Any:
    """Return the measured tilt drift about east over the predicted one: (drift / omega_N)^2 / P_UU.

    A heading error phi_U tilts the platform at omega_N phi_U, which the filter corrects. A larger
    correction than P allows shows that P is too small.
    """
    levels, full, (east, _) = _level_correction_rates(trigger_params, levels, snapshot)
    p_uu = snapshot.covariance(snapshot.belief).uu
    score = (east / snapshot.place.rate_n) ** 2 / p_uu
    return levels, jnp.where(full, score, 0.0)


STILL = 9.21
"""r' S^-1 r under which velocity is still: 99 % of chi-square with 2 degrees of freedom."""


def _score_levelled(
    trigger_params: TriggerParams, noise: AssumedNoise, levels: _Levels, snapshot: FilterSnapshot
) -> Any:
    """Return omega_N over the rate of level correction while the velocity is still, else 0.

    Once it exceeds 1, what is left of the drift can be the work of heading alone.
    """
    levels, full, (east, north) = _level_correction_rates(trigger_params, levels, snapshot)
    still = normalised_innovation_squared(snapshot.innovation, snapshot.variance) < STILL
    # The Earth of a backward pass turns the other way.
    score = jnp.abs(snapshot.place.rate_n) / jnp.sqrt(east**2 + north**2)
    return levels, jnp.where(full & still, score, 0.0)


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


def _fade_constantly(
    trigger_params: TriggerParams, noise: AssumedNoise, memory: Any, p: Triangle, r: Pair
) -> Any:
    """Return the threshold as the factor on P at each sample, such as 1.0001: fading memory."""
    return memory, trigger_params.threshold


def _fade_strong_tracking(
    trigger_params: TriggerParams, noise: AssumedNoise, memory: Any, p: Triangle, r: Pair
) -> Any:
    """Return the factor on P of strong tracking (Zhou and Frank 1996); the threshold is its beta.

    V <- (rho V + r r') / (1 + rho), rho = 0.95; N = V - H Q H' - beta R; M = H Phi P Phi' H';
    the factor is max(1, tr N / tr M).
    """
    forgetting = 0.95
    begun, before = memory
    power = r[0] ** 2 + r[1] ** 2
    v = jnp.where(begun, (forgetting * before + power) / (1 + forgetting), power)
    n = v - noise.q[VE] - noise.q[VN] - 2 * trigger_params.threshold * noise.r
    at = triangle_index(len(noise.q))
    factor = jnp.maximum(1.0, n / (p[at[VE, VE]] + p[at[VN, VN]]))
    return (jnp.ones_like(begun), v), factor


def _start_strong_tracking(trigger_params: TriggerParams, p: Triangle) -> Any:
    zero = jnp.zeros_like(trigger_params.threshold)
    return zero.astype(bool), zero


def _start_without_memory(trigger_params: TriggerParams, p: Triangle) -> Any:
    return ()


INNOVATION = Trigger(_start_block(5), _score_innovation)
NIS = Trigger(_start_without_memory, _score_nis)
WHITENESS = Trigger(_start_whiteness, _score_whiteness)
TILT_DRIFT = Trigger(_start_levels, _score_tilt_drift)
LEVELLED = Trigger(_start_levels, _score_levelled)
LINEARISATION = Trigger(_start_with_covariance, _score_linearisation)
STRONG_TRACKING = Trigger(_start_strong_tracking, fade=_fade_strong_tracking)
FADING = Trigger(_start_without_memory, fade=_fade_constantly)
