"""Stationary random processes as recursions from sample to sample, and their driving noise.

A process is linear and driven by one white number w of variance 1 a sample,

    x' = A x + b w,    y = c x + d w,

three times over, an axis each. What the recursions need of time constants and sample time is worked
out here once, with NumPy; they begin in their stationary distribution. A process is made from
``rms``, (..., 3) of each axis, and the sample time ``dt``, s; its other numbers are (...,).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from sinsjax.maths import rng
from sinsjax.maths.algebra import add, scale
from sinsjax.types import Array, Count, Scalar, Vec3

Numbers = np.ndarray | np.floating | float
"""Inputs of recursions, with leading axes, of draws, if any."""

State = tuple[Vec3, ...]
"""x of the three axes: a `Vec3` for each component."""

TRIADS, MOST_STATES = 8, 3
"""Triads of numbers per sample for all processes, and the most components that x may have."""

MOST_SAMPLES = 2**32 // TRIADS - 2 * MOST_STATES
"""Samples that have driving noise; the numbers after them are for the beginning."""


class Process(NamedTuple):
    """One process on three axes; leaves may have leading axes, of draws.

    Attributes:
        transition: (n, n) A.
        drive: (n,) b.
        output: (n,) c.
        direct: d.
        begin: (n, n) lower triangular factor of the covariance of x before the first sample.
        scale: (3,) factor of each axis, in the unit of the process.
        derivative: (n,) c of the time derivative of a process that has one; else None.
    """

    transition: Array
    drive: Array
    output: Array
    direct: Scalar
    begin: Array
    scale: Array
    derivative: Array | None = None


def gauss_markov_process(rms: Numbers, time: Numbers, dt: float) -> Process:
    """Return a first-order Gauss-Markov process of a correlation time (s) at sample times."""
    kept = np.exp(-dt / np.asarray(time, float))
    one = np.ones_like(kept)
    return _first_order_process(kept, np.sqrt(1 - kept * kept), 0.0 * one, one, rms)


def sampled_mean_of_gauss_markov(rms: Numbers, time: Numbers, dt: float) -> Process:
    """Return the means over samples of a first-order Gauss-Markov process, as sensors integrate it.

    The means of a continuous process, of a correlation time (s), are an ARMA(1, 1) sequence; its
    two coefficients follow from the variance of a mean and its covariance with the next one.
    """
    r = dt / np.asarray(time, float)
    kept, lost = np.exp(-r), -np.expm1(-r)
    small = r < 1e-2  # there the closed form of the variance cancels
    series = 1 - r / 3 + r * r / 12 - r**3 / 60
    variance = np.where(small, series, 2 * (r - lost) / (r * r))
    nearby = (lost / r) ** 2
    drive, direct = _moving_average_coefficients(
        (1 + kept * kept) * variance - 2 * kept * nearby, nearby - kept * variance
    )
    begin = (kept * direct + drive) / np.sqrt(lost * (1 + kept))
    return _first_order_process(kept, kept * direct + drive, direct, begin, rms)


def sampled_mean_of_random_walk(density: Numbers, dt: float) -> Process:
    """Return the means over samples of a random walk that starts at zero.

    ``density``, (..., 3), is its standard deviation after a second, of each axis.
    """
    one, rms = np.ones(np.shape(density)[:-1]), np.asarray(density) * np.sqrt(dt)
    drive, direct = _moving_average_coefficients(2 / 3 * one, 1 / 6 * one)
    return _first_order_process(one, direct + drive, direct, 0.0 * one, rms)


def rounding_process(quantum: Numbers) -> Process:
    """Return the error of rounded increments that carry on the remainder, which begins at zero.

    ``quantum``, (..., 3), is that of each axis.
    """
    zero, rms = np.zeros(np.shape(quantum)[:-1]), np.asarray(quantum) / np.sqrt(12)
    process = _first_order_process(zero, zero + 1, zero + 1, zero, rms)
    return process._replace(output=-process.output)


def velocity_of_bounded_position(
    rms: Numbers, time: Numbers, bandwidth_hz: Numbers, dt: float
) -> Process:
    """Return the velocity of a position that wanders within bounds, at sample times.

    White noise through the oscillator s'' + s'/T + s/T^2 and then a first-order lag gives the
    position: it, its velocity and its acceleration have finite variances, and those of the last two
    have the ratio 2 pi B/T + 1/T^2 of the lag's bandwidth B. The noise is held over a sample, and
    scaled to the velocity asked for: ``rms`` in m/s, ``time`` T in s.
    """
    rate, lag = 1 / np.asarray(time, float), 2 * np.pi * np.asarray(bandwidth_hz, float)
    zero, one = 0.0 * (rate + lag), 1.0 + 0.0 * (rate + lag)
    # In units of T: s, s' and the lagged position.
    rows = (zero, rate, zero), (-rate, -rate, zero), (lag, zero, -lag)
    return _discretise_with_held_noise(rows, (zero, one, zero), (lag, zero, -lag), rms, dt)


def resonance_process(rms: Numbers, frequency_hz: Numbers, damping: Numbers, dt: float) -> Process:
    """Return the vibration of a lightly damped structure driven by white noise, at sample times.

    The structure has an undamped natural frequency (Hz) and a damping ratio.
    """
    rate = 2 * np.pi * np.asarray(frequency_hz, float)
    zero, one = 0.0 * (rate + damping), 1.0 + 0.0 * (rate + damping)
    rows = ((zero, rate * one), (-rate * one, -2 * np.asarray(damping) * rate))
    made = _discretise_with_held_noise(rows, (zero, one), (one, zero), rms, dt)
    return made._replace(derivative=(rate * one)[..., None] * made.output[..., ::-1])


def _moving_average_coefficients(variance: Numbers, covariance: Numbers) -> tuple[Numbers, Numbers]:
    """Return a and b of the sequence a w_(k-1) + b w_k with a variance and a lag-one covariance."""
    b2 = (variance + np.sqrt(np.maximum(variance * variance - 4 * covariance * covariance, 0))) / 2
    b = np.sqrt(b2)
    return covariance / b, b


def _first_order_process(
    kept: Numbers, drive: Numbers, direct: Numbers, begin: Numbers, rms: Numbers
) -> Process:
    matrix, column = (..., None, None), (..., None)
    a, b, c = np.asarray(kept)[matrix], np.asarray(drive)[column], np.ones_like(kept)[column]
    return Process(a, b, c, direct, np.asarray(begin)[matrix], np.asarray(rms, float))


def _discretise_with_held_noise(
    rows: tuple, drive: tuple, output: tuple, rms: Numbers, dt: float
) -> Process:
    """Return a continuous process, (...,) entries, with its driving noise held over each sample."""
    # Half the time that importing all of sinsjax takes, and only such a process needs it.
    from scipy.linalg import expm

    n = len(drive)
    continuous = np.zeros((*np.shape(drive[0]), n + 1, n + 1))
    for i, row in enumerate(rows):
        for j, entry in enumerate((*row, drive[i])):
            continuous[..., i, j] = entry
    stepped = expm(continuous * dt)
    a, b = stepped[..., :n, :n], stepped[..., :n, n]
    c = np.stack(np.broadcast_arrays(*output), axis=-1)
    kron = np.einsum("...ij,...kl->...ikjl", a, a).reshape(*a.shape[:-2], n * n, n * n)
    noise = (b[..., :, None] * b[..., None, :]).reshape(*a.shape[:-2], n * n, 1)
    covariance = np.linalg.solve(np.eye(n * n) - kron, noise).reshape(a.shape)
    variance = np.einsum("...i,...ij,...j->...", c, covariance, c)
    begin = np.linalg.cholesky((covariance + np.swapaxes(covariance, -1, -2)) / 2)
    c = c / np.sqrt(variance)[..., None]
    return Process(a, b, c, np.zeros(a.shape[:-2]), begin, np.asarray(rms, float))


def initial_state(process: Process, normal: State) -> State:
    """X of a process without leading axes before the first sample, from standard normal numbers."""
    rows = range(len(process.drive))
    return tuple(_linear_combinations(process.begin[i, : i + 1], normal[: i + 1]) for i in rows)


def process_output(process: Process, state: State, normal: Vec3 | None = None) -> Vec3:
    """Return y of the three axes in a state; without ``normal`` that of a process whose d is 0."""
    y = _linear_combinations(process.output, state)
    if normal is not None:
        y = add(y, scale(process.direct, normal))
    return Vec3(*(factor * part for factor, part in zip(process.scale, y, strict=True)))


def advance_process(process: Process, state: State, normal: Vec3) -> State:
    """Return x one sample later."""
    rows = zip(process.transition, process.drive, strict=True)
    return tuple(add(_linear_combinations(row, state), scale(b, normal)) for row, b in rows)


def _linear_combinations(factors: Array, vectors: State) -> Vec3:
    total = scale(factors[0], vectors[0])
    for factor, vector in zip(factors[1:], vectors[1:], strict=True):
        total = add(total, scale(factor, vector))
    return total


def driving_noise(
    seed: Count, draw_id: Array, samples: Array, triads: tuple[int, ...]
) -> dict[int, Vec3]:
    """Return white numbers of mean 0 and variance 1 for the processes of one draw or of many.

    They depend on seed, draw, sample and triad alone, are independent of
    `sensors.draw_normal_numbers`, and do not depend on which other processes there are. They are
    made in one row, in single precision.

    Args:
        seed: the study's seed, below 2^63.
        draw_id: () or (draws,), below 2^32.
        samples: (n,) their numbers, below `MOST_SAMPLES`; any that is negative stands for zero.
        triads: which are wanted, below `TRIADS`; the numbers of each have leaves (n, *draws).
    """
    if not triads:
        return {}
    counters = TRIADS * jnp.maximum(samples, 0)[None] + jnp.asarray(triads)[:, None]
    made = rng.random_numbers(rng.binomial_triad, seed, draw_id, counters, apart=1)
    # Integers look cheap to XLA, which would make them anew for each of the numbers.
    axes = jax.lax.optimization_barrier(made)
    return {t: Vec3(*(a[i].astype(float) for a in axes)) for i, t in enumerate(triads)}


def standard_normals_for_initial_states(
    seed: Count, draw_id: Count, triads: tuple[int, ...]
) -> dict[int, State]:
    """Return standard normal numbers for the states of a draw's processes before its first sample.

    By triad, see `driving_noise`.
    """
    if not triads:
        return {}
    after = MOST_SAMPLES + jnp.arange(2 * MOST_STATES)
    counters = TRIADS * after[None] + jnp.asarray(triads)[:, None]
    pairs = rng.random_numbers(rng.normal_pair, seed, draw_id, counters, apart=1)
    first, second = (a.astype(float) for a in pairs)

    def state(i: int, j: int) -> Vec3:
        return Vec3(first[i, 2 * j], second[i, 2 * j], first[i, 2 * j + 1])

    return {t: tuple(state(i, j) for j in range(MOST_STATES)) for i, t in enumerate(triads)}
