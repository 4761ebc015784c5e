"""Plausibility checks of a record before its alignment.

Apart from sensor biases, the mean specific force of a stationary base is gravity and its mean rate
is Earth rate, even if it sways. Wrong units, axes or signs, or a turning vehicle, affect one of the
two. A base that is turned about the vertical shows the horizontal Earth rate alone, as the drift of
the vertical in the frame carried by the gyros.
"""

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from sinsjax.records.layout import (
    ACCEL_UNITS,
    GYRO_UNITS,
    Record,
    RecordLayout,
    increment_factor,
    message_key,
)
from sinsjax.records.means import (
    MAX_PARKED_TURN,
    Means,
    compute_means,
    merge_samples,
    vertical_rate,
    white_noise,
)
from sinsjax.records.turns import Turns, measure_turns
from sinsjax.units import DEG, DEG_PER_H, DEG_PER_SQRT_H, micro_g

GYRO_BIAS = 10.0 * DEG_PER_H
"""Largest gyro bias that raises no doubt, rad/s."""

LOW_NOISE_GYRO_BIAS = 4.5 * DEG_PER_H
"""The same for gyros with little noise at rest, 0.3 of Earth rate: their scale is rather wrong."""

ACCEL_BIAS_UG = 5000.0
"""Largest accelerometer bias that raises no doubt, ug."""

_LOW_NOISE = 0.1 * DEG_PER_SQRT_H  # of gyros that are no MEMS
_NOISE_SAMPLES = 2**17  # enough for a median

_CERTAIN_FACTOR = 9.5
"""Factor by which a rejected mean is wrong: below 10, to detect g taken for m/s^2 (9.8)."""

_MAX_SETTLING_ANGLE = 0.3 * DEG  # of an occupied vehicle on its suspension, in a third of a span
_SHORT_S = 20.0  # contains few sways
_LONG_S = 180.0  # a third of it contains several sways of most bases
_MIN_RESOLVED_RATIO = 0.99  # of gravity, when the gyros follow the sways
_MAX_TILT = 45 * DEG
_MAX_SWAY = 5 * DEG  # of a base that sways on the spot, and is not turned
_TURN_RATE_HZ = 25.0  # resolves turns, and saves the time of many samples
_BIAS_SHARE = 0.3  # of the largest bias, which may change between turns
_SAME_DIRECTION = 0.02  # share of a rate that is vertical
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
    """Expected measurements of a stationary record, SI units.

    Attributes:
        earth_rate: rad/s.
        latitude: rad.
        gravity: m/s^2.
        gyro_bias: largest plausible gyro bias, rad/s.
        accel_bias: largest plausible accelerometer bias, m/s^2.
        low_noise_gyro_bias: largest plausible gyro bias at rest if the gyros have little noise.
    """

    earth_rate: float
    latitude: float
    gravity: float
    gyro_bias: float
    accel_bias: float
    low_noise_gyro_bias: float = math.inf

    @classmethod
    def with_biases(
        cls,
        *,
        gyro_bias_deg_per_h: float | None = None,
        accel_bias_ug: float | None = None,
        **place: float,
    ) -> "StationaryValues":
        """Return the values of a place with the biases that a user accepts, or the usual ones."""
        accel = ACCEL_BIAS_UG if accel_bias_ug is None else accel_bias_ug
        if gyro_bias_deg_per_h is None:
            gyro, low_noise = GYRO_BIAS, LOW_NOISE_GYRO_BIAS
        else:
            gyro, low_noise = gyro_bias_deg_per_h * DEG_PER_H, math.inf
        return cls(
            **place,
            gyro_bias=gyro,
            accel_bias=accel * micro_g(),
            low_noise_gyro_bias=low_noise,
        )


class Finding(NamedTuple):
    """Something implausible.

    Attributes:
        is_certain: whether it is certainly wrong.
        text: in words, without the file.
        hides_north: whether a level gyro bias hides Earth rate, so that no method finds a heading,
            whereas pitch and roll can be found.
    """

    is_certain: bool
    text: str
    hides_north: bool = False


