"""Whether a record can be what it is taken for, before anything is aligned with it.

A base that stays feels gravity upward and the Earth's turn, whatever it sways by, and its sensors
add their biases. Wrong units, axes or signs and a vehicle that turns show in one of the two.
"""

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from sinsjax.records.layout import ACCEL_UNITS, GYRO_UNITS, FloatArray, Layout, Record
from sinsjax.records.turning import attitudes, multiply, rotate
from sinsjax.units import DEG, DEG_PER_H, micro_g

_HARD = 9.5
"""A mean that is off by this factor is refused: 10, with room for g read as m/s^2, which is 9.8."""

_TURN = 1.0 * DEG  # what a parked vehicle stays within
_SETTLING = 0.3 * DEG  # as one with people in it does in a third of a span
_SHORT_S = 20.0  # which holds few sways
_LONG_S = 180.0  # a third of it holds several sways of most bases
_KEPT = 0.99  # of gravity, by gyros that follow the sways
_LEANING = 45 * DEG
_MOST = 2**19  # steps that a span is looked at in: of a longer one, samples are put together
_NAMES = {
    "rad_per_s": "rad/s",
    "deg_per_s": "deg/s",
    "deg_per_h": "deg/h",
    "m_per_s2": "m/s^2",
    "m_per_s": "m/s a sample",
    "g_s": "g s a sample",
    "ug_s": "ug s a sample",
    "rad": "rad a sample",
    "deg": "deg a sample",
    "arcsec": "arcsec a sample",
    "g": "g",
    "mg": "mg",
    "ug": "ug",
}


class Expected(NamedTuple):
    """What a record should show, SI units.

    Attributes:
        earth_rate: rad/s.
        latitude: rad.
        gravity: m/s^2.
        gyro_bias: the most that a plausible gyro has, rad/s.
        accel_bias: the most that a plausible accelerometer has, m/s^2.
    """

    earth_rate: float
    latitude: float
    gravity: float
    gyro_bias: float
    accel_bias: float


class Finding(NamedTuple):
    """Something that does not fit, without the file's name; hard if it is beyond doubt."""

    hard: bool
    text: str


