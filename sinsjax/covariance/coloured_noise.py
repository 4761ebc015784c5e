"""Coloured inputs of the true error: drifting biases, a surging base, vibration, drawn biases.

Each is a process x' = A x + b w, y = c x + d w on three axes (`strapdown.processes`), whose y is an
error of a sample's increments. Over a record interval two things are accumulated for the error d of
the corrected solution: its response to x at the beginning of the interval, and its covariance with
the noise that has driven x since. From record to record d and all x are propagated together.
"""

from collections.abc import Iterator
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import block_diag

from sinsjax.maths import rotations
from sinsjax.maths.algebra import Minus, Triangle, times_plus_identity
from sinsjax.methods.base import ErrorStep
from sinsjax.strapdown.disturbances import Disturbances
from sinsjax.strapdown.processes import Process, constant_process
from sinsjax.types import Array, Quat, Scalar

_LEAST_SHARE = 1e-12
"""Least remaining share of a variance; less is rounding."""

VELOCITY, ANGLE = 0, 3
"""Number of the first increment that a process is an error of, among those of both sensors."""

IN_N, IN_B = "n", "b"


class ColouredInputs(NamedTuple):
    """A process per coloured input, or something for each process; None if it is absent.

    The last two are the deviations of drawn constant biases from their means, the others are those
    of `Disturbances` but for the rotation of the housing, which the gyros measure.
    """

    surge: Any = None
    gyro_instability: Any = None
    accel_instability: Any = None
    gyro_walk: Any = None
    accel_walk: Any = None
    shaking: Any = None
    gyro_bias: Any = None
    accel_bias: Any = None


PROCESS_INPUTS = ColouredInputs(
    surge=(VELOCITY, IN_N),
    gyro_instability=(ANGLE, IN_B),
    accel_instability=(VELOCITY, IN_B),
    gyro_walk=(ANGLE, IN_B),
    accel_walk=(VELOCITY, IN_B),
    shaking=(VELOCITY, IN_B),
    gyro_bias=(ANGLE, IN_B),
    accel_bias=(VELOCITY, IN_B),
)
"""Increments and axes in which each process enters."""

_INTEGRATED = ("surge", "shaking")
"""Processes that are a velocity, whose change is part of an increment."""


class ProcessGrowth(NamedTuple):
    """The effect of one process with p states on d since the record interval began.

    Attributes:
        row: (p,) response of y to x at the beginning.
        variance: (p, p) of x on each axis, given x at the beginning.
        response: n arrays (p, 3), response of d to x at the beginning.
        cross: n arrays (p, 3), covariance of d with x.
    """

    row: Array
    variance: Array
    response: tuple[Array, ...]
    cross: tuple[Array, ...]


def increment_error_processes(
    disturbances: Disturbances,
    dt: float,
    gyro_bias: np.ndarray | None = None,
    accel_bias: np.ndarray | None = None,
) -> ColouredInputs:
    """Return the processes whose y is the error of a sample's increments, rad and m/s.

    Args:
        disturbances: processes of base and sensors.
        dt: sample time, s.
        gyro_bias: (3,) standard deviation of drawn biases, rad/s; None if they are not drawn.
        accel_bias: (3,) likewise, m/s^2.
    """
    drawn = {"gyro_bias": gyro_bias, "accel_bias": accel_bias}
    constants = {
        name: constant_process(sigma) for name, sigma in drawn.items() if sigma is not None
    }
    errors = {}
    for name, process in (disturbances._asdict() | constants).items():
        if process is None or name == "rocking":
            continue
        if name in _INTEGRATED:
            a, c = process.transition, process.output
            change = jnp.asarray(c) @ (jnp.asarray(a) - jnp.eye(len(process.drive)))
            errors[name] = process._replace(output=change, direct=jnp.asarray(c) @ process.drive)
        else:
            errors[name] = process._replace(scale=process.scale * dt)
    return ColouredInputs(**errors)


def present_processes(coloured: ColouredInputs) -> Iterator[tuple[Process, tuple[int, str]]]:
    """Yield the processes that are present, with the increments and axes in which they enter."""
    for process, entry in zip(coloured, PROCESS_INPUTS, strict=True):
        if process is not None:
            yield process, entry


def initial_process_growth(process: Process, n: int, zero: Scalar) -> ProcessGrowth:
    """Return the growth at the beginning of an interval for n states of d."""
    p = process.output.shape[0]
    none = (jnp.zeros((p, 3)) + zero,) * n
    return ProcessGrowth(process.output + zero, jnp.zeros((p, p)) + zero, none, none)


def advance_process_growth(
    growth: ProcessGrowth,
    process: Process,
    step: ErrorStep,
    effect: tuple[Array, ...],
    covariance: Triangle,
) -> tuple[ProcessGrowth, Triangle]:
    """Return the growth one sample later, and the covariance of d with the process included.

    Args:
        growth: so far.
        process: an error of increments, see `increment_error_processes`.
        step: of the sample, whose gains are applied.
        effect: n arrays (3,), change of d by a unit error on each axis.
        covariance: of d without the process, before the gains.
    """
    a, b, c = process.transition, process.drive, process.output
    scale, shared = process.scale, growth.variance @ c
    unmeasured = jax.vmap(partial(times_plus_identity, step.transition))
    propagate = jax.vmap(jax.vmap(partial(_propagate_with_process, step)), in_axes=(0, None, 0))
    along = unmeasured(tuple(scale * jnp.sum(c[:, None] * x, axis=0) for x in growth.cross))
    variance = scale**2 * (c @ shared + process.direct**2)
    n = len(effect)
    added = tuple(
        jnp.sum(along[i] * effect[j] + effect[i] * along[j] + variance * effect[i] * effect[j])
        for i in range(n)
        for j in range(i, n)
    )
    cross = tuple(jnp.sum(a[:, :, None] * x[None], axis=1) for x in growth.cross)
    driven = a @ shared + process.direct * b
    later = ProcessGrowth(
        growth.row @ a,
        a @ growth.variance @ a.T + jnp.outer(b, b),
        propagate(growth.response, effect, jnp.outer(growth.row, scale)),
        propagate(cross, effect, jnp.outer(driven, scale)),
    )
    return later, tuple(x + y for x, y in zip(covariance, added, strict=True))


