"""Plausibility checks of a record before anything is aligned with it.

The mean specific force of a stationary base is gravity and its mean rate is Earth rate, however it
sways, apart from sensor biases. Wrong units, axes or signs, or a turning vehicle, show in one of
the two.
"""

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from sinsjax.records.layout import ACCEL_UNITS, GYRO_UNITS, FloatArray, Layout, Record
from sinsjax.records.turning import attitudes, multiply, rotate
from sinsjax.units import DEG, DEG_PER_H, micro_g

_HARD = 9.5
"""A mean wrong by this factor is rejected: below 10, so that g taken for m/s^2 (9.8) is caught."""

_TURN = 1.0 * DEG  # a parked vehicle stays within it
_SETTLING = 0.3 * DEG  # of an occupied vehicle on its suspension, in a third of a span
_SHORT_S = 20.0  # contains few sways
_LONG_S = 180.0  # a third of it contains several sways of most bases
_KEPT = 0.99  # of gravity, when the gyros follow the sways
_TILTED = 45 * DEG
_MOST = 2**19  # steps in which a span is analysed; of a longer one, samples are summed
_NAMES = {
    "rad_per_s": "rad/s",
    "deg_per_s": "deg/s",
    "deg_per_h": "deg/h",
    "m_per_s2": "m/s^2",
    "m_per_s": "m/s per sample",
    "g_s": "g s per sample",
    "ug_s": "ug s per sample",
    "rad": "rad per sample",
    "deg": "deg per sample",
    "arcsec": "arcsec per sample",
    "g": "g",
    "mg": "mg",
    "ug": "ug",
}


class StationaryValues(NamedTuple):
    """What a stationary record should measure, SI units.

    Attributes:
        earth_rate: rad/s.
        latitude: rad.
        gravity: m/s^2.
        gyro_bias: largest plausible gyro bias, rad/s.
        accel_bias: largest plausible accelerometer bias, m/s^2.
    """

    earth_rate: float
    latitude: float
    gravity: float
    gyro_bias: float
    accel_bias: float


class Finding(NamedTuple):
    """Something implausible, without the file's name; hard if it is certainly wrong."""

    hard: bool
    text: str


class _Means(NamedTuple):
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


def findings(
    record: Record, span: tuple[int, int], layout: Layout, expected: StationaryValues
) -> list[Finding]:
    """What is implausible for a stationary base in a span of a record.

    Args:
        record: the record, without missing samples in the span.
        span: first sample, and the one after the last; at least a second.
        layout: the layout that the record was read with, to suggest a cause.
        expected: measurements and sensor biases to expect.
    """
    means = _means(record, span, expected.gravity)
    found = [*_force(means, layout, record.rate_hz, expected), *_vertical(means, layout)]
    rate = list(_rate(record, span, layout, expected, means))
    if rate:  # gyros that are wrong cannot show a rotation of the base
        return found + rate
    return found + rate + list(_rotations(means, expected))


def _force(
    means: _Means, layout: Layout, rate_hz: float, expected: StationaryValues
) -> Iterator[Finding]:
    size, gravity = means.size, expected.gravity
    if abs(size - gravity) <= expected.accel_bias:
        return
    hard = not 1 / _HARD < size / gravity < _HARD
    others = _others(ACCEL_UNITS, "accel_unit", layout, rate_hz)
    likely = [unit for unit, by in others.items() if abs(size * by / gravity - 1) < 0.1]
    text = f"the mean specific force is {size:.5g} m/s^2, {size / gravity:.3g} times gravity"
    if likely:
        yield Finding(hard, f"{text}: are these {_NAMES[likely[0]]}?")
        return
    if hard:
        yield Finding(True, f"{text}: is the accelerometer scale right?")
        return
    bias = abs(size - gravity) / micro_g()
    yield Finding(False, f"{text}: an accelerometer bias of {bias:.2g} ug or more would explain it")


def _vertical(means: _Means, layout: Layout) -> Iterator[Finding]:
    size = float(np.linalg.norm(means.force)) or 1.0  # zero in a record that is trusted anyway
    tilt = math.acos(max(-1.0, min(1.0, means.force[2] / size)))
    if tilt > 90 * DEG:
        right_up = layout.axes_order in ("xyz", "rfu")
        hint = " ('frd' for front-right-down)" if right_up else ""
        yield Finding(
            True,
            f"the specific force points down, {tilt / DEG:.3g} deg from the up axis: are"
            f" axes_order{hint} and the sign of the accelerometers right?",
        )
    elif tilt > _TILTED:
        text = f"the up axis is tilted by {tilt / DEG:.3g} deg: is axes_order right?"
        yield Finding(False, text)


