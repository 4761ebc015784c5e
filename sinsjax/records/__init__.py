"""Reading and writing recorded inertial data: PSINS text, CSV, Parquet, and arrays in memory.

Every reader returns a `Record`: increments over each sample in SI units and right-front-up axes.
Every user mistake raises `InputError` with one line that names the file and the row, column or key.
"""

from pathlib import Path

from sinsjax.errors import InputError
from sinsjax.records.arrays import record_from_arrays
from sinsjax.records.layout import (
    ACCEL_UNITS,
    GYRO_UNITS,
    PSINS_LAYOUT,
    TIME_UNITS,
    Record,
    RecordLayout,
    check_layout,
    require_span,
)
from sinsjax.records.psins import read_psins, write_psins
from sinsjax.records.reference import Reference, read_reference
from sinsjax.records.tabular import read_csv, read_parquet, write_csv, write_parquet

__all__ = [
    "ACCEL_UNITS",
    "GYRO_UNITS",
    "PSINS_LAYOUT",
    "TIME_UNITS",
    "RecordLayout",
    "Record",
    "Reference",
    "check_layout",
    "read_csv",
    "read_parquet",
    "read_psins",
    "read_record",
    "record_from_arrays",
    "read_reference",
    "require_span",
    "write_csv",
    "write_parquet",
    "write_psins",
]

_READERS = {"psins": read_psins, "csv": read_csv, "parquet": read_parquet}


def read_record(path: str | Path, layout: RecordLayout) -> Record:
    """Read a record in the layout's format.

    Examples:
        >>> from sinsjax.records import PSINS_LAYOUT, write_psins
        >>> write_psins(sinsjax.simulated_record("paper1_resets"), "car.imu")
        >>> sinsjax.read_record("car.imu", PSINS_LAYOUT).dv.shape  # m/s per sample
        (90000, 3)
    """
    if layout.format not in _READERS:
        known = ", ".join(_READERS)
        raise InputError(f"{path}: format: {layout.format!r} is not one of {known}")
    return _READERS[layout.format](path, layout)
