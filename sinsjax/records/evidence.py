"""Units and axes of sensors from their names, and from gravity, Earth rate and sways.

Evidence becomes a reason and missing evidence a doubt. What neither names nor physics settle is a
question with the evidence for each candidate.
"""

import math
from collections.abc import Sequence
from itertools import permutations
from typing import NamedTuple

import numpy as np

from sinsjax.records.anomalies import find_dead_channels
from sinsjax.records.column_names import Triad, find_named_order
from sinsjax.records.layout import (
    ACCEL_UNITS,
    GYRO_UNITS,
    INCREMENTS,
    RATES,
    FloatArray,
    Note,
    Record,
    increment_factor,
    parse_axes_order,
    quantity_of,
    to_body_axes,
)
from sinsjax.records.means import (
    EARTH_RATE,
    Means,
    compute_means,
    measure_gyro_scale,
    vertical_rate,
)
from sinsjax.records.plausibility import UNIT_NAMES
from sinsjax.records.turns import Turns
from sinsjax.units import DEG, DEG_PER_H, STANDARD_GRAVITY

_EXAMINED_S = 300.0
_NEAR_GRAVITY = 0.1  # relative: accelerometers are better
_REMOVED_GRAVITY = 0.05  # of the smallest gravity, 1 g in g
_REFUSED_FACTOR = 9.5  # times gravity, or its inverse, beyond which no study accepts a record
_NEAR_EARTH_RATE = 0.5, 2.0  # ratios: gyros that can find north are better
_TURNING_EARTH_RATE = 0.15, 1.05  # ratios of the horizontal part, up to 81 deg of latitude
_MAX_TURNING_ERROR = 0.1  # relative to Earth rate
_MAX_TURNING_TILT = 5e-3  # by accelerometer biases: in wrong units the vertical moves further
_SETTLED = 0.01  # relative to Earth rate: MEMS gyros in a wrong unit rarely come so near
_SETTLED_PARTNER = 0.05  # the same for the unit that goes with that of the accelerometers
_MAX_BIAS = 10 * DEG  # rad/s, of the worst MEMS gyros
_MEMS_ARW = 0.1, 0.2  # deg/sqrt(h): the best of those with such a bias; beside their usual partner
_MIN_LIVE_RATIO = 0.14  # ratio of two live gyros with a dead third, far from that in another unit
_MAX_SCALE_FACTOR = 2.0  # of a scale by sways: far below the factor between two units
_PARTNERS = {
    "m_per_s2": "rad_per_s",
    "g": "deg_per_s",
    "mg": "deg_per_s",
    "m_per_s": "rad",
    "g_s": "deg",
}
"""Usual units of the gyros beside accelerometers in a unit."""

_COUNTS_PER_G = "16384, 8192, 4096 or 2048 counts per g"
_COUNTS_PER_DEG_PER_S = "131, 65.5, 32.8 or 16.4 counts per deg/s"
_LETTERS = "xyz"
NAMED_AXES_REASON = "from names or comments"
"""Beginning of the reason of axes that names tell, so that gravity confirms the signs."""


class Samples(NamedTuple):
    """Complete samples of a file, in its units and axes.

    Attributes:
        gyro: (T, 3) gyro samples.
        accel: (T, 3) accelerometer samples.
        rate_hz: sample rate, Hz.
    """

    gyro: FloatArray
    accel: FloatArray
    rate_hz: float

    @property
    def mean_force(self) -> FloatArray:
        """Mean specific force in the unit of the file, (3,)."""
        return np.asarray(self.accel[: max(2, round(_EXAMINED_S * self.rate_hz))].mean(axis=0))


class AccelUnit(NamedTuple):
    """Unit of the accelerometers.

    Attributes:
        unit: the unit.
        scale: unit of one count; 1 if the file has physical units.
        note: reason and doubt.
        question: the question about the scale; "" if it is known.
    """

    unit: str
    scale: float
    note: Note
    question: str


