"""The true motion of a base over a whole study, made block by block.

One program of each kind thus serves studies of any length.
"""

import jax
import jax.numpy as jnp
import numpy as np

from sinsjax.strapdown import base_motion
from sinsjax.strapdown.base_motion import Motion
from sinsjax.strapdown.earth import Place
from sinsjax.types import Array

_SAMPLES, _TIMES = 4000, 256
"""Samples of increments, and attitudes, that are made at a time."""

_increments = jax.jit(base_motion.increments, static_argnums=3)
_increments_and_axes = jax.jit(base_motion.increments_and_axes, static_argnums=3)


@jax.jit
def _attitudes(motion: Motion, times: Array) -> Array:
    return jax.vmap(lambda t: jnp.stack(base_motion.attitude(motion, t)))(times)


def rows(motion: Motion, place: Place, rate_hz: float, samples: int, *, axes: bool) -> np.ndarray:
    """Ideal sensor increments, rad and m/s: (samples, 6), or with the axes of n (samples, 15).

    Args:
        motion: of the base.
        place: Earth rates and gravity.
        rate_hz: sample rate, Hz.
        samples: how many, from the first.
        axes: whether to give the axes of n in b as well, means over each sample.
    """
    made, _ = blank(samples, 0, axes=axes)
    make = _increments_and_axes if axes else _increments
    for first in range(0, samples, _SAMPLES):
        some = made[first : first + _SAMPLES]
        some[:] = make(motion, place, rate_hz, _SAMPLES, float(first))[: len(some)]
    return made


def attitudes(motion: Motion, times: np.ndarray) -> np.ndarray:
    """True attitudes, body to n, (n, 4) quaternions at times (n,), s."""
    _, made = blank(0, len(times), axes=False)
    for first in range(0, len(times), _TIMES):
        some = made[first : first + _TIMES]
        padded = np.resize(times[first : first + _TIMES], _TIMES)
        some[:] = _attitudes(motion, padded)[: len(some)]
    return made


def blank(samples: int, times: int, *, axes: bool) -> tuple[np.ndarray, np.ndarray]:
    """Zeros of the shapes of `rows` and `attitudes`."""
    return np.zeros((samples, 15 if axes else 6)), np.zeros((times, 4))
