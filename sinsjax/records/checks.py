"""Checks of a record before its alignment: its samples, motion, mean force and rate.

Apart from sensor biases, the mean specific force of a base that stays is gravity, and the vertical
drifts by the horizontal Earth rate in the frame that its gyros carry, even if the base sways. Gyros
that do not show that rate cannot find north, whatever the reason.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import numpy as np

from sinsjax.records.layout import Finding, FloatArray, Record, find_spans
from sinsjax.units import DEG, DEG_PER_H, DEG_PER_SQRT_H, STANDARD_GRAVITY, micro_g

EARTH_RATE = 15.041 * DEG_PER_H
"""Earth rate, rad/s."""

_BLOCKS = 12
_MAX_STEPS = 2**19  # analysed steps of a span; in a longer one, samples are summed
_NOISE_SAMPLES = 2**17  # enough for a median
_MIN_TURN = 20 * DEG  # in addition to a steady rate
_MIN_TURN_RATE = 2 * DEG  # per second, if steady: a bias is less
_MAX_TURNED_TILT = 5 * DEG  # a base that tilts is not turned on the spot
_MIN_TURNED_RATIO = 0.8  # of gravity: even poor gyros follow the vertical of a turned base


class Motion(NamedTuple):
    """Motion and mean measurements of a span, SI units; uncertainties are 3 sigma."""

    force: FloatArray  # (3,) mean, in the body axes
    force_magnitude: float
    resolved_ratio: float  # of the mean force resolved by the gyros to the mean magnitude
    tilt_change: float  # largest angle between the mean forces of blocks and that of all
    turn: float  # about the vertical: largest minus smallest angle
    uneven_turn: float  # the same without a steady rate
    sway: float  # of the angle about the vertical
    vertical_rate: float  # about the vertical
    vertical_uncertainty: float
    drift: float  # rate of the vertical itself in the frame that the gyros carry
    drift_uncertainty: float
    length_s: float

    @property
    def is_turned(self) -> bool:
        """Whether the base is turned about the vertical; sensor biases turn with it."""
        turns = self.uneven_turn > _MIN_TURN or abs(self.vertical_rate) > _MIN_TURN_RATE
        is_level = self.resolved_ratio > _MIN_TURNED_RATIO and self.tilt_change < _MAX_TURNED_TILT
        return turns and is_level

    @property
    def magnitude(self) -> float:
        """Magnitude of the mean rate."""
        return math.hypot(self.vertical_rate, self.drift)

    @property
    def latitude(self) -> float:
        """Latitude at which the mean rate is Earth rate, rad."""
        return math.atan2(self.vertical_rate, self.drift)


def measure_motion(record: Record, span: tuple[int, int], gravity: float) -> Motion:
    """Return the motion in a span of a record that lacks no sample in it; gravity is in m/s^2."""
    count = -(-(span[1] - span[0]) // _MAX_STEPS)
    dtheta, dv = (
        rows[slice(*span)][: (span[1] - span[0]) // count * count].reshape(-1, count, 3).sum(axis=1)
        for rows in (record.dtheta, record.dv)
    )
    n, dt = len(dtheta), count / record.rate_hz
    q = integrate_attitudes(dtheta)
    q = _multiply(q[n // 2] * [1, -1, -1, -1], q)  # to the body axes at the middle
    force = _rotate(q[:-1], dv) / dt
    tilts, ups = _unit(_block_means(dv)), _unit(_block_means(force))
    up = _unit(ups.sum(axis=0))
    psi = _block_means(np.unwrap(2 * np.arctan2(q[1:, 1:] @ up, q[1:, 0]), period=4 * np.pi))
    steps = np.diff(psi) - np.median(np.diff(psi))
    vertical = _fit_slope(psi[:, None], n * dt)
    level = _fit_slope(ups, n * dt)
    seconds = [part.mean(axis=0) for part in np.array_split(dv / dt, max(1, int(n * dt)))]
    resolved = float(np.linalg.norm(force.mean(axis=0)))
    magnitude = float(np.linalg.norm(seconds, axis=1).mean())
    return Motion(
        force=dv.mean(axis=0) / dt,
        # Fast sways shorten the means of seconds, wrong gyros the resolved one: the better counts.
        force_magnitude=min((resolved, magnitude), key=lambda size: abs(size - gravity)),
        resolved_ratio=resolved / (magnitude or 1.0),
        tilt_change=float(np.linalg.norm(tilts - tilts.mean(axis=0), axis=1).max()),
        turn=float(np.ptp(psi)),
        uneven_turn=float(np.ptp(np.cumsum([0.0, *steps]))),
        sway=10 * float(np.median(np.abs(steps))),
        vertical_rate=float(vertical.rate[0]),
        vertical_uncertainty=vertical.uncertainty,
        drift=float(np.linalg.norm(level.rate)),
        drift_uncertainty=level.uncertainty,
        length_s=n * dt,
    )


def white_noise(increments: FloatArray, rate_hz: float) -> float:
    """Return the white noise of increments (n, 3): their standard deviation after 1 s.

    Second differences of white noise have six times its variance, and exclude slow motion.
    """
    differences = np.abs(np.diff(increments[:_NOISE_SAMPLES], n=2, axis=0))
    return float(np.median(differences)) / 0.6745 / math.sqrt(6) * math.sqrt(rate_hz)


class _Slope(NamedTuple):
    """A rate of change (k,), and 3 sigma of its components."""

    rate: FloatArray
    uncertainty: float


def _fit_slope(values: FloatArray, length_s: float) -> _Slope:
    """Fit a slope to the means (n, k) of overlapping blocks of a span."""
    time_s = (np.arange(len(values)) - (len(values) - 1) / 2) * length_s / (_BLOCKS + 1)
    sum_of_squares = float(time_s @ time_s)
    rate = time_s @ values / sum_of_squares
    scatter = values - values.mean(axis=0) - np.outer(time_s, rate)
    variance = float((scatter**2).sum()) / (len(values) - 2)
    return _Slope(rate, 3 * math.sqrt(variance / sum_of_squares))


def _block_means(values: FloatArray) -> FloatArray:
    """Return the means of overlapping blocks of rows, with weights that cancel sways."""
    half = max(1, len(values) // (_BLOCKS + 1))
    weight = np.hanning(2 * half + 2)[1:-1]
    blocks = [values[k * half :][: 2 * half] for k in range(_BLOCKS)]
    return np.array([weight[: len(block)] @ block for block in blocks]) / weight.sum()


def _unit(vectors: FloatArray) -> FloatArray:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-300)


# Attitudes, as quaternions (..., 4), scalar first


def integrate_attitudes(dtheta: FloatArray) -> FloatArray:
    """Return quaternions (n + 1, 4) from the body axes at each time to those at the start.

    Two-sample coning of the increments (n, 3), rad, is compensated.
    """
    previous = np.concatenate([dtheta[:1], dtheta[:-1]])
    vector = dtheta + np.cross(previous, dtheta) / 12
    angle = np.linalg.norm(vector, axis=1, keepdims=True)
    # sin(a/2)/a by NumPy's sin(pi x)/(pi x), which is defined at zero.
    steps = np.hstack([np.cos(angle / 2), vector * np.sinc(angle / 2 / np.pi) / 2])
    q, length = np.concatenate([[[1.0, 0.0, 0.0, 0.0]], steps]), 1
    while length < len(q):  # products of twice as many steps each time
        q[length:] = _multiply(q[:-length], q[length:])
        length *= 2
    return q


def _multiply(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return the Hamilton products of quaternions (..., 4)."""
    aw, ax, ay, az = (a[..., k] for k in range(4))  # np.moveaxis takes as long as the products
    bw, bx, by, bz = (b[..., k] for k in range(4))
    w = aw * bw - ax * bx - ay * by - az * bz
    x = aw * bx + ax * bw + ay * bz - az * by
    y = aw * by - ax * bz + ay * bw + az * bx
    return np.stack([w, x, y, aw * bz + ax * by - ay * bx + az * bw], axis=-1)


