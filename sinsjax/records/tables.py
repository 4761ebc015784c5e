"""Numeric columns of CSV and Parquet files, with the row of every number.

Rows are counted from 1: in CSV as lines of the file, including the header; in Parquet as rows of
the table.
"""

import csv
import os
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from difflib import get_close_matches
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute
import pyarrow.csv
import pyarrow.parquet as pq
from numpy.typing import NDArray

from sinsjax.errors import InputError
from sinsjax.messages import shorten
from sinsjax.records.files import (
    CUT_OFF_HINT,
    MAX_MAGNITUDE,
    Lines,
    parse_number,
    parse_number_or_nan,
    read_bytes,
    read_line_batches,
)
from sinsjax.records.layout import FloatArray
from sinsjax.records.stamps import parse_iso

MISSING_TEXT = "empty or not finite"


class ColumnTable(NamedTuple):
    """An opened file with named columns that is not yet read.

    Attributes:
        names: all columns of the file, in order.
        read: (names, blanks=False, dates=()) returns the named columns, each (T,) float64, T > 0.
            Missing values are nan with ``blanks`` and otherwise rejected; ``dates`` names columns
            of dates with time, which become seconds. A table can be read only once.
        row_number: function of sample k that returns its row, for messages.
        schema: types of the columns, for Parquet only.
    """

    names: list[str]
    read: Callable[..., list[FloatArray]]
    row_number: Callable[[int], int]
    schema: pa.Schema | None = None


def find_columns(path: str | Path, names: list[str], wanted: Sequence[str]) -> list[int]:
    """Return the positions of the wanted columns; raises InputError if missing or repeated."""
    for name in wanted:
        if name not in names:
            near = get_close_matches(name, names, n=3)
            hint = f"did you mean {' or '.join(map(repr, near))}?" if near else _format_names(names)
            raise InputError(f"{path}: no column {name!r}; {hint}")
        if names.count(name) > 1:
            raise InputError(f"{path}: column {name!r} appears more than once")
    return [names.index(name) for name in wanted]


def _format_names(names: list[str]) -> str:
    text = shorten(", ".join(map(repr, names[:12])))
    return f"the file has {text}{', ...' if len(names) > 12 else ''}"


COMMENTS = (b"#", b"%")
"""Beginnings of comment lines."""

DELIMITERS = {",": "comma", ";": "semicolon", "\t": "tab"}
"""Possible delimiters of columns, with their names."""

_BLANK_CELLS = ["", "nan", "NaN", "NAN"]
_BATCH_ROWS = 2**17


class _TextRows(NamedTuple):
    """Consecutive samples of a delimited text file.

    Attributes:
        path: the file.
        delimiter: delimiter of the columns.
        lines: one per sample.
        rows: row of each line in the file, from 1.
        is_last: whether these are the last lines of the file.
    """

    path: str | Path
    delimiter: str
    lines: list[bytes]
    rows: list[int]
    is_last: bool

    def split_cells(self, k: int) -> list[str]:
        line = self.lines[k].decode(errors="replace")
        try:
            return next(csv.reader([line], delimiter=self.delimiter, strict=True))
        except csv.Error:
            kind = DELIMITERS[self.delimiter]
            raise InputError(
                f"{self.path}: row {self.rows[k]}: not {kind}-separated text"
            ) from None


def open_csv(path: str | Path) -> ColumnTable:
    """Open comma-, semicolon- or tab-separated text.

    The first line that is not blank names the columns and determines the delimiter. Lines that
    begin with # or % are comments.
    """
    batches = read_line_batches(path)
    for batch in batches:
        head = next((k for k, line in enumerate(batch.lines) if _is_header(line)), None)
        if head is not None:
            break
    else:
        raise InputError(f"{path}: the file has only blank lines")
    header, row = batch.lines[head], batch.first + head
    delimiter = find_delimiter(header)
    names = [
        n.strip() for n in _TextRows(path, delimiter, [header], [row], batch.is_last).split_cells(0)
    ]
    remaining = chain([Lines(row + 1, batch.lines[head + 1 :], batch.is_last)], batches)
    rows: list[NDArray[np.int64]] = []

    def read(
        wanted: Sequence[str], *, blanks: bool = False, dates: Collection[str] = ()
    ) -> list[FloatArray]:
        columns = _WantedColumns(
            names, find_columns(path, names, wanted), blanks, [name in dates for name in wanted]
        )

        def values() -> Iterator[list[NDArray[Any]]]:
            for batch in remaining:
                text = _select_samples(path, delimiter, batch)
                if text.rows:
                    rows.append(np.asarray(text.rows))
                    yield _read_batch(text, columns)

        whole = _join_batches(values(), len(wanted))
        if not rows:
            raise InputError(f"{path}: no samples after the header")
        rows[:] = [np.concatenate(rows)]
        return whole

    return ColumnTable(names, read, lambda k: int(rows[0][k]))


