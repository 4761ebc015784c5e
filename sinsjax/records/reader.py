"""Opening logs: named columns of numbers in delimited text, gzipped or not, or in Parquet.

In text the first line that is no comment names the columns, or a comment before the samples does.
Lines before it with too few cells are skipped, and so is a row of units after it. The columns of a
file without names are ``column_1``, ``column_2`` and so on, or have the names of ``[record]
columns``. Rows are counted from 1: in text as lines of the file, in Parquet as rows of the table.
"""

import csv
import gzip
import math
import re
import zlib
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from itertools import islice, pairwise
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.csv
import pyarrow.parquet as pq
from numpy.typing import NDArray

from sinsjax.errors import InputError
from sinsjax.messages import shorten, suggest_closest
from sinsjax.records.layout import FloatArray

MISSING_TEXT = "empty or not finite"

MIN_COLUMNS = 6
"""Columns of an inertial record."""

_MAX_MAGNITUDE = 1e30  # of numbers; squares and sums of such stay finite
_MAX_COLUMNS, _HEAD_ROWS, _SHAPE_ROWS, _BATCH_ROWS = 1000, 20, 200, 2**13
_COMMENTS = ("#", "%", "//")
_NO_TEXT = (
    "not text in UTF-8 (unpack it, or convert it: `iconv -f CP1252 -t UTF-8 LOG > NEW` for text of"
    " Windows; to CSV from MATLAB, HDF5, a ROS bag or a spreadsheet)"
)
_NUMBERS = (pa.float64(),)
_DATES = (pa.timestamp("ns"), pa.timestamp("ns", "UTC"))  # without a zone, and with one


Columns = Sequence[pa.ChunkedArray]
"""Columns of numbers, dates or text."""


