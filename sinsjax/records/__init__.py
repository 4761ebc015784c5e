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
from sinsjax.records.tabular import record_from_table

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
]


def read_record(path: str | Path, layout: RecordLayout) -> Record:
    r"""Read a record in the layout's format: "psins", "csv" (delimited text) or "parquet".

    Examples:
        >>> from pathlib import Path
        >>> from sinsjax.records import RecordLayout
        >>> _ = Path("log.csv").write_text("gx,gy,gz,ax,ay,az\n" + 200 * "0,0,0,0,0,0.098\n")
        >>> columns = {"gyro_columns": ("gx", "gy", "gz"), "accel_columns": ("ax", "ay", "az")}
        >>> sinsjax.read_record("log.csv", RecordLayout("csv", **columns, rate_hz=100.0)).dv.shape
        (200, 3)
    """
    if layout.format == "psins":
        return read_psins(path, layout)
    check_layout(layout, str(path))
    if layout.format == "parquet":
        return record_from_table(layout, open_parquet(path))
    return record_from_table(layout, open_text(path, layout.columns, layout.skip_rows))
