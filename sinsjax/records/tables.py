"""Numeric columns of CSV and Parquet files, with the row of every number.

Rows are counted as a user sees them: in CSV the line of the file, from 1 and including the header;
in Parquet the row of the table, from 1.
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
from sinsjax.records.files import CUT_OFF, LARGEST, Lines, line_batches, load, number, number_or_nan
from sinsjax.records.layout import FloatArray
from sinsjax.records.stamps import from_iso

MISSING = "empty or not finite"


class ColumnTable(NamedTuple):
    """An opened file with named columns, not yet read.

    Attributes:
        names: all columns of the file, in order.
        read: (names, blanks=False, dates=()) gives the named columns, each (T,) float64, T > 0.
            Missing values are nan with ``blanks`` and otherwise rejected; ``dates`` names columns
            of dates with time, which become seconds. A table can be read once.
        row: the row to name in a message about sample k.
        schema: kinds of the columns, of a Parquet file alone.
    """

    names: list[str]
    read: Callable[..., list[FloatArray]]
    row: Callable[[int], int]
    schema: pa.Schema | None = None


def column_index(path: str | Path, names: list[str], wanted: Sequence[str]) -> list[int]:
    """Positions of the wanted columns; raises InputError for a missing or repeated name."""
    for name in wanted:
        if name not in names:
            near = get_close_matches(name, names, n=3)
            hint = f"did you mean {' or '.join(map(repr, near))}?" if near else _listed(names)
            raise InputError(f"{path}: no column {name!r}; {hint}")
        if names.count(name) > 1:
            raise InputError(f"{path}: column {name!r} appears more than once")
    return [names.index(name) for name in wanted]


def _listed(names: list[str]) -> str:
    shown = shorten(", ".join(map(repr, names[:12])))
    return f"the file has {shown}{', ...' if len(names) > 12 else ''}"


COMMENTS = (b"#", b"%")
"""What a line of comment begins with."""

DELIMITERS = {",": "comma", ";": "semicolon", "\t": "tab"}
"""What may separate the columns of a text, and what it is called."""

_BLANKS = ["", "nan", "NaN", "NAN"]
_BATCH_ROWS = 2**17


class _Text(NamedTuple):
    """Consecutive samples of a delimited text file.

    Attributes:
        path: the file.
        delimiter: of the columns.
        lines: one per sample.
        rows: row of each line in the file, from 1.
        ends: whether these are the last lines of the file.
    """

    path: str | Path
    delimiter: str
    lines: list[bytes]
    rows: list[int]
    ends: bool

    def cells(self, k: int) -> list[str]:
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
    batches = line_batches(path)
    for batch in batches:
        head = next((k for k, line in enumerate(batch.lines) if _names_columns(line)), None)
        if head is not None:
            break
    else:
        raise InputError(f"{path}: the file has only blank lines")
    title, row = batch.lines[head], batch.first + head
    delimiter = delimiter_of(title)
    names = [n.strip() for n in _Text(path, delimiter, [title], [row], batch.ends).cells(0)]
    todo = chain([Lines(row + 1, batch.lines[head + 1 :], batch.ends)], batches)
    rows: list[NDArray[np.int64]] = []

    def read(
        wanted: Sequence[str], *, blanks: bool = False, dates: Collection[str] = ()
    ) -> list[FloatArray]:
        columns = _Columns(
            names, column_index(path, names, wanted), blanks, [name in dates for name in wanted]
        )

        def values() -> Iterator[list[NDArray[Any]]]:
            for batch in todo:
                text = _samples(path, delimiter, batch)
                if text.rows:
                    rows.append(np.asarray(text.rows))
                    yield _read(text, columns)

        whole = _joined(values(), len(wanted))
        if not rows:
            raise InputError(f"{path}: no samples after the header")
        rows[:] = [np.concatenate(rows)]
        return whole

    return ColumnTable(names, read, lambda k: int(rows[0][k]))


def delimiter_of(title: bytes) -> str:
    """What separates the columns of a text whose first line of data this is."""
    return max(DELIMITERS, key=lambda mark: title.count(mark.encode()))


def _names_columns(line: bytes) -> bool:
    return bool(line.strip()) and _has_data(line)


def _has_data(line: bytes) -> bool:
    return not line.lstrip().startswith(COMMENTS)


def _samples(path: str | Path, delimiter: str, batch: Lines) -> _Text:
    numbered = enumerate(batch.lines, start=batch.first)
    rows = [row for row, line in numbered if line and _has_data(line)]
    lines = [batch.lines[row - batch.first] for row in rows]
    return _Text(path, delimiter, lines, rows, batch.ends)


def _joined(batches: Iterable[Sequence[NDArray[Any]]], width: int) -> list[FloatArray]:
    """The columns of all batches, joined so that a long record is never in memory twice."""
    whole = [np.empty(0) for _ in range(width)]
    for batch in batches:
        for column, more in zip(whole, batch, strict=True):
            # Resizing remaps memory pages instead of copying.
            column.resize(column.size + more.size, refcheck=False)
            column[column.size - more.size :] = more
    return whole


class _Columns(NamedTuple):
    """The columns to read from a text file.

    Attributes:
        names: all columns of the file.
        places: positions of the wanted columns among them.
        blanks: whether cells may be empty.
        dates: for each wanted column, whether it holds dates with time.
    """

    names: list[str]
    places: list[int]
    blanks: bool
    dates: list[bool]


def _read(text: _Text, columns: _Columns) -> list[NDArray[Any]]:
    values = _read_quickly(text, columns)
    if values is None or not (columns.blanks or all(np.isfinite(v).all() for v in values)):
        return _read_with_care(text, columns)
    if any((np.abs(v) > LARGEST).any() for v in values):  # the slower path names the row
        return _read_with_care(text, columns)
    return values


def _read_quickly(text: _Text, columns: _Columns) -> list[NDArray[Any]] | None:
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
                null_values=_BLANKS if columns.blanks else [],
            ),
        )
        pairs = zip(table.columns, columns.dates, strict=True)
        return [_seconds(column) if is_date else column.to_numpy() for column, is_date in pairs]
    except ValueError:  # including pyarrow's
        return None


def _seconds(dates: pa.ChunkedArray) -> FloatArray:
    return np.array([from_iso(date) for date in dates.to_pylist()])


def _read_with_care(text: _Text, columns: _Columns) -> list[NDArray[Any]]:
    """The slower path, which names the first invalid row."""
    plain = number_or_nan if columns.blanks else number
    parsers = [from_iso if is_date else plain for is_date in columns.dates]
    values, names = [], columns.names
    for k, row in enumerate(text.rows):
        cells = text.cells(k)
        if len(cells) != len(names):
            at_end = text.ends and row == text.rows[-1]
            end = CUT_OFF if at_end and len(cells) < len(names) else ""
            raise InputError(
                f"{text.path}: row {row}: the header has {len(names)} columns, this row has "
                f"{len(cells)}{end}"
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
    data = None if Path(path).is_file() else load(path)
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

        def values() -> Iterator[list[NDArray[Any]]]:
            before = 0
            for batch in file.iter_batches(_BATCH_ROWS, columns=list(wanted)):
                some = pa.Table.from_batches([batch])
                yield _numbers(path, some, wanted, dates, blanks=blanks, before=before)
                before += some.num_rows

        try:
            return _joined(values(), len(wanted))
        except (pa.ArrowException, OSError):
            raise InputError(f"{path}: damaged: its columns cannot be read") from None

    return ColumnTable(schema.names, read, lambda k: k + 1, schema)


def _numbers(
    path: str | Path,
    table: pa.Table,
    wanted: Sequence[str],
    dates: Collection[str],
    *,
    blanks: bool,
    before: int,
) -> list[NDArray[Any]]:
    """The wanted columns of a batch of rows, preceded by ``before`` others."""
    columns = (
        _dates(path, name, table[name], before) if name in dates else table[name] for name in wanted
    )
    values = [column.to_numpy().astype(np.float64) for column in columns]
    whole = np.column_stack(values)
    large = np.argwhere(np.isfinite(whole) & (np.abs(whole) > LARGEST))
    bad = large if len(large) else np.argwhere(~np.isfinite(whole))
    if len(large) or (len(bad) and not blanks):
        row, column = bad[0]
        what = f"out of range (beyond {LARGEST:g})" if len(large) else MISSING
        raise InputError(f"{path}: row {before + row + 1}: column {wanted[column]!r}: {what}")
    return values


def _dates(path: str | Path, name: str, column: pa.ChunkedArray, before: int) -> pa.ChunkedArray:
    """Seconds since 1970 of a column of dates with time, null where missing."""
    if pa.types.is_timestamp(column.type):
        whole = column.cast(pa.timestamp("ns"), safe=False).cast(pa.int64())
        return pa.compute.multiply(whole.cast(pa.float64(), safe=False), 1e-9)
    seconds = []
    for row, text in enumerate(column.to_pylist(), start=before + 1):
        try:
            seconds.append(None if text is None else from_iso(text))
        except ValueError as error:
            raise InputError(f"{path}: row {row}: column {name!r}: {error}") from None
    return pa.chunked_array([pa.array(seconds, pa.float64())])
