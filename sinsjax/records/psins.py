"""PSINS SIMU log text: three header lines, then six integer counts per sample.

The format of the PSINS toolbox (G. Yan, NWPU). Lines that start with % are comments. Header: pitch,
roll, yaw (deg), VE, VN, VU (m/s); latitude, longitude (deg), height (m), t0 (s), interval (ms), g
(m/s^2); scale factors, three gyro (arcsec) and three accelerometer (ug*s, in that g).
"""

import math
from collections.abc import Sequence
from itertools import chain, islice
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sinsjax.errors import InputError
from sinsjax.messages import shorten
from sinsjax.platform.files import atomic_write
from sinsjax.records.layout import (
    PSINS_LAYOUT,
    FloatArray,
    Record,
    RecordLayout,
    check_layout,
    resolve_rate,
)
from sinsjax.records.reader import Line, data_lines, is_number, open_text, read_lines
from sinsjax.records.tabular import record_from_table
from sinsjax.units import ARCSEC, STANDARD_GRAVITY, micro_g

_COUNT_COLUMNS = tuple(f"{sensor} {axis}" for sensor in ("gyro", "accelerometer") for axis in "xyz")
_LARGEST_SUM = 2.0**53  # above this, float64 no longer represents every integer


class _Header(NamedTuple):
    """The three header lines, six values each; nan for unknown values."""

    pose: Sequence[float]  # pitch, roll, yaw deg; VE, VN, VU m/s
    place: Sequence[float]  # latitude, longitude deg; height m; t0 s; interval ms; g m/s^2
    scale: Sequence[float]  # gyro x, y, z arcsec; accelerometer x, y, z ug*s


def is_psins(path: str | Path) -> bool:
    """Return whether the first three lines of data of a file are six numbers each."""
    rows = [line.text.split() for line in _header_lines(path)]
    return len(rows) == 3 and all(len(row) == 6 and all(map(is_number, row)) for row in rows)


def read_psins(path: str | Path, layout: RecordLayout = PSINS_LAYOUT) -> Record:
    """Read a PSINS SIMU log.

    The header's g scales the accelerometer counts to m/s. An attitude, latitude or height of nan in
    the header is unknown. Of the layout, axes_order, mounting_deg and rate_hz are used; the rate
    must agree with the header's interval.
    """
    check_layout(layout, str(path))
    lines = _header_lines(path)
    header = _parse_header(path, lines)
    latitude, _, height, t0, interval_ms, gravity = header.place
    attitude = (header.pose[0], header.pose[1], header.pose[2])
    place = f"{path}: row {lines[1].row}: the header"
    scale = np.array(header.scale)
    layout = layout._replace(
        gyro_columns=_COUNT_COLUMNS[:3],
        accel_columns=_COUNT_COLUMNS[3:],
        gyro_scale=tuple(scale[:3] * ARCSEC),
        accel_scale=tuple(scale[3:] * micro_g(gravity)),
        rate_hz=resolve_rate(1e3 / interval_ms, layout, 0.0, place),
    )
    table = open_text(path, _COUNT_COLUMNS, skip_rows=lines[-1].row)
    return record_from_table(layout, table)._replace(
        t0_s=t0,
        latitude_deg=None if math.isnan(latitude) else latitude,
        height_m=None if math.isnan(height) else height,
        attitude_deg=None if any(map(math.isnan, attitude)) else attitude,
        gravity_m_per_s2=gravity,
    )


def _header_lines(path: str | Path) -> list[Line]:
    batches = (data_lines(lines, row) for row, lines in read_lines(path))
    return [*islice(chain.from_iterable(batches), 3)]


def _parse_header(path: str | Path, lines: list[Line]) -> _Header:
    values = []
    for row, text in lines:
        words = text.split()
        if (
            len(words) != 6
            or not all(map(is_number, words))
            or any("inf" in w.lower() for w in words)
        ):
            hint = "(not PSINS text? `sinsjax init record --from LOG` writes a [record] for others)"
            problem = f"a header line must have 6 numbers: {shorten(text, 60)!r} {hint}"
            raise InputError(f"{path}: row {row}: {problem}")
        values.append([*map(float, words)])
    if len(values) < 3:
        raise InputError(f"{path}: the header must have 3 lines, not {len(values)}")
    header = _Header(*values)
    if fault := _find_header_fault(header):
        line, text = fault
        place, hint = f"row {lines[line].row}: header line {line + 1}", "must precede the samples"
        raise InputError(f"{path}: {place}: {text} (a 3-line header {hint})")
    return header


def _find_header_fault(header: _Header) -> tuple[int, str] | None:
    """Return the first invalid value of a header: its line (0 to 2) and the message, or None."""
    latitude, _, _, t0, interval_ms, gravity = header.place
    if not interval_ms > 0:
        return 1, f"the sampling interval must be positive, not {interval_ms:g} ms"
    if abs(latitude) >= 90:
        return 1, f"the latitude {latitude:g} deg is not between -90 and 90"
    # Lines in the wrong order, or a missing one, are detected here first.
    if not 9 < gravity < 11:
        return 1, f"g = {gravity:g} m/s^2 is not a plausible gravity"
    if math.isnan(t0):
        return 1, "t0 is not a number"
    for name, value in zip(_COUNT_COLUMNS, header.scale, strict=True):
        if not value > 0:
            return 2, f"the scale factor of {name} must be positive, not {value:g}"
    return None


def write_psins(
    record: Record,
    path: str | Path,
    gyro_scale_arcsec: float = 0.1,
    accel_scale_ug_s: float = 125.0,
) -> None:
    """Write a PSINS SIMU log.

    The running sums are rounded to counts, not the increments, so the error of a sum of any length
    is at most half a count; the scales are those of one count. The record's g, or else standard
    gravity, scales the specific force. Values unknown to the record become nan in the header;
    velocity and longitude, which a record lacks, become 0.
    """
    gravity = STANDARD_GRAVITY if record.gravity_m_per_s2 is None else record.gravity_m_per_s2
    latitude = math.nan if record.latitude_deg is None else record.latitude_deg
    height = math.nan if record.height_m is None else record.height_m
    header = _Header(
        pose=[*(record.attitude_deg or [math.nan] * 3), 0.0, 0.0, 0.0],
        place=[latitude, 0.0, height, record.t0_s, 1e3 / record.rate_hz, gravity],
        scale=[gyro_scale_arcsec] * 3 + [accel_scale_ug_s] * 3,
    )
    fault = _find_header_fault(header)
    if fault is not None:
        raise InputError(f"{path}: cannot be written: {fault[1]}")
    counts = np.column_stack(
        [
            _to_counts(path, record.dtheta, gyro_scale_arcsec * ARCSEC),
            _to_counts(path, record.dv, accel_scale_ug_s * micro_g(gravity)),
        ]
    )
    with atomic_write(path) as file:
        file.write(b"% PSINS-format SIMU log file.\n")
        for line in header:
            file.write(" ".join(repr(float(value)) for value in line).encode() + b"\n")
        np.savetxt(file, counts, fmt="%d")


def _to_counts(path: str | Path, increments: FloatArray, quantum: float) -> NDArray[np.int64]:
    sums = np.cumsum(increments, axis=0) / quantum
    if not np.all(np.abs(sums) < _LARGEST_SUM):
        raise InputError(f"{path}: cannot be written: an increment is not finite, or too large")
    whole = np.rint(sums).astype(np.int64)
    counts = whole.copy()
    counts[1:] -= whole[:-1]
    return counts
