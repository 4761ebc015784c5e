"""Coloured errors of the sensors' increments: drifting biases, a surging base, vibration.

Each is a process x' = A x + b w, y = c x + d w on three axes (`strapdown.processes`), whose y is an
error of a sample's increments.
"""

from collections.abc import Iterator
from typing import Any, NamedTuple

import jax.numpy as jnp

from sinsjax.strapdown.disturbances import Disturbances
from sinsjax.strapdown.processes import Process

VELOCITY, ANGLE = 0, 3
"""Number of the first increment that a process is an error of, among those of both sensors."""

IN_N, IN_B = "n", "b"


class ColouredInputs(NamedTuple):
    """A process per coloured input, or something for each process; None if it is absent.

    They are those of `Disturbances` but for the rotation of the housing, which the gyros measure.
    """

    surge: Any = None
    gyro_instability: Any = None
    accel_instability: Any = None
    gyro_walk: Any = None
    accel_walk: Any = None
    shaking: Any = None


PROCESS_INPUTS = ColouredInputs(
    surge=(VELOCITY, IN_N),
    gyro_instability=(ANGLE, IN_B),
    accel_instability=(VELOCITY, IN_B),
    gyro_walk=(ANGLE, IN_B),
    accel_walk=(VELOCITY, IN_B),
    shaking=(VELOCITY, IN_B),
)
"""Increments and axes in which each process enters."""

_INTEGRATED = ("surge", "shaking")
"""Processes that are a velocity, whose change is part of an increment."""


def increment_error_processes(disturbances: Disturbances, dt: float) -> ColouredInputs:
    """Return the processes whose y is the error of a sample's increments, rad and m/s.

    Args:
        disturbances: processes of base and sensors.
        dt: sample time, s.
    """
    errors = {}
    for name, process in disturbances._asdict().items():
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
