"""Mean rate and specific force of a span of a record, with sways averaged out."""

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from sinsjax.records.layout import FloatArray, Record
from sinsjax.records.quaternions import integrate_attitudes, multiply, rotate_vectors
from sinsjax.records.turns import Turns, measure_turns
from sinsjax.units import DEG, DEG_PER_H

EARTH_RATE = 15.041 * DEG_PER_H
"""Earth rate, rad/s."""

MAX_PARKED_TURN = 1.0 * DEG
"""Largest rotation of a parked vehicle, rad."""

_DRIFT_BLOCKS = 12
_MAX_STEPS = 2**19  # analysed steps of a span; in a longer one, samples are summed


class Means(NamedTuple):
    """Mean measurements of a span, in the body axes at its middle, SI units.

    Attributes:
        rate: (3,) mean rate, with sways averaged out.
        rate_uncertainty: uncertainty of the mean rate from sways and noise.
        is_steady: whether the rate is nearly constant.
        turn_angle: angle by which the base rotated in addition to the mean rate, rad.
        largest_turn: largest angle between the attitude and that at the middle, apart from the
            mean rate, rad.
        rate_change: least change of the mean rate from the first to the last third, rad/s.
        force: (3,) mean specific force.
        force_magnitude: mean magnitude of the specific force.
        resolved_force_ratio: magnitude of the mean force resolved by the gyros, over the mean
            magnitude.
        vertical_drift: rate at which the vertical turns in the frame carried by the gyros, rad/s:
            the horizontal Earth rate, however the base moves, but for the level part of their bias.
        drift_uncertainty: uncertainty of the drift from accelerations of the base, rad/s.
        vertical_shift: angle by which the vertical moved from the first to the last third, rad.
        length_s: length of the span.
        turns: turns about the vertical; None if the base does not turn.
    """

    rate: FloatArray
    rate_uncertainty: float
    is_steady: bool
    turn_angle: float
    largest_turn: float
    rate_change: float
    force: FloatArray
    force_magnitude: float
    resolved_force_ratio: float
    vertical_drift: float
    drift_uncertainty: float
    vertical_shift: float
    length_s: float
    turns: Turns | None


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
    drift, drift_uncertainty = _vertical_drift(force, n * dt)
    return Means(
        rate=rate,
        rate_uncertainty=rate_uncertainty,
        is_steady=typical < 0.15 * _norm(rate) or rate_uncertainty < 0.1 * _norm(rate),
        turn_angle=turn_angle,
        largest_turn=_largest_turn(q, float(np.linalg.norm(rate)) * dt),
        rate_change=rate_change / dt,
        force=dv.mean(axis=0) / dt,
        # Fast sways shorten the block means, wrong gyros the resolved mean: use the better one.
        force_magnitude=min(force_magnitudes, key=lambda size: abs(size - gravity)),
        resolved_force_ratio=force_magnitudes[0] / force_magnitudes[1],
        vertical_drift=drift,
        drift_uncertainty=drift_uncertainty,
        vertical_shift=math.acos(max(-1.0, min(1.0, cosine))),
        length_s=n * dt,
        turns=measure_turns(dtheta, dv, dt),
    )


def merge_samples(record: Record, span: tuple[int, int], rate_hz: float) -> Record:
    """Return a span of a record with samples summed to a rate not much below ``rate_hz``."""
    count = max(1, int(record.rate_hz / rate_hz))
    dtheta, dv = (_sum_increments(rows[slice(*span)], count) for rows in (record.dtheta, record.dv))
    return record._replace(dtheta=dtheta, dv=dv, rate_hz=record.rate_hz / count)


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
    weight = _weights(last - first)
    return np.asarray(weight @ rows[first:last] / weight.sum())


@lru_cache(maxsize=8)  # lengths of parts of a span
def _weights(n: int) -> FloatArray:
    return np.asarray(np.sin(np.pi * (np.arange(n) + 0.5) / n) ** 4)


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