def force_magnitude(accel: FloatArray, rate_hz: float) -> float:
    """Return the median magnitude of the mean specific force of each second, (T, 3)."""
    accel = accel[np.isfinite(accel).all(axis=1)]
    samples_per_second = max(1, min(round(rate_hz), len(accel)))
    rows = accel[: len(accel) // samples_per_second * samples_per_second]
    if not len(rows):
        return 0.0
    means = rows.reshape(-1, samples_per_second, 3).mean(axis=1)
    return float(np.median(np.linalg.norm(means, axis=1)))


def gravity_ratios(magnitude: float, rate_hz: float) -> dict[str, float]:
    """Return a magnitude of the specific force over gravity, by the unit that it might have."""
    to_rate = {INCREMENTS: rate_hz, RATES: 1.0}
    return {
        unit: magnitude * factor * to_rate[quantity] / STANDARD_GRAVITY
        for quantity, units in ACCEL_UNITS.items()
        for unit, factor in units.items()
    }


def is_gravity(accel: FloatArray, unit: str, rate_hz: float) -> bool:
    """Return whether samples (T, 3) have the magnitude of gravity in a unit, "" for any."""
    ratios = gravity_ratios(force_magnitude(accel, rate_hz), rate_hz)
    found = ratios.values() if not unit else [ratios[unit]]
    return any(abs(ratio - 1) < _NEAR_GRAVITY for ratio in found)


def lacks_gravity(accel: FloatArray, rate_hz: float) -> bool:
    """Return whether gravity seems to have been removed from samples (T, 3)."""
    return force_magnitude(accel, rate_hz) < _REMOVED_GRAVITY


def find_accel_unit(samples: Samples, gyro: Triad, accel: Triad) -> AccelUnit:
    """Return the unit of the accelerometers, from their names and gravity."""
    magnitude = force_magnitude(samples.accel, samples.rate_hz)
    ratios = gravity_ratios(magnitude, samples.rate_hz)
    named = accel.unit[0]
    expected = INCREMENTS if accel.are_increments else RATES
    if not named and not accel.are_increments and gyro.are_increments:
        expected = INCREMENTS
    plausible = [unit for unit, ratio in ratios.items() if abs(ratio - 1) < _NEAR_GRAVITY]
    plausible.sort(key=lambda unit: (unit != named, quantity_of(unit) != expected))
    is_refused = named and not 1 / _REFUSED_FACTOR < ratios[named] < _REFUSED_FACTOR
    if not plausible and (not named or is_refused):
        unit = named or ("g" if expected == RATES else "m_per_s")
        scale = 1 / ratios[unit]
        kind = "increments" if expected == INCREMENTS else "rates"
        question = (
            f"the mean of {', '.join(accel.names)} has a magnitude of {magnitude:.5g}, which is"
            f" gravity in no unit: are these counts? As {kind}, {scale:.4g}"
            f" {UNIT_NAMES[unit]} a count would be gravity; see the data sheet"
        )
        question += f" ({_COUNTS_PER_G} are usual)" if expected == RATES else ""
        return AccelUnit(unit, scale, Note("of one count, see accel_scale"), question)
    unit = plausible[0] if plausible else named
    reason = f"the mean has a magnitude of {magnitude:.5g}, {ratios[unit]:.4g} times gravity"
    doubt = ""
    if named and unit != named:
        doubt = f"the names state {UNIT_NAMES[named]}, {ratios[named]:.3g} times gravity"
    elif not plausible:
        doubt = "that is far from gravity, but the names state this unit"
    elif not named and quantity_of(unit) != expected:
        doubt = "only gravity indicates increments; counts may look alike"
    elif not named and (
        others := [u for u in plausible if abs(ratios[u] / ratios[unit] - 1) > 1e-3]
    ):
        names = ", ".join(f"{quantity_of(u)} in {UNIT_NAMES[u]}" for u in others)
        doubt = f"at {samples.rate_hz:.4g} Hz {names} would be gravity too"
    return AccelUnit(unit, 1.0, Note(f"{reason} in {UNIT_NAMES[unit]}", doubt), "")


class GyroUnit(NamedTuple):
    """Unit of the gyros.

    Attributes:
        unit: the unit, or a likely one.
        means: mean measurements in it.
        note: reason, doubt and question.
    """

    unit: str
    means: Means
    note: Note


def find_gyro_unit(samples: Samples, gyro: Triad, accel: Triad, accel_unit: str) -> GyroUnit:
    """Return the unit of the gyros, from their names, sways of the base and Earth rate.

    Args:
        samples: accelerometers in their unit.
        gyro: columns of the gyros.
        accel: columns of the accelerometers.
        accel_unit: their unit.
    """
    rate_hz = samples.rate_hz
    dead = find_dead_channels(samples.gyro.T)
    names = ", ".join(repr(n) for n, is_dead in zip(gyro.names, dead, strict=True) if is_dead)
    # Without a dead channel the others still show the order of Earth rate; with it, nothing.
    live = np.where(dead, 0.0, samples.gyro)[: max(2, round(_EXAMINED_S * rate_hz))]
    dv = samples.accel[: len(live)] * increment_factor(accel_unit, rate_hz)
    partner = _PARTNERS.get(accel_unit, "deg_per_s")
    if quantity_of(partner) == INCREMENTS and not gyro.are_increments and accel.are_increments:
        partner = "rad_per_s"  # as the names say, only the accelerometers hold increments
    quantities = [INCREMENTS, RATES]
    if gyro.are_increments or quantity_of(partner) == RATES:
        quantities = [INCREMENTS if gyro.are_increments else RATES]
    means, ratio = {}, {}
    units = [unit for quantity in quantities for unit in GYRO_UNITS[quantity]]
    for unit in dict.fromkeys([*units, *filter(None, [gyro.unit[0]])]):
        record = Record(live * increment_factor(unit, rate_hz), dv, rate_hz)
        means[unit] = compute_means(record, (0, len(dv)), STANDARD_GRAVITY)
        ratio[unit] = float(np.linalg.norm(means[unit].rate)) / EARTH_RATE
    named = gyro.unit[0]
    settled = _settled_by_turns(means, partner) or _settled_by_physics(
        live, dv, ratio, partner, has_dead=any(dead), rate_hz=rate_hz
    )
    unit = named or settled.unit
    reason = settled.reason if unit == settled.unit else ""
    if named in ("rad", "deg") and not gyro.are_increments and quantity_of(partner) == RATES:
        unit = f"{named}_per_s"  # as PX4 writes gyro_rad
        reason = f"{named} per second, as the accelerometers hold rates"
    doubt = f"found without {names}, which never changes" if names and unit == settled.unit else ""
    if named and settled.unit not in ("", unit) and abs(math.log(ratio[unit])) > math.log(2):
        doubt = f"the names state this unit, but {settled.reason}"
    if not unit:
        question = _unit_question(samples.gyro, means, ratio, partner, rate_hz)
        return GyroUnit(partner, means[partner], Note("", doubt, question))
    reason = reason or _earth_rate_text(ratio[unit], unit)
    return GyroUnit(unit, means[unit], Note(reason, doubt))


class _Settled(NamedTuple):
    """A unit that physics settle, "" for none, and how."""

    unit: str
    reason: str


def _settled_by_turns(means: dict[str, Means], partner: str) -> _Settled | None:
    """Return the unit in which a turning base senses the horizontal Earth rate; None for none."""
    first = [partner] if partner in means else []
    for unit in (*first, *means):
        if turns := find_turning_earth_rate(means[unit]):
            drift = turns.drift / DEG_PER_H
            text = (
                f"the base turns, and in the frame of its gyros the vertical drifts by {drift:.3g}"
            )
            return _Settled(unit, f"{text} deg/h in {UNIT_NAMES[unit]}, as Earth rate does")
    return None


def _settled_by_physics(
    gyro: FloatArray,
    dv: FloatArray,
    ratio: dict[str, float],
    partner: str,
    *,
    has_dead: bool,
    rate_hz: float,
) -> _Settled:
    """Return the unit in which the gyros follow the sways of the vertical, or sense Earth rate."""
    scale = abs(measure_gyro_scale(gyro, dv, rate_hz))
    if scale:
        by_unit = {unit: scale / increment_factor(unit, rate_hz) for unit in ratio}
        best = min(by_unit, key=lambda unit: abs(math.log(by_unit[unit])))
        if 1 / _MAX_SCALE_FACTOR < by_unit[best] < _MAX_SCALE_FACTOR:
            earth = _earth_rate_text(ratio[best], best)
            low, high = _NEAR_EARTH_RATE
            sways = f"in {UNIT_NAMES[best]} the gyros follow the sways of the vertical"
            return _Settled(best, earth if low < ratio[best] < high else sways)
    low = _MIN_LIVE_RATIO if has_dead else 1.0
    step = np.diff(gyro, axis=0)
    noise = float(np.sqrt((step**2).mean() / 2)) / math.sqrt(rate_hz)
    for unit, limit in [(partner, _SETTLED_PARTNER), *((unit, _SETTLED) for unit in ratio)]:
        arw = _MEMS_ARW[unit == partner] * DEG / 60
        is_coincidence = any(  # such a rate may be the bias of gyros with such noise
            2 * EARTH_RATE < ratio[other] * EARTH_RATE < _MAX_BIAS
            and noise * increment_factor(other, rate_hz) * rate_hz > arw
            for other in ratio
            if quantity_of(other) == quantity_of(unit)
        )
        if low - limit < ratio[unit] < 1 + limit and not is_coincidence:
            return _Settled(unit, _earth_rate_text(ratio[unit], unit))
    return _Settled("", "")


def _earth_rate_text(ratio: float, unit: str) -> str:
    return f"the mean rate is {ratio:.3g} times Earth rate in {UNIT_NAMES[unit]}"


def _unit_question(
    gyro: FloatArray, means: dict[str, Means], ratio: dict[str, float], partner: str, rate_hz: float
) -> str:
    """Return the question about the unit of the gyros, with the evidence for each candidate."""
    scatter = float(np.linalg.norm(gyro.std(axis=0)))
    lines = []
    for unit, of_earth in ratio.items():
        if quantity_of(unit) != quantity_of(partner):
            continue
        factor = increment_factor(unit, rate_hz) * rate_hz / DEG
        mean_deg_per_h = of_earth * EARTH_RATE / DEG_PER_H
        text = f'"{unit}": mean rate {mean_deg_per_h:.3g} deg/h, {of_earth:.3g} times Earth rate'
        if of_earth < 0.5:
            text += ": less than gyros on the Earth sense"
        else:
            bias = abs(of_earth - 1) * EARTH_RATE / DEG_PER_H
            text += (
                f", so a bias of at least {bias:.3g} deg/h; scatter {scatter * factor:.2g} deg/s"
            )
        text += "; goes with the unit of the accelerometers" if unit == partner else ""
        lines.append(text)
    return f"neither names nor Earth rate settle the unit of the gyros: {'. '.join(lines)}"


def ask_about_signs(samples: Samples) -> str:
    """Return the question about gyros that turn opposite to the vertical, "" if they do not."""
    if measure_gyro_scale(samples.gyro, samples.accel, samples.rate_hz) >= 0:
        return ""
    return (
        "the base sways, and the vertical turns opposite to what the gyros sense: their sign (-1?)"
        " or their axes differ from those of the accelerometers"
    )


def find_axes_order(
    mean_force: FloatArray, comments: Sequence[str], gyro: Triad, accel: Triad
) -> tuple[str, Note]:
    """Return the order of axes, from names, comments and gravity.

    Args:
        mean_force: (3,) mean specific force in the axes of the record, in any unit.
        comments: lines before the samples, and the names of the columns.
        gyro: columns of the gyros.
        accel: columns of the accelerometers.
    """
    up = mean_force / (float(np.linalg.norm(mean_force)) or 1.0)
    axis = int(np.argmax(np.abs(up)))
    pointing = f"{_LETTERS[axis]} reads {up[axis]:+.2f} g"
    named = gyro.directions or accel.directions or find_named_order(comments)
    if named:
        question = ""
        if float(to_body_axes(up[None], named)[0, 2]) < math.cos(60 * DEG):
            question = f"the names state {named!r}, but {pointing}: a sign or an axis is wrong"
        return named, Note(f"{NAMED_AXES_REASON}; {pointing}", "", question)
    order = _order_with_up(axis, is_positive=bool(up[axis] > 0))
    if abs(up[axis]) < math.cos(30 * DEG):
        question = f"no axis is near the vertical ({pointing}), and no name tells the axes"
        return order, Note(pointing, "", question)
    if order in ("flu", "frd"):
        return order, Note(f"{pointing}; x is taken for the front, so the heading is that of x")
    doubt = "it is unknown which axis points front: the heading turns by 90 or 180 deg with it"
    return order, Note(pointing, doubt)


def doubt_of_signs(means: Means) -> str:
    """Return the doubt about the signs of gyros and accelerometers, "" for none."""
    if shows_earth_rate(means) and vertical_rate(means) < -0.2 * EARTH_RATE:
        text = "the Earth turns clockwise about the specific force: the base is in the southern"
        return f"{text} hemisphere, or gyros and accelerometers differ in sign"
    return ""


def shows_earth_rate(means: Means) -> bool:
    """Return whether the mean rate is close to Earth rate, as with gyros that can find north."""
    low, high = _NEAR_EARTH_RATE
    return low < float(np.linalg.norm(means.rate)) / EARTH_RATE < high


def find_turning_earth_rate(means: Means) -> Turns | None:
    """Return the turns of a base that senses a horizontal Earth rate while it turns, or None."""
    turns, (low, high) = means.turns, _TURNING_EARTH_RATE
    if (
        turns is None
        or turns.drift_uncertainty > _MAX_TURNING_ERROR * EARTH_RATE
        or turns.accel_bias > _MAX_TURNING_TILT
    ):
        return None
    return turns if low < turns.drift / EARTH_RATE < high else None


def _order_with_up(axis: int, *, is_positive: bool) -> str:
    """Return an order of axes with an axis of the record, or its opposite, up."""
    return _orders_with_up(axis, is_positive=is_positive)[0]


def _orders_with_up(axis: int, *, is_positive: bool) -> list[str]:
    """Return the orders of axes with an axis of the record, or its opposite, up."""
    up = _LETTERS[axis] if is_positive else f"-{_LETTERS[axis]}"
    rest = [letter for letter in "zxy" if letter != _LETTERS[axis]]
    orders = (
        f"{sign}{right}{other}{front}{up}"
        for front, right in permutations(rest)
        for other in ("", "-")
        for sign in ("", "-")
    )
    usual = ["flu" if is_positive else "frd"] if axis == 2 else []
    return [*usual, *(order for order in orders if _is_right_handed(order))]


def _is_right_handed(order: str) -> bool:
    try:
        parse_axes_order(order)
    except ValueError:
        return False
    return True


def with_turns_in_order(gyro: Triad, order: str) -> Triad:
    """Return gyros named roll, pitch, yaw in the order of the record's x, y, z.

    Roll is about the front axis of the same triad, whichever letter that has.
    """
    if not gyro.turns:
        return gyro
    index, _ = parse_axes_order(order)
    place = {index[body]: gyro.turns.index(body) for body in range(3)}
    x, y, z = (gyro.names[place[axis]] for axis in range(3))
    return gyro._replace(names=(x, y, z), turns=())


def find_front_of_turns(
    turns: FloatArray, force: FloatArray, rate_hz: float, gyro: Triad, order: str
) -> tuple[str, Note]:
    """Return the order of axes by gyros named roll, pitch, yaw, which do not name the axes.

    Sways of the vertical show which axis of the accelerometers points front; at rest none does.

    Args:
        turns: (T, 3) samples of the gyros in the order of their names.
        force: (T, 3) specific force in the axes of the record, in any unit.
        rate_hz: sample rate, Hz.
        gyro: columns of the gyros.
        order: the order of axes by gravity.
    """
    axis = parse_axes_order(order)[0][2]
    is_positive = float(to_body_axes(force.mean(axis=0)[None], order)[0, 2]) > 0
    for candidate in _orders_with_up(axis, is_positive=is_positive):
        sorted_gyro = with_turns_in_order(gyro, candidate)
        places = [gyro.names.index(name) for name in sorted_gyro.names]
        if measure_gyro_scale(turns[:, places], force, rate_hz) > 0:
            front = parse_axes_order(candidate)[0][1]
            reason = f"roll follows the sways about {_LETTERS[front]}, which is the front"
            return candidate, Note(reason)
    question = (
        "roll, pitch and yaw do not tell which axis of the accelerometers points front, on which"
        " heading and level depend: 'flu', 'frd', 'rfu' or another order"
    )
    return order, Note("", "", question)


_OPPOSITES = {"r": "l", "l": "r", "f": "b", "b": "f", "u": "d", "d": "u"}


def share_directions(gyro: Triad, accel: Triad) -> Triad:
    """Return accelerometers in the directions of the gyros if the names give both."""
    if not (gyro.directions and accel.directions) or gyro.directions == accel.directions:
        return accel
    names, signs = [], []
    for direction in gyro.directions:
        sign = 1.0 if direction in accel.directions else -1.0
        place = accel.directions.index(direction if sign > 0 else _OPPOSITES[direction])
        names.append(accel.names[place])
        signs.append(sign * accel.signs[place])
    return accel._replace(
        names=(names[0], names[1], names[2]),
        signs=(signs[0], signs[1], signs[2]),
        directions=gyro.directions,
    )


def ask_for_gyro_scale(samples: Samples, unit: str) -> str:
    """Return the question about the unit of one count of the gyros."""
    mean = float(np.linalg.norm(samples.gyro.mean(axis=0)))
    scatter = float(np.linalg.norm(samples.gyro.std(axis=0)))
    earth = EARTH_RATE / (increment_factor(unit, samples.rate_hz) * samples.rate_hz)
    text = f"the mean rate is {mean:.4g} counts, the scatter {scatter:.3g}: see the data sheet"
    if quantity_of(unit) == RATES:
        return f"{text} ({_COUNTS_PER_DEG_PER_S} are usual)"
    count = f"{earth / mean:.4g} {UNIT_NAMES[unit]} a count would be Earth rate" if mean else ""
    return f"{text}; {count}"
