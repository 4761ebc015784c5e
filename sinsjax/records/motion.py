"""Rates and specific force of a span of a record, with sways averaged out, and its turns.

In the frame carried by the gyros the vertical drifts by the horizontal Earth rate, however the base
moves. What the level sensor biases add turns with the base, so that turns about the vertical
separate it.
"""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sinsjax.records.layout import FloatArray, Record
from sinsjax.units import DEG, DEG_PER_H

EARTH_RATE = 15.041 * DEG_PER_H
"""Earth rate, rad/s."""

_BLOCKS = 12
_MAX_STEPS = 2**19  # analysed steps of a span; in a longer one, samples are summed
_MIN_TURN = 20 * DEG  # a smaller turn does not separate biases from Earth rate
_MAX_LEVEL_SWAY = 5 * DEG  # median; a base that sways by more is not turned on the spot
_WINDOWS = 30
_ITERATIONS = 20
_MAX_RESIDUAL = 6.0  # times the median
_MAX_DROPPED = 6


class Turns(NamedTuple):
    """Turns about the vertical, SI units; the biases are the least ones that explain the record."""

    angle: float  # largest minus smallest turn angle psi
    drift: float  # as `Means.vertical_drift`, with the sensor biases taken out
    drift_uncertainty: float  # 3 sigma
    gyro_bias: float  # of the level gyros
    accel_bias: float  # of the level accelerometers, relative to gravity


class Means(NamedTuple):
    """Mean measurements of a span, SI units; uncertainties are 3 sigma."""

    rate: FloatArray  # (3,) in the body axes, of a parked base
    force: FloatArray  # (3,) in the body axes
    force_magnitude: float
    resolved_ratio: float  # of the mean force resolved by the gyros to the mean magnitude
    tilt_change: float  # largest angle between the mean forces of blocks and that of all
    turn_angle: float  # about the vertical, in addition to a steady rate
    vertical_rate: float  # about the vertical
    vertical_uncertainty: float
    vertical_drift: float  # rate of the vertical itself in the frame that the gyros carry
    drift_uncertainty: float
    length_s: float
    turns: Turns | None  # None if the base does not turn

    @property
    def magnitude(self) -> float:
        """Magnitude of the mean rate."""
        return math.hypot(self.vertical_rate, self.vertical_drift)

    @property
    def latitude(self) -> float:
        """Latitude at which the mean rate is Earth rate, rad."""
        return math.atan2(self.vertical_rate, self.vertical_drift)


