"""Records from named columns of numbers, by a `RecordLayout`."""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from sinsjax.errors import InputError
from sinsjax.messages import format_count
from sinsjax.records.checks import find_anomalies
from sinsjax.records.layout import (
    Flaw,
    FloatArray,
    Record,
    RecordLayout,
    find_spans,
    is_rate,
    rate_factor,
    to_vehicle_axes,
    unit_factor,
)
from sinsjax.records.reader import MISSING_TEXT, Table
from sinsjax.records.stamps import Sampling, combine_times, find_sampling, format_step

_MAX_OFFERED_GAP_S = 1.0
"""Longest gap for which interpolation is offered: most bases sway more slowly than this."""


def record_from_table(layout: RecordLayout, table: Table) -> Record:
    """Return the record in an opened table, by a valid layout.

    Rates are multiplied by the sampling interval. Time stamps are the ends of the samples and may
    be a few milliseconds late. A row that repeats the one before it, stamp included, is left out.
    A missing sample, from a gap or an empty cell, is interpolated if max_gap_s allows it; otherwise
    it is nan and a flaw of the record, see `require_span`. Errors name the row and the column.
    """
    names = [name for sensor in layout.sensors for name in sensor.columns]
    dates = [layout.time_column] if layout.time_unit == "iso" else []
    columns = table.read([*names, *layout.time_columns], dates)
    rows, times = np.column_stack(columns[:6]), columns[6:]
    del columns  # to save the memory of a second copy of a long record
    if not np.isfinite(rows).all(axis=1).any():
        raise InputError(f"{table.source}: no row has a number in all six columns of the sensors")
    remarks, samples = list[str](), np.arange(len(rows))
    if times:
        time_s = combine_times(times, layout)
        if not np.isfinite(time_s).any():
            raise InputError(f"{table.source}: column {layout.time_column!r}: {MISSING_TEXT}")
        repeated = np.zeros(len(rows), bool)
        repeated[1:] = (time_s[1:] == time_s[:-1]) & (rows[1:] == rows[:-1]).all(axis=1)
        if repeated.any():
            count = format_count(int(repeated.sum()), "row")
            first = table.row_number(int(repeated.argmax()))
            remarks.append(f"{count} left out that repeat the one before, the first in row {first}")
        samples = np.flatnonzero(np.isfinite(time_s) & ~repeated)
        if len(samples) < len(rows):
            rows, time_s = rows[samples], time_s[samples]
        sampling = find_sampling(
            table.source, layout, time_s, lambda k: table.row_number(int(samples[k]))
        )
        remarks += filter(None, [sampling.remark])
    else:
        assert layout.rate_hz is not None  # as `check_layout` ensures without a time column
        time_s, sampling = np.empty(0), Sampling(layout.rate_hz, 0.0, samples)
    rate_hz, number = sampling.rate_hz, sampling.number

    def row_number(sample: int) -> int:
        return table.row_number(int(samples[np.searchsorted(number, sample)]))

    def describe_gap(sample: int) -> str:
        k = int(np.searchsorted(number, sample))
        row = f"row {row_number(sample)}"
        if number[k] != sample:
            place = f"{table.source}: column {layout.time_column!r}: {row}"
            return f"{place}: a gap at {rate_hz:g} Hz, {format_step(time_s, k - 1)}"
        channel = int(np.isfinite(rows[k]).argmin())
        return f"{table.source}: {row}: column {names[channel]!r}: {MISSING_TEXT}"

    filled = _fill_gaps(rows, sampling, layout, describe_gap)
    factors = np.concatenate(
        [np.multiply(rate_factor(unit, rate_hz), scale) for _, unit, scale in layout.sensors]
    )
    anomalies = find_anomalies(names, filled.rows, factors, rate_hz, row_number)
    increments = list[FloatArray]()
    for values, (_, unit, scale) in zip(np.hsplit(filled.rows, 2), layout.sensors, strict=True):
        values = values * (unit_factor(unit) * np.array(scale))
        if is_rate(unit):
            values /= rate_hz
        increments.append(to_vehicle_axes(values, layout))
    dtheta, dv = increments
    return Record(
        dtheta,
        dv,
        rate_hz=rate_hz,
        t0_s=sampling.t0_s,
        source=table.source,
        flaws=tuple(filled.flaws),
        filled=filled.interpolated,
        anomalies=anomalies,
        remarks=tuple(remarks),
    )


class _Filled(NamedTuple):
    """Rows of all samples from the first to the last, and what is missing among them."""

    rows: FloatArray  # (T, 6); nan in flaws
    flaws: list[Flaw]
    interpolated: int  # samples


def _fill_gaps(
    rows: FloatArray, sampling: Sampling, layout: RecordLayout, describe_gap: Callable[[int], str]
) -> _Filled:
    """Return rows of all samples: short gaps are interpolated, others become nan and a flaw."""
    rate, number = sampling.rate_hz, sampling.number
    whole = np.full((number[-1] + 1, rows.shape[1]), np.nan)
    whole[number] = rows
    missing = np.asarray(~np.isfinite(whole).all(axis=1))
    whole[missing] = np.nan
    good, fill, flaws = np.flatnonzero(~missing), np.zeros(len(whole), bool), list[Flaw]()
    for begin, end in find_spans(missing):
        inside = begin > 0 and end < len(whole)
        gap_s = (end - begin + 1) / rate if inside else math.inf
        if gap_s <= layout.max_gap_s * (1 + 1e-9):
            fill[begin:end] = True
            continue
        text = describe_gap(begin)
        if gap_s <= _MAX_OFFERED_GAP_S and layout.format != "psins":
            text += f" (max_gap_s = {math.ceil(gap_s * 1e3 - 1e-6) / 1e3:g} would interpolate it)"
        flaws.append(Flaw(begin, end, text))
    for column in whole.T:
        column[fill] = np.interp(np.flatnonzero(fill), good, column[good])
    return _Filled(whole, flaws, int(fill.sum()))
