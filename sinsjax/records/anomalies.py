"""Anomalies of a record: samples out of range, stuck channels, removed Earth rate.

They are found while a file is read, since only then its rows are known.
"""

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sinsjax.messages import format_count
from sinsjax.records.layout import Anomaly, find_spans
from sinsjax.records.means import EARTH_RATE
from sinsjax.units import DEG, STANDARD_GRAVITY

_MAX_G, _MAX_DEG_PER_S = 20.0, 1000.0  # swaying bases and cars stay far below
_TYPICAL_SHARE = 0.1
"""Of the limit: if most samples are larger, the unit is wrong, which the mean reveals."""

_MAX_REPORTED = 6  # anomalies that may be harmless, in messages
_REMOVED_SHARE = 0.01  # of Earth rate, in every gyro: biases do not cancel it so well in all three
_STUCK_S = 1.0  # of all six channels: a single coarse one may repeat for long


def find_anomalies(
    names: Sequence[str],
    columns: Sequence[NDArray[Any]],
    factors: Sequence[float],
    rate_hz: float,
    row_number: Callable[[int], int],
) -> tuple[Anomaly, ...]:
    """Return the anomalies of a record.

    Args:
        names: names of the columns, three of gyros, then three of accelerometers.
        columns: (T,) each, in any unit, nan where missing.
        factors: conversion of each column's unit to rad/s or m/s^2.
        rate_hz: sample rate, Hz.
        row_number: function of sample k that returns its row, for messages.
    """
    out_of_range = _find_out_of_range(names, columns, factors, row_number)
    return (
        *out_of_range,
        *_find_removed_earth_rate(columns[:3], factors),
        *_find_stuck_channels(names, columns, rate_hz, row_number),
    )


def report_anomalies(
    anomalies: Sequence[Anomaly], spans: Sequence[tuple[int, int]]
) -> Iterator[Anomaly]:
    """Yield the anomalies within some spans of samples, for messages.

    Certain errors are reduced to the first one and the number of others.

    Args:
        anomalies: anomalies of a record.
        spans: first sample of each span, and the one after its last.
    """
    relevant = [
        anomaly
        for anomaly in anomalies
        if any(anomaly.begin < end and anomaly.end > begin for begin, end in spans)
    ]
    certain = [anomaly for anomaly in relevant if anomaly.is_certain]
    if certain:
        first, further = min(certain, key=lambda anomaly: anomaly.begin), len(certain) - 1
        text = (
            f"{first.text}; {format_count(further, 'more such place')}" if further else first.text
        )
        yield first._replace(text=text)
    yield from [anomaly for anomaly in relevant if not anomaly.is_certain][:_MAX_REPORTED]


def _find_out_of_range(
    names: Sequence[str],
    columns: Sequence[NDArray[Any]],
    factors: Sequence[float],
    row_number: Callable[[int], int],
) -> Iterator[Anomaly]:
    for channel, (name, values, factor) in enumerate(zip(names, columns, factors, strict=True)):
        is_gyro = channel < 3
        unit, unit_name = (DEG, "deg/s") if is_gyro else (STANDARD_GRAVITY, "g")
        limit = _MAX_DEG_PER_S if is_gyro else _MAX_G
        max_value = limit * unit / factor
        is_large = (values > max_value) | (values < -max_value)
        if not is_large.any() or np.nanmedian(np.abs(values)) > _TYPICAL_SHARE * max_value:
            continue
        for begin, end in find_spans(is_large):
            value = float(values[begin])
            yield Anomaly(
                begin,
                end,
                True,
                f"{_format_rows(row_number, begin, end)}: column {name!r}: {value:.6g} is"
                f" {value * factor / unit:.4g} {unit_name}, and no base at rest has more than"
                f" {limit:g} {unit_name}: leave such cells empty, as missing samples",
            )


def _find_removed_earth_rate(
    gyros: Sequence[NDArray[Any]], factors: Sequence[float]
) -> Iterator[Anomaly]:
    """Yield an anomaly if Earth rate was removed by subtracting each gyro's mean.

    Only the mean over the whole log shows it; that of a part depends on its sways.
    """
    if any(map(_is_constant, gyros)):
        return
    means = [
        float(np.nansum(gyro)) / max(1, int(np.isfinite(gyro).sum())) * factor
        for gyro, factor in zip(gyros, factors, strict=False)
    ]
    if max(map(abs, means)) < _REMOVED_SHARE * EARTH_RATE:
        text = (
            f"the mean of each gyro over the whole log is below {_REMOVED_SHARE:.0%} of Earth"
            " rate: has"
        )
        yield Anomaly(0, len(gyros[0]), True, f"{text} Earth rate been removed?")


def _find_stuck_channels(
    names: Sequence[str],
    columns: Sequence[NDArray[Any]],
    rate_hz: float,
    row_number: Callable[[int], int],
) -> Iterator[Anomaly]:
    count = len(columns[0])
    min_samples = max(2, round(_STUCK_S * rate_hz))
    if count < min_samples:
        return
    dead = [name for name, values in zip(names, columns, strict=True) if _is_constant(values)]
    if len(dead) == len(names):
        yield Anomaly(0, count, False, "no channel changes in any row: is this a log of sensors?")
        return
    for name in dead:
        value = float(columns[names.index(name)][0])
        text = f"column {name!r} is {value:.6g} in every row: is that sensor dead?"
        yield Anomaly(0, count, False, text)
    unchanged = np.ones(count - 1, bool)
    for values in columns:
        unchanged &= values[1:] == values[:-1]
    for begin, last in find_spans(unchanged):
        if last + 1 - begin >= min_samples:
            yield Anomaly(
                begin,
                last + 1,
                False,
                f"{_format_rows(row_number, begin, last + 1)}: all six channels are stuck for"
                f" {(last + 1 - begin) / rate_hz:.3g} s: did the sensor or the logger stop?",
            )


def find_dead_channels(channels: NDArray[Any]) -> list[bool]:
    """Return for each channel (n, T) whether it never changes although another one does."""
    constant = list(map(_is_constant, channels))
    return [False] * len(constant) if all(constant) else constant


def _is_constant(values: NDArray[Any]) -> bool:
    """Return whether a channel (T,) never changes."""
    return bool(values[0] == values[-1] and (values == values[0]).all())


def _format_rows(row_number: Callable[[int], int], begin: int, end: int) -> str:
    first, last = row_number(begin), row_number(end - 1)
    return f"row {first}" if first == last else f"rows {first} to {last}"
