"""How inputs that are not white enter the true error over a record interval.

A drifting bias and a surging base are processes x' = A x + b w, y = c x + d w on three axes
(`strapdown.processes`), whose y is an error of a sample's increments. Beside the error d of the
corrected solution go its response to x as it was when the interval began, and its covariance with
what has driven x since.
"""

from collections.abc import Iterator
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from sinsjax.maths import rotations
from sinsjax.maths.algebra import Minus, Triangle, times_plus_identity
from sinsjax.methods.base import ErrorStep, apply_gain
from sinsjax.strapdown.disturbances import Disturbances
from sinsjax.strapdown.processes import Process, constant
from sinsjax.types import Array, Quat, Scalar

VELOCITY, ANGLE = 0, 3
"""First of the increments that a process is an error of, among those of both sensors."""

IN_N, IN_B = "n", "b"


class Coloured(NamedTuple):
    """Inputs that are not white, or something of each; None for what there is not.

    The last two are what draws have of a constant bias beyond its mean, the others `Disturbances`.
    """

    surge: Any = None
    gyro_instability: Any = None
    accel_instability: Any = None
    gyro_walk: Any = None
    accel_walk: Any = None
    shaking: Any = None
    rocking: Any = None
    gyro_bias: Any = None
    accel_bias: Any = None


ENTERS = Coloured(
    surge=(VELOCITY, IN_N),
    gyro_instability=(ANGLE, IN_B),
    accel_instability=(VELOCITY, IN_B),
    gyro_walk=(ANGLE, IN_B),
    accel_walk=(VELOCITY, IN_B),
    shaking=(VELOCITY, IN_B),
    rocking=(ANGLE, IN_B),
    gyro_bias=(ANGLE, IN_B),
    accel_bias=(VELOCITY, IN_B),
)
"""Where the three axes of each process enter."""

_MOVES = ("surge", "shaking", "rocking")
"""Processes that are a velocity or an angle, of which increments hold the change."""


class Growth(NamedTuple):
    """What has become of the error by one process since an interval began; p its states.

    Attributes:
        first: (p,) c, where the row begins.
        row: (p,) what y would be of x as it was then.
        variance: (p, p) of x about what it would be, on each axis.
        response: n arrays (p, 3) of d to x as it was then.
        cross: n arrays (p, 3), covariance of d with x.
    """

    first: Array
    row: Array
    variance: Array
    response: tuple[Array, ...]
    cross: tuple[Array, ...]


def increments(
    disturbances: Disturbances,
    dt: float,
    gyro_bias: np.ndarray | None = None,
    accel_bias: np.ndarray | None = None,
) -> Coloured:
    """Processes whose y is the error of a sample's increments, rad and m/s.

    Args:
        disturbances: the processes of a base and its sensors.
        dt: sample time, s.
        gyro_bias: (3,) standard deviation of what draws have for themselves, rad/s; None where
            they have nothing.
        accel_bias: (3,) likewise, m/s^2.
    """
    drawn = {"gyro_bias": gyro_bias, "accel_bias": accel_bias}
    constants = {name: constant(own) for name, own in drawn.items() if own is not None}
    made = {}
    for name, process in (disturbances._asdict() | constants).items():
        if process is None:
            continue
        if name in _MOVES:
            a, c = process.transition, process.output
            change = jnp.asarray(c) @ (jnp.asarray(a) - jnp.eye(len(process.drive)))
            made[name] = process._replace(output=change, direct=jnp.asarray(c) @ process.drive)
        else:
            made[name] = process._replace(scale=process.scale * dt)
    return Coloured(**made)


def each(coloured: Coloured) -> Iterator[tuple[Process, tuple[int, str]]]:
    """The processes there are, and where they enter."""
    for process, enters in zip(coloured, ENTERS, strict=True):
        if process is not None:
            yield process, enters


def begin(process: Process, n: int, zero: Scalar) -> Growth:
    """At the beginning of an interval, for n states of d."""
    p = process.output.shape[0]
    none = (jnp.zeros((p, 3)) + zero,) * n
    c = process.output + zero
    return Growth(c, c, jnp.zeros((p, p)) + zero, none, none)


def anew(growth: Growth) -> Growth:
    """At the beginning of the next interval."""
    none = tuple(map(jnp.zeros_like, growth.response))
    return Growth(growth.first, growth.first, jnp.zeros_like(growth.variance), none, none)


def advance(
    growth: Growth,
    process: Process,
    step: ErrorStep,
    enters: tuple[Array, ...],
    gained: Triangle,
) -> tuple[Growth, Triangle]:
    """The growth a sample later, and what the process adds to the covariance of d meanwhile.

    Args:
        growth: so far.
        process: an error of increments, see `increments`.
        step: of the sample; its measurements are taken.
        enters: n arrays (3,), what d gains by a unit error on each axis.
        gained: covariance of d without it, before the measurements.
    """
    a, b, c = process.transition, process.drive, process.output
    scale, shared = process.scale, growth.variance @ c
    unmeasured = jax.vmap(partial(times_plus_identity, step.transition))
    moved = jax.vmap(jax.vmap(partial(_moved, step)), in_axes=(0, None, 0))
    along = unmeasured(tuple(scale * jnp.sum(c[:, None] * x, axis=0) for x in growth.cross))
    variance = scale**2 * (c @ shared + process.direct**2)
    n = len(enters)
    more = tuple(
        jnp.sum(along[i] * enters[j] + enters[i] * along[j] + variance * enters[i] * enters[j])
        for i in range(n)
        for j in range(i, n)
    )
    cross = tuple(jnp.sum(a[:, :, None] * one[None], axis=1) for one in growth.cross)
    driven = a @ shared + process.direct * b
    later = Growth(
        growth.first,
        growth.row @ a,
        a @ growth.variance @ a.T + jnp.outer(b, b),
        moved(growth.response, enters, jnp.outer(growth.row, scale)),
        moved(cross, enters, jnp.outer(driven, scale)),
    )
    return later, tuple(x + y for x, y in zip(gained, more, strict=True))


def _moved(
    step: ErrorStep, d: tuple[Scalar, ...], enters: tuple[Scalar, ...], by: Scalar
) -> tuple[Scalar, ...]:
    """The error d a sample later that an error of an increment enters, so much of it."""
    out = times_plus_identity(step.transition, d)
    out = tuple(one + h * by for one, h in zip(out, enters, strict=True))
    for k, m in zip(step.gains, step.measured, strict=True):
        out = apply_gain(out, k, m)
    return out


def entering(step: ErrorStep, q: Quat, n: int, first: int, axes: str) -> tuple[Array, ...]:
    """What d gains by a unit error of an increment on each axis, n arrays (3,).

    Args:
        step: of the sample.
        q: attitude, body to n.
        n: how many states d has.
        first: `VELOCITY` or `ANGLE`.
        axes: `IN_N` or `IN_B`, whose axes they are.
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


def told(growth: Growth) -> tuple[Scalar, ...]:
    """Response and covariance as numbers, each d by d, then state of the process by axis."""
    return tuple(
        one[s, axis]
        for kind in (growth.response, growth.cross)
        for one in kind
        for s in range(one.shape[0])
        for axis in range(3)
    )