def _largest_turn(q: FloatArray, mean_step: float) -> float:
    """Return the largest angle of attitudes (n + 1, 4) relative to the middle one, rad.

    Apart from what a rotation by ``mean_step``, rad, over each sample explains.
    """
    angle = 2 * np.arctan2(np.linalg.norm(q[:, 1:], axis=1), np.abs(q[:, 0]))
    samples = np.abs(np.arange(len(q)) - len(q) // 2)
    return float(np.max(np.maximum(angle - mean_step * samples, 0.0)))


def _vertical_drift(force: FloatArray, length_s: float) -> tuple[float, float]:
    """Return the drift of the direction of specific forces (n, 3), rad/s, and its 3 sigma."""
    blocks = np.array_split(force, _DRIFT_BLOCKS)
    up = np.array([block.mean(axis=0) for block in blocks if len(block)])
    up /= np.linalg.norm(up, axis=1, keepdims=True)
    time_s = (np.arange(len(up)) - (len(up) - 1) / 2) * length_s / len(up)
    sum_of_squares = float(time_s @ time_s)
    slope = time_s @ up / sum_of_squares
    scatter = up - up.mean(axis=0) - np.outer(time_s, slope)
    sigma = math.sqrt(float((scatter**2).sum()) / max(1, len(up) - 2) / sum_of_squares)
    return _norm(slope), 3 * sigma


def white_noise(increments: FloatArray, rate_hz: float) -> float:
    """Return the white noise of increments (n, 3): their standard deviation after 1 s.

    Second differences of white noise have six times its variance, and exclude slow motion.
    """
    differences = np.abs(np.diff(increments, n=2, axis=0))
    return float(np.median(differences)) / 0.6745 / math.sqrt(6) * math.sqrt(rate_hz)


def vertical_rate(means: Means) -> float:
    """Return the mean rate about the vertical, rad/s."""
    return float(means.rate @ means.force) / float(np.linalg.norm(means.force))


_SCALE_BLOCKS_S = 0.25, 1.0, 3.0
_MIN_BLOCKS = 16
_MIN_CORRELATION = 0.9


def measure_gyro_scale(gyro: FloatArray, dv: FloatArray, rate_hz: float) -> float:
    """Return the angle of one unit of the gyros over one sample by the sways of the vertical, rad.

    The direction u of the specific force in the body turns as the gyros sense, du = -w x u. The
    result is negative if it turns the other way, and 0 if the base sways too little to tell.

    Args:
        gyro: (T, 3) gyro samples, in any unit.
        dv: (T, 3) specific-force increments.
        rate_hz: sample rate, Hz.
    """
    for block_s in _SCALE_BLOCKS_S:
        size = max(1, round(block_s * rate_hz))
        blocks = len(dv) // size
        if blocks < _MIN_BLOCKS:
            break
        force, turn = (
            rows[: blocks * size].reshape(blocks, size, 3).sum(axis=1) for rows in (dv, gyro)
        )
        up = force / np.maximum(np.linalg.norm(force, axis=1, keepdims=True), 1e-12)
        middle = (turn[1:] + turn[:-1]) / 2
        expected = -np.cross(middle, (up[1:] + up[:-1]) / 2)
        expected -= expected.mean(axis=0)
        seen = np.diff(up, axis=0)
        seen -= seen.mean(axis=0)
        power = (expected**2).sum(axis=0)
        used = power > 0.1 * power.max()  # a dead gyro shows no sway about its axis
        if not used.any():
            continue
        product = float((seen * expected)[:, used].sum())
        norms = [float(np.sqrt((part[:, used] ** 2).sum())) for part in (seen, expected)]
        if norms[0] and abs(product) > _MIN_CORRELATION * norms[0] * norms[1]:
            return math.copysign(norms[0] / norms[1], product)
    return 0.0
