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
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from difflib import get_close_matches
from itertools import islice, pairwise
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet as pq
from numpy.typing import NDArray

from sinsjax.errors import InputError
from sinsjax.messages import shorten
from sinsjax.records.layout import FloatArray
from sinsjax.records.stamps import parse_iso

MISSING_TEXT = "empty or not finite"

MIN_COLUMNS = 6
"""Columns of an inertial record."""

_MAX_MAGNITUDE = 1e30  # of numbers; squares and sums of such stay finite
_MAX_COLUMNS, _HEAD_ROWS, _SHAPE_ROWS, _BATCH_ROWS = 1000, 20, 200, 2**13
_COMMENTS = ("#", "%", "//")
_BLANK_CELLS = ["", "nan", "NaN", "NAN"]
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)(e[+-]?\d+)?", re.ASCII | re.IGNORECASE)
_NO_NUMBER = re.compile(r"[+-]?(nan|inf|infinity)?", re.IGNORECASE)
_NO_TEXT = (
    "not text in UTF-8 (unpack it, or convert it: `iconv -f CP1252 -t UTF-8 LOG > NEW` for text of"
    " Windows; to CSV from MATLAB, HDF5, a ROS bag or a spreadsheet)"
)


class Table(NamedTuple):
    """An opened file with named columns.

    Attributes:
        names: all columns of the file, in order.
        read: (names, blanks=False, dates=()) returns the named columns, (T,) each, T > 0. Missing
            values are nan with ``blanks`` and otherwise rejected. Dates with time in the columns
            ``dates`` become seconds since 1970.
        row_number: function of sample k that returns its row, for messages; after ``read``.
        format: "csv" or "parquet"; "arrays" for columns in memory.
        head: cells of the first rows as text, by name.
        units: cells of a row of units, by name.
        comments: lines before the samples.
    """

    names: list[str]
    read: Callable[..., list[FloatArray]]
    row_number: Callable[[int], int]
    format: str
    head: Mapping[str, Sequence[str]] = MappingProxyType({})
    units: Mapping[str, str] = MappingProxyType({})
    comments: Sequence[str] = ()

    @property
    def numbers(self) -> set[str]:
        """Names of the columns whose first cells are numbers or empty."""
        return {n for n, cells in self.head.items() if all(not c or is_number(c) for c in cells)}

    @property
    def dates(self) -> set[str]:
        """Names of the columns whose first cells are dates with time, or times of day."""
        return {n for n, cells in self.head.items() if any(cells) and all(map(_is_date, cells))}


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


def find_columns(path: str | Path, names: list[str], wanted: Sequence[str]) -> list[int]:
    """Return the positions of the wanted columns; raises InputError if missing or repeated."""
    for name in wanted:
        if names.count(name) > 1:
            raise InputError(f"{path}: column {name!r} appears more than once")
        if name not in names:
            shown = shorten(", ".join(map(repr, names[:12]))) + ", ..." * (len(names) > 12)
            near = " or ".join(map(repr, get_close_matches(name, names, n=3)))
            hint = f"did you mean {near}?" if near else f"the file has {shown}"
            raise InputError(f"{path}: no column {name!r}; {hint}")
    return [names.index(name) for name in wanted]


def is_number(text: str) -> bool:
    """Return whether a text is a number, or one of the words for none."""
    return bool(_NUMBER.fullmatch(text) or text and _NO_NUMBER.fullmatch(text))


def parse_number(text: str) -> float:
    """Parse one finite number; the ValueError of an invalid text states what is wrong."""
    shown, value = repr(shorten(text, 24)), math.nan
    if not text:
        raise ValueError("is empty")
    if not is_number(text):
        raise ValueError(f"{shown} is not a number")
    if not math.isfinite(value := float(text)):
        raise ValueError(f"{shown} is not finite")
    if abs(value) > _MAX_MAGNITUDE:
        raise ValueError(f"{shown} is out of range (beyond {_MAX_MAGNITUDE:g})")
    return value


def _is_date(cell: str) -> bool:
    try:
        parse_iso(cell)
    except ValueError:
        return not cell
    return not is_number(cell)


def check_values(
    source: str | Path, name: str, values: FloatArray, first_row: int, *, blanks: bool
) -> FloatArray:
    """Return values (T,); refuses those out of range, and missing ones unless ``blanks``."""
    valid = _is_in_range(values, blanks=blanks)
    if not valid.all():
        k = int(valid.argmin())
        is_large = math.isfinite(values[k])
        text = f"out of range (beyond {_MAX_MAGNITUDE:g})" if is_large else MISSING_TEXT
        raise InputError(f"{source}: row {first_row + k}: column {name!r}: {text}")
    return values


def _is_in_range(values: FloatArray, *, blanks: bool) -> NDArray[np.bool_]:
    return (np.abs(values) <= _MAX_MAGNITUDE) | (blanks & ~np.isfinite(values))


# Text


class Line(NamedTuple):
    """A line that is neither blank nor a comment, without its ending, and its row, from 1."""

    row: int
    text: str


