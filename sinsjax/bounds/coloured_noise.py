"""Coloured errors of the sensors' increments: drifting biases, a surging base, vibration.

Each is a process x' = A x + b w, y = c x + d w on three axes (`strapdown.processes`), whose y is an
error of a sample's increments.
"""

import jax.numpy as jnp

from sinsjax.strapdown.disturbances import Disturbances
from sinsjax.strapdown.processes import Process

VELOCITY, ANGLE = 0, 3
"""Number of the first increment that a process is an error of, among those of both sensors."""

IN_N, IN_B = "n", "b"


_ENTRIES = {
    "surge": (VELOCITY, IN_N),
    "gyro_instability": (ANGLE, IN_B),
    "accel_instability": (VELOCITY, IN_B),
    "gyro_walk": (ANGLE, IN_B),
    "accel_walk": (VELOCITY, IN_B),
    "shaking": (VELOCITY, IN_B),
}
"""Increments and axes in which each disturbance enters; the gyros measure a rotating housing."""

_INTEGRATED = ("surge", "shaking")
"""Processes that are a velocity, whose change is part of an increment."""


def increment_error_processes(
    disturbances: Disturbances, dt: float
) -> dict[str, tuple[Process, tuple[int, str]]]:
    """Return the processes whose y is the error of a sample's increments, rad and m/s.

    Args:
        disturbances: processes of base and sensors.
        dt: sample time, s.

    Returns:
        Those that are present by name, with the increments and axes in which they enter.
    """
    errors = {}
    for name, entry in _ENTRIES.items():
        if (process := getattr(disturbances, name)) is None:
            continue
        if name in _INTEGRATED:
            a, c = process.transition, process.output
            change = jnp.asarray(c) @ (jnp.asarray(a) - jnp.eye(len(process.drive)))
            process = process._replace(output=change, direct=jnp.asarray(c) @ process.drive)
        else:
            process = process._replace(scale=process.scale * dt)
        errors[name] = process, entry
    return errors