class _Felt(NamedTuple):
    """What a span shows, in the body axes of its middle, SI units.

    Attributes:
        rate: (3,) mean rate over whole sways.
        uncertain: of it, what sways and noise may leave.
        steady: whether it is about the same all the time.
        turned: angle by which the base turned beside that, rad.
        change: how much the rate certainly differs from the first to the last third, rad/s.
        force: (3,) mean specific force.
        size: mean size of the specific force.
        kept: size of the mean force, turned by the gyros, over the mean size.
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
    record: Record, span: tuple[int, int], layout: Layout, expected: Expected
) -> list[Finding]:
    """What of a span of a record is not plausible for a base that stays.

    Args:
        record: all of whose samples in the span are there.
        span: first sample, and the one after the last; a second or more.
        layout: how the record was read, for the likely cause.
        expected: of sensors and place.
    """
    felt = _felt(record, span, expected.gravity)
    found = [*_force(felt, layout, record.rate_hz, expected), *_vertical(felt, layout)]
    rate = list(_rate(record, span, layout, expected, felt))
    if rate:  # no gyro to see a turn with
        return found + rate
    return found + rate + list(_turns(felt, expected))


def _force(felt: _Felt, layout: Layout, rate_hz: float, expected: Expected) -> Iterator[Finding]:
    size, gravity = felt.size, expected.gravity
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
        yield Finding(True, f"{text}: is the scale of the accelerometers right?")
        return
    bias = abs(size - gravity) / micro_g()
    yield Finding(False, f"{text}: an accelerometer bias of {bias:.2g} ug or more would explain it")


def _vertical(felt: _Felt, layout: Layout) -> Iterator[Finding]:
    size = float(np.linalg.norm(felt.force)) or 1.0  # there may be none in a record to be trusted
    lean = math.acos(max(-1.0, min(1.0, felt.force[2] / size)))
    if lean > 90 * DEG:
        hint = " ('yx-z' of front-right-down)" if layout.axes_order == "xyz" else ""
        yield Finding(
            True,
            f"the specific force points down, {lean / DEG:.3g} deg from the up axis: does"
            f" axes_order{hint} or the sign of the accelerometers turn it round?",
        )
    elif lean > _LEANING:
        text = f"the up axis leans by {lean / DEG:.3g} deg: is axes_order right?"
        yield Finding(False, text)


def _rate(
    record: Record, span: tuple[int, int], layout: Layout, expected: Expected, felt: _Felt
) -> Iterator[Finding]:
    size, earth = float(np.linalg.norm(felt.rate)), expected.earth_rate
    allowed, bias = expected.gyro_bias + felt.uncertain, abs(size - earth)
    text = f"the mean rate is {size / DEG_PER_H:.3g} deg/h, {size / earth:.3g} times Earth rate"
    high = (size - felt.uncertain) / earth >= _HARD
    low = (size + felt.uncertain) / earth <= 1 / _HARD
    up, vertical = _up(felt), earth * math.sin(expected.latitude)
    if felt.seconds < _SHORT_S and not felt.steady:
        return
    lost = felt.kept < _KEPT - ((earth + expected.gyro_bias) * felt.seconds) ** 2 / 8
    judged = lost or (bias > allowed and (low or (high and felt.steady)))
    likely = _other_gyro_unit(record, span, layout, expected) if judged else ""
    if bias > allowed and (low or (likely and high and felt.steady)):
        yield Finding(True, f"{text}: {likely or 'has the turn of the Earth been taken out?'}")
    elif bias > allowed and high and felt.steady:
        # A wrong scale leaves the direction, which a bias has no reason to share.
        same = abs(up / size - math.sin(expected.latitude)) < 0.2 + felt.uncertain / size
        yield Finding(True, f"{text}: {'is the gyro scale right?' if same else _hidden(bias)}")
    elif lost:
        text += ", and the gyros do not turn as the vertical does"
        yield Finding(bool(likely), f"{text}: {likely or 'are their unit, axes and signs right?'}")
    elif bias > allowed and not felt.steady:
        yield Finding(False, f"{text}, and it changes: the base turns, or sways slowly")
    elif bias - felt.uncertain >= earth * math.cos(expected.latitude):
        yield Finding(False, f"{text}: {_hidden(bias)}")
    elif bias > allowed:
        least = bias / DEG_PER_H
        text += f": a gyro bias of {least:.3g} deg/h or more would explain it"
        yield Finding(False, f"{text}, and the heading is not to be trusted")
    elif abs(up - vertical) > allowed:
        yield Finding(
            False,
            f"the rate about the vertical is {up / DEG_PER_H:.3g} deg/h where the Earth turns at"
            f" {vertical / DEG_PER_H:.3g}: are the gyros' axes those of the accelerometers, and is"
            " the latitude right?",
        )


def _up(felt: _Felt) -> float:
    """The mean rate about the vertical, rad/s."""
    return float(felt.rate @ felt.force) / float(np.linalg.norm(felt.force))


def _hidden(bias: float) -> str:
    least = bias / DEG_PER_H
    return f"a gyro bias of {least:.3g} deg/h or more hides Earth rate, and no heading is left"


def _turns(felt: _Felt, expected: Expected) -> Iterator[Finding]:
    drift = (expected.earth_rate + expected.gyro_bias + felt.uncertain) * felt.seconds
    if felt.turned > _TURN:
        yield Finding(
            False,
            f"the base turns by about {felt.turned / DEG:.3g} deg within the span that is used: an"
            " attitude at its end is not that at its beginning",
        )
    elif felt.moved > _TURN + drift:
        yield Finding(
            False,
            f"the vertical moves by {felt.moved / DEG:.2g} deg while the gyros feel no turn: are"
            " pieces of several records put together?",
        )
    elif felt.seconds >= _LONG_S and felt.change > max(
        expected.gyro_bias, 3 * _SETTLING / felt.seconds
    ):
        yield Finding(
            False,
            f"the mean rate changes by {felt.change / DEG_PER_H:.3g} deg/h within the span that is"
            " used: the base was turned, or a gyro bias drifts",
        )


def _others(
    units: dict[str, dict[str, float]], key: str, layout: Layout, rate_hz: float
) -> dict[str, float]:
    """Every other unit that columns may have, and by what a mean then is to be multiplied.

    PSINS text has no unit but its own.
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
    record: Record, span: tuple[int, int], layout: Layout, expected: Expected
) -> str:
    """The gyro unit in which all would be plausible: Earth rate in its direction, level kept."""
    part = record._replace(dtheta=record.dtheta[slice(*span)], dv=record.dv[slice(*span)])
    earth = expected.earth_rate
    others = _others(GYRO_UNITS, "gyro_unit", layout, record.rate_hz)
    for unit, factor in sorted(others.items(), key=lambda item: abs(math.log(item[1]))):
        scaled = part._replace(dtheta=part.dtheta * factor)
        felt = _felt(scaled, (0, len(part.dv)), expected.gravity)
        size = float(np.linalg.norm(felt.rate))
        if felt.kept < _KEPT:
            continue
        if abs(size - earth) <= min(expected.gyro_bias, earth / 2) + felt.uncertain:
            off = abs(_up(felt) / size - math.sin(expected.latitude))
            if off < 0.2 + felt.uncertain / size:
                return f"are these {_NAMES[unit]}?"
    return ""


