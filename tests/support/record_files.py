"""Writing records as PSINS SIMU logs, as delimited text and as Parquet."""

import math

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet as pq

from sinsjax.records.layout import is_rate, parse_axes_order, unit_factor
from sinsjax.units import ARCSEC, STANDARD_GRAVITY, micro_g


def write_psins(record, path, gyro_arcsec=0.1, accel_ug_s=125.0):
    """Write a record in counts of some size; running sums are rounded, not the increments."""
    gravity = record.gravity_m_per_s2 or STANDARD_GRAVITY
    latitude, height = (
        math.nan if x is None else x for x in (record.latitude_deg, record.height_m)
    )
    header = [
        [*[math.nan] * 3, 0.0, 0.0, 0.0],
        [latitude, 0.0, height, record.t0_s, 1e3 / record.rate_hz, gravity],
        [gyro_arcsec] * 3 + [accel_ug_s] * 3,
    ]
    quanta = np.repeat([gyro_arcsec * ARCSEC, accel_ug_s * micro_g(gravity)], 3)
    sums = np.rint(np.cumsum(np.hstack([record.dtheta, record.dv]), axis=0) / quanta)
    counts = np.diff(sums.astype(np.int64), axis=0, prepend=0)
    with path.open("w") as file:
        file.write("% PSINS-format SIMU log file.\n")
        file.writelines(" ".join(map(repr, map(float, line))) + "\n" for line in header)
        np.savetxt(file, counts, fmt="%d")


def write_record(record, path, layout):
    """Write a record in the layout's columns, units and axes."""
    time_s = record.t0_s + np.arange(1, len(record.dv) + 1) / record.rate_hz
    columns = {layout.time_column: time_s} if layout.time_column else {}
    pairs = zip((record.dtheta, record.dv), layout.sensors, strict=True)
    for increments, (names, unit, scale) in pairs:
        values = from_body_axes(increments, layout.axes_order)
        values = values * (record.rate_hz if is_rate(unit) else 1.0)
        columns |= zip(names, (values / (unit_factor(unit) * np.array(scale))).T, strict=True)
    write = pq.write_table if layout.format == "parquet" else pa.csv.write_csv
    write(pa.table(columns), path)


def from_body_axes(values, order):
    """Transform (T, 3) vectors from right-front-up to a record's axes."""
    index, signs = parse_axes_order(order)
    return (values * signs)[:, np.argsort(index)]
