"""Recorded inertial data: PSINS text, CSV, Parquet, and arrays in memory.

It takes a file or arrays and a `RecordLayout`, and gives a `Record`: increments over each sample in
SI units and right-front-up axes, with what is missing or doubtful in them. Every mistake of a user
raises `InputError` with one line that names the file and the row, column or key.
"""

from sinsjax.records.layout import PSINS_LAYOUT, Record, RecordLayout, check_layout, require_samples
from sinsjax.records.reference import Reference, read_reference
from sinsjax.records.sources import read_psins_counts, read_record, record_from_arrays

__all__ = [
    "PSINS_LAYOUT",
    "Record",
    "RecordLayout",
    "Reference",
    "check_layout",
    "read_psins_counts",
    "read_record",
    "read_reference",
    "record_from_arrays",
    "require_samples",
]