def _felt(record: Record, span: tuple[int, int], gravity: float) -> _Felt:
    together = -(-(span[1] - span[0]) // _MOST)
    dtheta, dv = (_summed(rows[slice(*span)], together) for rows in (record.dtheta, record.dv))
    n, dt = len(dtheta), together / record.rate_hz
    q = attitudes(dtheta)
    q = multiply(q[n // 2] * [1, -1, -1, -1], q)  # to the body axes of the middle
    turns = _steps(q, dtheta)
    force = rotate(q[:-1], dv) / dt
    rate = _mean(turns) / dt
    uncertain = 3 * _spread(turns) / dt
    # Windows a quarter of the span long: one that turns stands out from the median of all.
    some = np.array([_mean(turns, k / 16, (k + 4) / 16) for k in range(13)]) / dt
    from_usual = np.linalg.norm(some - np.median(some, axis=0), axis=1)
    usual = float(np.median(from_usual))
    uncertain += usual / 16  # where there are few sways, all long means err alike
    turned = (float(from_usual.max()) - 5 * usual) * n * dt / 4 / 2.3  # of the weight at its peak
    if turned > _TURN:
        rate, uncertain = np.median(some, axis=0), 3 * usual
    ends = (0.0, 1 / 3), (2 / 3, 1.0)
    early, late = (_mean(force, *end) for end in ends)
    thirds = turns[: n // 3], turns[-(n // 3) :]
    change = _size(_mean(thirds[1]) - _mean(thirds[0])) - sum(map(_spread, thirds))
    # Sways make neighbours differ; what changes once does not.
    change -= dt / 2 * float(np.median(np.linalg.norm(np.diff(some, axis=0), axis=1)))
    cosine = float(early @ late) / (_size(early) * _size(late))
    second = max(1, round(1 / dt))
    blocks = dv[: n // second * second].reshape(-1, second, 3).mean(axis=1) / dt
    sizes = _size(_mean(force)), float(np.linalg.norm(blocks, axis=1).mean())
    return _Felt(
        rate=rate,
        uncertain=uncertain,
        steady=usual < 0.15 * _size(rate) or uncertain < 0.1 * _size(rate),
        turned=turned,
        change=change / dt,
        force=dv.mean(axis=0) / dt,
        # Sways shorten the plain mean, wrong gyros the turned one: the better of the two counts.
        size=min(sizes, key=lambda size: abs(size - gravity)),
        kept=sizes[0] / sizes[1],
        moved=math.acos(max(-1.0, min(1.0, cosine))),
        seconds=n * dt,
    )


def _summed(rows: FloatArray, together: int) -> FloatArray:
    """Increments (n, 3) over that many samples at a time; a rest is left out."""
    if together == 1:
        return rows
    return rows[: len(rows) // together * together].reshape(-1, together, 3).sum(axis=1)


def _size(vector: FloatArray) -> float:
    return float(np.linalg.norm(vector))


def _spread(rows: FloatArray) -> float:
    """How far means over most of some rows lie from that over all of them."""
    parts = [(0.0, 0.9), (0.1, 1.0), (0.05, 0.95)]
    return max(_size(_mean(rows, *part) - _mean(rows)) for part in parts)


def _mean(rows: FloatArray, begin: float = 0.0, end: float = 1.0) -> FloatArray:
    """Mean of rows (n, 3) over a part, so weighted that sways of a few periods cancel."""
    first, last = int(begin * len(rows)), max(int(begin * len(rows)) + 1, round(end * len(rows)))
    n = last - first
    weight = np.sin(np.pi * (np.arange(n) + 0.5) / n) ** 4
    return np.asarray(weight @ rows[first:last] / weight.sum())


def _steps(q: FloatArray, dtheta: FloatArray) -> FloatArray:
    """Turn of each sample in the axes that q (n + 1, 4) goes to, (n, 3).

    Steps of the rotation vector: a sway takes back what it gave, in whatever order of axes. Where
    the base turns too far for one, the gyros' turned increments.
    """
    q = q * np.sign(q[:, :1] + (q[:, :1] == 0))
    sine = np.linalg.norm(q[:, 1:], axis=1)
    angle = 2 * np.arctan2(sine, q[:, 0])
    if angle.max() > 150 * DEG:
        return rotate(q[:-1], dtheta)
    vector = q[:, 1:] * np.where(sine > 1e-12, angle / np.maximum(sine, 1e-12), 2.0)[:, None]
    return np.diff(vector, axis=0)
