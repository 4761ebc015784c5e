"""Opening logs: named columns of numbers in delimited text, gzipped or not, or in Parquet.

In text the row with as many cells as the samples and no number names the columns, perhaps with a
row of units after it; else a comment does, or they are ``column_1``, ``column_2`` and so on. Rows
are counted from 1: in text as lines of the file, in Parquet as rows of the table.
"""

import csv
import gzip
import zlib
from array import array
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from itertools import chain, islice
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.csv
import pyarrow.parquet as pq

from sinsjax.errors import InputError
from sinsjax.messages import first_error_line, shorten, suggest_closest
from sinsjax.records.layout import FloatArray

MISSING_TEXT = "empty or not finite"

MIN_COLUMNS = 6
"""Columns of an inertial record."""

_MAX_MAGNITUDE = 1e30  # of numbers; squares and sums of such stay finite
_MAX_COLUMNS, _SHAPE_LINES, _BATCH_ROWS = 1000, 1000, 2**13
_COMMENTS = ("#", "%", "//")
_NO_TEXT = (
    "not text in UTF-8 (unpack it, or convert it: `iconv -f CP1252 -t UTF-8 LOG > NEW` for text of"
    " Windows; to CSV from MATLAB, HDF5, a ROS bag or a spreadsheet)"
)


class Table(NamedTuple):
    """An opened file with named columns, or columns in memory."""

    source: str  # name of the file, for messages
    data: pa.Table  # of numbers (float64), dates with time, or text
    row_number: Callable[[int], int]  # row of sample k, for messages
    format: str  # "csv" or "parquet"; "arrays" for columns in memory
    units: Mapping[str, str] = MappingProxyType({})  # cells of a row of units, by name
    comments: Sequence[str] = ()  # lines before the samples

    @property
    def names(self) -> list[str]:
        """The names of all columns, in order."""
        return [*self.data.column_names]

    @property
    def kinds(self) -> dict[str, str]:
        """What each column contains: "numbers", "dates with time" or "text"."""
        return {field.name: _kind(field.type) for field in self.data.schema}

    def read(self, wanted: Sequence[str], dates: Collection[str] = ()) -> list[FloatArray]:
        """Return the named columns, (T,) each, T > 0, with nan for missing values.

        Args:
            wanted: names of the columns.
            dates: columns of dates with time, in UTC unless they have a zone; they become seconds
                since 1970.
        """
        for name in wanted:
            if self.names.count(name) > 1:
                raise InputError(f"{self.source}: column {name!r} appears more than once")
            if name not in self.names:
                shown = shorten(", ".join(map(repr, self.names)), 300)
                hint = suggest_closest(name, self.names) or f"; the file has {shown}"
                raise InputError(f"{self.source}: no column {name!r}{hint}")
        if wanted and not len(self.data):
            raise InputError(f"{self.source}: no samples after the header")
        return [
            self._read(name, "dates with time" if name in dates else "numbers") for name in wanted
        ]

    def _read(self, name: str, wanted_kind: str) -> FloatArray:
        column = self.data[name]

        def refuse(k: int, text: str) -> InputError:
            place = f"{self.source}: row {self.row_number(k)}"
            return InputError(f"{place}: column {name!r}: {text}")

        if _kind(column.type) != wanted_kind:
            cells = (_kind(_numbers_or_dates(column.slice(k, 1)).type) for k in range(len(column)))
            k = next((k for k, found in enumerate(cells) if found != wanted_kind), 0)
            raise refuse(k, f"{shorten(str(column[k]), 24)!r} is not one of {wanted_kind}")
        if wanted_kind != "numbers":
            whole = column.cast(pa.timestamp("ns")).cast(pa.int64())
            column = pc.multiply(whole.cast(pa.float64(), safe=False), 1e-9)
        values = np.asarray(column.to_numpy())
        if (large := np.isfinite(values) & (np.abs(values) > _MAX_MAGNITUDE)).any():
            raise refuse(int(large.argmax()), f"out of range (beyond {_MAX_MAGNITUDE:g})")
        return values


def _kind(kind: pa.DataType) -> str:
    is_date = pa.types.is_timestamp(kind)
    return "numbers" if kind == pa.float64() else "dates with time" if is_date else "text"


