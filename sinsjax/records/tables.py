"""Number columns out of CSV and Parquet files, with the row of every number.

Rows are counted as a user sees them: in CSV the line of the file from 1 (the header included), in
Parquet the row of the table from 1.
"""

import csv
from collections.abc import Callable, Collection, Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute
import pyarrow.csv
import pyarrow.parquet as pq

from sinsjax.records.files import CUT_OFF, load, load_lines, number, number_or_nan
from sinsjax.records.layout import FloatArray
from sinsjax.records.stamps import from_iso
from sinsjax.types import InputError

MISSING = "empty or not finite"


class Table(NamedTuple):
    """A file with named columns, not read yet.

    Attributes:
        names: every column of the file, in order.
        read: (names, blanks=False, dates=()) gives the named columns as (T, n) float64, T > 0. What
            is missing is nan if ``blanks``, else refused; ``dates`` names the columns that hold
            dates with time, which become seconds.
        row: the row to name in a message about sample k.
    """

    names: list[str]
    read: Callable[..., FloatArray]
    row: Callable[[int], int]


def column_index(path: str | Path, names: list[str], wanted: Sequence[str]) -> list[int]:
    """Where the wanted columns are; raises InputError for a missing or doubled name."""
    for name in wanted:
        if name not in names:
            near = get_close_matches(name, names, n=3)
            hint = f"did you mean {' or '.join(map(repr, near))}?" if near else _listed(names)
            raise InputError(f"{path}: no column {name!r}; {hint}")
        if names.count(name) > 1:
            raise InputError(f"{path}: column {name!r} is there more than once")
    return [names.index(name) for name in wanted]


def _listed(names: list[str]) -> str:
    shown = ", ".join(map(repr, names[:12]))
    return f"the file has {shown}{', ...' if len(names) > 12 else ''}"


_COMMENTS = (b"#", b"%")
_BLANKS = ["", "nan", "NaN", "NAN"]


class _Text(NamedTuple):
    """A text file with columns: its lines, its delimiter and the rows of its samples."""

    path: str | Path
    lines: list[bytes]
    delimiter: str
    rows: list[int]

    def cells(self, row: int) -> list[str]:
        line = self.lines[row].decode(errors="replace")
        try:
            return next(csv.reader([line], delimiter=self.delimiter, strict=True))
        except csv.Error:
            kind = "comma" if self.delimiter == "," else "semicolon"
            raise InputError(f"{self.path}: row {row + 1}: not {kind}-separated text") from None


def open_csv(path: str | Path) -> Table:
    """Opens text with commas or semicolons between its columns.

    The first line that is not empty names the columns, and shows which of the two it is. Lines that
    begin with # or % are comments.
    """
    lines = load_lines(path)
    head = next((row for row, line in enumerate(lines) if line.strip() and _has_data(line)), None)
    if head is None:
        raise InputError(f"{path}: the file has only empty lines")
    delimiter = ";" if lines[head].count(b";") > lines[head].count(b",") else ","
    rows = [row for row, line in enumerate(lines) if line and row > head and _has_data(line)]
    text = _Text(path, lines, delimiter, rows)
    names = [name.strip() for name in text.cells(head)]

    def read(
        wanted: Sequence[str], *, blanks: bool = False, dates: Collection[str] = ()
    ) -> FloatArray:
        index = column_index(path, names, wanted)
        if not rows:
            raise InputError(f"{path}: no samples after the header")
        values = None if dates else _read_quickly(text, len(names), index, blanks=blanks)
        if values is None or not (blanks or np.isfinite(values).all()):
            plain = number_or_nan if blanks else number
            parsers = [from_iso if name in dates else plain for name in wanted]
            return _read_with_care(text, names, index, parsers)
        return values

    return Table(names, read, lambda k: rows[k] + 1)


def _has_data(line: bytes) -> bool:
    return not line.lstrip().startswith(_COMMENTS)