def check_stationary(
    record: Record, span: tuple[int, int], layout: RecordLayout, expected: StationaryValues
) -> list[Finding]:
    """Return what is implausible for a stationary base in a span of a record.

    Args:
        record: the record, without missing samples in the span.
        span: first sample, and the one after the last; at least a second.
        layout: the layout that the record was read with, to suggest a cause.
        expected: measurements and sensor biases to expect.
    """
    means = compute_means(record, span, expected.gravity)
    results = [
        *_check_mean_force(means, layout, record.rate_hz, expected),
        *_check_up_axis(means, layout),
    ]
    # Wrong gyros cannot show a rotation of the base.
    parked_findings = list(_check_mean_rate(record, span, layout, expected, means)) or list(
        _check_rotation(means, expected)
    )
    if parked_findings or _lacks_earth_rate(means, expected):
        turn_findings = _check_turning_base(record, span, layout, expected, means)
        if turn_findings is not None:
            return results + turn_findings
    return results + parked_findings


def _check_mean_force(
    means: Means, layout: RecordLayout, rate_hz: float, expected: StationaryValues
) -> Iterator[Finding]:
    magnitude, gravity = means.force_magnitude, expected.gravity
    if abs(magnitude - gravity) <= expected.accel_bias:
        return
    is_certain = not 1 / _CERTAIN_FACTOR < magnitude / gravity < _CERTAIN_FACTOR
    other_units = _other_unit_factors(ACCEL_UNITS, "accel_unit", layout, rate_hz)
    likely = [
        unit for unit, factor in other_units.items() if abs(magnitude * factor / gravity - 1) < 0.1
    ]
    text = (
        f"the mean specific force is {magnitude:.5g} m/s^2, {magnitude / gravity:.3g} times gravity"
    )
    if likely:
        yield Finding(is_certain, f"{text}: are these {UNIT_NAMES[likely[0]]}?")
        return
    if is_certain:
        yield Finding(True, f"{text}: is the accelerometer scale right?")
        return
    bias = abs(magnitude - gravity) / micro_g()
    yield Finding(False, f"{text}: an accelerometer bias of {bias:.2g} ug or more would explain it")


def _check_up_axis(means: Means, layout: RecordLayout) -> Iterator[Finding]:
    magnitude = float(np.linalg.norm(means.force)) or 1.0  # zero in a record that is trusted anyway
    tilt = math.acos(max(-1.0, min(1.0, means.force[2] / magnitude)))
    key = message_key(layout, "axes_order")
    if tilt > 90 * DEG:
        is_default = layout.axes_order in ("xyz", "rfu")
        hint = " ('yx-z' for front-right-down)" if is_default else ""
        yield Finding(
            True,
            f"the specific force points down, {tilt / DEG:.3g} deg from the up axis: are"
            f" {key}{hint} and the sign of the accelerometers right?",
        )
    elif tilt > _MAX_TILT:
        text = f"the up axis is tilted by {tilt / DEG:.3g} deg: is {key} right?"
        yield Finding(False, text)


def _lacks_earth_rate(means: Means, expected: StationaryValues) -> bool:
    """Return whether the vertical drifts by far less than the horizontal Earth rate."""
    drift = means.vertical_drift + means.drift_uncertainty
    return drift < 0.5 * expected.earth_rate * math.cos(expected.latitude)


def finds_north_by_turns(means: Means, expected: StationaryValues) -> bool:
    """Return whether the gyros of a turning base sense the horizontal Earth rate."""
    return _north_error(means.turns, expected) is not None


