"""Reading and writing recorded inertial data: PSINS text, CSV, Parquet, and arrays in memory.

Every reader returns a `Record`: increments over each sample in SI units and right-front-up axes.
Every user mistake raises `InputError` with one line that names the file and the row, column or key.
"""

from pathlib import Path

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
from sinsjax.records.psins import read_psins
from sinsjax.records.reader import open_parquet, open_text
from sinsjax.records.reference import Reference, read_reference
from sinsjax.records.tabular import record_from_table, write_record

__all__ = [
    "ACCEL_UNITS",
    "GYRO_UNITS",
    "PSINS_LAYOUT",
    "TIME_UNITS",
    "Record",
    "RecordLayout",
    "Reference",
    "check_layout",
    "read_psins",
    "read_record",
    "read_reference",
    "record_from_arrays",
    "require_span",
    "write_record",
]


def read_record(path: str | Path, layout: RecordLayout) -> Record:
    """Read a record in the layout's format: "psins", "csv" (delimited text) or "parquet".

    Examples:
        >>> from sinsjax.records import write_record
        >>> layout = sinsjax.load_study("csv_log").record.layout(rate_hz=100.0)
        >>> write_record(sinsjax.simulated_record("paper1_resets"), "drive.csv", layout)
        >>> sinsjax.read_record("drive.csv", layout).dv.shape  # m/s per sample
        (90000, 3)
    """
    if layout.format == "psins":
        return read_psins(path, layout)
    check_layout(layout, str(path))
    if layout.format == "parquet":
        return record_from_table(layout, open_parquet(path))
    return record_from_table(layout, open_text(path, layout.columns, layout.skip_rows))
