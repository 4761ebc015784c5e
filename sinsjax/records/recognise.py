"""How a file that nobody described holds a record: from its names, gravity and Earth rate.

What the file tells is a reason; what it cannot tell is a doubt. Neither is settled in silence.
"""

import math
import re
from collections.abc import Callable, Mapping
from itertools import permutations
from pathlib import Path
from typing import NamedTuple

import numpy as np

from sinsjax.errors import InputError
from sinsjax.messages import shorten
from sinsjax.records.clock import LOOKED_AT_S, timing_of
from sinsjax.records.head import Head, listed
from sinsjax.records.layout import (
    ACCEL_UNITS,
    GYRO_UNITS,
    FloatArray,
    Layout,
    Note,
    Record,
    axes,
    to_body,
)
from sinsjax.records.means import EARTH_RATE, Means, means_of, rate_up
from sinsjax.records.names import Clock, Triad, clocks, incomplete, told_axes, triads
from sinsjax.records.oddities import dead_among
from sinsjax.records.plausible import UNIT_NAMES
from sinsjax.units import DEG, STANDARD_GRAVITY

_NEAR_GRAVITY = 0.1  # relative: accelerometers are better
_NEAR_EARTH_RATE = 0.5, 2.0  # ratios: gyros that can find north are better
_LEAST_OF_LIVE = 0.14  # ratio of the gyros beside a dead one: far from that in the nearest unit
_REFUSED = 9.5  # times gravity, or a part of it: no study runs on such a record
_BESIDE = {
    "m_per_s2": "rad_per_s",
    "g": "deg_per_s",
    "mg": "deg_per_s",
    "m_per_s": "rad",
    "g_s": "deg",
}
"""Units of gyros that go with those of accelerometers where nothing else tells them."""


class Recognised(NamedTuple):
    """What is found in a file.

    Attributes:
        layout: how it holds a record; its rate stands for one that nothing tells, or is None.
        notes: by key of the layout.
        means: mean measurements of its first minutes, in its own axes.
        tells_rate: whether the file tells its rate.
    """

    layout: Layout
    notes: Mapping[str, Note]
    means: Means
    tells_rate: bool


class _Samples(NamedTuple):
    """Numbers of a file, in its units and axes.

    Attributes:
        gyro: (T, 3).
        accel: (T, 3).
        rate_hz: how many a second.
    """

    gyro: FloatArray
    accel: FloatArray
    rate_hz: float


def sees_earth_rate(means: Means) -> bool:
    """Whether the mean rate is about Earth rate, as that of gyros that can find north."""
    low, high = _NEAR_EARTH_RATE
    return low < float(np.linalg.norm(means.rate)) / EARTH_RATE < high


def recognise(path: Path, head: Head) -> Recognised:
    """How a file holds a record.

    Args:
        path: CSV or Parquet.
        head: its beginning.

    Raises:
        InputError: it has no columns of gyros or accelerometers, or none that measure gravity; or
            its time runs backward.
    """
    notes: dict[str, Note] = {}
    gyro, notes["gyro_columns"] = _sensor(path, head, "gyro")
    accel, notes["accel_columns"] = _sensor(path, head, "accel")
    columns, times, row = _read(path, head, gyro, accel)
    timing = timing_of(path, times, row)
    clock, rate_hz = timing.clock, timing.rate_hz
    notes |= timing.notes
    looked_at = columns[: max(2, round(LOOKED_AT_S * rate_hz))]
    whole = looked_at[np.isfinite(looked_at).all(axis=1)]
    if len(whole) < rate_hz:
        raise InputError(f"{path}: has less than a second without missing samples")
    samples = _Samples(whole[:, :3], whole[:, 3:], rate_hz)
    quantity, accel_unit, notes["accel_unit"] = _accel_unit(path, samples, gyro, accel)
    notes["quantity"] = Note("as the unit of the accelerometers tells")
    gyro_unit, means, notes["gyro_unit"] = _gyro_unit(samples, gyro, quantity, accel_unit)
    order, notes["axes_order"] = _axes(means, head, gyro, accel)
    layout = Layout(
        format=head.format,
        quantity=quantity,
        time_column=clock.name if clock else "",
        gyro_columns=gyro.names,
        accel_columns=accel.names,
        gyro_unit=gyro_unit,
        accel_unit=accel_unit,
        axes_order=order,
        rate_hz=None if clock else rate_hz,
        time_unit=clock.unit if clock else "s",
    )
    return Recognised(layout, notes, means, timing.known)