class Table(NamedTuple):
    """An opened file with named columns, or columns in memory."""

    source: str  # name of the file, for messages
    names: list[str]  # of all columns, in order
    load: Callable[[list[int]], Iterable[Columns]]  # batches of the columns of some indices
    row_number: Callable[[int], int]  # row of sample k, for messages; after `read`
    format: str  # "csv" or "parquet"; "arrays" for columns in memory
    head: Mapping[str, Sequence[str]] = MappingProxyType({})  # cells of the first rows, by name
    units: Mapping[str, str] = MappingProxyType({})  # cells of a row of units, by name
    comments: Sequence[str] = ()  # lines before the samples

    @property
    def kinds(self) -> dict[str, str]:
        """What the first cells of each column are: number, date (also a time of day) or text."""
        kinds = {"number": _NUMBERS, "date": _DATES, "text": (pa.string(),)}
        return {
            name: next(kind for kind, types in kinds.items() if _is_castable([*cells], types))
            for name, cells in self.head.items()
        }

    def read(
        self, wanted: Sequence[str], *, blanks: bool = False, dates: Collection[str] = ()
    ) -> list[FloatArray]:
        """Return the named columns, (T,) each, T > 0.

        Args:
            wanted: names of the columns.
            blanks: whether missing values become nan; otherwise they are refused.
            dates: columns of dates with time, in UTC unless they have a zone, or of times of day;
                they become seconds since 1970, or since midnight.
        """
        for name in wanted:
            if self.names.count(name) > 1:
                raise InputError(f"{self.source}: column {name!r} appears more than once")
            if name not in self.names:
                shown = shorten(", ".join(map(repr, self.names)), 300)
                hint = suggest_closest(name, self.names) or f"; the file has {shown}"
                raise InputError(f"{self.source}: no column {name!r}{hint}")
        batches, count = list[list[FloatArray]](), 0
        for columns in self.load([self.names.index(name) for name in wanted]) if wanted else ():
            pairs = zip(wanted, columns, strict=True)
            batches.append(
                [self._to_numbers(n, c, count, is_date=n in dates, blanks=blanks) for n, c in pairs]
            )
            count += len(columns[0])
        if wanted and not count:
            raise InputError(f"{self.source}: no samples after the header")
        return [np.concatenate(parts) for parts in zip(*batches, strict=True)]

    def _to_numbers(
        self, name: str, column: pa.ChunkedArray, first: int, *, is_date: bool, blanks: bool
    ) -> FloatArray:
        """Return samples of a column, of which the first one has a number for messages."""
        kinds, wanted = (_DATES, "dates with time") if is_date else (_NUMBERS, "numbers")
        if pa.types.is_string(column.type):
            column = pc.utf8_trim_whitespace(column)
            cells = pc.if_else(pc.equal(column, ""), pa.scalar(None, pa.string()), column)
            for kind in kinds:
                with suppress(pa.ArrowException):
                    column = _cast(cells, kind)
            if pa.types.is_string(column.type):
                texts = cells.to_pylist()
                wrong = (k for k, text in enumerate(texts) if not _is_castable([text], kinds))
                k = next(wrong, 0)  # the first one, if only some dates have a zone
                text = f"{shorten(str(texts[k]), 24)!r} is not one of {wanted}"
                raise self._cell_error(name, first + k, text)
        kind = column.type
        are_numbers = pa.types.is_floating(kind) or pa.types.is_integer(kind)
        if not (pa.types.is_timestamp(kind) if is_date else are_numbers):
            raise InputError(f"{self.source}: column {name!r} contains {kind}, not {wanted}")
        if is_date:
            whole = column.cast(pa.timestamp("ns"), safe=False).cast(pa.int64())
            column = pc.multiply(whole.cast(pa.float64(), safe=False), 1e-9)
        values = np.array(column.to_numpy(), np.float64)
        valid = (np.abs(values) <= _MAX_MAGNITUDE) | (blanks & ~np.isfinite(values))
        if not valid.all():
            k = int(valid.argmin())
            is_large = math.isfinite(values[k])
            text = f"out of range (beyond {_MAX_MAGNITUDE:g})" if is_large else MISSING_TEXT
            raise self._cell_error(name, first + k, text)
        return values

    def _cell_error(self, name: str, k: int, text: str) -> InputError:
        return InputError(f"{self.source}: row {self.row_number(k)}: column {name!r}: {text}")


def is_number(text: str) -> bool:
    """Return whether a text is a number, or one of the words for none."""
    return bool(text) and _is_castable([text], _NUMBERS)


def _cast(column: pa.ChunkedArray, kind: pa.DataType) -> pa.ChunkedArray:
    """Return a column of text as numbers or dates, of 1970 if these are times of day."""
    if pa.types.is_timestamp(kind):
        column = pc.replace_substring_regex(column, r"^(\d+:)", r"1970-01-01T\1")
    return column.cast(kind)


def _is_castable(cells: Sequence[str | None], kinds: Sequence[pa.DataType]) -> bool:
    """Return whether all cells that are not empty fit one of some kinds."""
    column = pa.chunked_array([[cell or None for cell in cells]], pa.string())
    for kind in kinds:
        with suppress(pa.ArrowException):
            _cast(column, kind)
            return True
    return False


def open_log(path: str | Path, columns: Sequence[str] = (), skip_rows: int = 0) -> Table:
    """Open a Parquet file, recognised by its first bytes, or delimited text as `open_text`."""
    is_parquet = _read_start(path).startswith(b"PAR1")
    return open_parquet(path) if is_parquet else open_text(path, columns, skip_rows)


def _read_start(path: str | Path) -> bytes:
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


def _check_width(path: str | Path, names: Sequence[str]) -> None:
    if len(names) > _MAX_COLUMNS:
        raise InputError(f"{path}: {len(names):,} columns (keep those of one IMU)")


# Text


class Line(NamedTuple):
    """A line that is neither blank nor a comment, without its ending, and its row, from 1."""

    row: int
    text: str