def _north_error(turns: Turns | None, expected: StationaryValues) -> float | None:
    """Return the difference of the drift from the horizontal Earth rate, rad/s.

    None without turns, or if plausible biases do not explain the difference.
    """
    horizontal = expected.earth_rate * math.cos(expected.latitude)
    if turns is None or turns.accel_bias * expected.gravity > expected.accel_bias:
        return None
    error, uncertainty = abs(turns.drift - horizontal), turns.drift_uncertainty
    allowed = _BIAS_SHARE * expected.gyro_bias + uncertainty
    return error + uncertainty if error <= allowed and uncertainty <= horizontal / 5 else None


def _check_turning_base(
    record: Record,
    span: tuple[int, int],
    layout: RecordLayout,
    expected: StationaryValues,
    means: Means,
) -> list[Finding] | None:
    """Return the findings about a base that turns.

    None if its gyros sense no Earth rate while it turns, and no other unit or sign would let them.
    """
    turns = means.turns
    if turns is not None and finds_north_by_turns(means, expected):
        if turns.gyro_bias <= expected.gyro_bias:
            return []
        text = (
            f"the base turns by {turns.angle / DEG:.3g} deg, and a gyro bias of"
            f" {turns.gyro_bias / DEG_PER_H:.3g} deg/h or more would explain the record: are the"
            " signs and axes of the gyros right?"
        )
        return [Finding(False, text)]
    likely = _suggest_for_turns(record, span, layout, expected)
    if not likely:
        return None
    if turns is not None and turns.accel_bias * expected.gravity > expected.accel_bias:
        text = "its gyros do not follow the vertical"
    else:
        drift = means.vertical_drift if turns is None else turns.drift
        text = (
            f"in the frame of its gyros the vertical drifts by {drift / DEG_PER_H:.3g} deg/h and"
            " not by the horizontal Earth rate of"
            f" {expected.earth_rate * math.cos(expected.latitude) / DEG_PER_H:.3g}"
        )
    return [Finding(True, f"the base turns, but {text}: {likely}")]


def _suggest_for_turns(
    record: Record, span: tuple[int, int], layout: RecordLayout, expected: StationaryValues
) -> str:
    """Return a question about the unit or sign with which a turning base is plausible, or ""."""
    units = _other_unit_factors(GYRO_UNITS, "gyro_unit", layout, record.rate_hz)
    causes = {f"are these {UNIT_NAMES[unit]}?": np.full(3, f) for unit, f in units.items()}
    causes["is the sign of the gyros right?"] = np.full(3, -1.0)
    for axis, name in enumerate(("right", "front", "up")):
        question = f"is the sign of the gyro of the {name} axis right?"
        causes[question] = np.where(np.arange(3) == axis, -1.0, 1.0)
    part = merge_samples(record, span, _TURN_RATE_HZ)
    errors: dict[str, float] = {}
    for question, factor in causes.items():
        turns = measure_turns(part.dtheta * factor, part.dv, 1 / part.rate_hz)
        error = _north_error(turns, expected)
        if error is not None and turns and turns.gyro_bias <= expected.gyro_bias:
            errors[question] = error + turns.gyro_bias
    return min(errors, key=lambda question: errors[question]) if errors else ""


