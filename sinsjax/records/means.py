"""Mean rate and specific force of a span of a record, with sways averaged out."""

import math
from typing import NamedTuple

import numpy as np

from sinsjax.records.layout import FloatArray, Record
from sinsjax.records.turning import attitudes, multiply, rotate
from sinsjax.units import DEG, DEG_PER_H

EARTH_RATE = 15.041 * DEG_PER_H
"""rad/s."""

TURN = 1.0 * DEG
"""A parked vehicle stays within it."""

_MOST = 2**19  # steps in which a span is analysed; of a longer one, samples are summed


class Means(NamedTuple):
    """Mean measurements of a span, in the body axes at its middle, SI units.

    Attributes:
        rate: (3,) mean rate, with sways averaged out.
        uncertain: uncertainty of the mean rate from sways and noise.
        steady: whether the rate is about constant.
        turned: angle by which the base rotated in addition to the mean rate, rad.
        change: least change of the mean rate from the first to the last third, rad/s.
        force: (3,) mean specific force.
        size: mean magnitude of the specific force.
        kept: magnitude of the mean force resolved by the gyros, over the mean magnitude.
        moved: angle by which the vertical moved from the first to the last third, rad.
        seconds: length of the span.
    """

    rate: FloatArray
    uncertain: float
    steady: bool
    turned: float
    change: float
    force: FloatArray
    size: float
    kept: float
    moved: float
    seconds: float


def means_of(record: Record, span: tuple[int, int], gravity: float) -> Means:
    """Mean measurements of a span of a record: its first sample, and the one after its last.

    Args:
        record: the record, without missing samples in the span.
        span: at least some samples.
        gravity: m/s^2, that the mean specific force is expected to be near.
    """
    together = -(-(span[1] - span[0]) // _MOST)
    dtheta, dv = (_summed(rows[slice(*span)], together) for rows in (record.dtheta, record.dv))
    n, dt = len(dtheta), together / record.rate_hz
    q = attitudes(dtheta)
    q = multiply(q[n // 2] * [1, -1, -1, -1], q)  # to the body axes at the middle
    turns = _steps(q, dtheta)
    force = rotate(q[:-1], dv) / dt
    rate = _mean(turns) / dt
    uncertain = 3 * _spread(turns) / dt
    # Windows of a quarter of the span: one with a turn stands out from the median of all.
    windows = np.array([_mean(turns, k / 16, (k + 4) / 16) for k in range(13)]) / dt
    deviation = np.linalg.norm(windows - np.median(windows, axis=0), axis=1)
    typical = float(np.median(deviation))
    uncertain += typical / 16  # with few sways, all long means share the same error
    turned = (float(deviation.max()) - 5 * typical) * n * dt / 4 / 2.3  # peak weight over mean
    if turned > TURN:
        rate, uncertain = np.median(windows, axis=0), 3 * typical
    ends = (0.0, 1 / 3), (2 / 3, 1.0)
    early, late = (_mean(force, *end) for end in ends)
    thirds = turns[: n // 3], turns[-(n // 3) :]
    change = _size(_mean(thirds[1]) - _mean(thirds[0])) - sum(map(_spread, thirds))
    # Sways make every pair of neighbouring windows differ; a single change does not.
    change -= dt / 2 * float(np.median(np.linalg.norm(np.diff(windows, axis=0), axis=1)))
    cosine = float(early @ late) / (_size(early) * _size(late))
    second = max(1, round(1 / dt))
    blocks = dv[: n // second * second].reshape(-1, second, 3).mean(axis=1) / dt
    sizes = _size(_mean(force)), float(np.linalg.norm(blocks, axis=1).mean())
    return Means(
        rate=rate,
        uncertain=uncertain,
        steady=typical < 0.15 * _size(rate) or uncertain < 0.1 * _size(rate),
        turned=turned,
        change=change / dt,
        force=dv.mean(axis=0) / dt,
        # Fast sways shorten the block means, wrong gyros the resolved mean: the better one counts.
        size=min(sizes, key=lambda size: abs(size - gravity)),
        kept=sizes[0] / sizes[1],
        moved=math.acos(max(-1.0, min(1.0, cosine))),
        seconds=n * dt,
    )


def _summed(rows: FloatArray, together: int) -> FloatArray:
    """Increments (n, 3) over ``together`` samples each; an incomplete last sum is dropped."""
    if together == 1:
        return rows
    return rows[: len(rows) // together * together].reshape(-1, together, 3).sum(axis=1)


def _size(vector: FloatArray) -> float:
    return float(np.linalg.norm(vector))


def _spread(rows: FloatArray) -> float:
    """The largest difference between the mean of most of the rows and that of all."""
    parts = [(0.0, 0.9), (0.1, 1.0), (0.05, 0.95)]
    return max(_size(_mean(rows, *part) - _mean(rows)) for part in parts)


def _mean(rows: FloatArray, begin: float = 0.0, end: float = 1.0) -> FloatArray:
    """Mean of a part of the rows (n, 3), weighted so that a few periods of sway cancel."""
    first, last = int(begin * len(rows)), max(int(begin * len(rows)) + 1, round(end * len(rows)))
    n = last - first
    weight = np.sin(np.pi * (np.arange(n) + 0.5) / n) ** 4
    return np.asarray(weight @ rows[first:last] / weight.sum())


def _steps(q: FloatArray, dtheta: FloatArray) -> FloatArray:
    """Rotation over each sample in the fixed axes that q (n + 1, 4) transforms to, (n, 3), rad.

    Steps of the rotation vector, over which a sway sums to zero whatever the order of its axes; the
    transformed gyro increments where the base turns too far for a rotation vector.
    """
    q = q * np.sign(q[:, :1] + (q[:, :1] == 0))
    sine = np.linalg.norm(q[:, 1:], axis=1)
    angle = 2 * np.arctan2(sine, q[:, 0])
    if angle.max() > 150 * DEG:
        return rotate(q[:-1], dtheta)
    vector = q[:, 1:] * np.where(sine > 1e-12, angle / np.maximum(sine, 1e-12), 2.0)[:, None]
    return np.diff(vector, axis=0)


def rate_up(means: Means) -> float:
    """The mean rate about the vertical, rad/s."""
    return float(means.rate @ means.force) / float(np.linalg.norm(means.force))