def find_delimiter(header: bytes) -> str:
    """Return the delimiter of a text's columns, from its first line of data."""
    return max(DELIMITERS, key=lambda delimiter: header.count(delimiter.encode()))


def _is_header(line: bytes) -> bool:
    return bool(line.strip()) and _is_data(line)


def _is_data(line: bytes) -> bool:
    return not line.lstrip().startswith(COMMENTS)


def _select_samples(path: str | Path, delimiter: str, batch: Lines) -> _TextRows:
    numbered = enumerate(batch.lines, start=batch.first)
    rows = [row for row, line in numbered if line and _is_data(line)]
    lines = [batch.lines[row - batch.first] for row in rows]
    return _TextRows(path, delimiter, lines, rows, batch.is_last)


def _join_batches(batches: Iterable[Sequence[NDArray[Any]]], width: int) -> list[FloatArray]:
    """Join the columns of all batches without a second copy of a long record in memory."""
    whole = [np.empty(0) for _ in range(width)]
    for batch in batches:
        for column, part in zip(whole, batch, strict=True):
            # Resizing remaps memory pages instead of copying.
            column.resize(column.size + part.size, refcheck=False)
            column[column.size - part.size :] = part
    return whole


class _WantedColumns(NamedTuple):
    """The columns to read from a text file.

    Attributes:
        names: all columns of the file.
        places: positions of the wanted columns among them.
        blanks: whether cells may be empty.
        dates: for each wanted column, whether it contains dates with time.
    """

    names: list[str]
    places: list[int]
    blanks: bool
    dates: list[bool]


def _read_batch(text: _TextRows, columns: _WantedColumns) -> list[NDArray[Any]]:
    values = _read_fast(text, columns)
    if values is None or not (columns.blanks or all(np.isfinite(v).all() for v in values)):
        return _read_row_by_row(text, columns)
    if any((np.abs(v) > MAX_MAGNITUDE).any() for v in values):  # the slower path names the row
        return _read_row_by_row(text, columns)
    return values


def _read_fast(text: _TextRows, columns: _WantedColumns) -> list[NDArray[Any]] | None:
    keys = [str(column) for column in range(len(columns.names))]
    wanted = [keys[column] for column in columns.places]
    kinds = [pa.string() if is_date else pa.float64() for is_date in columns.dates]
    try:
        table = pa.csv.read_csv(
            pa.BufferReader(b"\n".join(text.lines)),
            read_options=pa.csv.ReadOptions(column_names=keys),
            parse_options=pa.csv.ParseOptions(delimiter=text.delimiter),
            convert_options=pa.csv.ConvertOptions(
                column_types=dict(zip(wanted, kinds, strict=True)),
                include_columns=wanted,
                null_values=_BLANK_CELLS if columns.blanks else [],
            ),
        )
        pairs = zip(table.columns, columns.dates, strict=True)
        return [
            _iso_to_seconds(column) if is_date else column.to_numpy() for column, is_date in pairs
        ]
    except ValueError:  # including pyarrow's
        return None


def _iso_to_seconds(dates: pa.ChunkedArray) -> FloatArray:
    return np.array([parse_iso(date) for date in dates.to_pylist()])


def _read_row_by_row(text: _TextRows, columns: _WantedColumns) -> list[NDArray[Any]]:
    """Read rows slowly, to name the first invalid one."""
    parse_plain = parse_number_or_nan if columns.blanks else parse_number
    parsers = [parse_iso if is_date else parse_plain for is_date in columns.dates]
    values, names = [], columns.names
    for k, row in enumerate(text.rows):
        cells = text.split_cells(k)
        if len(cells) != len(names):
            at_end = text.is_last and row == text.rows[-1]
            hint = CUT_OFF_HINT if at_end and len(cells) < len(names) else ""
            raise InputError(
                f"{text.path}: row {row}: the header has {len(names)} columns, this row has "
                f"{len(cells)}{hint}"
            )
        for column, parse in zip(columns.places, parsers, strict=True):
            try:
                values.append(parse(cells[column]))
            except ValueError as error:
                place = f"{text.path}: row {row}: column {names[column]!r}"
                raise InputError(f"{place}: {error}") from None
    return list(np.array(values).reshape(len(text.rows), len(columns.places)).T)


