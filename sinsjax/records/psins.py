"""PSINS SIMU log text: three header lines, then six integer counts per sample.

The format of the PSINS toolbox (G. Yan, NWPU). Lines that start with % are comments. Header: pitch,
roll, yaw (deg), VE, VN, VU (m/s); latitude, longitude (deg), height (m), t0 (s), interval (ms), g
(m/s^2); scale factors, three gyro (arcsec) and three accelerometer (ug*s, in that g).
"""

import math
import re
from collections.abc import Sequence
from itertools import chain
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sinsjax.errors import InputError
from sinsjax.platform.files import atomic_write
from sinsjax.records.anomalies import find_anomalies
from sinsjax.records.files import (
    CUT_OFF_HINT,
    Lines,
    cut_row_text,
    is_cut_short,
    parse_number,
    read_line_batches,
)
from sinsjax.records.layout import (
    PSINS_LAYOUT,
    Anomaly,
    FloatArray,
    Record,
    RecordLayout,
    check_layout,
    resolve_rate,
    to_body_axes,
    to_vehicle_axes,
)
from sinsjax.units import ARCSEC, STANDARD_GRAVITY, micro_g

_COUNT_COLUMNS = tuple(f"{sensor} {axis}" for sensor in ("gyro", "accelerometer") for axis in "xyz")
_INT64 = np.iinfo(np.int64)
# Above this, float64 no longer represents every integer.
_LARGEST_SUM = 2.0**53


class _Header(NamedTuple):
    """The three header lines, six values each; nan for unknown values."""

    pose: Sequence[float]  # pitch, roll, yaw deg; VE, VN, VU m/s
    place: Sequence[float]  # latitude, longitude deg; height m; t0 s; interval ms; g m/s^2
    scale: Sequence[float]  # gyro x, y, z arcsec; accelerometer x, y, z ug*s


def read_psins(path: str | Path, layout: RecordLayout = PSINS_LAYOUT) -> Record:
    """Read a PSINS SIMU log.

    The header's g scales the accelerometer counts to m/s. An attitude, latitude or height of nan in
    the header is unknown.

    Args:
        path: the file.
        layout: only its axes_order, mounting_deg and rate_hz are used; rate_hz must agree with the
            header's interval.

    Returns:
        The record with the header's position, attitude and g.

    Raises:
        InputError: the file cannot be read, is cut off, or has a bad header or sample; the message
            names the row.
    """
    check_layout(layout, str(path))
    batches = map(_data_lines, read_line_batches(path))
    head = next(batches)
    while len(head.lines) <= 3 and (next_lines := next(batches, None)):
        head = next_lines._replace(
            lines=head.lines + next_lines.lines, rows=head.rows + next_lines.rows
        )
    header = _read_header(path, head)
    if len(head.rows) == 3:
        raise InputError(f"{path}: no samples after the header")
    first = head._replace(lines=head.lines[3:], rows=head.rows[3:])
    remarks: list[str] = []
    counts_and_rows = [
        (_read_counts(path, batch), np.asarray(batch.rows, np.int64))
        for batch in (_drop_cut_row(batch, remarks) for batch in chain([first], batches))
    ]
    counts, rows = (np.concatenate(parts) for parts in zip(*counts_and_rows, strict=True))
    scale = np.array(header.scale)
    latitude, _, height, t0, interval_ms, gravity = header.place
    attitude = (header.pose[0], header.pose[1], header.pose[2])
    rate = resolve_rate(1e3 / interval_ms, layout, 0.0, f"{path}: row {head.rows[1]}: the header")

    def to_axes(increments: FloatArray) -> FloatArray:
        in_box = to_body_axes(increments, layout.axes_order)
        return to_vehicle_axes(in_box, layout.mounting_deg)

    return Record(
        dtheta=to_axes(counts[:, :3] * (scale[:3] * ARCSEC)),
        dv=to_axes(counts[:, 3:] * (scale[3:] * micro_g(gravity))),
        rate_hz=rate,
        t0_s=t0,
        latitude_deg=None if math.isnan(latitude) else latitude,
        height_m=None if math.isnan(height) else height,
        attitude_deg=None if any(map(math.isnan, attitude)) else attitude,
        gravity_m_per_s2=gravity,
        source=str(path),
        anomalies=_find_anomalies(counts, scale, rate, gravity, rows),
        remarks=tuple(remarks),
    )


def _find_anomalies(
    counts: NDArray[np.int64],
    scale: FloatArray,
    rate_hz: float,
    gravity: float,
    rows: NDArray[np.int64],
) -> tuple[Anomaly, ...]:
    units = np.repeat([ARCSEC, micro_g(gravity)], 3)
    factors = (scale * units * rate_hz).tolist()
    return find_anomalies(
        _COUNT_COLUMNS, list(counts.T), factors, rate_hz, lambda sample: int(rows[sample])
    )


class _DataLines(NamedTuple):
    """Lines that are not comments.

    Attributes:
        lines: the lines.
        rows: row of each line in the file, from 1.
        is_last: whether the file ends with them.
        is_unterminated: whether the last of them has no line ending.
    """

    lines: list[bytes]
    rows: list[int]
    is_last: bool
    is_unterminated: bool


