"""Files with named columns of numbers: CSV and other text, see `text`, and Parquet.

Rows are counted from 1: in text as lines of the file, including the header; in Parquet as rows of
the table.
"""

import os
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from difflib import get_close_matches
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute
import pyarrow.parquet as pq
from numpy.typing import NDArray

from sinsjax.errors import InputError
from sinsjax.messages import shorten
from sinsjax.records.files import MAX_MAGNITUDE, read_bytes
from sinsjax.records.layout import FloatArray
from sinsjax.records.stamps import parse_iso

MISSING_TEXT = "empty or not finite"

MIN_COLUMNS = 6
"""Columns of an inertial record."""

MAX_LABELS = 8
"""Largest number of different texts in a column that may label rows."""

HEAD_ROWS = 20
"""Rows that show what a column contains."""

_BATCH_ROWS = 2**17


class ColumnTable(NamedTuple):
    """An opened file with named columns that is not yet read.

    Attributes:
        names: all columns of the file, in order.
        read: (names, blanks=False, dates=(), labels={}) returns the named columns, each (T,)
            float64, T > 0. Missing values are nan with ``blanks`` and otherwise rejected; ``dates``
            names columns of dates with time, which become seconds; the texts of columns in
            ``labels`` become numbers, which are added to the mapping by text. A table can be read
            only once.
        row_number: function of sample k that returns its row, for messages.
        format: "csv" or "parquet"; "arrays" for columns in memory.
        numbers: names of the numeric columns, as far as its first rows show.
        dates: names of the columns of dates or times of day.
        non_numbers: first cell that is not a number, by name: row and text.
        units: units in words by name, from a row of units.
        comments: lines before the samples.
        description: description of the file in words.
        types: types of the columns by name, for Parquet only.
        remarks: what was left out while the file was read, one line each.
        repetitive: names of the columns with at most `MAX_LABELS` different cells in the first
            rows.
    """

    names: list[str]
    read: Callable[..., list[FloatArray]]
    row_number: Callable[[int], int]
    format: str
    numbers: Collection[str] = ()
    dates: Collection[str] = ()
    non_numbers: Mapping[str, tuple[int, str]] = MappingProxyType({})
    units: Mapping[str, str] = MappingProxyType({})
    comments: Sequence[str] = ()
    description: str = ""
    types: Mapping[str, pa.DataType] = MappingProxyType({})
    remarks: Sequence[str] = ()
    repetitive: Sequence[str] = ()


Labels = Mapping[str, dict[str, float]]
"""Numbers of the texts in some columns, by column and text."""

NO_LABELS: Labels = MappingProxyType({})


def number_texts(texts: pa.ChunkedArray, numbers: dict[str, float]) -> NDArray[np.float64]:
    """Return the numbers of texts, adding those of new ones, but for more than are labels."""
    if len(numbers) > MAX_LABELS:
        return np.zeros(len(texts))
    texts = pa.compute.fill_null(pa.compute.utf8_trim_whitespace(texts), "")
    for text in pa.compute.unique(texts).to_pylist():
        numbers.setdefault(text, float(len(numbers)))
    index = pa.compute.index_in(texts, value_set=pa.array(list(numbers), texts.type))
    return np.asarray(index.to_numpy(), np.float64)


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


def join_batches(batches: Iterable[Sequence[NDArray[Any]]], width: int) -> list[FloatArray]:
    """Join the columns of all batches without a second copy of a long record in memory."""
    whole = [np.empty(0) for _ in range(width)]
    for batch in batches:
        for column, part in zip(whole, batch, strict=True):
            # Resizing remaps memory pages instead of copying.
            column.resize(column.size + part.size, refcheck=False)
            column[column.size - part.size :] = part
    return whole


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
        wanted: Sequence[str],
        *,
        blanks: bool = False,
        dates: Collection[str] = (),
        labels: Labels = NO_LABELS,
    ) -> list[FloatArray]:
        index = find_columns(path, schema.names, wanted)
        for name, column in zip(wanted, index, strict=True):
            kind = schema.field(column).type
            if name in labels:
                continue
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
                for name, numbers in labels.items():
                    place = part.column_names.index(name)
                    texts = part[name].cast(pa.string())
                    part = part.set_column(place, name, [number_texts(texts, numbers)])
                yield _to_floats(path, part, wanted, dates, blanks=blanks, rows_before=rows_before)
                rows_before += part.num_rows

        try:
            return join_batches(values(), len(wanted))
        except (pa.ArrowException, OSError):
            raise InputError(f"{path}: damaged: its columns cannot be read") from None

    types = {field.name: field.type for field in schema}
    return ColumnTable(
        schema.names,
        read,
        lambda k: k + 1,
        "parquet",
        numbers={n for n, t in types.items() if pa.types.is_floating(t) or pa.types.is_integer(t)},
        dates={name for name, type_ in types.items() if pa.types.is_timestamp(type_)},
        description=f"Parquet, {len(types)} columns",
        types=types,
        repetitive=_find_repetitive(file, types),
    )


def _find_repetitive(file: pq.ParquetFile, types: Mapping[str, pa.DataType]) -> list[str]:
    """Return the columns of numbers or texts that may label rows, by the first ones."""
    names = [
        name for name, kind in types.items()
        if pa.types.is_floating(kind) or pa.types.is_integer(kind) or pa.types.is_string(kind)
    ]  # fmt: skip
    try:
        head = next(file.iter_batches(HEAD_ROWS, columns=names), None)
    except (pa.ArrowException, OSError):
        return []  # reading the columns reports the error
    if head is None:
        return []
    return [
        name for name in names
        if list(types).count(name) == 1 and len(set(head[name].to_pylist())) <= MAX_LABELS
    ]  # fmt: skip


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