def open_parquet(path: str | Path) -> ColumnTable:
    """Open a Parquet file."""
    # A pipe or the like does not support random access, so it is loaded whole.
    data = None if Path(path).is_file() else read_bytes(path)
    try:
        source = pa.OSFile(os.fsencode(path)) if data is None else pa.BufferReader(data)
        if source.size() == 0:
            raise InputError(f"{path}: the file is empty")
        file = pq.ParquetFile(source)
    except PermissionError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from None
    except (pa.ArrowException, OSError):
        raise InputError(f"{path}: not a Parquet file, or cut off") from None
    schema = file.schema_arrow

    def read(
        wanted: Sequence[str], *, blanks: bool = False, dates: Collection[str] = ()
    ) -> list[FloatArray]:
        index = find_columns(path, schema.names, wanted)
        for name, column in zip(wanted, index, strict=True):
            kind = schema.field(column).type
            is_date = pa.types.is_timestamp(kind) or pa.types.is_string(kind)
            if name in dates and not is_date:
                raise InputError(f"{path}: column {name!r} contains {kind}, not dates with time")
            if name not in dates and not (pa.types.is_floating(kind) or pa.types.is_integer(kind)):
                raise InputError(f"{path}: column {name!r} contains {kind}, not numbers")
        if file.metadata.num_rows == 0:
            raise InputError(f"{path}: the file has no rows")

        def values() -> Iterator[list[NDArray[Any]]]:
            rows_before = 0
            for batch in file.iter_batches(_BATCH_ROWS, columns=list(wanted)):
                part = pa.Table.from_batches([batch])
                yield _to_floats(path, part, wanted, dates, blanks=blanks, rows_before=rows_before)
                rows_before += part.num_rows

        try:
            return _join_batches(values(), len(wanted))
        except (pa.ArrowException, OSError):
            raise InputError(f"{path}: damaged: its columns cannot be read") from None

    return ColumnTable(schema.names, read, lambda k: k + 1, schema)


def _to_floats(
    path: str | Path,
    table: pa.Table,
    wanted: Sequence[str],
    dates: Collection[str],
    *,
    blanks: bool,
    rows_before: int,
) -> list[NDArray[Any]]:
    """Return the wanted columns of a batch of rows, preceded by ``rows_before`` others."""
    columns = (
        _dates_to_seconds(path, name, table[name], rows_before) if name in dates else table[name]
        for name in wanted
    )
    values = [column.to_numpy().astype(np.float64) for column in columns]
    whole = np.column_stack(values)
    large = np.argwhere(np.isfinite(whole) & (np.abs(whole) > MAX_MAGNITUDE))
    bad = large if len(large) else np.argwhere(~np.isfinite(whole))
    if len(large) or (len(bad) and not blanks):
        row, column = bad[0]
        problem = f"out of range (beyond {MAX_MAGNITUDE:g})" if len(large) else MISSING_TEXT
        raise InputError(
            f"{path}: row {rows_before + row + 1}: column {wanted[column]!r}: {problem}"
        )
    return values


def _dates_to_seconds(
    path: str | Path, name: str, column: pa.ChunkedArray, rows_before: int
) -> pa.ChunkedArray:
    """Return a column of dates with time as seconds since 1970, null if missing."""
    if pa.types.is_timestamp(column.type):
        whole = column.cast(pa.timestamp("ns"), safe=False).cast(pa.int64())
        return pa.compute.multiply(whole.cast(pa.float64(), safe=False), 1e-9)
    seconds = []
    for row, text in enumerate(column.to_pylist(), start=rows_before + 1):
        try:
            seconds.append(None if text is None else parse_iso(text))
        except ValueError as error:
            raise InputError(f"{path}: row {row}: column {name!r}: {error}") from None
    return pa.chunked_array([pa.array(seconds, pa.float64())])
