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


class Drift(NamedTuple):
    """A slow error of each axis of a triad, or the surge: a first-order process.

    Attributes:
        variance: at the first sample; that of a stationary process if ``rate`` is not zero.
        rate: 1 over its correlation time, 1/s; 0 for a random walk.
        density: variance that a random walk gains per second.
    """

    variance: Scalar
    rate: Scalar
    density: Scalar

    def kept(self, length_s: float) -> Scalar:
        """Return the share of it that is left after a time."""
        return jnp.exp(-self.rate * length_s)

    def driven(self, length_s: float) -> Scalar:
        """Return the variance that it gains in a time."""
        return self.variance * -jnp.expm1(-2 * self.rate * length_s) + self.density * length_s


class SensorNoise(NamedTuple):
    """The noise of the sensors and of the base, SI units.

    Attributes:
        gyro: density of the gyros' white noise, rad/s^0.5.
        accel: density of the accelerometers' white noise, m/s^1.5.
        gyro_drifts: of each gyro, rad/s.
        accel_drifts: of each accelerometer, m/s^2.
        surge: velocity of the base along east and north, m/s; None for a base in place.
    """

    gyro: Scalar
    accel: Scalar
    gyro_drifts: tuple[Drift, ...] = ()
    accel_drifts: tuple[Drift, ...] = ()
    surge: Drift | None = None


class NoiseState(NamedTuple):
    """A slow error as a complex state of the level axes.

    Attributes:
        seen: factor of the state in a measurement.
        kept: share of it that is left after a block.
        to_walk: factor with which it adds to w; None for a state that does not turn with the body.
        driven: variance that it gains in a block.
        shared: covariance of that with the noise of the measurement.
        variance: before the first block.
    """

    seen: Scalar
    kept: Scalar
    to_walk: Scalar | None
    driven: Scalar
    shared: Scalar
    variance: Scalar


class NoiseModel(NamedTuple):
    """Noise of the blocks.

    Attributes:
        states: w, then drifts, which turn with the body, then the surge.
        measured: variance of the noise of a measurement.
    """

    states: tuple[NoiseState, ...]
    measured: Scalar

    @property
    def turns(self) -> bool:
        """Whether a state turns with the body, so that covariances are complex."""
        return any(state.to_walk is not None for state in self.states)

    def initial(self) -> dict[tuple[int, int], Number]:
        """Return the covariance of the states before the first block, by pairs i <= k."""
        zero, n = jnp.zeros_like(self.measured), len(self.states)
        off = _as_complex(zero) if self.turns else zero
        return {
            (i, k): self.states[i].variance if i == k else off
            for i in range(n)
            for k in range(i, n)
        }


def noise_model(noise: SensorNoise, gravity: Scalar, length_s: float) -> NoiseModel:
    """Return the model of blocks of a length."""
    h, zero = length_s, jnp.zeros_like(noise.gyro)
    gh, q = gravity * h, noise.gyro**2 * h
    # The measurement sees the mean of w over the block, of which half and a third are new.
    states = [NoiseState(gh, zero + 1, None, q, gh * q / 2, zero)]
    drifts = [(gh * h / 2, zero + h, drift) for drift in noise.gyro_drifts]
    drifts += [(zero + h, zero, drift) for drift in noise.accel_drifts]
    for seen, to_walk, drift in drifts:
        kept, driven = drift.kept(h), drift.driven(h)
        states.append(NoiseState(seen, kept, to_walk, driven, zero, drift.variance))
    measured = gh**2 * q / 3 + noise.accel**2 * h
    if noise.surge is not None:
        kept, driven = noise.surge.kept(h), noise.surge.driven(h)
        states.append(NoiseState(kept - 1, kept, None, driven, driven, noise.surge.variance))
        measured = measured + driven
    return NoiseModel(tuple(states), measured)


def predict(
    noise: NoiseModel, variance: dict[tuple[int, int], Number], turned: Scalar
) -> tuple[list[list[Number | None]], list[Number], Scalar, dict[tuple[int, int], Number]]:
    """Return transition, gain, innovation variance and the covariance after a block.

    Args:
        noise: model of the blocks.
        variance: covariance before the block.
        turned: angle by which the body turned about the vertical, rad.
    """
    states, places = noise.states, range(len(noise.states))
    # Real numbers do as long as no state turns.
    cast = _as_complex if noise.turns else jnp.asarray

    def p(i: int, k: int) -> Number:
        return cast(variance[i, k]) if i <= k else jnp.conj(cast(variance[k, i]))

    step: list[list[Number | None]] = [[None for _ in places] for _ in places]
    for i, state in enumerate(states):
        step[i][i] = cast(state.kept)
        if state.to_walk is not None:
            step[i][i] = cast(state.kept) * jnp.exp(_as_complex(turned) * 1j)
            step[0][i] = cast(state.to_walk)
    seen = [sum(p(i, k) * cast(states[k].seen) for k in places) for i in places]
    s = noise.measured + sum(states[i].seen * jnp.real(seen[i]) for i in places)
    moved = [
        sum(f * seen[k] for k, f in enumerate(row) if f is not None) + cast(states[i].shared)
        for i, row in enumerate(step)
    ]
    half = [
        [sum(f * p(j, k) for j, f in enumerate(row) if f is not None) for k in places]
        for row in step
    ]
    after = {}
    for i, k in variance:
        terms = (half[i][j] * jnp.conj(f) for j, f in enumerate(step[k]) if f is not None)
        value = sum(terms) - moved[i] * jnp.conj(moved[k]) / cast(s)
        after[i, k] = jnp.real(value) + states[i].driven if i == k else value
    return step, [m / cast(s) for m in moved], s, after


def _as_complex(number: Number) -> Number:
    return jnp.asarray(number).astype(complex)


def times(factor: Number, pairs: Array) -> Array:
    """Return a number, maybe complex, times complex numbers in pairs, (n, 2)."""
    if not jnp.iscomplexobj(factor):
        return factor * pairs
    real, imaginary = jnp.real(factor), jnp.imag(factor)
    return jnp.stack(
        [
            real * pairs[:, 0] - imaginary * pairs[:, 1],
            imaginary * pairs[:, 0] + real * pairs[:, 1],
        ],
        axis=-1,
    )


def heading_variance(noise: SensorNoise, time_s: Scalar) -> Scalar:
    """Return the variance by which noise and drift of the vertical gyro turn the heading."""
    total = noise.gyro**2 * time_s
    for drift in noise.gyro_drifts:
        x = drift.rate * time_s
        small = x < 1e-2
        large = jnp.where(small, 1.0, x)
        share = jnp.where(small, 1 - x / 3, 2 * (large + jnp.expm1(-large)) / large**2)
        total = total + drift.variance * time_s**2 * share + drift.density * time_s**3 / 3
    return total