def _read_quickly(text: _Text, width: int, index: list[int], *, blanks: bool) -> FloatArray | None:
    keys = [str(column) for column in range(width)]
    wanted = [keys[column] for column in index]
    try:
        table = pa.csv.read_csv(
            pa.BufferReader(b"\n".join(text.lines[row] for row in text.rows)),
            read_options=pa.csv.ReadOptions(column_names=keys),
            parse_options=pa.csv.ParseOptions(delimiter=text.delimiter),
            convert_options=pa.csv.ConvertOptions(
                column_types=dict.fromkeys(wanted, pa.float64()),
                include_columns=wanted,
                null_values=_BLANKS if blanks else [],
            ),
        )
    except pa.ArrowInvalid:
        return None
    return np.column_stack([column.to_numpy() for column in table.columns])


def _read_with_care(
    text: _Text,
    names: list[str],
    index: list[int],
    parsers: Sequence[Callable[[str], float]],
) -> FloatArray:
    """The second, slower path: it names the first row that is wrong, and reads dates."""
    values = []
    for row in text.rows:
        cells = text.cells(row)
        if len(cells) != len(names):
            end = CUT_OFF if row == text.rows[-1] and len(cells) < len(names) else ""
            raise InputError(
                f"{text.path}: row {row + 1}: the header has {len(names)} columns, this row "
                f"{len(cells)}{end}"
            )
        for column, parse in zip(index, parsers, strict=True):
            try:
                values.append(parse(cells[column]))
            except ValueError as error:
                place = f"{text.path}: row {row + 1}: column {names[column]!r}"
                raise InputError(f"{place}: {error}") from None
    return np.array(values).reshape(len(text.rows), len(index))


def open_parquet(path: str | Path) -> Table:
    """Opens a Parquet file."""
    data = load(path)
    try:
        file = pq.ParquetFile(pa.BufferReader(data))
    except (pa.ArrowException, OSError):
        raise InputError(f"{path}: not a Parquet file, or cut off") from None
    schema = file.schema_arrow

    def read(
        wanted: Sequence[str], *, blanks: bool = False, dates: Collection[str] = ()
    ) -> FloatArray:
        index = column_index(path, schema.names, wanted)
        for name, column in zip(wanted, index, strict=True):
            kind = schema.field(column).type
            is_date = pa.types.is_timestamp(kind) or pa.types.is_string(kind)
            if name in dates and not is_date:
                raise InputError(f"{path}: column {name!r} holds {kind}, not dates with time")
            if name not in dates and not (pa.types.is_floating(kind) or pa.types.is_integer(kind)):
                raise InputError(f"{path}: column {name!r} holds {kind}, not numbers")
        if file.metadata.num_rows == 0:
            raise InputError(f"{path}: the file has no rows")
        try:
            table = file.read(columns=list(wanted))
        except (pa.ArrowException, OSError):
            raise InputError(f"{path}: damaged: its columns cannot be read") from None
        columns = (
            _dates(path, name, table[name]) if name in dates else table[name] for name in wanted
        )
        values = np.column_stack([column.to_numpy().astype(np.float64) for column in columns])
        bad = np.argwhere(~np.isfinite(values))
        if len(bad) and not blanks:
            row, column = bad[0]
            raise InputError(f"{path}: row {row + 1}: column {wanted[column]!r}: {MISSING}")
        return values

    return Table(schema.names, read, lambda k: k + 1)


def _dates(path: str | Path, name: str, column: pa.ChunkedArray) -> pa.ChunkedArray:
    """Seconds from 1970 of a column of dates with time, null where there is none."""
    if pa.types.is_timestamp(column.type):
        whole = column.cast(pa.timestamp("ns"), safe=False).cast(pa.int64())
        return pa.compute.multiply(whole.cast(pa.float64(), safe=False), 1e-9)
    seconds = []
    for row, text in enumerate(column.to_pylist()):
        try:
            seconds.append(None if text is None else from_iso(text))
        except ValueError as error:
            raise InputError(f"{path}: row {row + 1}: column {name!r}: {error}") from None
    return pa.chunked_array([pa.array(seconds, pa.float64())])