def _data_lines(batch: Lines) -> _DataLines:
    numbered = enumerate(batch.lines, start=batch.first)
    data = [(line, row) for row, line in numbered if _is_data(line)]
    return _DataLines(
        [line for line, _ in data], [row for _, row in data], batch.is_last, batch.is_unterminated
    )


def _drop_cut_row(data: _DataLines, remarks: list[str]) -> _DataLines:
    """Return samples without the last row if the file is cut off within its last number."""
    if not (data.is_unterminated and len(data.lines) > 2):
        return data
    *earlier, last = (line.decode("latin-1").split() for line in data.lines[-500:])
    if len(last) != 6 or not is_cut_short(last[-1], [words[-1] for words in earlier if words]):
        return data
    remarks.append(cut_row_text(data.rows[-1]))
    return data._replace(lines=data.lines[:-1], rows=data.rows[:-1])


def _is_data(line: bytes) -> bool:
    text = line.lstrip()
    return bool(text) and not text.startswith(b"%")


def _read_header(path: str | Path, head: _DataLines) -> _Header:
    pairs = zip(head.lines[:3], head.rows[:3], strict=True)
    parsed = [_parse_header_line(path, line, row) for line, row in pairs]
    if len(parsed) < 3:
        raise InputError(f"{path}: the header must have 3 lines, not {len(parsed)}")
    header = _Header(*parsed)
    fault = _find_header_fault(header)
    if fault is not None:
        line, text = fault
        raise InputError(
            f"{path}: row {head.rows[line]}: header line {line + 1}: {text} (a 3-line header must "
            "precede the samples)"
        )
    return header


def _parse_header_line(path: str | Path, line: bytes, row: int) -> list[float]:
    words = line.decode("latin-1").split()
    if len(words) != 6:
        text = f"a header line must have 6 values, not {len(words)}"
        if b"," in line or b";" in line:
            text += (
                " (not PSINS text? `sinsjax init record --from LOG` writes a [record] for others)"
            )
        raise InputError(f"{path}: row {row}: {text}")
    try:
        return [math.nan if word.lower() == "nan" else parse_number(word) for word in words]
    except ValueError as error:
        raise InputError(f"{path}: row {row}: header: {error}") from None


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


def _read_counts(path: str | Path, data: _DataLines) -> NDArray[np.int64]:
    if not data.lines:
        return np.empty((0, 6), np.int64)
    # loadtxt would accept "1.5" as an integer: any unusual character takes the slower path.
    if not b"".join(data.lines).translate(None, b"0123456789+- \t"):
        try:
            counts = np.loadtxt(data.lines, dtype=np.int64, comments=None, ndmin=2)
        except ValueError:
            pass
        else:
            if counts.shape[1] == 6:
                return counts
    return _read_counts_line_by_line(path, data)


def _read_counts_line_by_line(path: str | Path, data: _DataLines) -> NDArray[np.int64]:
    """Read counts slowly, to name the first invalid row."""
    counts = []
    for line, row in zip(data.lines, data.rows, strict=True):
        words = line.decode("latin-1").split()
        if len(words) != 6:
            end = CUT_OFF_HINT if data.is_last and row == data.rows[-1] and len(words) < 6 else ""
            raise InputError(
                f"{path}: row {row}: a sample must have 6 counts, not {len(words)}{end}"
            )
        for name, word in zip(_COUNT_COLUMNS, words, strict=True):
            fault = _describe_count_fault(word)
            if fault:
                raise InputError(f"{path}: row {row}: {name}: {fault}")
        counts.append([int(word) for word in words])
    return np.array(counts, dtype=np.int64)


def _describe_count_fault(word: str) -> str:
    try:
        parse_number(word)
    except ValueError as error:
        return str(error)
    if not re.fullmatch(r"[+-]?[0-9]+", word):
        return f"{word!r} is not an integer count"
    if len(word) > 20 or not _INT64.min <= int(word) <= _INT64.max:
        return f"a number of {len(word)} digits is too large for a count"
    return ""


def write_psins(
    record: Record,
    path: str | Path,
    gyro_scale_arcsec: float = 0.1,
    accel_scale_ug_s: float = 125.0,
) -> None:
    """Write a PSINS SIMU log.

    The running sums are rounded to counts, not the increments, so the error of a sum of any length
    is at most half a count. Values unknown to the record become nan in the header;
    velocity and longitude, which a record lacks, become 0.

    Args:
        record: the record; its g, or else standard gravity, scales the specific force.
        path: the file to write; written atomically.
        gyro_scale_arcsec: one gyro count, arcsec.
        accel_scale_ug_s: one accelerometer count, ug*s.

    Raises:
        InputError: a scale factor or the record cannot be written, or the target is not writable.
    """
    gravity = STANDARD_GRAVITY if record.gravity_m_per_s2 is None else record.gravity_m_per_s2
    place = (math.nan if v is None else v for v in (record.latitude_deg, record.height_m))
    latitude, height = place
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
