"""PSINS SIMU log text: three header lines, then six integer counts per sample.

The format of the PSINS toolbox (G. Yan, NWPU). Lines that start with % are comments. Header: pitch,
roll, yaw (deg), VE, VN, VU (m/s); latitude, longitude (deg), height (m), t0 (s), interval (ms), g
(m/s^2); scale factors, three gyro (arcsec) and three accelerometer (ug*s, in that g).
"""

import math
from itertools import islice
from pathlib import Path

import numpy as np

from sinsjax.errors import InputError
from sinsjax.messages import shorten
from sinsjax.records.layout import (
    PSINS_LAYOUT,
    Record,
    RecordLayout,
    check_layout,
    resolve_rate,
)
from sinsjax.records.reader import Line, data_lines, is_number, open_text, read_lines
from sinsjax.records.tabular import record_from_table
from sinsjax.units import ARCSEC, micro_g

_COUNT_COLUMNS = tuple(f"{sensor} {axis}" for sensor in ("gyro", "accelerometer") for axis in "xyz")


def is_psins(path: str | Path) -> bool:
    """Return whether the first three lines of data of a file are six numbers each."""
    return sum(map(_is_header, _header_lines(path))) == 3


def _header_lines(path: str | Path) -> list[Line]:
    return [*islice(data_lines(read_lines(path)), 3)]


def _is_header(line: Line) -> bool:
    words = line.text.split()
    return len(words) == 6 and all(map(is_number, words)) and "inf" not in line.text.lower()


def read_psins(path: str | Path, layout: RecordLayout = PSINS_LAYOUT) -> Record:
    """Read a PSINS SIMU log.

    The header's g scales the accelerometer counts to m/s. An attitude, latitude or height of nan in
    the header is unknown. Of the layout, axes_order, mounting_deg and rate_hz are used; the rate
    must agree with the header's interval.
    """
    check_layout(layout, str(path))
    lines = _header_lines(path)

    def refuse(number: int, problem: str) -> InputError:
        return InputError(f"{path}: row {lines[number].row}: header line {number + 1}: {problem}")

    hint = "not PSINS text? `sinsjax init record --from LOG` writes a [record] for others"
    for number, line in enumerate(lines):
        if len(lines) < 3 or not _is_header(line):
            raise refuse(number, f"must have 6 numbers: {shorten(line.text, 60)!r} ({hint})")
    pose, place, scale = (np.array([*map(float, line.text.split())]) for line in lines)
    pitch, roll, yaw = pose[:3].tolist()
    latitude, _, height, t0, interval_ms, gravity = place.tolist()
    # Lines in the wrong order, or a missing one, are detected here.
    if not (interval_ms > 0 and 9 < gravity < 11 and not abs(latitude) >= 90 and t0 == t0):
        raise refuse(
            1,
            f"latitude {latitude:g} deg, t0 {t0:g} s, interval {interval_ms:g} ms and g"
            f" {gravity:g} m/s^2 are no place and clock (a 3-line header must precede the samples)",
        )
    if not (scale > 0).all():
        raise refuse(2, f"scale factors must be positive, not {scale.min():g}")
    layout = layout._replace(
        gyro_columns=_COUNT_COLUMNS[:3],
        accel_columns=_COUNT_COLUMNS[3:],
        gyro_scale=tuple(scale[:3] * ARCSEC),
        accel_scale=tuple(scale[3:] * micro_g(gravity)),
        rate_hz=resolve_rate(1e3 / interval_ms, layout, 0.0, f"{path}: row {lines[1].row}"),
    )
    record = record_from_table(layout, open_text(path, _COUNT_COLUMNS, skip_rows=lines[2].row))
    return record._replace(
        t0_s=t0,
        latitude_deg=None if math.isnan(latitude) else latitude,
        height_m=None if math.isnan(height) else height,
        attitude_deg=None if math.isnan(pitch + roll + yaw) else (pitch, roll, yaw),
        gravity_m_per_s2=gravity,
    )
