"""Turns of the base about the vertical, and the Earth rate that the gyros sense during them.

In the frame carried by the gyros the vertical drifts by the horizontal Earth rate, however the base
turns. What the sensor biases add turns with the base, so that turns separate it: this works where
the mean rate in the body axes shows nothing.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sinsjax.records.layout import FloatArray
from sinsjax.records.quaternions import integrate_attitudes, rotate_vectors
from sinsjax.units import DEG

_MIN_TURN = 20 * DEG  # a smaller turn does not separate biases from Earth rate
_MAX_LEVEL_SWAY = 5 * DEG  # median; a base that sways by more is not turned on the spot
_WINDOWS = 30
_UNKNOWNS = 4
_ITERATIONS = 20
_MAX_RESIDUAL = 6.0  # times the median
_MAX_DROPPED = 6


class Turns(NamedTuple):
    """Turns about the vertical, SI units.

    Attributes:
        angle: largest minus smallest turn angle psi, rad.
        drift: rate at which the vertical turns in the frame carried by the gyros, with the sensor
            biases taken out, rad/s: the horizontal Earth rate.
        drift_uncertainty: 3 sigma of the drift, rad/s.
        gyro_bias: least level gyro bias, its uncertainty taken off, rad/s.
        accel_bias: least level accelerometer bias, relative to gravity, in the same way.
    """

    angle: float
    drift: float
    drift_uncertainty: float
    gyro_bias: float
    accel_bias: float


def measure_turns(dtheta: FloatArray, dv: FloatArray, dt: float) -> Turns | None:
    """Return the turns of a base about the vertical; None if it does not turn, or tilts.

    The level part y of the unit mean force of windows is y = c + s t + a e^(i psi) + b P, where s
    is the drift, P the integral of e^(i psi), and a and b contain the level biases of
    accelerometers and gyros.

    Args:
        dtheta: (n, 3) gyro increments.
        dv: (n, 3) specific-force increments.
        dt: length of a step, s.
    """
    if len(dv) < 2 * _WINDOWS:
        return None
    up = dv.sum(axis=0)
    up = up / (float(np.linalg.norm(up)) or 1.0)
    psi = np.cumsum(dtheta @ up)
    angle = float(np.ptp(psi))
    if angle < _MIN_TURN or _level_sway(dv, up, dt) > _MAX_LEVEL_SWAY:
        return None
    phasor = np.exp(1j * (psi - dtheta @ up / 2))
    integral = np.cumsum(phasor) * dt - phasor * dt / 2
    time_s = (np.arange(len(psi)) - (len(psi) - 1) / 2) * dt
    columns = np.column_stack(
        [_window_means(values) for values in (np.ones(len(psi)), time_s, phasor, integral)]
    )
    y = _level_part(rotate_vectors(integrate_attitudes(dtheta)[:-1], dv))
    if not (np.isfinite(columns).all() and np.isfinite(y).all()):
        return None
    used = _steady_windows(columns, y)
    inverse = _inverse(columns[used])
    solution = inverse @ y[used]
    residual = y[used] - columns[used] @ solution
    variance = float((np.abs(residual) ** 2).sum()) / (int(used.sum()) - _UNKNOWNS)
    uncertainty = 3 * np.sqrt(variance * (np.abs(inverse) ** 2).sum(axis=1))
    least = np.maximum(np.abs(solution) - uncertainty, 0.0)
    return Turns(
        angle=angle,
        drift=float(abs(solution[1])),
        drift_uncertainty=float(uncertainty[1]),
        gyro_bias=float(least[3]),
        accel_bias=float(least[2]),
    )


def _steady_windows(columns: NDArray[Any], y: NDArray[Any]) -> NDArray[np.bool_]:
    """Return which windows have no strong accelerations, as those of a turn by hand have."""
    weight = np.ones(len(y))
    for _ in range(_ITERATIONS):
        solution = _inverse(columns * weight[:, None]) @ (y * weight)
        size = np.abs(y - columns @ solution)
        typical = float(np.median(size)) or 1.0
        weight = 1 / np.sqrt(np.maximum(size / typical, 1.0))
    used = size <= _MAX_RESIDUAL * typical
    return used if int((~used).sum()) <= _MAX_DROPPED else np.ones(len(y), bool)


def _inverse(columns: NDArray[Any]) -> NDArray[Any]:
    """Return the pseudo-inverse of columns of different units."""
    scale = np.maximum(np.linalg.norm(columns, axis=0), 1e-12)  # zero with whole turns a window
    return np.asarray(np.linalg.pinv(columns / scale, rcond=1e-9) / scale[:, None])


def _level_sway(dv: FloatArray, up: FloatArray, dt: float) -> float:
    """Return the median angle between specific forces of 1 s and their mean direction, rad."""
    steps = max(1, round(1 / dt))
    blocks = dv[: max(1, len(dv) // steps) * steps].reshape(-1, min(steps, len(dv)), 3).sum(axis=1)
    along = blocks @ up
    across = np.linalg.norm(blocks - along[:, None] * up, axis=1)
    return float(np.median(np.arctan2(across, along)))


def _window_means(values: NDArray[Any]) -> NDArray[Any]:
    return np.array([part.mean(axis=0) for part in np.array_split(values, _WINDOWS)])


def _level_part(force: FloatArray) -> NDArray[np.complex128]:
    """Return the level part of the unit mean force of each window, as a complex number."""
    unit = _window_means(force)
    unit = unit / np.maximum(np.linalg.norm(unit, axis=1, keepdims=True), 1e-12)
    up = unit.sum(axis=0)
    up = up / (float(np.linalg.norm(up)) or 1.0)
    front = np.cross(up, np.eye(3)[int(np.argmin(np.abs(up)))])
    front = front / float(np.linalg.norm(front))
    return np.asarray(unit @ front + 1j * (unit @ np.cross(up, front)))