class _Shape(NamedTuple):
    """Where the columns of a text file are; `begin` is the row of the first possible sample."""

    names: list[str]
    is_named: bool  # by the file or by the user
    units: list[str]
    delimiter: str
    decimal_mark: str
    begin: int


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
    _, lines = next(read_lines(path))
    shape = _find_shape(path, lines, columns, skip_rows)
    _check_width(path, shape.names)
    rows: list[NDArray[np.int64]] = []

    def read(
        wanted: Sequence[str], *, blanks: bool = False, dates: Collection[str] = ()
    ) -> list[FloatArray]:
        index = find_columns(path, shape.names, wanted)
        parsers = [parse_iso if name in dates else parse_number for name in wanted]
        parts = []
        rows.clear()
        for first, batch in read_lines(path):
            if data := [*data_lines(batch, first, shape.begin)]:
                rows.append(np.array([line.row for line in data]))
                columns = None if dates else _parse_fast(shape, data, index, blanks=blanks)
                parts.append(columns or _parse(path, shape, data, index, parsers, blanks=blanks))
        if not parts:
            raise InputError(f"{path}: no samples after the header")
        rows[:] = [np.concatenate(rows)]
        return [np.concatenate(column) for column in zip(*parts, strict=True)]

    start = islice(data_lines(lines, 1, shape.begin), _HEAD_ROWS)
    head = [_split(line.text, shape) for line in start]
    return Table(
        shape.names,
        read,
        lambda k: int(rows[0][k]),
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
    mark = "," if has_commas else "."
    shape = _Shape([*columns], True, [], delimiter, mark, data[0].row)
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


def _parse_fast(
    shape: _Shape, data: list[Line], index: list[int], *, blanks: bool
) -> list[FloatArray] | None:
    """Return columns of consecutive lines; None if `_parse` must name an invalid number."""
    keys = [str(column) for column in range(len(shape.names))]
    wanted = [keys[column] for column in index]
    lines: Iterator[str] = (line.text for line in data)
    if shape.delimiter == " ":
        lines = (" ".join(line.split()) for line in lines)
    try:
        table = pa.csv.read_csv(
            pa.BufferReader("\n".join(lines).encode()),
            read_options=pa.csv.ReadOptions(column_names=keys),
            parse_options=pa.csv.ParseOptions(delimiter=shape.delimiter),
            convert_options=pa.csv.ConvertOptions(
                column_types=dict.fromkeys(wanted, pa.float64()),
                include_columns=wanted,
                null_values=_BLANK_CELLS if blanks else [],
                decimal_point=shape.decimal_mark,
            ),
        )
    except pa.ArrowException:
        return None
    values = [column.to_numpy() for column in table.columns]
    is_valid = all(_is_in_range(column, blanks=blanks).all() for column in values)
    return values if is_valid and table.num_rows == len(data) else None


def _parse(
    path: str | Path,
    shape: _Shape,
    data: list[Line],
    index: list[int],
    parsers: Sequence[Callable[[str], float]],
    *,
    blanks: bool,
) -> list[FloatArray]:
    """Return columns of consecutive lines, slowly: dates, or to name the first invalid row."""
    found = np.full((len(index), len(data)), math.nan)
    for k, (row, text) in enumerate(data):
        cells, count = _split(text, shape), len(shape.names)
        if len(cells) != count:
            problem = f"the header has {count} columns, this row has {len(cells)}"
            hint = "if it is the last row: is the file cut off?"
            if not shape.is_named:
                problem = f"{len(cells)} cells follow {count} in row {shape.begin}, and no header"
                hint = "keep the rows of one kind, and name their columns in [record] columns"
            raise InputError(f"{path}: row {row}: {problem} ({hint})")
        for values, column, parse in zip(found, index, parsers, strict=True):
            if not (blanks and _NO_NUMBER.fullmatch(cells[column])):
                try:
                    values[k] = parse(cells[column])
                except ValueError as error:
                    name = shape.names[column]
                    raise InputError(f"{path}: row {row}: column {name!r}: {error}") from None
    return [*found]


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

    def read(
        wanted: Sequence[str], *, blanks: bool = False, dates: Collection[str] = ()
    ) -> list[FloatArray]:
        find_columns(path, names, wanted)
        if start is None:
            raise InputError(f"{path}: the file has no rows")
        columns = []
        for name in wanted:
            try:
                column = file.read([name]).column(name)
            except (pa.ArrowException, OSError, KeyError):
                raise InputError(f"{path}: damaged: its columns cannot be read") from None
            values = _to_numbers(path, name, column, is_date=name in dates)
            columns.append(check_values(path, name, values, 1, blanks=blanks))
        return columns

    cells = start.to_pydict() if start is not None and len({*names}) == len(names) else {}
    head = {n: ["" if cell is None else str(cell) for cell in cells[n]] for n in cells}
    return Table(names, read, lambda k: k + 1, "parquet", head)


def _to_numbers(
    path: str | Path, name: str, column: pa.ChunkedArray, *, is_date: bool
) -> FloatArray:
    """Return a column as numbers, or as seconds since 1970; nan if missing."""
    kind = column.type
    if is_date and pa.types.is_timestamp(kind):
        whole = column.cast(pa.timestamp("ns"), safe=False).cast(pa.int64())
        column = pa.compute.multiply(whole.cast(pa.float64(), safe=False), 1e-9)
    elif is_date and pa.types.is_string(kind):
        seconds = np.full(len(column), math.nan)
        for k, text in enumerate(column.to_pylist()):
            try:
                seconds[k] = math.nan if text is None else parse_iso(text)
            except ValueError as error:
                raise InputError(f"{path}: row {k + 1}: column {name!r}: {error}") from None
        return seconds
    elif is_date or not (pa.types.is_floating(kind) or pa.types.is_integer(kind)):
        wanted = "dates with time" if is_date else "numbers"
        raise InputError(f"{path}: column {name!r} contains {kind}, not {wanted}")
    return np.array(column.to_numpy(), np.float64)
