"""Plausibility checks of a record before anything is aligned with it.

The mean specific force of a stationary base is gravity and its mean rate is Earth rate, however it
sways, apart from sensor biases. Wrong units, axes or signs, or a turning vehicle, show in one of
the two.
"""

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from sinsjax.records.layout import ACCEL_UNITS, GYRO_UNITS, Layout, Record, given_as
from sinsjax.records.means import TURN, Means, means_of, rate_up
from sinsjax.units import DEG, DEG_PER_H, micro_g

_HARD = 9.5
"""A mean wrong by this factor is rejected: below 10, so that g taken for m/s^2 (9.8) is caught."""

_SETTLING = 0.3 * DEG  # of an occupied vehicle on its suspension, in a third of a span
_SHORT_S = 20.0  # contains few sways
_LONG_S = 180.0  # a third of it contains several sways of most bases
_KEPT = 0.99  # of gravity, when the gyros follow the sways
_TILTED = 45 * DEG
UNIT_NAMES = {
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
    means = means_of(record, span, expected.gravity)
    found = [*_force(means, layout, record.rate_hz, expected), *_vertical(means, layout)]
    rate = list(_rate(record, span, layout, expected, means))
    if rate:  # gyros that are wrong cannot show a rotation of the base
        return found + rate
    return found + rate + list(_rotations(means, expected))


def _force(
    means: Means, layout: Layout, rate_hz: float, expected: StationaryValues
) -> Iterator[Finding]:
    size, gravity = means.size, expected.gravity
    if abs(size - gravity) <= expected.accel_bias:
        return
    hard = not 1 / _HARD < size / gravity < _HARD
    others = _others(ACCEL_UNITS, "accel_unit", layout, rate_hz)
    likely = [unit for unit, by in others.items() if abs(size * by / gravity - 1) < 0.1]
    text = f"the mean specific force is {size:.5g} m/s^2, {size / gravity:.3g} times gravity"
    if likely:
        yield Finding(hard, f"{text}: are these {UNIT_NAMES[likely[0]]}?")
        return
    if hard:
        yield Finding(True, f"{text}: is the accelerometer scale right?")
        return
    bias = abs(size - gravity) / micro_g()
    yield Finding(False, f"{text}: an accelerometer bias of {bias:.2g} ug or more would explain it")


def _vertical(means: Means, layout: Layout) -> Iterator[Finding]:
    size = float(np.linalg.norm(means.force)) or 1.0  # zero in a record that is trusted anyway
    tilt = math.acos(max(-1.0, min(1.0, means.force[2] / size)))
    key = given_as(layout, "axes_order")
    if tilt > 90 * DEG:
        right_up = layout.axes_order in ("xyz", "rfu")
        hint = " ('yx-z' for front-right-down)" if right_up else ""
        yield Finding(
            True,
            f"the specific force points down, {tilt / DEG:.3g} deg from the up axis: are"
            f" {key}{hint} and the sign of the accelerometers right?",
        )
    elif tilt > _TILTED:
        text = f"the up axis is tilted by {tilt / DEG:.3g} deg: is {key} right?"
        yield Finding(False, text)


def _rate(
    record: Record, span: tuple[int, int], layout: Layout, expected: StationaryValues, means: Means
) -> Iterator[Finding]:
    size, earth = float(np.linalg.norm(means.rate)), expected.earth_rate
    allowed, bias = expected.gyro_bias + means.uncertain, abs(size - earth)
    text = f"the mean rate is {size / DEG_PER_H:.3g} deg/h, {size / earth:.3g} times Earth rate"
    high = (size - means.uncertain) / earth >= _HARD
    low = (size + means.uncertain) / earth <= 1 / _HARD
    up, vertical = rate_up(means), earth * math.sin(expected.latitude)
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
        removed = ", or has Earth rate been removed" if abs(up) < 0.5 * abs(vertical) else ""
        yield Finding(
            False,
            f"the rate about the vertical is {up / DEG_PER_H:.3g} deg/h, but Earth rate there is"
            f" {vertical / DEG_PER_H:.3g}: do gyros and accelerometers share their axes, and is the"
            f" latitude right{removed}?",
        )


def _hidden(bias: float) -> str:
    least = bias / DEG_PER_H
    return f"a gyro bias of {least:.3g} deg/h or more hides Earth rate: no heading can be found"


def _rotations(means: Means, expected: StationaryValues) -> Iterator[Finding]:
    drift = (expected.earth_rate + expected.gyro_bias + means.uncertain) * means.seconds
    if means.turned > TURN:
        yield Finding(
            False,
            f"the base turns by about {means.turned / DEG:.3g} deg within the span used: the"
            " attitude at its end differs from that at its start",
        )
    elif means.moved > TURN + drift:
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
        means = means_of(scaled, (0, len(part.dv)), expected.gravity)
        size = float(np.linalg.norm(means.rate))
        if means.kept < _KEPT:
            continue
        if abs(size - earth) <= min(expected.gyro_bias, earth / 2) + means.uncertain:
            off = abs(rate_up(means) / size - math.sin(expected.latitude))
            if off < 0.2 + means.uncertain / size:
                return f"are these {UNIT_NAMES[unit]}?"
    return ""