def _sensor(path: Path, head: Head, kind: str) -> tuple[Triad, Note]:
    """The columns of the gyros or accelerometers, by their names."""
    found = triads([name for name in head.names if name in head.numbers], kind)
    if not found and (named := triads(head.names, kind)):
        name = next(name for name in named[0].names if name not in head.numbers)
        if name in head.kinds:
            raise InputError(f"{path}: column {name!r} holds {head.kinds[name]}, not numbers")
        row, cell = head.odd[name]
        hint = "decimal commas are not read: write points"
        if not re.fullmatch(r"[+-]?\d*,\d+", cell):
            hint = "if it is a row of units, begin it with #"
        text = f"row {row}: column {name!r}: {shorten(cell, 24)!r} is no number"
        raise InputError(f"{path}: {text} ({hint})")
    if not found:
        what = "gyros" if kind == "gyro" else "accelerometers"
        lacking = f"no columns of {what}"
        if two := incomplete(head.names, kind):
            there = " and ".join(map(repr, two[0]))
            lacking = f"{there} are there, but no column of the {what} named {two[1]}"
        raise InputError(
            f"{path}: {lacking} among {listed(head.names)}: name them {kind}_x,"
            f" {kind}_y, {kind}_z, or give [record] {kind}_columns in a study (see `sinsjax init"
            " record`)"
        )
    others = [", ".join(triad.names) for triad in found[1:]]
    return found[0], Note("by their names", f"or {'; or '.join(others)}?" if others else "")


def _read(
    path: Path, head: Head, gyro: Triad, accel: Triad
) -> tuple[FloatArray, dict[Clock, FloatArray], Callable[[int], int]]:
    """Samples (T, 6), those columns that may hold their times, and the row of each sample."""
    taken = [*gyro.names, *accel.names]
    usable = head.numbers | head.dates
    maybe = [c for c in clocks(head.names) if c.name in usable and c.name not in taken]
    maybe = [c._replace(unit="iso") if c.name in head.dates else c for c in maybe]
    if not maybe and head.names[0] in usable and head.names[0] not in taken:
        maybe = [Clock(head.names[0], "iso" if head.names[0] in head.dates else "")]
    names = [*taken, *(clock.name for clock in maybe)]
    table = head.open(path)
    columns = table.read(names, blanks=True, dates=list(head.dates))
    times = dict(zip(maybe, columns[6:], strict=True))
    return np.column_stack(columns[:6]), times, table.row


