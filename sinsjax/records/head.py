"""The beginning of a file of named columns: its kind, names, comments, what its columns hold."""

import csv
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

import pyarrow as pa

from sinsjax.errors import InputError
from sinsjax.messages import shorten
from sinsjax.records.files import line_batches, number
from sinsjax.records.stamps import from_iso
from sinsjax.records.tables import (
    COMMENTS,
    DELIMITERS,
    ColumnTable,
    delimiter_of,
    open_csv,
    open_parquet,
)

_BYTES, _ROWS = 2**16, 20  # that are looked at


class Head(NamedTuple):
    """The beginning of a file.

    Attributes:
        format: "csv" or "parquet".
        names: of its columns.
        numbers: names of those that hold numbers.
        odd: what else the first rows hold in place of numbers, by name: row and cell.
        dates: names of those that hold dates with time.
        comments: lines of comment before the names.
        told: what kind of file it is, in words.
        kinds: of its columns by name, of a Parquet file alone.
    """

    format: str
    names: list[str]
    numbers: set[str]
    odd: dict[str, tuple[int, str]]
    dates: set[str]
    comments: list[str]
    told: str
    kinds: Mapping[str, pa.DataType] = MappingProxyType({})

    def open(self, path: Path) -> ColumnTable:
        """The file with its columns."""
        return open_parquet(path) if self.format == "parquet" else open_csv(path)


def head_of(path: Path) -> Head:
    """The beginning of a CSV or Parquet file.

    Raises:
        InputError: it cannot be read, or its columns have no names.
    """
    try:
        with path.open("rb") as file:
            mark = file.read(4)
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from None
    return _of_parquet(path) if mark == b"PAR1" else _of_csv(path)


def _of_parquet(path: Path) -> Head:
    schema = open_parquet(path).schema
    assert schema is not None
    kinds = {field.name: field.type for field in schema}
    return Head(
        format="parquet",
        names=list(kinds),
        numbers={
            name
            for name, kind in kinds.items()
            if pa.types.is_floating(kind) or pa.types.is_integer(kind)
        },
        odd={},
        dates={name for name, kind in kinds.items() if pa.types.is_timestamp(kind)},
        comments=[],
        told=f"Parquet, {len(kinds)} columns",
        kinds=kinds,
    )


def _of_csv(path: Path) -> Head:
    lines = next(line_batches(path, _BYTES)).lines
    data = [k for k, line in enumerate(lines) if line.strip() and not _is_comment(line)]
    comments = [line.decode(errors="replace") for line in lines[: data[0] if data else None]]
    if not data:
        raise InputError(f"{path}: has no line that names its columns")
    row, delimiter = data[0] + 1, delimiter_of(lines[data[0]])
    names, *rest = [_cells(lines[k], delimiter) for k in data[: _ROWS + 1]]
    where = f"{path}: row {row}"
    if len(names) < 6:
        text = f"{len(names)} columns between commas, semicolons or tabs: an IMU has six"
        raise InputError(f"{where}: {text} (blanks do not separate columns)")
    if all(map(_is_number, names)):
        named = any(len(_cells(line.encode(), delimiter)) == len(names) for line in comments)
        hint = (
            "its names stand in a comment: take the sign away that begins it"
            if named
            else "begin the file with a line such as time_s,gyro_x,gyro_y,gyro_z,accel_x,..."
        )
        raise InputError(f"{where}: numbers where the names of the columns belong ({hint})")
    odd: dict[str, tuple[int, str]] = {}
    for k, row_cells in zip(data[1:], rest, strict=False):
        for name, cell in zip(names, row_cells, strict=False):
            if cell and not _is_number(cell):
                odd.setdefault(name, (k + 1, cell))
    after = f", after {row - 1} lines of comment" if row > 1 else ""
    return Head(
        format="csv",
        names=names,
        numbers=set(names) - odd.keys(),
        odd=odd,
        dates={name for name, (_, cell) in odd.items() if _is_date(cell)},
        comments=comments,
        told=f"{DELIMITERS[delimiter]}-separated text, its {len(names)} names in row {row}{after}",
    )


def _is_comment(line: bytes) -> bool:
    return line.lstrip().startswith(COMMENTS)


def _cells(line: bytes, delimiter: str) -> list[str]:
    text = line.decode(errors="replace")
    return [cell.strip() for cell in next(csv.reader([text], delimiter=delimiter), [])]


def _is_number(cell: str) -> bool:
    try:
        number(cell)
    except ValueError:
        return cell.lower() in ("nan", "inf", "-inf")
    return True


def _is_date(cell: str) -> bool:
    try:
        from_iso(cell)
    except ValueError:
        return False
    return not _is_number(cell)


def listed(names: list[str]) -> str:
    """Names of columns for a message, as many as a line holds."""
    return shorten(", ".join(names), 120)
