"""Checks of a record before its alignment: its samples, and its mean force and rate at rest.

Apart from sensor biases, the mean specific force of a base that stays is gravity, and the vertical
drifts by the horizontal Earth rate in the frame that its gyros carry, even if the base sways. Gyros
that do not show that rate cannot find north, whatever the reason.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import numpy as np

from sinsjax.records.layout import (
    ACCEL_UNITS,
    Finding,
    FloatArray,
    Record,
    RecordLayout,
    find_spans,
    rate_factor,
)
from sinsjax.records.motion import Motion, measure_motion, white_noise
from sinsjax.units import DEG, DEG_PER_H, DEG_PER_SQRT_H, STANDARD_GRAVITY, micro_g

GYRO_BIAS, ACCEL_BIAS_UG = 10.0 * DEG_PER_H, 5000.0
"""Largest biases that raise no doubt, rad/s and ug."""

LOW_NOISE_GYRO_BIAS = 4.5 * DEG_PER_H
"""The same for gyros with little noise at rest, 0.3 of Earth rate: their scale is rather wrong."""

_NEAR_GRAVITY = 0.018  # relative: cm/s^2 would be mg with 0.0193
_MAX_G, _MAX_DEG_PER_S = 20.0, 1000.0  # swaying bases and cars stay far below
_MAX_REPORTED = 6  # anomalies, in messages
_STUCK_S = 1.0  # of all six channels: a single coarse one may repeat for long
_LOW_NOISE = 0.1 * DEG_PER_SQRT_H  # of gyros that are no MEMS
_BIAS_PER_ARW = 10.0  # 1/sqrt(h), of a usual gyro, whose bias hides a wrong latitude
_CERTAIN_FACTOR = 9.5  # of a rejected mean: below 10, to detect g taken for m/s^2 (9.8)
_MAX_PARKED_TURN = 1.0 * DEG
_SHORT_S = 20.0  # contains few sways
_MIN_RESOLVED = 0.99  # of gravity, when the gyros follow the sways
_MAX_TILT = 45 * DEG
_MIRRORED = 0.3  # relative difference from the opposite of the vertical Earth rate


class StationaryValues(NamedTuple):
    """Expected measurements of a stationary record, SI units, and the largest plausible biases."""

    earth_rate: float
    latitude: float
    gravity: float
    gyro_bias_deg_per_h: float | None = None  # None for the usual ones
    accel_bias_ug: float | None = None

    @property
    def gyro_bias(self) -> float:
        """Largest gyro bias, rad/s."""
        given = self.gyro_bias_deg_per_h
        return GYRO_BIAS if given is None else given * DEG_PER_H

    @property
    def accel_bias(self) -> float:
        """Largest accelerometer bias, m/s^2."""
        return (ACCEL_BIAS_UG if self.accel_bias_ug is None else self.accel_bias_ug) * micro_g()

    @property
    def horizontal_rate(self) -> float:
        """Horizontal Earth rate, rad/s."""
        return self.earth_rate * math.cos(self.latitude)


# Samples


def find_anomalies(
    names: Sequence[str],
    values: FloatArray,
    factors: FloatArray,
    rate_hz: float,
    row_number: Callable[[int], int],
) -> tuple[Finding, ...]:
    """Return samples out of range, and channels that are stuck.

    Values (T, 6) are those of gyros, then of accelerometers; factors (6,) make them rad/s or m/s^2.
    """
    count, found = len(values), list[Finding]()
    limits = [(DEG, "deg/s", _MAX_DEG_PER_S)] * 3 + [(STANDARD_GRAVITY, "g", _MAX_G)] * 3
    for name, column, factor, limit in zip(names, values.T, factors, limits, strict=True):
        unit, word, largest = limit
        sizes = np.abs(column) * (abs(factor) / unit)
        if np.nanmedian(sizes) > 0.1 * largest:
            continue  # if most are large, the unit is wrong, which the mean reveals
        for begin, end in find_spans(sizes > largest):
            rows = f"rows {row_number(begin)} to {row_number(end - 1)}: column {name!r}"
            size = f"{column[begin]:.6g} is {column[begin] * factor / unit:.4g} {word}"
            text = f"{rows}: {size}, and no base at rest has more than {largest:g} {word}"
            hint = "leave such cells empty, as missing samples"
            found.append(Finding(True, f"{text}: {hint}", begin=begin, end=end))
    if count < (stuck := max(2, round(_STUCK_S * rate_hz))):
        return tuple(found)
    constant = (values == values[0]).all(axis=0)
    if dead := ", ".join(repr(names[channel]) for channel in np.flatnonzero(constant).tolist()):
        text = f"constant in every row: column {dead}: is this sensor dead?"
        found.append(Finding(False, text, begin=0, end=count))
    for begin, last in find_spans((values[1:] == values[:-1]).all(axis=1)):
        if last + 1 - begin >= stuck and not constant.all():
            rows = f"rows {row_number(begin)} to {row_number(last)}"
            text = f"all six channels are stuck for {(last + 1 - begin) / rate_hz:.3g} s"
            hint = "did the sensor or the logger stop?"
            found.append(Finding(False, f"{rows}: {text}: {hint}", begin=begin, end=last + 1))
    return tuple(found)


def report_anomalies(
    anomalies: Sequence[Finding], spans: Sequence[tuple[int, int]]
) -> list[Finding]:
    """Return the first anomalies in spans of samples (from, to before), certain ones first."""
    relevant = [
        a for a in anomalies if any(a.begin < end and a.end > begin for begin, end in spans)
    ]
    return sorted(relevant, key=lambda anomaly: not anomaly.is_certain)[:_MAX_REPORTED]


# Means


def check_stationary(
    record: Record, span: tuple[int, int], layout: RecordLayout, expected: StationaryValues
) -> list[Finding]:
    """Return what is implausible for a base that stays in a span (from, to before) of a record.

    The span is at least a second long and lacks no sample. The layout that the record was read with
    suggests causes.
    """
    motion = measure_motion(record, span, expected.gravity)
    noise = white_noise(record.dtheta[slice(*span)], record.rate_hz)
    return [
        *_check_force(motion, layout, record.rate_hz, expected),
        *_check_gyros(motion, expected, noise),
    ]


def gravity_units(magnitude: float, rate_hz: float = math.nan) -> list[str]:
    """Return the units in which the magnitude of a mean specific force is that of gravity."""
    return [
        unit for units in ACCEL_UNITS.values() for unit in units
        if abs(magnitude * rate_factor(unit, rate_hz) / STANDARD_GRAVITY - 1) < _NEAR_GRAVITY
    ]  # fmt: skip


def _check_force(
    motion: Motion, layout: RecordLayout, rate_hz: float, expected: StationaryValues
) -> Iterator[Finding]:
    ratio = motion.force_magnitude / expected.gravity
    if abs(ratio - 1) * expected.gravity > expected.accel_bias:
        is_certain = not 1 / _CERTAIN_FACTOR < ratio < _CERTAIN_FACTOR
        bias = abs(ratio - 1) * expected.gravity / micro_g()
        cause = f"an accelerometer bias of {bias:.2g} ug or more would explain it"
        if is_certain:
            cause = "has gravity been removed, or is the accelerometer scale wrong?"
        magnitude = motion.force_magnitude / rate_factor(layout.accel_unit, rate_hz)
        units = [] if layout.format == "psins" else gravity_units(magnitude, rate_hz)
        if units and layout.accel_unit not in units:
            cause = f"are these {units[0]}?"
        text = f"the mean specific force is {motion.force_magnitude:.5g} m/s^2, {ratio:.3g} times"
        yield Finding(is_certain, f"{text} gravity: {cause}")
    length = float(np.linalg.norm(motion.force)) or 1.0
    tilt = math.acos(max(-1.0, min(1.0, motion.force[2] / length)))
    if tilt > _MAX_TILT:
        points = "points down" if tilt > 90 * DEG else "is tilted"
        text = f"the specific force {points}, {tilt / DEG:.3g} deg from the up axis: are the axes"
        hint = f"{text} ('yx-z' for front-right-down) and signs of the accelerometers right?"
        yield Finding(tilt > 90 * DEG, hint)


def _check_gyros(motion: Motion, expected: StationaryValues, noise: float) -> Iterator[Finding]:
    """Compare the mean rate with Earth rate, unless the base is turned."""
    if motion.is_turned:
        text = f"by its gyros the base turns by {motion.turn / DEG:.3g} deg"
        yield Finding(False, f"{text}, so whether they find north is not checked")
    elif not (hidden := _describe_hidden_north(motion, expected)):
        yield from _check_rate(motion, expected, noise)
    elif motion.tilt_change > _MAX_PARKED_TURN:
        angle = motion.tilt_change / DEG
        yield Finding(True, f"the vertical moves by {angle:.3g} deg in the body, and {hidden}")
    else:
        yield Finding(False, f"{hidden}: no heading can be found", hides_north=True)


def _describe_hidden_north(motion: Motion, expected: StationaryValues) -> str:
    """Return why the gyros show no Earth rate; "" if they may."""
    earth, horizontal = expected.earth_rate, expected.horizontal_rate
    magnitude, vertical = max(motion.magnitude, 1e-300), earth * math.sin(expected.latitude)
    opposite, uncertainty = motion.vertical_rate + vertical, motion.vertical_uncertainty
    turned_square = ((earth + expected.gyro_bias) * motion.length_s) ** 2
    if abs(motion.drift - horizontal) - motion.drift_uncertainty >= horizontal:
        bias = abs(magnitude - earth) / DEG_PER_H
        cause = f"a gyro bias of {bias:.3g} deg/h or more, or a wrong unit, hides Earth rate"
    elif (
        motion.drift + motion.drift_uncertainty < horizontal / 2
        or magnitude + uncertainty < earth / _CERTAIN_FACTOR
    ):
        cause = "has Earth rate been removed, or are the gyros' unit, axes or signs wrong?"
    elif motion.resolved_ratio < _MIN_RESOLVED - turned_square / 8:
        cause = "the gyros do not follow the vertical: are their unit, axes and signs right?"
    elif abs(opposite) + uncertainty < _MIRRORED * abs(vertical):
        cause = "its vertical part has the wrong sign: are the gyros' axes and the latitude right?"
    else:
        return ""
    ratio = f"{magnitude / DEG_PER_H:.3g} deg/h, {magnitude / earth:.3g} times Earth rate"
    return f"the mean rate is {ratio}: {cause}"


def _check_rate(motion: Motion, expected: StationaryValues, noise: float) -> Iterator[Finding]:
    """Compare the mean rate of gyros that may find north, and its vertical part, with Earth's."""
    earth, uncertainty = expected.earth_rate, motion.vertical_uncertainty + motion.drift_uncertainty
    largest_drift = motion.drift + motion.drift_uncertainty
    if (
        motion.drift_uncertainty > expected.horizontal_rate / 2
        and largest_drift > earth + expected.gyro_bias
    ):
        drift = f"up to {largest_drift / DEG_PER_H:.3g} deg/h"
        text = f"in the frame of its gyros the vertical drifts by {drift}"
        yield Finding(False, f"{text}: whether they find north cannot be determined")
        return
    if (turn := motion.uneven_turn - motion.sway) > _MAX_PARKED_TURN:
        text = f"the base turns by about {turn / DEG:.3g} deg within the span used"
        yield Finding(False, f"{text}: the attitude at its end differs from that at its start")
        return
    if motion.length_s < _SHORT_S:
        return
    is_quiet = noise < _LOW_NOISE and uncertainty < 0.1 * earth
    is_usual = expected.gyro_bias_deg_per_h is None
    largest = LOW_NOISE_GYRO_BIAS if is_quiet and is_usual else expected.gyro_bias
    up_bias = motion.vertical_rate - earth * math.sin(expected.latitude)
    bias = math.hypot(up_bias, motion.drift - expected.horizontal_rate)
    # A bias that leaves the magnitude right by chance is as large as those of such gyros are.
    off_earth = abs(motion.magnitude - earth)
    sigma = math.hypot(uncertainty / 3, off_earth, _BIAS_PER_ARW * noise / 60) / earth
    is_elsewhere = is_quiet and abs(motion.latitude - expected.latitude) > 5 * sigma
    if bias > largest + uncertainty or is_elsewhere:
        accepted = math.ceil(10 * bias / DEG_PER_H) / 10
        text = (
            f"the mean rate is {motion.magnitude / DEG_PER_H:.3g} deg/h,"
            f" {motion.magnitude / earth:.3g} times Earth rate, of a latitude of"
            f" {motion.latitude / DEG:.4g} deg, give or take {sigma / DEG:.2g}, and not"
            f" {expected.latitude / DEG:.6g}: are latitude_deg and the gyros' unit and scale right,"
            f" or is there a gyro bias of {bias / DEG_PER_H:.3g} deg/h or more ([record]"
            f" gyro_bias_deg_per_h = {accepted:g} if so)? Only the method 'level' is not affected"
        )
        yield Finding(False, text)