def _accel_unit(path: Path, samples: _Samples, gyro: Triad, accel: Triad) -> tuple[str, str, Note]:
    """Quantity and unit of the accelerometers, by their names and gravity."""
    second = max(1, round(samples.rate_hz))
    whole = samples.accel[: len(samples.accel) // second * second]
    means = whole.reshape(-1, second, 3).mean(axis=1)
    size = float(np.median(np.linalg.norm(means, axis=1)))
    times_gravity = {
        (quantity, unit): size
        * factor
        * (samples.rate_hz if quantity == "increments" else 1.0)
        / STANDARD_GRAVITY
        for quantity, units in ACCEL_UNITS.items()
        for unit, factor in units.items()
    }
    fits = [pair for pair, ratio in times_gravity.items() if abs(ratio - 1) < _NEAR_GRAVITY]
    by_name = [pair for pair in times_gravity if pair[1] == accel.unit]
    named = by_name[0] if by_name else None
    hinted = "increments" if gyro.increments or accel.increments else "rates"
    fits.sort(key=lambda pair: (pair != named, pair[0] != hinted))
    if not fits and (named is None or not 1 / _REFUSED < times_gravity[named] < _REFUSED):
        why = "has gravity been removed?" if size < 0.05 else "are these counts?"
        raise InputError(
            f"{path}: the mean of {', '.join(accel.names)} has a magnitude of {size:.5g}, which is"
            f" gravity in no unit: {why} (sinsjax reads physical units with gravity in them)"
        )
    quantity, unit = chosen = fits[0] if fits else named or fits[0]
    reason = f"the mean has a magnitude of {size:.5g}, {times_gravity[chosen]:.4g} times gravity"
    reason += f" in {UNIT_NAMES[unit]}"
    doubt = ""
    if named is not None and chosen != named:
        doubt = f"the names tell {UNIT_NAMES[named[1]]}, {times_gravity[named]:.3g} times gravity"
    elif not fits:
        doubt = "that is far from gravity, but the names tell this unit"
    elif quantity != hinted and named is None:
        doubt = "gravity alone tells that these are increments; counts may look alike"
    elif len(fits) > 1 and named is None:
        others = ", ".join(f"{q} in {UNIT_NAMES[u]}" for q, u in fits[1:])
        doubt = f"at {samples.rate_hz:.4g} Hz {others} would be gravity too"
    return quantity, unit, Note(reason, doubt)


def _gyro_unit(
    samples: _Samples, gyro: Triad, quantity: str, accel_unit: str
) -> tuple[str, Means, Note]:
    """Unit of the gyros by their names and Earth rate, and the means in it."""
    spread = samples.rate_hz if quantity == "rates" else 1.0
    dv = samples.accel * (ACCEL_UNITS[quantity][accel_unit] / spread)
    # Without a dead channel the others tell the order of Earth rate; with its constant, nothing.
    dead = dead_among(samples.gyro.T)
    left_out = any(dead)
    live = np.where(dead, 0.0, samples.gyro)
    means, ratio = {}, {}
    for unit, factor in GYRO_UNITS[quantity].items():
        record = Record(live * (factor / spread), dv, samples.rate_hz)
        means[unit] = means_of(record, (0, len(dv)), STANDARD_GRAVITY)
        ratio[unit] = float(np.linalg.norm(means[unit].rate)) / EARTH_RATE
    # Gyros in a wrong unit do not follow the vertical of a base that sways.
    far = {unit: abs(math.log(max(ratio[unit], 1e-12))) for unit in ratio}
    best = min(ratio, key=lambda unit: (means[unit].kept < 0.99, far[unit]))
    beside = _BESIDE.get(accel_unit, best)
    low, high = _LEAST_OF_LIVE if left_out else _NEAR_EARTH_RATE[0], _NEAR_EARTH_RATE[1]
    unit = gyro.unit if gyro.unit in ratio else best if low < ratio[best] < high else beside
    told = f"the mean rate is {ratio[unit]:.3g} times Earth rate in {UNIT_NAMES[unit]}"
    names = ", ".join(repr(name) for name, is_dead in zip(gyro.names, dead, strict=True) if is_dead)
    if low < ratio[unit] < high:
        doubt = f"told without {names}, which never changes" if left_out else ""
        return unit, means[unit], Note(told, doubt)
    by_name = unit == gyro.unit
    if low < ratio[best] < high:
        doubt = f"the names tell this unit; in {UNIT_NAMES[best]} it would be {ratio[best]:.3g}"
    elif by_name:
        doubt = "biases or motion hide Earth rate, so that only the names tell the unit"
    else:
        others = [f"{one:.3g} in {UNIT_NAMES[name]}" for name, one in ratio.items() if name != unit]
        doubt = f"no unit gives Earth rate ({', '.join(others)}): this one goes with that of the"
        doubt += " accelerometers; see the data sheet"
    return unit, means[unit], Note(told, doubt)


def _axes(means: Means, head: Head, gyro: Triad, accel: Triad) -> tuple[str, Note]:
    """The order of axes by names, comments and gravity."""
    up = means.force / float(np.linalg.norm(means.force))
    axis = int(np.argmax(np.abs(up)))
    pointing = f"{'xyz'[axis]} reads {up[axis]:+.2f} g"
    doubts = []
    if abs(up[axis]) < math.cos(30 * DEG):
        doubts.append(f"no axis is near the vertical ({pointing})")
    if sees_earth_rate(means) and rate_up(means) < -0.2 * EARTH_RATE:
        text = "the Earth turns clockwise about the specific force: the base is in the southern"
        doubts.append(f"{text} hemisphere, or gyros and accelerometers differ in sign")
    named = gyro.ways or accel.ways or told_axes([*head.comments, *head.names])
    if named:
        if float(to_body(up[None], named)[0, 2]) < math.cos(60 * DEG):
            doubts.append(f"the names tell {named!r}, but {pointing}: a sign or an axis is wrong")
        return named, Note(f"by names or comments; {pointing}", "; ".join(doubts))
    order = _order_with_up(axis, bool(up[axis] > 0))
    about = "the yaw turns by 90 or 180 deg with it"
    if order == "flu":
        doubts.append(f"x may point front ('flu') or y ('rfu'): {about}")
    elif order == "frd":
        text = "z points down, or the accelerometers have the opposite sign; x may not point front"
        doubts.append(f"{text}: {about}")
    else:
        doubts.append(f"nothing tells which axis points front: {about}")
    return order, Note(pointing, "; ".join(doubts))


def _order_with_up(axis: int, positive: bool) -> str:
    """An order of axes whose up is an axis of the record or its opposite."""
    if axis == 2:
        return "flu" if positive else "frd"
    up = "xyz"[axis] if positive else f"-{'xyz'[axis]}"
    rest = [letter for letter in "zxy" if letter != "xyz"[axis]]
    orders = (
        f"{sign}{right}{other}{front}{up}"
        for front, right in permutations(rest)
        for other in ("", "-")
        for sign in ("", "-")
    )
    return next(order for order in orders if _is_right_handed(order))


def _is_right_handed(order: str) -> bool:
    try:
        axes(order)
    except ValueError:
        return False
    return True