class _Shape(NamedTuple):
    """Where the columns of a text file are."""

    names: list[str]
    delimiter: str
    decimal_mark: str
    begin: int  # row of the first possible sample
    is_named: bool = True  # by the file or by the user
    units: Sequence[str] = ()


def read_lines(path: str | Path) -> Iterator[tuple[int, list[str]]]:
    """Yield the lines of a text file in batches, each with the row of its first line, from 1.

    The file may be gzipped; it is in UTF-8, or in UTF-16 with its mark.
    """
    start, row = _read_start(path), 1
    encoding = "utf-16" if start.startswith((b"\xff\xfe", b"\xfe\xff")) else "utf-8-sig"
    opener: Callable[..., Any] = gzip.open if start.startswith(b"\x1f\x8b") else open
    try:
        with opener(path, "rt", encoding=encoding) as file:
            while lines := [line.rstrip("\r\n") for line in islice(file, _BATCH_ROWS)]:
                if any("\0" in line for line in lines):
                    raise InputError(f"{path}: {_NO_TEXT}")
                yield row, lines
                row += len(lines)
    except UnicodeError:
        raise InputError(f"{path}: {_NO_TEXT}") from None
    except (EOFError, zlib.error, gzip.BadGzipFile):
        raise InputError(f"{path}: a damaged or incomplete archive (unpack it)") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from None


def data_lines(lines: Sequence[str], first: int = 1, begin: int = 1) -> Iterator[Line]:
    """Yield the data among lines, of which the first is in row ``first``, from row ``begin`` on."""
    for row, line in enumerate(lines, first):
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
    _, lines = next(read_lines(path), (1, []))
    shape = _find_shape(path, lines, columns, skip_rows)
    _check_width(path, shape.names)
    rows: list[NDArray[np.int64]] = []

    def load(index: list[int]) -> Iterator[Columns]:
        rows.clear()
        for first, batch in read_lines(path):
            if data := [*data_lines(batch, first, shape.begin)]:
                rows.append(np.array([line.row for line in data]))
                yield _split_batch(path, shape, data, index).columns

    def row_number(k: int) -> int:
        rows[:] = [np.concatenate(rows)]
        return int(rows[0][k])

    start = islice(data_lines(lines, 1, shape.begin), _HEAD_ROWS)
    head = [_split(line.text, shape) for line in start]
    return Table(
        str(path),
        shape.names,
        load,
        row_number,
        "csv",
        head={n: [c[k] for c in head if k < len(c)] for k, n in enumerate(shape.names)},
        units=dict(zip(shape.names, shape.units, strict=False)),
        comments=lines[: shape.begin - 1],
    )


def _find_shape(
    path: str | Path, lines: list[str], columns: Sequence[str], skip_rows: int
) -> _Shape:
    """Return where the columns of a file are, from its first lines."""
    data = [*islice(data_lines(lines, 1, skip_rows + 1), _SHAPE_ROWS)]
    if not data:
        kind = "the file has only comments (remove their signs?) or blank lines"
        raise InputError(f"{path}: {f'no samples after row {skip_rows}' if skip_rows else kind}")
    rows = [_split(line.text) for line in data]
    if len(rows[0]) < MIN_COLUMNS and not columns:  # a preamble, if the cells of an IMU follow
        for place, (cells, following) in enumerate(pairwise(rows)):
            if len(cells) == len(following) and sum(map(is_number, following)) >= MIN_COLUMNS:
                data, rows = data[place:], rows[place:]
                break
    delimiter = _find_delimiter(data[0].text)
    has_commas = delimiter != "," and re.search(r"\d,\d", data[-1].text) is not None
    shape = _Shape([*columns], delimiter, "," if has_commas else ".", data[0].row)
    if columns:
        return shape
    if sum(map(is_number, rows[0])) < MIN_COLUMNS:
        names, units = rows[0], rows[1] if len(rows) > 1 else []
        if len(units) == len(names) + 1 and not units[-1]:
            names.append("")  # a delimiter ends all lines but that of the names
        if len(units) != len(names) or not any(units) or any(map(is_number, units)):
            units = []
        return shape._replace(names=names, units=units, begin=data[1 if units else 0].row + 1)
    for line in reversed(lines[: shape.begin - 1]):
        names = _split(line.strip().lstrip("#%/ \t"))
        if len(names) == len(rows[0]) and not any(map(is_number, names)):
            return shape._replace(names=names)
    names = [f"column_{number}" for number in range(1, len(rows[0]) + 1)]
    return shape._replace(names=names, is_named=False)


