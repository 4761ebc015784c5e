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
from sinsjax.records.reader import data_lines, is_number, open_text, read_lines
from sinsjax.records.tabular import record_from_table
from sinsjax.units import ARCSEC, micro_g

_COUNT_COLUMNS = tuple(f"{sensor} {axis}" for sensor in ("gyro", "accelerometer") for axis in "xyz")


def read_psins(path: str | Path, layout: RecordLayout = PSINS_LAYOUT) -> Record:
    """Read a PSINS SIMU log.

    The header's g scales the accelerometer counts to m/s. A latitude or height of nan is unknown.
    Of the layout, axes_order and rate_hz are used; the rate must agree with the header's interval.
    """
    check_layout(layout, str(path))
    lines = [*islice(data_lines(read_lines(path)), 3)]

    def refuse(number: int, problem: str) -> InputError:
        return InputError(f"{path}: row {lines[number].row}: header line {number + 1}: {problem}")

    hint = "not PSINS text? `sinsjax init record --from LOG` writes a [record] for others"
    for number, line in enumerate(lines):
        words = line.text.split()
        if len(lines) < 3 or len(words) != 6 or not all(map(is_number, words)):
            raise refuse(number, f"must have 6 numbers: {shorten(line.text, 60)!r} ({hint})")
    _, place, scale = (np.array([*map(float, line.text.split())]) for line in lines)
    latitude, _, height, t0, interval_ms, gravity = place.tolist()
    # Lines in the wrong order, or a missing one, are detected here.
    is_clock = 0 < interval_ms < math.inf and math.isfinite(t0)
    if not (is_clock and 9 < gravity < 11 and not abs(latitude) >= 90):
        raise refuse(
            1,
            f"latitude {latitude:g} deg, t0 {t0:g} s, interval {interval_ms:g} ms and g"
            f" {gravity:g} m/s^2 are no place and clock (a 3-line header must precede the samples)",
        )
    if not (np.isfinite(scale) & (scale > 0)).all():
        raise refuse(2, f"scale factors must be positive and finite, not {scale.min():g}")
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
        gravity_m_per_s2=gravity,
    )