def _check_mean_rate(
    record: Record,
    span: tuple[int, int],
    layout: RecordLayout,
    expected: StationaryValues,
    means: Means,
) -> Iterator[Finding]:
    magnitude, earth = float(np.linalg.norm(means.rate)), expected.earth_rate
    allowed, bias = expected.gyro_bias + means.rate_uncertainty, abs(magnitude - earth)
    text = (
        f"the mean rate is {magnitude / DEG_PER_H:.3g} deg/h, {magnitude / earth:.3g} times Earth"
        " rate"
    )
    is_high = (magnitude - means.rate_uncertainty) / earth >= _CERTAIN_FACTOR
    is_low = (magnitude + means.rate_uncertainty) / earth <= 1 / _CERTAIN_FACTOR
    measured = vertical_rate(means)
    horizontal = earth * math.cos(expected.latitude)
    hides_north = abs(means.vertical_drift - horizontal) - means.drift_uncertainty >= horizontal
    is_unresolved = (
        means.resolved_force_ratio
        < _MIN_RESOLVED_RATIO - ((earth + expected.gyro_bias) * means.length_s) ** 2 / 8
    )
    if not means.is_steady and (means.length_s < _SHORT_S or not is_unresolved):
        if undetermined := _describe_undetermined_north(means, expected):
            yield Finding(False, undetermined)
            return
        if means.length_s < _SHORT_S:
            return
    is_suspect = is_unresolved or (bias > allowed and (is_low or (is_high and means.is_steady)))
    likely = _suggest_gyro_unit(record, span, layout, expected) if is_suspect else ""
    if bias > allowed and (is_low or (likely and is_high and means.is_steady)):
        yield Finding(True, f"{text}: {likely or 'has Earth rate been removed?'}")
    elif bias > allowed and is_high and means.is_steady:
        # A wrong scale keeps the direction of Earth rate; a bias would do so only by chance.
        keeps_direction = (
            abs(measured / magnitude - math.sin(expected.latitude))
            < _SAME_DIRECTION + means.rate_uncertainty / magnitude
        )
        if keeps_direction:
            yield Finding(True, f"{text}: is the gyro scale right?")
        elif hides_north:
            yield Finding(True, f"{text}: {_hidden_earth_rate_text(bias)}", hides_north=True)
        else:
            yield Finding(False, f"{text}: does the base turn about the vertical?")
    elif is_unresolved:
        text += ", and the gyros do not follow the vertical"
        yield Finding(bool(likely), f"{text}: {likely or 'are their unit, axes and signs right?'}")
    elif bias > allowed and not means.is_steady:
        yield Finding(False, f"{text}, and it varies: the base turns or sways slowly")
    elif hides_north:
        yield Finding(False, f"{text}: {_hidden_earth_rate_text(bias)}", hides_north=True)
    else:
        if means.is_steady and is_low_noise(record, span):
            allowed = min(allowed, expected.low_noise_gyro_bias + means.rate_uncertainty)
        yield from _check_scale_and_axes(means, expected, allowed, text)


def is_low_noise(record: Record, span: tuple[int, int]) -> bool:
    """Return whether the gyros have less noise than those of MEMS in a span of a record."""
    rows = record.dtheta[span[0] : min(span[1], span[0] + _NOISE_SAMPLES)]
    return white_noise(rows, record.rate_hz) < _LOW_NOISE


def _check_scale_and_axes(
    means: Means, expected: StationaryValues, allowed: float, rate_text: str
) -> Iterator[Finding]:
    """Compare size and vertical part of the mean rate with those of Earth rate."""
    magnitude, measured = float(np.linalg.norm(means.rate)), vertical_rate(means)
    vertical = expected.earth_rate * math.sin(expected.latitude)
    bias, vertical_bias = abs(magnitude - expected.earth_rate), abs(measured - vertical)
    accepted = math.ceil(10 * max(bias, vertical_bias) / DEG_PER_H) / 10
    key = f"[record] gyro_bias_deg_per_h = {accepted:g} if so"
    if bias > allowed:
        yield Finding(
            False,
            f"{rate_text}: are the gyros' unit and scale right, or is there a gyro bias of"
            f" {bias / DEG_PER_H:.3g} deg/h or more ({key})? The heading cannot be trusted, nor"
            " pitch and roll of 'inertial' or 'optimisation' ('level' finds these)",
        )
    elif vertical_bias > allowed:
        removed_hint = (
            ", or has Earth rate been removed" if abs(measured) < 0.5 * abs(vertical) else ""
        )
        yield Finding(
            False,
            f"the rate about the vertical is {measured / DEG_PER_H:.3g} deg/h, but Earth rate there"
            f" is {vertical / DEG_PER_H:.3g}: do gyros and accelerometers share their axes, and is"
            f" the latitude right{removed_hint}, or is there a gyro bias of"
            f" {vertical_bias / DEG_PER_H:.3g} deg/h or more ({key})?",
        )