def _find_delimiter(line: str) -> str:
    """Return the delimiter of a line: the commonest; blanks only without another one."""
    best = max(",;\t", key=line.count)
    return best if best in line else " "


def _split(line: str, shape: _Shape | None = None) -> list[str]:
    """Return the cells of a line, also before its shape is known; [] for no delimited text."""
    delimiter = shape.delimiter if shape else _find_delimiter(line)
    text = " ".join(line.split()) if delimiter == " " else line
    try:
        cells = next(csv.reader([text], delimiter=delimiter, strict=True), [])
    except csv.Error:
        return []
    return [cell.strip().replace(shape.decimal_mark if shape else ".", ".") for cell in cells]


def _split_batch(path: str | Path, shape: _Shape, data: list[Line], index: list[int]) -> pa.Table:
    """Return some columns of consecutive lines as text."""
    keys, bad = [str(column) for column in range(len(shape.names))], list[Any]()
    lines: Iterator[str] = (line.text for line in data)
    if shape.delimiter == " ":
        lines = (" ".join(line.split()) for line in lines)

    def skip(row: Any) -> str:
        bad.append(row)
        return "skip"

    table = pa.csv.read_csv(
        pa.BufferReader("\n".join(lines).encode()),
        pa.csv.ReadOptions(column_names=keys, use_threads=False),
        pa.csv.ParseOptions(delimiter=shape.delimiter, invalid_row_handler=skip),
        pa.csv.ConvertOptions(
            column_types=dict.fromkeys(keys, pa.string()),
            include_columns=[keys[column] for column in index],
        ),
    )
    count = len(keys)
    if bad:
        cells = bad[0].actual_columns
        problem = f"the header has {count} columns, this row has {cells}"
        hint = "if it is the last row: is the file cut off?"
        if not shape.is_named:
            problem = f"{cells} cells follow {count} in row {shape.begin}, and no header names them"
            hint = "keep the rows of one kind, and name their columns in [record] columns"
        raise InputError(f"{path}: row {data[bad[0].number - 1].row}: {problem} ({hint})")
    if len(table) != len(data):
        raise InputError(f"{path}: rows {data[0].row} to {data[-1].row}: a quote without its end")
    if shape.decimal_mark == ",":
        columns = [pc.replace_substring(column, ",", ".") for column in table.columns]
        table = pa.table(columns, table.column_names)
    return table


# Parquet


def open_parquet(path: str | Path) -> Table:
    """Open a Parquet file."""
    _read_start(path)
    try:
        file = pq.ParquetFile(path)
        start = next(file.iter_batches(_HEAD_ROWS), None)
    except (pa.ArrowException, OSError):
        raise InputError(f"{path}: not a Parquet file, or cut off") from None
    names = file.schema_arrow.names
    _check_width(path, names)

    def load(index: list[int]) -> list[Columns]:
        try:
            return [[file.read([names[k]]).column(names[k]) for k in index]]
        except (pa.ArrowException, OSError, KeyError):
            raise InputError(f"{path}: damaged: its columns cannot be read") from None

    cells = start.to_pydict() if start is not None and len({*names}) == len(names) else {}
    head = {n: ["" if cell is None else str(cell) for cell in cells[n]] for n in cells}
    return Table(str(path), names, load, lambda k: k + 1, "parquet", head)
