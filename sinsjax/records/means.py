"""Mean rate and specific force of a span of a record, with sways averaged out."""

import math
from typing import NamedTuple

import numpy as np

from sinsjax.records.layout import FloatArray, Record
from sinsjax.records.quaternions import integrate_attitudes, multiply, rotate_vectors
from sinsjax.units import DEG, DEG_PER_H

EARTH_RATE = 15.041 * DEG_PER_H
"""Earth rate, rad/s."""

MAX_PARKED_TURN = 1.0 * DEG
"""Largest rotation of a parked vehicle, rad."""

_MAX_STEPS = 2**19  # analysed steps of a span; in a longer one, samples are summed


class Means(NamedTuple):
    """Mean measurements of a span, in the body axes at its middle, SI units.

    Attributes:
        rate: (3,) mean rate, with sways averaged out.
        rate_uncertainty: uncertainty of the mean rate from sways and noise.
        is_steady: whether the rate is nearly constant.
        turn_angle: angle by which the base rotated in addition to the mean rate, rad.
        rate_change: least change of the mean rate from the first to the last third, rad/s.
        force: (3,) mean specific force.
        force_magnitude: mean magnitude of the specific force.
        resolved_force_ratio: magnitude of the mean force resolved by the gyros, over the mean
            magnitude.
        vertical_shift: angle by which the vertical moved from the first to the last third, rad.
        length_s: length of the span.
    """

    rate: FloatArray
    rate_uncertainty: float
    is_steady: bool
    turn_angle: float
    rate_change: float
    force: FloatArray
    force_magnitude: float
    resolved_force_ratio: float
    vertical_shift: float
    length_s: float


def compute_means(record: Record, span: tuple[int, int], gravity: float) -> Means:
    """Return the mean measurements of a span of a record.

    Args:
        record: the record, without missing samples in the span.
        span: first sample, and the one after the last.
        gravity: expected magnitude of the mean specific force, m/s^2.
    """
    samples_per_step = -(-(span[1] - span[0]) // _MAX_STEPS)
    dtheta, dv = (
        _sum_increments(rows[slice(*span)], samples_per_step) for rows in (record.dtheta, record.dv)
    )
    n, dt = len(dtheta), samples_per_step / record.rate_hz
    q = integrate_attitudes(dtheta)
    q = multiply(q[n // 2] * [1, -1, -1, -1], q)  # to the body axes at the middle
    rotations = _rotation_steps(q, dtheta)
    force = rotate_vectors(q[:-1], dv) / dt
    rate = _weighted_mean(rotations) / dt
    rate_uncertainty = 3 * _mean_uncertainty(rotations) / dt
    # Windows of a quarter of the span: one with a turn differs from the median of all.
    windows = np.array([_weighted_mean(rotations, k / 16, (k + 4) / 16) for k in range(13)]) / dt
    deviation = np.linalg.norm(windows - np.median(windows, axis=0), axis=1)
    typical = float(np.median(deviation))
    rate_uncertainty += typical / 16  # with few sways, all long means share the same error
    turn_angle = (float(deviation.max()) - 5 * typical) * n * dt / 4 / 2.3  # peak weight over mean
    if turn_angle > MAX_PARKED_TURN:
        rate, rate_uncertainty = np.median(windows, axis=0), 3 * typical
    ends = (0.0, 1 / 3), (2 / 3, 1.0)
    early, late = (_weighted_mean(force, *end) for end in ends)
    thirds = rotations[: n // 3], rotations[-(n // 3) :]
    rate_change = _norm(_weighted_mean(thirds[1]) - _weighted_mean(thirds[0])) - sum(
        map(_mean_uncertainty, thirds)
    )
    # With sways every pair of neighbouring windows differs; with a single change only one does.
    rate_change -= dt / 2 * float(np.median(np.linalg.norm(np.diff(windows, axis=0), axis=1)))
    cosine = float(early @ late) / (_norm(early) * _norm(late))
    samples_per_second = max(1, round(1 / dt))
    blocks = (
        dv[: n // samples_per_second * samples_per_second]
        .reshape(-1, samples_per_second, 3)
        .mean(axis=1)
        / dt
    )
    force_magnitudes = _norm(_weighted_mean(force)), float(np.linalg.norm(blocks, axis=1).mean())
    return Means(
        rate=rate,
        rate_uncertainty=rate_uncertainty,
        is_steady=typical < 0.15 * _norm(rate) or rate_uncertainty < 0.1 * _norm(rate),
        turn_angle=turn_angle,
        rate_change=rate_change / dt,
        force=dv.mean(axis=0) / dt,
        # Fast sways shorten the block means, wrong gyros the resolved mean: use the better one.
        force_magnitude=min(force_magnitudes, key=lambda size: abs(size - gravity)),
        resolved_force_ratio=force_magnitudes[0] / force_magnitudes[1],
        vertical_shift=math.acos(max(-1.0, min(1.0, cosine))),
        length_s=n * dt,
    )


def _sum_increments(rows: FloatArray, count: int) -> FloatArray:
    """Return increments (n, 3) over ``count`` samples each; an incomplete last sum is dropped."""
    if count == 1:
        return rows
    return rows[: len(rows) // count * count].reshape(-1, count, 3).sum(axis=1)


def _norm(vector: FloatArray) -> float:
    return float(np.linalg.norm(vector))


def _mean_uncertainty(rows: FloatArray) -> float:
    """Return the largest difference between the mean of most rows and that of all."""
    parts = [(0.0, 0.9), (0.1, 1.0), (0.05, 0.95)]
    return max(_norm(_weighted_mean(rows, *part) - _weighted_mean(rows)) for part in parts)


def _weighted_mean(rows: FloatArray, begin: float = 0.0, end: float = 1.0) -> FloatArray:
    """Return the mean of a part of the rows (n, 3), with weights that cancel sways."""
    first, last = int(begin * len(rows)), max(int(begin * len(rows)) + 1, round(end * len(rows)))
    n = last - first
    weight = np.sin(np.pi * (np.arange(n) + 0.5) / n) ** 4
    return np.asarray(weight @ rows[first:last] / weight.sum())


def _rotation_steps(q: FloatArray, dtheta: FloatArray) -> FloatArray:
    """Return the rotation over each sample in the target axes of q (n + 1, 4); (n, 3), rad.

    Steps of the rotation vector, over which a sway sums to zero for any order of its axes; the
    transformed gyro increments if the base turns too far for a rotation vector.
    """
    q = q * np.sign(q[:, :1] + (q[:, :1] == 0))
    sine = np.linalg.norm(q[:, 1:], axis=1)
    angle = 2 * np.arctan2(sine, q[:, 0])
    if angle.max() > 150 * DEG:
        return rotate_vectors(q[:-1], dtheta)
    vector = q[:, 1:] * np.where(sine > 1e-12, angle / np.maximum(sine, 1e-12), 2.0)[:, None]
    return np.diff(vector, axis=0)


def vertical_rate(means: Means) -> float:
    """Return the mean rate about the vertical, rad/s."""
    return float(means.rate @ means.force) / float(np.linalg.norm(means.force))