def _numbers_or_dates(column: Any) -> Any:
    """Return a column as numbers or dates with time, if all of its cells are such."""
    if pa.types.is_string(column.type):
        column = pc.utf8_trim_whitespace(column)
        column = pc.if_else(pc.equal(column, ""), pa.scalar(None, pa.string()), column)
    if not pa.types.is_timestamp(column.type):
        for kind in (pa.float64(), pa.timestamp("ns"), pa.timestamp("ns", "UTC")):
            with suppress(pa.ArrowException):
                return pc.cast(column, kind, safe=not pa.types.is_integer(column.type))
    return column


def _join(parts: list[pa.Array]) -> pa.ChunkedArray:
    """Return the parts of a column as one, as text if they differ in type."""
    kinds = {part.type for part in parts}
    kind = kinds.pop() if len(kinds) == 1 else pa.string()
    return pa.chunked_array([part.cast(kind) for part in parts], kind)


def make_table(columns: Iterable[Any], names: Sequence[str]) -> pa.Table:
    """Return named columns of numbers, dates or text."""
    return pa.Table.from_arrays([_numbers_or_dates(column) for column in columns], [*names])


def is_number(text: str) -> bool:
    """Return whether a text is a number, or one of the words for none."""
    return bool(text) and _kind(_numbers_or_dates(pa.array([text])).type) == "numbers"


def open_log(path: str | Path, columns: Sequence[str] = (), skip_rows: int = 0) -> Table:
    """Open a Parquet file, recognised by its first bytes, or delimited text as `open_text`."""
    is_parquet = _read_first_four_bytes(path).startswith(b"PAR1")
    return open_parquet(path) if is_parquet else open_text(path, columns, skip_rows)


def _read_first_four_bytes(path: str | Path) -> bytes:
    """Return the first bytes of a file; raises InputError if it cannot be read."""
    try:
        if Path(path).is_fifo():
            raise InputError(f"{path}: cannot be read: a pipe (write it to a file first)")
        with open(path, "rb") as file:
            start = file.read(4)
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from None
    if not start:
        raise InputError(f"{path}: the file is empty")
    return start


def open_parquet(path: str | Path) -> Table:
    """Open a Parquet file."""
    try:
        data = pq.ParquetFile(path).read()
    except (pa.ArrowException, OSError):
        raise InputError(f"{path}: not a Parquet file, damaged or cut off") from None
    data = make_table(data.columns, data.column_names)
    return Table(str(path), data, lambda k: k + 1, "parquet")


# Text


class Line(NamedTuple):
    """A line that is neither blank nor a comment, without its ending, and its row, from 1."""

    row: int
    text: str


class _Shape(NamedTuple):
    """Where the columns of a text file are."""

    names: list[str]
    delimiter: str
    begin: int  # row of the first possible sample
    units: Sequence[str] = ()


def read_lines(path: str | Path) -> Iterator[str]:
    """Yield the lines of a text file, in UTF-8 or in UTF-16 with its mark, gzipped or not."""
    start = _read_first_four_bytes(path)
    encoding = "utf-16" if start.startswith((b"\xff\xfe", b"\xfe\xff")) else "utf-8-sig"
    opener: Callable[..., Any] = gzip.open if start.startswith(b"\x1f\x8b") else open
    try:
        with opener(path, "rt", encoding=encoding) as file:
            for line in file:
                if "\0" in line:
                    raise InputError(f"{path}: {_NO_TEXT}")
                yield line.rstrip("\r\n")
    except UnicodeError:
        raise InputError(f"{path}: {_NO_TEXT}") from None
    except (EOFError, zlib.error, OSError) as error:
        raise InputError(f"{path}: cannot be read: {first_error_line(error)}") from None


def data_lines(lines: Iterable[str], begin: int = 1) -> Iterator[Line]:
    """Yield the data among the lines of a file, from row ``begin`` on."""
    for row, line in enumerate(lines, 1):
        text = line.strip(" ")
        if text and row >= begin and not text.startswith(_COMMENTS):
            yield Line(row, text)


def open_text(path: str | Path, columns: Sequence[str] = (), skip_rows: int = 0) -> Table:
    """Open text with columns between commas, semicolons, tabs or blanks.

    Args:
        path: the file.
        columns: names of all columns of a file that does not name them.
        skip_rows: number of lines before the names, or before the samples.
    """
    lines = read_lines(path)
    start = [*islice(lines, skip_rows + _SHAPE_LINES)]
    data = [*data_lines(start, skip_rows + 1)]
    if not data:
        kind = "the file has only comments (remove their signs?) or blank lines"
        raise InputError(f"{path}: {f'no samples after row {skip_rows}' if skip_rows else kind}")
    comments = start[: data[0].row - 1]
    shape = _find_columns([*columns], data, comments)
    if len(shape.names) > _MAX_COLUMNS:
        raise InputError(f"{path}: {len(shape.names):,} columns (keep those of one IMU)")
    rows, parts = array("q"), [list[pa.Array]() for _ in shape.names]
    left = data_lines(chain(start, lines), shape.begin)
    while batch := [*islice(left, _BATCH_ROWS)]:
        rows.extend(line.row for line in batch)
        for part, column in zip(parts, _split_batch(path, shape, batch).columns, strict=True):
            part.extend(_numbers_or_dates(column).chunks)  # at once: numbers need less memory
    return Table(
        str(path),
        make_table(map(_join, parts), shape.names),
        rows.__getitem__,
        "csv",
        units=dict(zip(shape.names, shape.units, strict=False)),
        comments=comments,
    )