def _rotate(q: FloatArray, v: FloatArray) -> FloatArray:
    """Return vectors (n, 3) rotated by quaternions (n, 4)."""
    across = 2 * np.cross(q[:, 1:], v)
    return v + q[:, :1] * across + np.cross(q[:, 1:], across)


GYRO_BIAS, ACCEL_BIAS_UG = 10.0 * DEG_PER_H, 5000.0
"""Largest biases that raise no doubt, rad/s and ug."""

LOW_NOISE_GYRO_BIAS = 4.5 * DEG_PER_H
"""The same for gyros with little noise at rest, 0.3 of Earth rate: their scale is rather wrong."""

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
    accel_bias: float = ACCEL_BIAS_UG * micro_g()

    @property
    def gyro_bias(self) -> float:
        """Largest gyro bias, rad/s."""
        given = self.gyro_bias_deg_per_h
        return GYRO_BIAS if given is None else given * DEG_PER_H

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
    record: Record, span: tuple[int, int], expected: StationaryValues
) -> list[Finding]:
    """Return what is implausible for a base that stays in a span (from, to before) of a record.

    The span is at least a second long and lacks no sample.
    """
    motion = measure_motion(record, span, expected.gravity)
    noise = white_noise(record.dtheta[slice(*span)], record.rate_hz)
    return [*_check_force(motion, expected), *_check_gyros(motion, expected, noise)]


def _check_force(motion: Motion, expected: StationaryValues) -> Iterator[Finding]:
    ratio = motion.force_magnitude / expected.gravity
    if abs(ratio - 1) * expected.gravity > expected.accel_bias:
        is_certain = not 1 / _CERTAIN_FACTOR < ratio < _CERTAIN_FACTOR
        bias = abs(ratio - 1) * expected.gravity / micro_g()
        cause = f"an accelerometer bias of {bias:.2g} ug or more would explain it"
        if is_certain:
            cause = "has gravity been removed, or is the accelerometers' unit or scale wrong?"
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
        yield Finding(False, f"no heading can be found: {hidden}", hides_north=True)


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
    off_latitude = abs(motion.latitude - expected.latitude)
    if bias > largest + uncertainty or (is_quiet and off_latitude > 5 * sigma):
        accepted = math.ceil(10 * bias / DEG_PER_H) / 10
        rate = f"{motion.magnitude / DEG_PER_H:.3g} deg/h, {motion.magnitude / earth:.3g} times"
        place = f", of a latitude of {motion.latitude / DEG:.4g} deg, give or take"
        place += f" {sigma / DEG:.2g}, and not {expected.latitude / DEG:.6g}"
        text = (
            f"the mean rate is {rate} Earth rate{place if off_latitude > sigma else ''}: are"
            f" latitude_deg and the gyros' unit and scale right, or is there a gyro bias of"
            f" {bias / DEG_PER_H:.3g} deg/h or more ([record] gyro_bias_deg_per_h = {accepted:g} if"
            f" so)? Only the method 'level' is not affected"
        )
        yield Finding(False, text)
