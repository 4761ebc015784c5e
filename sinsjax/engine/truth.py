"""True and coarsely aligned attitudes, and the increments of ideal sensors, of whole studies."""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from sinsjax.methods.method import Options, Program, Site
from sinsjax.methods.registry import METHODS
from sinsjax.strapdown import base_motion, earth, sensors
from sinsjax.types import Array, Navigation, Quat, Sample, Scalar

_SAMPLES, _TIMES = 4000, 256
"""Samples of increments, and attitudes, per call: one program serves studies of any length."""


@partial(jax.jit, static_argnums=(0, 2))
def coarse_attitudes(method: str, rows: Array, dt: float, site: Site) -> Array:
    """Return coarsely aligned attitudes at the ends of parts of a record, (parts, 4).

    The method needs no initial attitude and no params; the rows (parts, n, 6) are measured
    increments over ``dt`` s, rad and m/s.
    """
    program = METHODS[method].build(Options(dt))

    def align(part: Array) -> Array:
        samples = sensors.compensate_record(part, part[0])
        return jnp.stack(align_by_program(program, samples, site))

    return jax.vmap(align)(rows)


def align_by_program(program: Program, samples: Sample, site: Site) -> Quat:
    """Return q_nb at the end of compensated samples, leaves (n,), by a method without params."""
    counts = 1 + jnp.arange(samples.dv.x.size, dtype=samples.dv.x.dtype)
    zero = jnp.zeros_like(counts[0])
    start = Navigation(Quat(zero + 1, zero, zero, zero), zero, zero, site.latitude + zero, zero)

    def over_sample(state: Any, numbered: tuple[Sample, Scalar]) -> tuple[Any, None]:
        sample, n = numbered
        return program.step((), site, state, sample, n), None

    state, _ = jax.lax.scan(over_sample, program.init((), start), (samples, counts))
    return program.attitude(program.normalise(state))


_increments = jax.jit(base_motion.ideal_increments, static_argnums=3)
_increments_and_axes = jax.jit(base_motion.ideal_increments_and_axes, static_argnums=3)


@jax.jit
def _attitudes(motion: base_motion.Motion, times: Array) -> Array:
    return jax.vmap(lambda t: jnp.stack(base_motion.attitude(motion, t)))(times)


def true_increments(
    motion: base_motion.Motion,
    place: earth.Place,
    rate_hz: float,
    samples: int,
    *,
    axes: bool = False,
    blank: bool = False,
) -> np.ndarray:
    """Return ideal increments, rad and m/s: (samples, 6), or with the axes of n (samples, 15).

    The axes of n in b are means over each sample. If blank, all are zero, enough to compile.
    """
    increments = np.zeros((samples, 15 if axes else 6))
    integrate = _increments_and_axes if axes else _increments
    for first in range(0, 0 if blank else samples, _SAMPLES):
        block = increments[first : first + _SAMPLES]
        block[:] = integrate(motion, place, rate_hz, _SAMPLES, float(first))[: len(block)]
    return increments


def true_attitudes(
    motion: base_motion.Motion, times: np.ndarray, *, blank: bool = False
) -> np.ndarray:
    """Return true attitudes, body to n, (n, 4) quaternions at times (n,), s; or zeros if blank."""
    attitudes = np.zeros((len(times), 4))
    for first in range(0, 0 if blank else len(times), _TIMES):
        block = attitudes[first : first + _TIMES]
        padded = np.resize(times[first : first + _TIMES], _TIMES)
        block[:] = _attitudes(motion, padded)[: len(block)]
    return attitudes
