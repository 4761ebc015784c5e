"""Number columns out of CSV and Parquet files, with the row of every number.

Rows are counted as a user sees them: in CSV the line of the file from 1 (the header included), in
Parquet the row of the table from 1.
"""

import csv
from collections.abc import Callable, Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet as pq

from sinsjax.records.files import CUT_OFF, load, load_lines, number
from sinsjax.records.layout import FloatArray
from sinsjax.types import InputError


class Table(NamedTuple):
    """A file with named columns, not read yet.

    Attributes:
        names: every column of the file, in order.
        read: gives the named columns as (T, n) float64, all finite, T > 0.
        row: the row to name in a message about sample k.
    """

    names: list[str]
    read: Callable[[Sequence[str]], FloatArray]
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


def open_csv(path: str | Path) -> Table:
    """Opens a comma-separated file whose first line that is not empty names the columns."""
    lines = load_lines(path)
    head = next((row for row, line in enumerate(lines) if line.strip()), None)
    if head is None:
        raise InputError(f"{path}: the file has only empty lines")
    names = [name.strip() for name in _cells(path, lines, head)]
    rows = [row for row, line in enumerate(lines) if line and row > head]

    def read(wanted: Sequence[str]) -> FloatArray:
        index = column_index(path, names, wanted)
        if not rows:
            raise InputError(f"{path}: no samples after the header")
        values = _read_quickly(lines[head + 1 :], len(names), index)
        if values is None or not np.isfinite(values).all():
            return _read_with_care(path, lines, rows, list(zip(wanted, index, strict=True)), names)
        return values

    return Table(names, read, lambda k: rows[k] + 1)


def _cells(path: str | Path, lines: list[bytes], row: int) -> list[str]:
    try:
        return next(csv.reader([lines[row].decode(errors="replace")], strict=True))
    except csv.Error:
        raise InputError(f"{path}: row {row + 1}: not comma-separated text") from None


def _read_quickly(lines: list[bytes], width: int, index: list[int]) -> FloatArray | None:
    keys = [str(column) for column in range(width)]
    wanted = [keys[column] for column in index]
    try:
        table = pa.csv.read_csv(
            pa.BufferReader(b"\n".join(lines)),
            read_options=pa.csv.ReadOptions(column_names=keys),
            convert_options=pa.csv.ConvertOptions(
                column_types=dict.fromkeys(wanted, pa.float64()),
                include_columns=wanted,
                null_values=[],
            ),
        )
    except pa.ArrowInvalid:
        return None
    return np.column_stack([column.to_numpy() for column in table.columns])


def _read_with_care(
    path: str | Path,
    lines: list[bytes],
    rows: list[int],
    wanted: list[tuple[str, int]],
    names: list[str],
) -> FloatArray:
    """The second, slower path: it names the first row that is wrong."""
    values = []
    for row in rows:
        cells = _cells(path, lines, row)
        if len(cells) != len(names):
            end = CUT_OFF if row == rows[-1] and len(cells) < len(names) else ""
            raise InputError(
                f"{path}: row {row + 1}: the header has {len(names)} columns, this row "
                f"{len(cells)}{end}"
            )
        for name, column in wanted:
            try:
                values.append(number(cells[column]))
            except ValueError as error:
                raise InputError(f"{path}: row {row + 1}: column {name!r}: {error}") from None
    return np.array(values).reshape(len(rows), len(wanted))


def open_parquet(path: str | Path) -> Table:
    """Opens a Parquet file."""
    data = load(path)
    try:
        file = pq.ParquetFile(pa.BufferReader(data))
    except (pa.ArrowException, OSError):
        raise InputError(f"{path}: not a Parquet file, or cut off") from None
    schema = file.schema_arrow

    def read(wanted: Sequence[str]) -> FloatArray:
        index = column_index(path, schema.names, wanted)
        for name, column in zip(wanted, index, strict=True):
            kind = schema.field(column).type
            if not (pa.types.is_floating(kind) or pa.types.is_integer(kind)):
                raise InputError(f"{path}: column {name!r} holds {kind}, not numbers")
        if file.metadata.num_rows == 0:
            raise InputError(f"{path}: the file has no rows")
        try:
            table = file.read(columns=list(wanted))
        except (pa.ArrowException, OSError):
            raise InputError(f"{path}: damaged: its columns cannot be read") from None
        values = np.column_stack([table[name].to_numpy().astype(np.float64) for name in wanted])
        bad = np.argwhere(~np.isfinite(values))
        if len(bad):
            row, column = bad[0]
            raise InputError(
                f"{path}: row {row + 1}: column {wanted[column]!r}: empty or not finite"
            )
        return values

    return Table(schema.names, read, lambda k: k + 1)