def _rate(
    record: Record, span: tuple[int, int], layout: Layout, expected: StationaryValues, means: _Means
) -> Iterator[Finding]:
    size, earth = float(np.linalg.norm(means.rate)), expected.earth_rate
    allowed, bias = expected.gyro_bias + means.uncertain, abs(size - earth)
    text = f"the mean rate is {size / DEG_PER_H:.3g} deg/h, {size / earth:.3g} times Earth rate"
    high = (size - means.uncertain) / earth >= _HARD
    low = (size + means.uncertain) / earth <= 1 / _HARD
    up, vertical = _up(means), earth * math.sin(expected.latitude)
    if means.seconds < _SHORT_S and not means.steady:
        return
    lost = means.kept < _KEPT - ((earth + expected.gyro_bias) * means.seconds) ** 2 / 8
    judged = lost or (bias > allowed and (low or (high and means.steady)))
    likely = _other_gyro_unit(record, span, layout, expected) if judged else ""
    if bias > allowed and (low or (likely and high and means.steady)):
        yield Finding(True, f"{text}: {likely or 'has Earth rate been removed?'}")
    elif bias > allowed and high and means.steady:
        # A wrong scale keeps the direction of Earth rate; a bias would do so only by chance.
        same = abs(up / size - math.sin(expected.latitude)) < 0.2 + means.uncertain / size
        yield Finding(True, f"{text}: {'is the gyro scale right?' if same else _hidden(bias)}")
    elif lost:
        text += ", and the gyros do not follow the vertical"
        yield Finding(bool(likely), f"{text}: {likely or 'are their unit, axes and signs right?'}")
    elif bias > allowed and not means.steady:
        yield Finding(False, f"{text}, and it varies: the base turns or sways slowly")
    elif bias - means.uncertain >= earth * math.cos(expected.latitude):
        yield Finding(False, f"{text}: {_hidden(bias)}")
    elif bias > allowed:
        least = bias / DEG_PER_H
        text += f": a gyro bias of {least:.3g} deg/h or more would explain it"
        yield Finding(False, f"{text}, and the heading cannot be trusted")
    elif abs(up - vertical) > allowed:
        yield Finding(
            False,
            f"the rate about the vertical is {up / DEG_PER_H:.3g} deg/h, but Earth rate there is"
            f" {vertical / DEG_PER_H:.3g}: do gyros and accelerometers share their axes, and is the"
            " latitude right?",
        )


def _up(means: _Means) -> float:
    """The mean rate about the vertical, rad/s."""
    return float(means.rate @ means.force) / float(np.linalg.norm(means.force))


def _hidden(bias: float) -> str:
    least = bias / DEG_PER_H
    return f"a gyro bias of {least:.3g} deg/h or more hides Earth rate: no heading can be found"


def _rotations(means: _Means, expected: StationaryValues) -> Iterator[Finding]:
    drift = (expected.earth_rate + expected.gyro_bias + means.uncertain) * means.seconds
    if means.turned > _TURN:
        yield Finding(
            False,
            f"the base turns by about {means.turned / DEG:.3g} deg within the span used: the"
            " attitude at its end differs from that at its start",
        )
    elif means.moved > _TURN + drift:
        yield Finding(
            False,
            f"the vertical moves by {means.moved / DEG:.2g} deg but the gyros sense no rotation:"
            " were several records joined?",
        )
    elif means.seconds >= _LONG_S and means.change > max(
        expected.gyro_bias, 3 * _SETTLING / means.seconds
    ):
        yield Finding(
            False,
            f"the mean rate changes by {means.change / DEG_PER_H:.3g} deg/h within the span used:"
            " the base was turned, or a gyro bias drifts",
        )


def _others(
    units: dict[str, dict[str, float]], key: str, layout: Layout, rate_hz: float
) -> dict[str, float]:
    """The factor that converts a mean to each other unit its columns might have.

    PSINS text has fixed units.
    """
    if layout.format == "psins":
        return {}
    now = units[layout.quantity][getattr(layout, key)]
    other = {"increments": rate_hz, "rates": 1 / rate_hz}
    return {
        unit: factor / now * (1.0 if quantity == layout.quantity else other[quantity])
        for quantity, names in units.items()
        for unit, factor in names.items()
        if unit != getattr(layout, key)
    }


def _other_gyro_unit(
    record: Record, span: tuple[int, int], layout: Layout, expected: StationaryValues
) -> str:
    """The gyro unit that would make the rate plausible: near Earth rate, and along it."""
    part = record._replace(dtheta=record.dtheta[slice(*span)], dv=record.dv[slice(*span)])
    earth = expected.earth_rate
    others = _others(GYRO_UNITS, "gyro_unit", layout, record.rate_hz)
    for unit, factor in sorted(others.items(), key=lambda item: abs(math.log(item[1]))):
        scaled = part._replace(dtheta=part.dtheta * factor)
        means = _means(scaled, (0, len(part.dv)), expected.gravity)
        size = float(np.linalg.norm(means.rate))
        if means.kept < _KEPT:
            continue
        if abs(size - earth) <= min(expected.gyro_bias, earth / 2) + means.uncertain:
            off = abs(_up(means) / size - math.sin(expected.latitude))
            if off < 0.2 + means.uncertain / size:
                return f"are these {_NAMES[unit]}?"
    return ""


def _means(record: Record, span: tuple[int, int], gravity: float) -> _Means:
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
    if turned > _TURN:
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
    return _Means(
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