def _describe_undetermined_north(means: Means, expected: StationaryValues) -> str:
    """Return why a base that moves does not show whether its gyros find north; "" if it does."""
    drift, uncertainty = means.vertical_drift, means.drift_uncertainty
    plausible = expected.earth_rate + expected.gyro_bias
    is_sway = means.largest_turn < _MAX_SWAY
    if drift + (-uncertainty if is_sway else uncertainty) <= plausible:
        return ""
    text = (
        f"the base turned by {means.largest_turn / DEG:.3g} deg; whether these gyros find north"
        " cannot be determined: in their frame the vertical drifts by"
        f" {drift / DEG_PER_H:.3g} deg/h"
    )
    if drift - uncertainty > plausible:
        return f"{text}, which is more than Earth rate"
    return f"{text}, give or take {uncertainty / DEG_PER_H:.3g}"


def _hidden_earth_rate_text(bias: float) -> str:
    bias_deg_per_h = bias / DEG_PER_H
    return (
        f"a gyro bias of {bias_deg_per_h:.3g} deg/h or more hides Earth rate:"
        " no heading can be found"
    )


def _check_rotation(means: Means, expected: StationaryValues) -> Iterator[Finding]:
    drift = (expected.earth_rate + expected.gyro_bias + means.rate_uncertainty) * means.length_s
    if means.turn_angle > MAX_PARKED_TURN:
        yield Finding(
            False,
            f"the base turns by about {means.turn_angle / DEG:.3g} deg within the span used: the"
            " attitude at its end differs from that at its start",
        )
    elif means.vertical_shift > MAX_PARKED_TURN + drift:
        yield Finding(
            False,
            f"the vertical moves by {means.vertical_shift / DEG:.2g} deg but the gyros sense no"
            " rotation: were several records joined?",
        )
    elif means.length_s >= _LONG_S and means.rate_change > max(
        expected.gyro_bias, 3 * _MAX_SETTLING_ANGLE / means.length_s
    ):
        yield Finding(
            False,
            f"the mean rate changes by {means.rate_change / DEG_PER_H:.3g} deg/h within the span"
            " used: the base was turned, or a gyro bias drifts",
        )


def _other_unit_factors(
    units: dict[str, dict[str, float]], key: str, layout: RecordLayout, rate_hz: float
) -> dict[str, float]:
    """Return the factors that convert a mean to other possible units of its columns.

    PSINS text has fixed units.
    """
    if layout.format == "psins":
        return {}
    current = getattr(layout, key)
    factor = increment_factor(current, rate_hz)
    return {
        unit: increment_factor(unit, rate_hz) / factor
        for known in units.values()
        for unit in known
        if unit != current
    }


def _suggest_gyro_unit(
    record: Record, span: tuple[int, int], layout: RecordLayout, expected: StationaryValues
) -> str:
    """Return a question about a unit that would make the rate plausible; "" without one."""
    part = record._replace(dtheta=record.dtheta[slice(*span)], dv=record.dv[slice(*span)])
    earth = expected.earth_rate
    factors = _other_unit_factors(GYRO_UNITS, "gyro_unit", layout, record.rate_hz)
    for unit, factor in sorted(factors.items(), key=lambda item: abs(math.log(item[1]))):
        scaled = part._replace(dtheta=part.dtheta * factor)
        means = compute_means(scaled, (0, len(part.dv)), expected.gravity)
        magnitude = float(np.linalg.norm(means.rate))
        if means.resolved_force_ratio < _MIN_RESOLVED_RATIO:
            continue
        if abs(magnitude - earth) <= min(expected.gyro_bias, earth / 2) + means.rate_uncertainty:
            direction_error = abs(vertical_rate(means) / magnitude - math.sin(expected.latitude))
            if direction_error < 0.2 + means.rate_uncertainty / magnitude:
                return f"are these {UNIT_NAMES[unit]}?"
    return ""
