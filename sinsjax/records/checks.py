"""Checks of a record before its alignment: its samples, and its mean force and rate at rest.

Apart from sensor biases, the mean specific force of a base that stays is gravity, and the vertical
drifts by the horizontal Earth rate in the frame that its gyros carry, even if the base sways or is
turned about the vertical. Gyros that do not show that rate cannot find north, whatever the reason.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sinsjax.messages import format_count
from sinsjax.records.layout import (
    ACCEL_UNITS,
    GYRO_UNITS,
    Anomaly,
    Record,
    RecordLayout,
    find_spans,
    increment_factor,
    message_key,
)
from sinsjax.records.motion import EARTH_RATE, Means, compute_means, white_noise
from sinsjax.units import DEG, DEG_PER_H, DEG_PER_SQRT_H, STANDARD_GRAVITY, micro_g

GYRO_BIAS = 10.0 * DEG_PER_H
"""Largest gyro bias that raises no doubt, rad/s."""

LOW_NOISE_GYRO_BIAS = 4.5 * DEG_PER_H
"""The same for gyros with little noise at rest, 0.3 of Earth rate: their scale is rather wrong."""

ACCEL_BIAS_UG = 5000.0
"""Largest accelerometer bias that raises no doubt, ug."""

_MAX_G, _MAX_DEG_PER_S = 20.0, 1000.0  # swaying bases and cars stay far below
_MAX_REPORTED = 6  # anomalies that may be harmless, in messages
_REMOVED_SHARE = 0.01  # of Earth rate, in every gyro: biases do not cancel it so well in all three
_STUCK_S = 1.0  # of all six channels: a single coarse one may repeat for long
_LOW_NOISE = 0.1 * DEG_PER_SQRT_H  # of gyros that are no MEMS
_NOISE_SAMPLES = 2**17  # enough for a median
_BIAS_PER_ARW = 10.0  # 1/sqrt(h), of a usual gyro, whose bias hides a wrong latitude
_CERTAIN_FACTOR = 9.5  # of a rejected mean: below 10, to detect g taken for m/s^2 (9.8)
_MAX_PARKED_TURN = 1.0 * DEG
_SHORT_S = 20.0  # contains few sways
_MIN_RESOLVED = 0.99  # of gravity, when the gyros follow the sways
_MAX_TILT = 45 * DEG
_MIRRORED = 0.3  # relative difference from the opposite of the vertical Earth rate
_MIN_TURN = 20 * DEG  # beyond the turn of the Earth and of a bias
_BIAS_SHARE = 0.3  # of the largest bias, which may change between turns


class StationaryValues(NamedTuple):
    """Expected measurements of a stationary record, SI units, and the largest plausible biases."""

    earth_rate: float
    latitude: float
    gravity: float
    gyro_bias: float
    accel_bias: float
    low_noise_gyro_bias: float = math.inf  # at rest, if the gyros have little noise

    @classmethod
    def with_biases(
        cls,
        *,
        gyro_bias_deg_per_h: float | None = None,
        accel_bias_ug: float | None = None,
        **place: float,
    ) -> "StationaryValues":
        """Return the values of a place with the biases that a user accepts, or the usual ones."""
        gyro, low_noise = GYRO_BIAS, LOW_NOISE_GYRO_BIAS
        if gyro_bias_deg_per_h is not None:
            gyro, low_noise = gyro_bias_deg_per_h * DEG_PER_H, math.inf
        accel = (ACCEL_BIAS_UG if accel_bias_ug is None else accel_bias_ug) * micro_g()
        return cls(**place, gyro_bias=gyro, accel_bias=accel, low_noise_gyro_bias=low_noise)

    @property
    def horizontal_rate(self) -> float:
        """Horizontal Earth rate, rad/s."""
        return self.earth_rate * math.cos(self.latitude)


class Finding(NamedTuple):
    """Something implausible, or certainly wrong, without the file."""

    is_certain: bool
    text: str
    hides_north: bool = False  # pitch and roll can be found, but no heading


# Samples


def find_anomalies(
    names: Sequence[str],
    columns: Sequence[NDArray[Any]],
    factors: Sequence[float],
    rate_hz: float,
    row_number: Callable[[int], int],
) -> tuple[Anomaly, ...]:
    """Return samples out of range, removed Earth rate, and channels that are stuck.

    They are found while a file is read, since only then its rows are known. Columns (T,) are those
    of three gyros, then of three accelerometers; factors convert them to rad/s or m/s^2.
    """
    count, found = len(columns[0]), list[Anomaly]()

    def rows(begin: int, end: int) -> str:
        first, last = row_number(begin), row_number(end - 1)
        return f"row {first}" if first == last else f"rows {first} to {last}"

    for channel, (name, values, factor) in enumerate(zip(names, columns, factors, strict=True)):
        unit, word, limit = (DEG, "deg/s", _MAX_DEG_PER_S)
        if channel >= 3:
            unit, word, limit = (STANDARD_GRAVITY, "g", _MAX_G)
        size, largest = np.abs(values), limit * unit / abs(factor)
        is_large = size > largest
        if not is_large.any() or np.nanmedian(size) > 0.1 * largest:
            continue  # if most are large, the unit is wrong, which the mean reveals
        for begin, end in find_spans(is_large):
            value = float(values[begin])
            text = (
                f"{rows(begin, end)}: column {name!r}: {value:.6g} is"
                f" {value * factor / unit:.4g} {word}, and no base at rest has more than"
                f" {limit:g} {word}: leave such cells empty, as missing samples"
            )
            found.append(Anomaly(begin, end, True, text))
    constant = [bool(v[0] == v[-1] and (v == v[0]).all()) for v in columns]
    if not any(constant[:3]):
        means = [abs(float(np.nanmean(v)) * f) for v, f in zip(columns, factors, strict=True)]
        if max(means[:3]) < _REMOVED_SHARE * EARTH_RATE:
            # Only the mean over the whole log shows it; that of a part depends on its sways.
            text = "the mean of each gyro over the whole log is below 1% of Earth rate: has"
            found.append(Anomaly(0, count, False, f"{text} Earth rate been removed?", True))
    if count < (stuck := max(2, round(_STUCK_S * rate_hz))):
        return tuple(found)
    if all(constant):
        text = "no channel changes in any row: is this a log of sensors?"
        return (*found, Anomaly(0, count, False, text))
    for name, values, is_constant in zip(names, columns, constant, strict=True):
        if is_constant:
            text = f"column {name!r} is {float(values[0]):.6g} in every row: is that sensor dead?"
            found.append(Anomaly(0, count, False, text))
    unchanged = np.logical_and.reduce([values[1:] == values[:-1] for values in columns])
    for begin, last in find_spans(unchanged):
        if last + 1 - begin >= stuck:
            text = (
                f"{rows(begin, last + 1)}: all six channels are stuck for"
                f" {(last + 1 - begin) / rate_hz:.3g} s: did the sensor or the logger stop?"
            )
            found.append(Anomaly(begin, last + 1, False, text))
    return tuple(found)


def report_anomalies(
    anomalies: Sequence[Anomaly], spans: Sequence[tuple[int, int]]
) -> Iterator[Anomaly]:
    """Yield the anomalies within some spans of samples (from, to before), for messages.

    Certain errors are reduced to the first one and the number of others.
    """
    relevant = [
        anomaly
        for anomaly in anomalies
        if any(anomaly.begin < end and anomaly.end > begin for begin, end in spans)
    ]
    if certain := sorted(anomaly for anomaly in relevant if anomaly.is_certain):
        count = format_count(len(certain) - 1, "more such place")
        more = f"; {count}" if len(certain) > 1 else ""
        yield certain[0]._replace(text=certain[0].text + more)
    yield from [anomaly for anomaly in relevant if not anomaly.is_certain][:_MAX_REPORTED]


# Means


def check_stationary(
    record: Record, span: tuple[int, int], layout: RecordLayout, expected: StationaryValues
) -> list[Finding]:
    """Return what is implausible for a base that stays in a span (from, to before) of a record.

    The span is at least a second long and lacks no sample. The layout that the record was read with
    suggests causes.
    """
    means = compute_means(record, span, expected.gravity)
    noise = white_noise(record.dtheta[span[0] : span[1]][:_NOISE_SAMPLES], record.rate_hz)
    return [
        *_check_force(means, layout, record.rate_hz, expected),
        *_check_gyros(means, layout, record.rate_hz, expected, noise),
    ]


def _check_force(
    means: Means, layout: RecordLayout, rate_hz: float, expected: StationaryValues
) -> Iterator[Finding]:
    ratio = means.force_magnitude / expected.gravity
    if abs(ratio - 1) * expected.gravity > expected.accel_bias:
        is_certain = not 1 / _CERTAIN_FACTOR < ratio < _CERTAIN_FACTOR
        text = f"the mean specific force is {means.force_magnitude:.5g} m/s^2, {ratio:.3g} times"
        unit = _suggest_unit(ACCEL_UNITS, layout.accel_unit, layout, rate_hz, 1 / ratio, 0.1)
        bias = abs(ratio - 1) * expected.gravity / micro_g()
        cause = f"an accelerometer bias of {bias:.2g} ug or more would explain it"
        if unit or is_certain:
            cause = unit or "has gravity been removed, or is the accelerometer scale wrong?"
        yield Finding(is_certain, f"{text} gravity: {cause}")
    length = float(np.linalg.norm(means.force)) or 1.0
    tilt = math.acos(max(-1.0, min(1.0, means.force[2] / length)))
    key = message_key(layout, "axes_order")
    if tilt > 90 * DEG:
        hint = " ('yx-z' for front-right-down)" if layout.axes_order in ("xyz", "rfu") else ""
        text = (
            f"the specific force points down, {tilt / DEG:.3g} deg from the up axis: are"
            f" {key}{hint} and the sign of the accelerometers right?"
        )
        yield Finding(True, text)
    elif tilt > _MAX_TILT:
        yield Finding(False, f"the up axis is tilted by {tilt / DEG:.3g} deg: is {key} right?")


def finds_north_by_turns(means: Means, expected: StationaryValues) -> bool:
    """Return whether the gyros of a turning base sense the horizontal Earth rate."""
    turns, horizontal = means.turns, expected.horizontal_rate
    if turns is None or turns.accel_bias * expected.gravity > expected.accel_bias:
        return False
    allowed = _BIAS_SHARE * expected.gyro_bias + turns.drift_uncertainty
    is_measured = turns.drift_uncertainty <= horizontal / 5
    return is_measured and abs(turns.drift - horizontal) <= allowed


def _check_gyros(
    means: Means, layout: RecordLayout, rate_hz: float, expected: StationaryValues, noise: float
) -> list[Finding]:
    """Return the finding about the gyros, if any.

    Earth rate in the body axes shows nothing if the base is turned, which its turns make up for.
    """
    turns, parked_turn = means.turns, (expected.earth_rate + expected.gyro_bias) * means.length_s
    hidden = _describe_hidden_north(means, layout, rate_hz, expected)
    findings = [] if hidden else [*_check_rate(means, expected, noise)]
    if turns is not None and (hidden or turns.angle > _MIN_TURN + parked_turn):
        turned = f"by its gyros the base turns by {turns.angle / DEG:.3g} deg, and"
        if finds_north_by_turns(means, expected):
            if turns.gyro_bias <= expected.gyro_bias:
                return []
            bias = f"a gyro bias of {turns.gyro_bias / DEG_PER_H:.3g} deg/h or more"
            text = f"{turned} {bias} would explain the record: are the signs and axes of the gyros"
            return [Finding(False, f"{text} right?")]
        is_measured = turns.drift_uncertainty <= expected.horizontal_rate / 5
        is_wrong = is_measured or turns.accel_bias * expected.gravity > expected.accel_bias
        if not hidden and is_wrong:
            hidden = (
                f"{turned} in the frame of its gyros the vertical drifts by"
                f" {turns.drift / DEG_PER_H:.3g} deg/h, and not by the horizontal Earth rate of"
                f" {expected.horizontal_rate / DEG_PER_H:.3g}: are unit, axes and signs right?"
            )
        elif not hidden:
            return [Finding(False, f"{turned} whether its gyros find north cannot be determined")]
    if not hidden:
        return findings
    if means.tilt_change > _MAX_PARKED_TURN:
        angle = means.tilt_change / DEG
        return [Finding(True, f"the vertical moves by {angle:.3g} deg in the body, and {hidden}")]
    return [Finding(False, f"{hidden}: no heading can be found", hides_north=True)]


def _describe_hidden_north(
    means: Means, layout: RecordLayout, rate_hz: float, expected: StationaryValues
) -> str:
    """Return why the gyros show no Earth rate; "" if they may."""
    earth, horizontal = expected.earth_rate, expected.horizontal_rate
    magnitude, unit = max(means.magnitude, 1e-300), ""
    bias, vertical = abs(magnitude - earth), earth * math.sin(expected.latitude)
    if abs(means.vertical_rate / magnitude - math.sin(expected.latitude)) < 0.2:
        ratio = earth / magnitude
        unit = _suggest_unit(GYRO_UNITS, layout.gyro_unit, layout, rate_hz, ratio, 0.5)
    mirrored = abs(means.vertical_rate + vertical) + means.vertical_uncertainty
    turned_square = ((earth + expected.gyro_bias) * means.length_s) ** 2
    if abs(means.vertical_drift - horizontal) - means.drift_uncertainty >= horizontal:
        cause = f"a gyro bias of {bias / DEG_PER_H:.3g} deg/h or more hides Earth rate"
    elif (
        means.vertical_drift + means.drift_uncertainty < horizontal / 2
        or magnitude + means.vertical_uncertainty < earth / _CERTAIN_FACTOR
    ):
        cause = "has Earth rate been removed, or are the gyros' unit, axes or signs wrong?"
    elif means.resolved_ratio < _MIN_RESOLVED - turned_square / 8:
        cause = "the gyros do not follow the vertical: are their unit, axes and signs right?"
    elif mirrored < _MIRRORED * abs(vertical):
        cause = "its vertical part has the wrong sign: are the gyros' axes and the latitude right?"
    else:
        return ""
    text = f"the mean rate is {magnitude / DEG_PER_H:.3g} deg/h, {magnitude / earth:.3g} times"
    return f"{text} Earth rate: {unit + ' or ' if unit else ''}{cause}"


def _check_rate(means: Means, expected: StationaryValues, noise: float) -> Iterator[Finding]:
    """Compare the mean rate of gyros that may find north, and its vertical part, with Earth's."""
    earth, uncertainty = expected.earth_rate, means.vertical_uncertainty + means.drift_uncertainty
    plausible = earth + expected.gyro_bias
    if (
        means.vertical_drift + means.drift_uncertainty > plausible
        and means.drift_uncertainty > expected.horizontal_rate / 2
    ):
        text = (
            "whether these gyros find north cannot be determined: in their frame the vertical"
            f" drifts by {means.vertical_drift / DEG_PER_H:.3g} deg/h, give or take"
            f" {means.drift_uncertainty / DEG_PER_H:.3g}"
        )
        yield Finding(False, text)
        return
    if means.turn_angle > _MAX_PARKED_TURN:
        text = (
            f"the base turns by about {means.turn_angle / DEG:.3g} deg within the span used: the"
            " attitude at its end differs from that at its start"
        )
        yield Finding(False, text)
        return
    if means.length_s < _SHORT_S:
        return
    magnitude, up = means.magnitude, means.vertical_rate
    is_quiet = noise < _LOW_NOISE and uncertainty < 0.1 * earth
    largest = min(expected.gyro_bias, expected.low_noise_gyro_bias if is_quiet else math.inf)
    bias, up_bias = abs(magnitude - earth), abs(up - earth * math.sin(expected.latitude))
    accepted = math.ceil(10 * max(bias, up_bias) / DEG_PER_H) / 10
    key = f"[record] gyro_bias_deg_per_h = {accepted:g} if so"
    if bias > largest + uncertainty:
        text = (
            f"the mean rate is {magnitude / DEG_PER_H:.3g} deg/h, {magnitude / earth:.3g} times"
            " Earth rate: are the gyros' unit and scale right, or is there a gyro bias of"
            f" {bias / DEG_PER_H:.3g} deg/h or more ({key})? The heading cannot be trusted, nor"
            " pitch and roll of 'inertial' or 'optimisation' ('level' finds these)"
        )
        yield Finding(False, text)
    elif up_bias > largest + uncertainty:
        vertical = earth * math.sin(expected.latitude) / DEG_PER_H
        text = (
            f"the rate about the vertical is {up / DEG_PER_H:.3g} deg/h, but Earth rate there is"
            f" {vertical:.3g}: do gyros and accelerometers share their axes, and is the latitude"
            f" right, or is there a gyro bias of {up_bias / DEG_PER_H:.3g} deg/h or more ({key})?"
        )
        yield Finding(False, text)
    elif is_quiet:
        # A bias that leaves the magnitude right by chance is as large as those of such gyros are.
        sigma = math.hypot(uncertainty / 3, bias, _BIAS_PER_ARW * noise / 60) / earth
        if abs(means.latitude - expected.latitude) > 5 * sigma:
            text = (
                f"gyros and accelerometers give a latitude of {means.latitude / DEG:.4g} deg, give"
                f" or take {sigma / DEG:.2g}, and not {expected.latitude / DEG:.6g}: is [earth]"
                " latitude_deg right?"
            )
            yield Finding(False, text)


def _suggest_unit(
    units: dict[str, dict[str, float]],
    current: str,
    layout: RecordLayout,
    rate_hz: float,
    factor: float,
    tolerance: float,
) -> str:
    """Return the question whether another unit explains a mean; PSINS text has fixed units."""
    if layout.format == "psins":
        return ""
    for unit in (unit for known in units.values() for unit in known if unit != current):
        ratio = increment_factor(unit, rate_hz) / increment_factor(current, rate_hz)
        if abs(ratio / factor - 1) < tolerance:
            per_sample = "" if "_per_" in unit or unit in ("g", "mg", "ug") else " per sample"
            spelling = unit.replace("_per_", "/").replace("s2", "s^2")
            return f"are these {spelling}{per_sample}?"
    return ""