def _propagate_with_process(
    step: ErrorStep, d: tuple[Scalar, ...], effect: tuple[Scalar, ...], size: Scalar
) -> tuple[Scalar, ...]:
    """Return the error d one sample later, with an error of an increment of a given size."""
    out = times_plus_identity(step.transition, d)
    return step.apply_gains(tuple(x + h * size for x, h in zip(out, effect, strict=True)))


def unit_effect(step: ErrorStep, q: Quat, n: int, first: int, axes: str) -> tuple[Array, ...]:
    """Return the change of d by a unit error of an increment on each axis, n arrays (3,).

    Args:
        step: of the sample.
        q: attitude, body to n.
        n: number of states of d.
        first: `VELOCITY` or `ANGLE`.
        axes: `IN_N` or `IN_B`, the frame of the three axes.
    """
    if axes == IN_B:
        rows = [jnp.stack(row) for row in rotations.matrix(q)]
    else:
        rows = list(jnp.eye(3))
    out: list[Array] = [jnp.zeros(3)] * n
    for (i, axis), by in step.inputs.items():
        if first <= axis < first + 3:
            row = rows[axis - first]
            out[i] = out[i] - by.of * row if isinstance(by, Minus) else out[i] + by * row
    return tuple(out)


def to_rows(arrays: tuple[Array, ...]) -> tuple[tuple[Scalar, ...], ...]:
    """Return arrays (p, 3), one per state of d, as rows of numbers, axis by axis per state."""
    return tuple(
        tuple(array[s, axis] for s in range(array.shape[0]) for axis in range(3))
        for array in arrays
    )


# From record to record: the states of the processes together with d


class IntervalInputs(NamedTuple):
    """All processes over a record interval, with m states on all axes.

    Attributes:
        transition: (m, m).
        noise: (m, m) covariance of the noise that drives them meanwhile.
        initial: (m, m) factor of the covariance before the first sample.
    """

    transition: Array
    noise: Array
    initial: Array


def count_states(coloured: ColouredInputs) -> int:
    """Return the number of states of all processes on their three axes."""
    return sum(3 * process.output.shape[-1] for process, _ in present_processes(coloured))


def propagate_processes(coloured: ColouredInputs, samples: int) -> IntervalInputs:
    """Return all processes over an interval of the given number of samples."""
    each = [_propagate_process(process, samples) for process, _ in present_processes(coloured)]
    return IntervalInputs(*(block_diag(*matrices) for matrices in zip(*each, strict=True)))


def _propagate_process(process: Process, samples: int) -> tuple[Array, Array, Array]:
    """Return transition, noise and initial factor of one process on three axes."""
    a, b = jnp.asarray(process.transition), jnp.asarray(process.drive)

    def over_sample(_: Array, moments: tuple[Array, Array]) -> tuple[Array, Array]:
        power, noise = moments
        return a @ power, a @ noise @ a.T + jnp.outer(b, b)

    start = jnp.eye(len(b)), jnp.zeros((len(b), len(b)))
    power, noise = jax.lax.fori_loop(0, samples, over_sample, start)
    axes = jnp.eye(3)
    return jnp.kron(power, axes), jnp.kron(noise, axes), jnp.kron(process.begin, axes)


def join_with_processes(
    f: Array, w: Array, response: Array, cross: Array, inputs: IntervalInputs
) -> tuple[Array, Array]:
    """Return F and W of d and the states of the processes together, (n + m, n + m) each.

    Args:
        f: (n, n) of d.
        w: (n, n) of d, by white noise and by the processes.
        response: (n, m) of d to the states at the beginning of the interval.
        cross: (n, m) covariance of d with the states.
        inputs: the processes over the interval.
    """
    m, n = cross.shape[1], len(f)
    whole = jnp.block([[f, response], [jnp.zeros((m, n)), inputs.transition]])
    return whole, jnp.block([[w, cross], [cross.T, inputs.noise]])


def semidefinite_factor(p: Array) -> Array:
    """Return the lower triangular L with P = L L', P symmetric and positive semidefinite (n, n).

    A variance that others explain except for rounding counts as explained.
    """
    n = len(p)
    out = jnp.zeros_like(p)
    for j in range(n):
        left = p[j, j] - jnp.sum(out[j] ** 2)
        is_left = left > _LEAST_SHARE * p[j, j]
        root = jnp.sqrt(jnp.where(is_left, left, 1.0))
        column = jnp.where(is_left, (p[:, j] - out @ out[j]) / root, 0.0)
        out = out.at[:, j].set(jnp.where(jnp.arange(n) >= j, column, 0.0))
    return out
