"""Noise of the blocks that `fit` whitens: a Kalman filter of its slow parts.

A complex number stands for the two level axes of l. White noise of the gyros makes a random walk w
of the tilt, p_y - i p_x; drifts of the gyros add to it, drifts of the accelerometers and the surge
of the base to the measurement. Drifts belong to axes of the body, and turn in l as the body turns,
by a phase. The noise of both axes is alike, so each covariance is that of one axis.
"""

from typing import Any, NamedTuple, TypeAlias

import jax.numpy as jnp

from sinsjax.types import Array, Scalar

Number: TypeAlias = Any
"""A scalar, real or complex."""

Covariance: TypeAlias = dict[tuple[int, int], Number]
"""Of the states of a `NoiseModel`, by pairs i <= k."""


class Drift(NamedTuple):
    """A slow error of each axis of a triad, or the surge: a first-order process."""

    variance: Scalar  # at the first sample; that of a stationary process if ``rate`` is not zero
    rate: Scalar  # 1 over its correlation time, 1/s; 0 for a random walk
    density: Scalar  # variance that a random walk gains per second


class SensorNoise(NamedTuple):
    """The noise of the sensors and of the base, SI units."""

    gyro: Scalar  # density of the gyros' white noise, rad/s^0.5
    accel: Scalar  # density of the accelerometers' white noise, m/s^1.5
    gyro_drifts: tuple[Drift, ...] = ()  # of each gyro, rad/s
    accel_drifts: tuple[Drift, ...] = ()  # of each accelerometer, m/s^2
    # Velocity of the base along east and north, m/s; None for a base in place
    surge: Drift | None = None


class NoiseState(NamedTuple):
    """A slow error of the blocks as a complex state of the level axes: w, a drift or the surge."""

    seen: Scalar  # factor of the state in a measurement
    kept: Scalar  # share of it that is left after a block
    # Factor with which it adds to w; None for a state that does not turn with the body
    to_walk: Scalar | None
    driven: Scalar  # variance that it gains in a block
    shared: Scalar  # covariance of that with the noise of the measurement
    variance: Scalar  # before the first block


class NoiseModel(NamedTuple):
    """Noise of the blocks: its slow states, w first, and the variance of a measurement's noise."""

    states: tuple[NoiseState, ...]
    measured: Scalar

    def cast(self, number: Number) -> Number:
        """Return a number as complex if a state turns with the body; else real numbers do."""
        turns = any(state.to_walk is not None for state in self.states)
        return jnp.asarray(number).astype(complex) if turns else jnp.asarray(number)

    def initial(self) -> Covariance:
        """Return the covariance of the states before the first block."""
        off, n = self.cast(jnp.zeros_like(self.measured)), len(self.states)
        pairs = [(i, k) for i in range(n) for k in range(i, n)]
        return {(i, k): self.states[i].variance if i == k else off for i, k in pairs}


def block_noise_model(noise: SensorNoise, gravity: Scalar, length_s: float) -> NoiseModel:
    """Return the model of blocks of a length."""
    h, zero = length_s, jnp.zeros_like(noise.gyro)
    gh, q = gravity * h, noise.gyro**2 * h
    # The measurement sees the mean of w over the block, of which half and a third are new.
    states = [NoiseState(gh, zero + 1, None, q, gh * q / 2, zero)]
    measured = gh**2 * q / 3 + noise.accel**2 * h
    drifts = [(gh * h / 2, zero + h, drift) for drift in noise.gyro_drifts]
    drifts += [(zero + h, zero, drift) for drift in noise.accel_drifts]
    drifts += [] if noise.surge is None else [(None, None, noise.surge)]
    for seen, to_walk, drift in drifts:
        kept = jnp.exp(-drift.rate * h)
        driven = drift.variance * -jnp.expm1(-2 * drift.rate * h) + drift.density * h
        shared = zero
        if seen is None:  # the surge, whose change a block sees
            seen, shared, measured = kept - 1, driven, measured + driven
        states.append(NoiseState(seen, kept, to_walk, driven, shared, drift.variance))
    return NoiseModel(tuple(states), measured)


def kalman_predictor_step(
    noise: NoiseModel, variance: Covariance, middle: Scalar, turned: Scalar
) -> tuple[list[Number], list[dict[int, Number]], list[Number], Scalar, Covariance]:
    """Return measurement, transition, gain, innovation variance and the covariance after a block.

    The transition is rows of entries by column, without zeros; ``turned`` is the angle by which the
    body turned about the vertical in the block, and ``middle`` its mean over the block, rad.
    """
    states, places, cast = noise.states, range(len(noise.states)), noise.cast

    def p(i: int, k: int) -> Number:
        return cast(variance[i, k]) if i <= k else jnp.conj(cast(variance[k, i]))

    step = [{i: cast(state.kept)} for i, state in enumerate(states)]
    sees = [state.seen for state in states]
    for i, state in enumerate(states):
        if state.to_walk is not None:
            mean = jnp.exp(cast(middle) * 1j)
            sees[i], step[0][i] = cast(state.seen) * mean, cast(state.to_walk) * mean
            step[i][i] = step[i][i] * jnp.exp(cast(turned) * 1j)
    seen = [sum(p(i, k) * cast(jnp.conj(sees[k])) for k in places) for i in places]
    s = noise.measured + sum(jnp.real(cast(sees[i]) * seen[i]) for i in places)
    moved = [
        sum(f * seen[k] for k, f in row.items()) + cast(state.shared)
        for row, state in zip(step, states, strict=True)
    ]
    half = [[sum(f * p(j, k) for j, f in row.items()) for k in places] for row in step]
    after = {}
    for i, k in variance:
        value = sum(half[i][j] * jnp.conj(f) for j, f in step[k].items())
        value = value - moved[i] * jnp.conj(moved[k]) / cast(s)
        after[i, k] = jnp.real(value) + states[i].driven if i == k else value
    return sees, step, [m / cast(s) for m in moved], s, after


def multiply_pairs(factor: Number, pairs: Array) -> Array:
    """Return a number, maybe complex, times complex numbers in pairs, (n, 2)."""
    if not jnp.iscomplexobj(factor):
        return factor * pairs
    x, y = pairs.T
    real, imaginary = jnp.real(factor), jnp.imag(factor)
    return jnp.stack([real * x - imaginary * y, imaginary * x + real * y], axis=-1)


def vertical_gyro_heading_variance(noise: SensorNoise, time_s: Scalar) -> Scalar:
    """Return the variance by which noise and drift of the vertical gyro turn the heading."""
    total = noise.gyro**2 * time_s
    for drift in noise.gyro_drifts:
        x = drift.rate * time_s
        small = x < 1e-2
        large = jnp.where(small, 1.0, x)
        share = jnp.where(small, 1 - x / 3, 2 * (large + jnp.expm1(-large)) / large**2)
        total = total + drift.variance * time_s**2 * share + drift.density * time_s**3 / 3
    return total
