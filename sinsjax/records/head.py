"""The beginning of a file with named columns: format, names, comments and types of columns."""

import csv
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

import pyarrow as pa

from sinsjax.errors import InputError
from sinsjax.messages import shorten
from sinsjax.records.files import parse_number, read_line_batches
from sinsjax.records.stamps import parse_iso
from sinsjax.records.tables import (
    COMMENTS,
    DELIMITERS,
    ColumnTable,
    find_delimiter,
    open_csv,
    open_parquet,
)

_BYTES, _ROWS = 2**16, 20  # examined part of a file


class Head(NamedTuple):
    """The beginning of a file.

    Attributes:
        format: "csv" or "parquet".
        names: names of its columns.
        numbers: names of the numeric columns.
        non_numbers: first cell that is not a number, by name: row and cell.
        dates: names of the columns of dates with time.
        comments: comment lines before the names.
        description: description of the file in words.
        column_types: types of the columns by name, for Parquet only.
    """

    format: str
    names: list[str]
    numbers: set[str]
    non_numbers: dict[str, tuple[int, str]]
    dates: set[str]
    comments: list[str]
    description: str
    column_types: Mapping[str, pa.DataType] = MappingProxyType({})

    def open_table(self, path: Path) -> ColumnTable:
        """Open the file with its columns."""
        return open_parquet(path) if self.format == "parquet" else open_csv(path)


def read_head(path: Path) -> Head:
    """Read the beginning of a CSV or Parquet file.

    Raises:
        InputError: it cannot be read, or its columns have no names.
    """
    try:
        with path.open("rb") as file:
            first_bytes = file.read(4)
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from None
    return _read_parquet_head(path) if first_bytes == b"PAR1" else _read_csv_head(path)


def _read_parquet_head(path: Path) -> Head:
    schema = open_parquet(path).schema
    assert schema is not None
    types = {field.name: field.type for field in schema}
    return Head(
        format="parquet",
        names=list(types),
        numbers={
            name
            for name, type_ in types.items()
            if pa.types.is_floating(type_) or pa.types.is_integer(type_)
        },
        non_numbers={},
        dates={name for name, type_ in types.items() if pa.types.is_timestamp(type_)},
        comments=[],
        description=f"Parquet, {len(types)} columns",
        column_types=types,
    )


def _read_csv_head(path: Path) -> Head:
    lines = next(read_line_batches(path, _BYTES)).lines
    data = [k for k, line in enumerate(lines) if line.strip() and not _is_comment(line)]
    comments = [line.decode(errors="replace") for line in lines[: data[0] if data else None]]
    if not data:
        raise InputError(f"{path}: has no header line with column names (write one)")
    row, delimiter = data[0] + 1, find_delimiter(lines[data[0]])
    names, *rest = [_split_cells(lines[k], delimiter) for k in data[: _ROWS + 1]]
    place = f"{path}: row {row}"
    if len(names) < 6:
        text = f"{len(names)} columns between commas, semicolons or tabs: an IMU has six"
        raise InputError(f"{place}: {text} (blanks do not separate columns)")
    if all(map(_is_number, names)):
        is_commented = any(
            len(_split_cells(line.encode(), delimiter)) == len(names) for line in comments
        )
        hint = (
            "its names are in a comment: remove the comment mark"
            if is_commented
            else "begin the file with a line such as time_s,gyro_x,gyro_y,gyro_z,accel_x,..."
        )
        raise InputError(f"{place}: numbers instead of column names ({hint})")
    non_numbers: dict[str, tuple[int, str]] = {}
    for k, row_cells in zip(data[1:], rest, strict=False):
        for name, cell in zip(names, row_cells, strict=False):
            if cell and not _is_number(cell):
                non_numbers.setdefault(name, (k + 1, cell))
    comment_text = f", after {row - 1} lines of comment" if row > 1 else ""
    return Head(
        format="csv",
        names=names,
        numbers=set(names) - non_numbers.keys(),
        non_numbers=non_numbers,
        dates={name for name, (_, cell) in non_numbers.items() if _is_date(cell)},
        comments=comments,
        description=f"{DELIMITERS[delimiter]}-separated text, its {len(names)} names in row"
        f" {row}{comment_text}",
    )


def _is_comment(line: bytes) -> bool:
    return line.lstrip().startswith(COMMENTS)


def _split_cells(line: bytes, delimiter: str) -> list[str]:
    text = line.decode(errors="replace")
    return [cell.strip() for cell in next(csv.reader([text], delimiter=delimiter), [])]


def _is_number(cell: str) -> bool:
    try:
        parse_number(cell)
    except ValueError:
        return cell.lower() in ("nan", "inf", "-inf")
    return True


def _is_date(cell: str) -> bool:
    try:
        parse_iso(cell)
    except ValueError:
        return False
    return not _is_number(cell)


def format_names(names: list[str]) -> str:
    """Return column names for a message, shortened to one line."""
    return shorten(", ".join(names), 120)