def _find_columns(columns: list[str], data: list[Line], comments: list[str]) -> _Shape:
    """Return where the columns of a file are, from its first lines of data."""
    if columns:
        return _Shape(columns, _find_delimiter(data[0].text), data[0].row)
    rows = [_split(line.text) for line in data]
    first = next((k for k, cells in enumerate(rows) if _are_samples(cells)), len(rows))
    samples = rows[min(first, len(rows) - 1)]
    widths = {len(samples), len(samples) - (samples[-1:] == [""])}  # a delimiter may end all lines
    named = [k for k in range(first) if len(rows[k]) in widths and not any(map(is_number, rows[k]))]
    delimiter = _find_delimiter(data[min(first, len(rows) - 1)].text)
    if first:
        place = named[0] if named else first - 1
        has_units = place + 1 in named and any(rows[place + 1])
        names = rows[place] + [""] * (max(widths) - len(rows[place]))
        units = rows[place + 1] if has_units else ()
        return _Shape(names, delimiter, data[place + has_units].row + 1, units=units)
    for line in reversed(comments):
        names = _split(line.strip().lstrip("#%/ \t"))
        if len(names) == len(samples) and not any(map(is_number, names)):
            return _Shape(names, delimiter, data[0].row)
    names = [f"column_{number}" for number in range(1, len(samples) + 1)]
    return _Shape(names, delimiter, data[0].row)


def _are_samples(cells: Sequence[str]) -> bool:
    """Return whether the cells of a row are those of a record or a reference."""
    numbers = sum(map(is_number, cells))
    return numbers >= MIN_COLUMNS or numbers >= max(3, len(cells) - 1)


def _find_delimiter(line: str) -> str:
    """Return the delimiter of a line, blanks if no other one separates four cells."""
    return next((delimiter for delimiter in ";\t," if line.count(delimiter) >= 3), " ")


def _normalise(line: str, delimiter: str) -> str:
    """Return a line with single blanks between columns, and with decimal points."""
    line = " ".join(line.split()) if delimiter == " " else line
    return line if delimiter == "," else line.replace(",", ".")


def _split(line: str) -> list[str]:
    """Return the cells of a line; [] for no delimited text."""
    delimiter = _find_delimiter(line)
    try:
        (cells,) = csv.reader([_normalise(line, delimiter)], delimiter=delimiter, strict=True)
    except csv.Error:
        return []
    return [cell.strip() for cell in cells]


def _split_batch(path: str | Path, shape: _Shape, data: list[Line]) -> pa.Table:
    """Return columns of text, named by their number, from consecutive lines."""
    count, bad = len(shape.names), list[Any]()
    keys = [*map(str, range(count))]
    text = "\n".join(_normalise(line.text, shape.delimiter) for line in data)

    def skip(row: Any) -> str:
        bad.append(row)
        return "skip"

    table = pa.csv.read_csv(
        pa.BufferReader(text.encode()),
        pa.csv.ReadOptions(column_names=keys, use_threads=False),
        pa.csv.ParseOptions(delimiter=shape.delimiter, invalid_row_handler=skip),
        pa.csv.ConvertOptions(column_types=dict.fromkeys(keys, pa.string())),
    )
    if bad:
        found = bad[0].actual_columns
        problem = f"the header has {count} columns, this row has {found}"
        hint = "if it is the last row: is the file cut off?"
        if shape.names[0] == "column_1":
            problem = f"{found} cells follow {count} in row {shape.begin}, and no header names them"
            hint = "keep the rows of one kind, and name their columns in [record] columns"
        raise InputError(f"{path}: row {data[bad[0].number - 1].row}: {problem} ({hint})")
    if len(table) != len(data):
        raise InputError(f"{path}: rows {data[0].row} to {data[-1].row}: a quote without its end")
    return table