def compute_means(record: Record, span: tuple[int, int], gravity: float) -> Means:
    """Return the means of a span of a record that lacks no sample in it, at some gravity, m/s^2."""
    count = -(-(span[1] - span[0]) // _MAX_STEPS)
    dtheta, dv = (
        rows[slice(*span)][: (span[1] - span[0]) // count * count].reshape(-1, count, 3).sum(axis=1)
        for rows in (record.dtheta, record.dv)
    )
    n, dt = len(dtheta), count / record.rate_hz
    q = integrate_attitudes(dtheta)
    q = _multiply(q[n // 2] * [1, -1, -1, -1], q)  # to the body axes at the middle
    force = _rotate(q[:-1], dv) / dt
    mean_force, tilts, ups = force.mean(axis=0), _block_means(dv), _block_means(force)
    tilts, ups = (v / np.maximum(np.linalg.norm(v, axis=1), 1e-300)[:, None] for v in (tilts, ups))
    up = ups.sum(axis=0) / (_norm(ups.sum(axis=0)) or 1.0)
    psi = _block_means(np.unwrap(2 * np.arctan2(q[1:, 1:] @ up, q[1:, 0]), period=4 * np.pi))
    steps = np.diff(psi) - np.median(np.diff(psi))
    sway = 10 * float(np.median(np.abs(steps)))
    spacing_s = n * dt / (_BLOCKS + 1)
    vertical_rate, vertical_uncertainty = _slope(psi[:, None], spacing_s)
    drift, drift_uncertainty = _slope(ups, spacing_s)
    seconds = np.array_split(dv / dt, max(1, int(n * dt)))
    magnitudes = _norm(mean_force), float(np.mean([_norm(part.mean(axis=0)) for part in seconds]))
    return Means(
        rate=dtheta.mean(axis=0) / dt,
        force=dv.mean(axis=0) / dt,
        # Fast sways shorten the means of seconds, wrong gyros the resolved one: the better counts.
        force_magnitude=min(magnitudes, key=lambda size: abs(size - gravity)),
        resolved_ratio=magnitudes[0] / (magnitudes[1] or 1.0),
        tilt_change=float(np.linalg.norm(tilts - tilts.mean(axis=0), axis=1).max()),
        turn_angle=max(0.0, float(np.ptp(np.cumsum([0.0, *steps]))) - sway),
        vertical_rate=float(vertical_rate[0]),
        vertical_uncertainty=vertical_uncertainty,
        vertical_drift=_norm(drift),
        drift_uncertainty=drift_uncertainty,
        length_s=n * dt,
        turns=measure_turns(dtheta, dv, force, dt),
    )


def _block_means(values: FloatArray) -> FloatArray:
    """Return the means of overlapping blocks of rows, with weights that cancel sways."""
    half = max(1, len(values) // (_BLOCKS + 1))
    weight = np.hanning(2 * half + 2)[1:-1]
    blocks = [values[k * half :][: 2 * half] for k in range(_BLOCKS)]
    return np.array([weight[: len(block)] @ block for block in blocks]) / weight.sum()


def _slope(values: FloatArray, spacing_s: float) -> tuple[FloatArray, float]:
    """Return the slope of values (n, k) in steps of some time, and 3 sigma of its components."""
    time_s = (np.arange(len(values)) - (len(values) - 1) / 2) * spacing_s
    sum_of_squares = float(time_s @ time_s)
    slope = time_s @ values / sum_of_squares
    scatter = values - values.mean(axis=0) - np.outer(time_s, slope)
    variance = float((scatter**2).sum()) / (len(values) - 2)
    return slope, 3 * math.sqrt(variance / sum_of_squares)


def white_noise(increments: FloatArray, rate_hz: float) -> float:
    """Return the white noise of increments (n, 3): their standard deviation after 1 s.

    Second differences of white noise have six times its variance, and exclude slow motion.
    """
    differences = np.abs(np.diff(increments, n=2, axis=0))
    return float(np.median(differences)) / 0.6745 / math.sqrt(6) * math.sqrt(rate_hz)


def _norm(vector: FloatArray) -> float:
    return float(np.linalg.norm(vector))


# Turns


def measure_turns(dtheta: FloatArray, dv: FloatArray, force: FloatArray, dt: float) -> Turns | None:
    """Return the turns of a base about the vertical; None if it does not turn, or tilts.

    The level part y of the unit mean force of windows is y = c + s t + a e^(i psi) + b P, where s
    is the drift, P the integral of e^(i psi), and a and b contain the level biases of
    accelerometers and gyros. Increments (n, 3) are over steps of ``dt``, s; the force (n, 3) is in
    the frame that the gyros carry.
    """
    if len(dv) < 2 * _WINDOWS:
        return None
    up = dv.sum(axis=0)
    up = up / (_norm(up) or 1.0)
    psi = np.cumsum(dtheta @ up)
    angle = float(np.ptp(psi))
    seconds = max(1, len(dv) // max(1, round(1 / dt)))
    forces = np.array([part.sum(axis=0) for part in np.array_split(dv, seconds)])
    across = np.linalg.norm(np.cross(forces, up), axis=1)
    if angle < _MIN_TURN or np.median(np.arctan2(across, forces @ up)) > _MAX_LEVEL_SWAY:
        return None
    phasor = np.exp(1j * (psi - dtheta @ up / 2))
    integral = np.cumsum(phasor) * dt - phasor * dt / 2
    time_s = (np.arange(len(psi)) - (len(psi) - 1) / 2) * dt
    columns = np.column_stack(
        [_window_means(values) for values in (np.ones(len(psi)), time_s, phasor, integral)]
    )
    y = _level_part(force)
    if not (np.isfinite(columns).all() and np.isfinite(y).all()):
        return None
    used = _steady_windows(columns, y)
    inverse = _inverse(columns[used])
    solution = inverse @ y[used]
    residual = y[used] - columns[used] @ solution
    variance = float((np.abs(residual) ** 2).sum()) / (int(used.sum()) - columns.shape[1])
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


def _window_means(values: NDArray[Any]) -> NDArray[Any]:
    return np.array([part.mean(axis=0) for part in np.array_split(values, _WINDOWS)])


def _level_part(force: FloatArray) -> NDArray[np.complex128]:
    """Return the level part of the unit mean force of each window, as a complex number."""
    unit = _window_means(force)
    unit = unit / np.maximum(np.linalg.norm(unit, axis=1, keepdims=True), 1e-12)
    up = unit.sum(axis=0)
    up = up / (_norm(up) or 1.0)
    front = np.cross(up, np.eye(3)[int(np.argmin(np.abs(up)))])
    front = front / _norm(front)
    return np.asarray(unit @ front + 1j * (unit @ np.cross(up, front)))


# Attitudes, as quaternions (..., 4), scalar first


def integrate_attitudes(dtheta: FloatArray) -> FloatArray:
    """Return quaternions (n + 1, 4) from the body axes at each time to those at the start.

    Two-sample coning of the increments (n, 3), rad, is compensated.
    """
    n = len(dtheta)
    previous = np.concatenate([dtheta[:1], dtheta[:-1]])
    vector = dtheta + np.cross(previous, dtheta) / 12
    angle = np.linalg.norm(vector, axis=1, keepdims=True)
    # sin(a/2)/a by NumPy's sin(pi x)/(pi x), which is defined at zero.
    steps = np.hstack([np.cos(angle / 2), vector * np.sinc(angle / 2 / np.pi) / 2])
    # Products within all blocks at once, then of blocks: two short loops instead of a long one.
    size = math.isqrt(n) + 1
    blocks = np.tile([1.0, 0.0, 0.0, 0.0], (size * size, 1))
    blocks[:n] = steps
    blocks = blocks.reshape(size, size, 4)
    for k in range(1, size):
        blocks[:, k] = _multiply(blocks[:, k - 1], blocks[:, k])
    starts = np.tile([1.0, 0.0, 0.0, 0.0], (size, 1))
    for k in range(1, size):
        starts[k] = _multiply(starts[k - 1], blocks[k - 1, -1])
    q = _multiply(starts[:, None], blocks).reshape(-1, 4)[:n]
    return np.concatenate([[[1.0, 0.0, 0.0, 0.0]], q])


def _multiply(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return the Hamilton products of quaternions (..., 4)."""
    aw, ax, ay, az = (a[..., k] for k in range(4))  # np.moveaxis takes as long as the products
    bw, bx, by, bz = (b[..., k] for k in range(4))
    w = aw * bw - ax * bx - ay * by - az * bz
    x = aw * bx + ax * bw + ay * bz - az * by
    y = aw * by - ax * bz + ay * bw + az * bx
    return np.stack([w, x, y, aw * bz + ax * by - ay * bx + az * bw], axis=-1)


def _rotate(q: FloatArray, v: FloatArray) -> FloatArray:
    """Return vectors (n, 3) rotated by quaternions (n, 4)."""
    across = 2 * np.cross(q[:, 1:], v)
    return v + q[:, :1] * across + np.cross(q[:, 1:], across)
