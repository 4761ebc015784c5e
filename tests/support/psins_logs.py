"""Writing records as PSINS SIMU logs."""

import math
from pathlib import Path

import numpy as np

from sinsjax.records import Record
from sinsjax.units import ARCSEC, STANDARD_GRAVITY, micro_g


def write_psins(
    record: Record, path: Path, gyro_arcsec: float = 0.1, accel_ug_s: float = 125.0
) -> None:
    """Write a record in counts of some size; running sums are rounded, not the increments."""
    gravity = record.gravity_m_per_s2 or STANDARD_GRAVITY
    latitude, height = (
        math.nan if x is None else x for x in (record.latitude_deg, record.height_m)
    )
    header = [
        [*(record.attitude_deg or [math.nan] * 3), 0.0, 0.0, 0.0],
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
