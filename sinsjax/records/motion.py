"""How a base moves in a span of a record, and the means of its sensors, with sways averaged out.

In the frame carried by the gyros the vertical drifts by the horizontal Earth rate, however the base
sways.
"""

import math
from typing import NamedTuple

import numpy as np

from sinsjax.records.layout import FloatArray, Record
from sinsjax.units import DEG, DEG_PER_H

EARTH_RATE = 15.041 * DEG_PER_H
"""Earth rate, rad/s."""

_BLOCKS = 12
_MAX_STEPS = 2**19  # analysed steps of a span; in a longer one, samples are summed
_NOISE_SAMPLES = 2**17  # enough for a median
_MIN_TURN = 20 * DEG  # in addition to a steady rate
_MIN_TURN_RATE = 2 * DEG  # per second, if steady: a bias is less
_MAX_TURNED_TILT = 5 * DEG  # a base that tilts is not turned on the spot
_MIN_TURNED_RATIO = 0.8  # of gravity: even poor gyros follow the vertical of a turned base


class Motion(NamedTuple):
    """Motion and mean measurements of a span, SI units; uncertainties are 3 sigma."""

    force: FloatArray  # (3,) mean, in the body axes
    force_magnitude: float
    resolved_ratio: float  # of the mean force resolved by the gyros to the mean magnitude
    tilt_change: float  # largest angle between the mean forces of blocks and that of all
    turn: float  # about the vertical: largest minus smallest angle
    uneven_turn: float  # the same without a steady rate
    sway: float  # of the angle about the vertical
    vertical_rate: float  # about the vertical
    vertical_uncertainty: float
    drift: float  # rate of the vertical itself in the frame that the gyros carry
    drift_uncertainty: float
    length_s: float

    @property
    def is_turned(self) -> bool:
        """Whether the base is turned about the vertical; sensor biases turn with it."""
        turns = self.uneven_turn > _MIN_TURN or abs(self.vertical_rate) > _MIN_TURN_RATE
        is_level = self.resolved_ratio > _MIN_TURNED_RATIO and self.tilt_change < _MAX_TURNED_TILT
        return turns and is_level

    @property
    def magnitude(self) -> float:
        """Magnitude of the mean rate."""
        return math.hypot(self.vertical_rate, self.drift)

    @property
    def latitude(self) -> float:
        """Latitude at which the mean rate is Earth rate, rad."""
        return math.atan2(self.vertical_rate, self.drift)


def measure_motion(record: Record, span: tuple[int, int], gravity: float) -> Motion:
    """Return the motion in a span of a record that lacks no sample in it; gravity is in m/s^2."""
    count = -(-(span[1] - span[0]) // _MAX_STEPS)
    dtheta, dv = (
        rows[slice(*span)][: (span[1] - span[0]) // count * count].reshape(-1, count, 3).sum(axis=1)
        for rows in (record.dtheta, record.dv)
    )
    n, dt = len(dtheta), count / record.rate_hz
    q = integrate_attitudes(dtheta)
    q = _multiply(q[n // 2] * [1, -1, -1, -1], q)  # to the body axes at the middle
    force = _rotate(q[:-1], dv) / dt
    tilts, ups = _unit(_block_means(dv)), _unit(_block_means(force))
    up = _unit(ups.sum(axis=0))
    psi = _block_means(np.unwrap(2 * np.arctan2(q[1:, 1:] @ up, q[1:, 0]), period=4 * np.pi))
    steps = np.diff(psi) - np.median(np.diff(psi))
    vertical = _fit_slope(psi[:, None], n * dt)
    level = _fit_slope(ups, n * dt)
    seconds = np.array_split(dv / dt, max(1, int(n * dt)))
    magnitudes = _norm(force.mean(axis=0)), float(np.mean([_norm(s.mean(axis=0)) for s in seconds]))
    return Motion(
        force=dv.mean(axis=0) / dt,
        # Fast sways shorten the means of seconds, wrong gyros the resolved one: the better counts.
        force_magnitude=min(magnitudes, key=lambda size: abs(size - gravity)),
        resolved_ratio=magnitudes[0] / (magnitudes[1] or 1.0),
        tilt_change=float(np.linalg.norm(tilts - tilts.mean(axis=0), axis=1).max()),
        turn=float(np.ptp(psi)),
        uneven_turn=float(np.ptp(np.cumsum([0.0, *steps]))),
        sway=10 * float(np.median(np.abs(steps))),
        vertical_rate=float(vertical.rate[0]),
        vertical_uncertainty=vertical.uncertainty,
        drift=_norm(level.rate),
        drift_uncertainty=level.uncertainty,
        length_s=n * dt,
    )


def white_noise(increments: FloatArray, rate_hz: float) -> float:
    """Return the white noise of increments (n, 3): their standard deviation after 1 s.

    Second differences of white noise have six times its variance, and exclude slow motion.
    """
    differences = np.abs(np.diff(increments[:_NOISE_SAMPLES], n=2, axis=0))
    return float(np.median(differences)) / 0.6745 / math.sqrt(6) * math.sqrt(rate_hz)


class _Slope(NamedTuple):
    """A rate of change (k,), and 3 sigma of its components."""

    rate: FloatArray
    uncertainty: float


def _fit_slope(values: FloatArray, length_s: float) -> _Slope:
    """Fit a slope to the means (n, k) of overlapping blocks of a span."""
    time_s = (np.arange(len(values)) - (len(values) - 1) / 2) * length_s / (_BLOCKS + 1)
    sum_of_squares = float(time_s @ time_s)
    rate = time_s @ values / sum_of_squares
    scatter = values - values.mean(axis=0) - np.outer(time_s, rate)
    variance = float((scatter**2).sum()) / (len(values) - 2)
    return _Slope(rate, 3 * math.sqrt(variance / sum_of_squares))


def _block_means(values: FloatArray) -> FloatArray:
    """Return the means of overlapping blocks of rows, with weights that cancel sways."""
    half = max(1, len(values) // (_BLOCKS + 1))
    weight = np.hanning(2 * half + 2)[1:-1]
    blocks = [values[k * half :][: 2 * half] for k in range(_BLOCKS)]
    return np.array([weight[: len(block)] @ block for block in blocks]) / weight.sum()


def _unit(vectors: FloatArray) -> FloatArray:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-300)


def _norm(vector: FloatArray) -> float:
    return float(np.linalg.norm(vector))


# Attitudes, as quaternions (..., 4), scalar first


def integrate_attitudes(dtheta: FloatArray) -> FloatArray:
    """Return quaternions (n + 1, 4) from the body axes at each time to those at the start.

    Two-sample coning of the increments (n, 3), rad, is compensated.
    """
    previous = np.concatenate([dtheta[:1], dtheta[:-1]])
    vector = dtheta + np.cross(previous, dtheta) / 12
    angle = np.linalg.norm(vector, axis=1, keepdims=True)
    # sin(a/2)/a by NumPy's sin(pi x)/(pi x), which is defined at zero.
    steps = np.hstack([np.cos(angle / 2), vector * np.sinc(angle / 2 / np.pi) / 2])
    q, length = np.concatenate([[[1.0, 0.0, 0.0, 0.0]], steps]), 1
    while length < len(q):  # products of twice as many steps each time
        q[length:] = _multiply(q[:-length], q[length:])
        length *= 2
    return q


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
