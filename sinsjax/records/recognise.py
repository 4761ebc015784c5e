"""Layout of a file without a description, from its names, gravity and Earth rate.

Evidence in the file becomes a reason, missing evidence a doubt. Nothing is assumed silently.
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
from sinsjax.records.anomalies import find_dead_channels
from sinsjax.records.clock import EXAMINED_S, find_timing
from sinsjax.records.column_names import (
    Clock,
    Triad,
    find_axes_order,
    find_clocks,
    find_incomplete_triad,
    find_triads,
)
from sinsjax.records.head import Head, format_names
from sinsjax.records.layout import (
    ACCEL_UNITS,
    GYRO_UNITS,
    FloatArray,
    Layout,
    Note,
    Record,
    parse_axes_order,
    to_body_axes,
)
from sinsjax.records.means import EARTH_RATE, Means, compute_means, vertical_rate
from sinsjax.records.plausibility import UNIT_NAMES
from sinsjax.units import DEG, STANDARD_GRAVITY

_NEAR_GRAVITY = 0.1  # relative: accelerometers are better
_NEAR_EARTH_RATE = 0.5, 2.0  # ratios: gyros that can find north are better
_MIN_LIVE_RATIO = 0.14  # ratio of two live gyros with a dead third, far from that in another unit
_REFUSED_FACTOR = 9.5  # times gravity, or its inverse, beyond which no study accepts a record
_GYRO_UNIT_FOR = {
    "m_per_s2": "rad_per_s",
    "g": "deg_per_s",
    "mg": "deg_per_s",
    "m_per_s": "rad",
    "g_s": "deg",
}
"""Usual gyro units for accelerometer units, without other evidence."""


class Recognised(NamedTuple):
    """The recognised layout of a file.

    Attributes:
        layout: layout of its record; the rate is a placeholder if unknown, or None.
        notes: reasons and doubts by key of the layout.
        means: mean measurements of its first minutes, in its own axes.
        has_rate: whether the file determines its rate.
    """

    layout: Layout
    notes: Mapping[str, Note]
    means: Means
    has_rate: bool


class _Samples(NamedTuple):
    """Samples of a file, in its units and axes.

    Attributes:
        gyro: (T, 3) gyro samples.
        accel: (T, 3) accelerometer samples.
        rate_hz: sample rate, Hz.
    """

    gyro: FloatArray
    accel: FloatArray
    rate_hz: float


def shows_earth_rate(means: Means) -> bool:
    """Return whether the mean rate is close to Earth rate, as with gyros that can find north."""
    low, high = _NEAR_EARTH_RATE
    return low < float(np.linalg.norm(means.rate)) / EARTH_RATE < high


def recognise_layout(path: Path, head: Head) -> Recognised:
    """Recognise the layout of a record in a file.

    Args:
        path: CSV or Parquet file.
        head: its beginning.

    Raises:
        InputError: it has no columns of gyros or accelerometers, no gravity, or time that runs
            backward.
    """
    notes: dict[str, Note] = {}
    gyro, notes["gyro_columns"] = _find_sensor_columns(path, head, "gyro")
    accel, notes["accel_columns"] = _find_sensor_columns(path, head, "accel")
    columns, times, row_number = _read_samples(path, head, gyro, accel)
    timing = find_timing(path, times, row_number)
    clock, rate_hz = timing.clock, timing.rate_hz
    notes |= timing.notes
    examined = columns[: max(2, round(EXAMINED_S * rate_hz))]
    complete = examined[np.isfinite(examined).all(axis=1)]
    if len(complete) < rate_hz:
        raise InputError(f"{path}: has less than a second without missing samples")
    samples = _Samples(complete[:, :3], complete[:, 3:], rate_hz)
    quantity, accel_unit, notes["accel_unit"] = _find_accel_unit(path, samples, gyro, accel)
    notes["quantity"] = Note("according to the unit of the accelerometers")
    gyro_unit, means, notes["gyro_unit"] = _find_gyro_unit(samples, gyro, quantity, accel_unit)
    order, notes["axes_order"] = _find_axes_order(means, head, gyro, accel)
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
    return Recognised(layout, notes, means, timing.is_known)


def _find_sensor_columns(path: Path, head: Head, sensor: str) -> tuple[Triad, Note]:
    """Return the columns of the gyros or accelerometers, according to their names."""
    candidates = find_triads([name for name in head.names if name in head.numbers], sensor)
    if not candidates and (by_name := find_triads(head.names, sensor)):
        name = next(name for name in by_name[0].names if name not in head.numbers)
        if name in head.column_types:
            raise InputError(
                f"{path}: column {name!r} contains {head.column_types[name]}, not numbers"
            )
        row, cell = head.non_numbers[name]
        hint = "decimal commas are not read: write points"
        if not re.fullmatch(r"[+-]?\d*,\d+", cell):
            hint = "begin a row of units with #"
        text = f"row {row}: column {name!r}: {shorten(cell, 24)!r} is not a number"
        raise InputError(f"{path}: {text} ({hint})")
    if not candidates:
        sensor_name = "gyros" if sensor == "gyro" else "accelerometers"
        problem = f"no columns of {sensor_name}"
        if pair := find_incomplete_triad(head.names, sensor):
            present = " and ".join(map(repr, pair[0]))
            problem = f"there are {present}, but no column of the {sensor_name} named {pair[1]}"
        raise InputError(
            f"{path}: {problem} among {format_names(head.names)}: name them {sensor}_x,"
            f" {sensor}_y, {sensor}_z, or give [record] {sensor}_columns in a study"
            " (see `sinsjax init record`)"
        )
    others = [", ".join(triad.names) for triad in candidates[1:]]
    return candidates[0], Note("by their names", f"or {'; or '.join(others)}?" if others else "")


def _read_samples(
    path: Path, head: Head, gyro: Triad, accel: Triad
) -> tuple[FloatArray, dict[Clock, FloatArray], Callable[[int], int]]:
    """Return samples (T, 6), the possible time columns, and the row of each sample."""
    sensor_names = [*gyro.names, *accel.names]
    usable = head.numbers | head.dates
    clock_candidates = [
        c for c in find_clocks(head.names) if c.name in usable and c.name not in sensor_names
    ]
    clock_candidates = [
        c._replace(unit="iso") if c.name in head.dates else c for c in clock_candidates
    ]
    if not clock_candidates and head.names[0] in usable and head.names[0] not in sensor_names:
        clock_candidates = [Clock(head.names[0], "iso" if head.names[0] in head.dates else "")]
    names = [*sensor_names, *(clock.name for clock in clock_candidates)]
    table = head.open_table(path)
    columns = table.read(names, blanks=True, dates=list(head.dates))
    times = dict(zip(clock_candidates, columns[6:], strict=True))
    return np.column_stack(columns[:6]), times, table.row_number


def _find_accel_unit(
    path: Path, samples: _Samples, gyro: Triad, accel: Triad
) -> tuple[str, str, Note]:
    """Return quantity and unit of the accelerometers, from their names and gravity."""
    samples_per_second = max(1, round(samples.rate_hz))
    rows = samples.accel[: len(samples.accel) // samples_per_second * samples_per_second]
    means = rows.reshape(-1, samples_per_second, 3).mean(axis=1)
    magnitude = float(np.median(np.linalg.norm(means, axis=1)))
    times_gravity = {
        (quantity, unit): magnitude
        * factor
        * (samples.rate_hz if quantity == "increments" else 1.0)
        / STANDARD_GRAVITY
        for quantity, units in ACCEL_UNITS.items()
        for unit, factor in units.items()
    }
    plausible = [pair for pair, ratio in times_gravity.items() if abs(ratio - 1) < _NEAR_GRAVITY]
    by_name = [pair for pair in times_gravity if pair[1] == accel.unit]
    named_unit = by_name[0] if by_name else None
    expected_quantity = "increments" if gyro.are_increments or accel.are_increments else "rates"
    plausible.sort(key=lambda pair: (pair != named_unit, pair[0] != expected_quantity))
    if not plausible and (
        named_unit is None or not 1 / _REFUSED_FACTOR < times_gravity[named_unit] < _REFUSED_FACTOR
    ):
        question = "has gravity been removed?" if magnitude < 0.05 else "are these counts?"
        raise InputError(
            f"{path}: the mean of {', '.join(accel.names)} has a magnitude of {magnitude:.5g},"
            f" which is gravity in no unit: {question} (sinsjax reads physical units with gravity"
            " in them)"
        )
    quantity, unit = chosen = plausible[0] if plausible else named_unit or plausible[0]
    reason = (
        f"the mean has a magnitude of {magnitude:.5g}, {times_gravity[chosen]:.4g} times gravity"
    )
    reason += f" in {UNIT_NAMES[unit]}"
    doubt = ""
    if named_unit is not None and chosen != named_unit:
        doubt = f"the names state {UNIT_NAMES[named_unit[1]]}, {times_gravity[named_unit]:.3g}"
        doubt += " times gravity"
    elif not plausible:
        doubt = "that is far from gravity, but the names state this unit"
    elif quantity != expected_quantity and named_unit is None:
        doubt = "only gravity indicates increments; counts may look alike"
    elif len(plausible) > 1 and named_unit is None:
        others = ", ".join(f"{q} in {UNIT_NAMES[u]}" for q, u in plausible[1:])
        doubt = f"at {samples.rate_hz:.4g} Hz {others} would be gravity too"
    return quantity, unit, Note(reason, doubt)


def _find_gyro_unit(
    samples: _Samples, gyro: Triad, quantity: str, accel_unit: str
) -> tuple[str, Means, Note]:
    """Return the unit of the gyros, from their names and Earth rate, and the means in it."""
    rate_divisor = samples.rate_hz if quantity == "rates" else 1.0
    dv = samples.accel * (ACCEL_UNITS[quantity][accel_unit] / rate_divisor)
    # Without a dead channel the others still show the order of Earth rate; with it, nothing.
    dead = find_dead_channels(samples.gyro.T)
    has_dead = any(dead)
    live = np.where(dead, 0.0, samples.gyro)
    means, ratio = {}, {}
    for unit, factor in GYRO_UNITS[quantity].items():
        record = Record(live * (factor / rate_divisor), dv, samples.rate_hz)
        means[unit] = compute_means(record, (0, len(dv)), STANDARD_GRAVITY)
        ratio[unit] = float(np.linalg.norm(means[unit].rate)) / EARTH_RATE
    # Gyros in a wrong unit do not follow the vertical of a base that sways.
    distance = {unit: abs(math.log(max(ratio[unit], 1e-12))) for unit in ratio}
    best = min(ratio, key=lambda unit: (means[unit].resolved_force_ratio < 0.99, distance[unit]))
    default_unit = _GYRO_UNIT_FOR.get(accel_unit, best)
    low, high = _MIN_LIVE_RATIO if has_dead else _NEAR_EARTH_RATE[0], _NEAR_EARTH_RATE[1]
    unit = gyro.unit if gyro.unit in ratio else best if low < ratio[best] < high else default_unit
    reason = f"the mean rate is {ratio[unit]:.3g} times Earth rate in {UNIT_NAMES[unit]}"
    names = ", ".join(repr(name) for name, is_dead in zip(gyro.names, dead, strict=True) if is_dead)
    if low < ratio[unit] < high:
        doubt = f"found without {names}, which never changes" if has_dead else ""
        return unit, means[unit], Note(reason, doubt)
    by_name = unit == gyro.unit
    if low < ratio[best] < high:
        doubt = f"the names state this unit; in {UNIT_NAMES[best]} it would be {ratio[best]:.3g}"
    elif by_name:
        doubt = "biases or motion hide Earth rate, so only the names indicate the unit"
    else:
        others = [
            f"{value:.3g} in {UNIT_NAMES[name]}" for name, value in ratio.items() if name != unit
        ]
        doubt = f"no unit gives Earth rate ({', '.join(others)}): this one matches that of the"
        doubt += " accelerometers; see the data sheet"
    return unit, means[unit], Note(reason, doubt)


def _find_axes_order(means: Means, head: Head, gyro: Triad, accel: Triad) -> tuple[str, Note]:
    """Return the order of axes, from names, comments and gravity."""
    up = means.force / float(np.linalg.norm(means.force))
    axis = int(np.argmax(np.abs(up)))
    pointing = f"{'xyz'[axis]} reads {up[axis]:+.2f} g"
    doubts = []
    if abs(up[axis]) < math.cos(30 * DEG):
        doubts.append(f"no axis is near the vertical ({pointing})")
    if shows_earth_rate(means) and vertical_rate(means) < -0.2 * EARTH_RATE:
        text = "the Earth turns clockwise about the specific force: the base is in the southern"
        doubts.append(f"{text} hemisphere, or gyros and accelerometers differ in sign")
    named_order = (
        gyro.directions or accel.directions or find_axes_order([*head.comments, *head.names])
    )
    if named_order:
        if float(to_body_axes(up[None], named_order)[0, 2]) < math.cos(60 * DEG):
            doubts.append(
                f"the names state {named_order!r}, but {pointing}: a sign or an axis is wrong"
            )
        return named_order, Note(f"from names or comments; {pointing}", "; ".join(doubts))
    order = _axes_order_with_up(axis, bool(up[axis] > 0))
    consequence = "the yaw turns by 90 or 180 deg with it"
    if order == "flu":
        doubts.append(f"x may point front ('flu') or y ('rfu'): {consequence}")
    elif order == "frd":
        text = "z points down, or the accelerometers have the opposite sign; x may not point front"
        doubts.append(f"{text}: {consequence}")
    else:
        doubts.append(f"it is unknown which axis points front: {consequence}")
    return order, Note(pointing, "; ".join(doubts))


def _axes_order_with_up(axis: int, positive: bool) -> str:
    """Return an order of axes with an axis of the record, or its opposite, up."""
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
        parse_axes_order(order)
    except ValueError:
        return False
    return True
