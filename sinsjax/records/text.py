"""Columns of delimited text: where their names and samples are, and the numbers in them.

The first line that is no comment names the columns, or a comment before the samples does. Lines
before it with too few cells are skipped, and so is a row of units after it. The columns of a file
without names are ``column_1``, ``column_2`` and so on, or have the names of ``[record] columns``.
Rows are counted from 1 as lines of the file.
"""

import csv
import re
from collections.abc import Callable, Collection, Iterator, Sequence
from functools import partial
from itertools import chain, zip_longest
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.csv
from numpy.typing import NDArray

from sinsjax.errors import InputError
from sinsjax.records.files import (
    CUT_OFF_HINT,
    MAX_MAGNITUDE,
    Lines,
    cut_row_text,
    is_cut_short,
    is_number,
    parse_number,
    parse_number_or_nan,
    read_line_batches,
)
from sinsjax.records.layout import FloatArray
from sinsjax.records.names import parse_unit
from sinsjax.records.stamps import parse_iso
from sinsjax.records.tables import (
    HEAD_ROWS,
    MAX_LABELS,
    MIN_COLUMNS,
    NO_LABELS,
    ColumnTable,
    Labels,
    find_columns,
    join_batches,
    number_texts,
)


def is_date(cell: str) -> bool:
    """Return whether a cell is a date with time or a time of day, and not a number."""
    try:
        parse_iso(cell)
    except ValueError:
        return False
    return not is_number(cell)


_COMMENTS = (b"#", b"%", b"//")
_DELIMITERS = {",": "comma", ";": "semicolon", "\t": "tab", " ": "blank"}
_BLANK_CELLS = ["", "nan", "NaN", "NAN"]

_NOVATEL = re.compile(rb"[#%]RAWIMUS?(X?)A,")
_NOVATEL_NAMES = (
    *("imu_info", "imu_type", "gps_week", "gps_seconds", "imu_status"),
    *("delta_v_z", "delta_v_y", "delta_v_x", "delta_angle_z", "delta_angle_y", "delta_angle_x"),
)
"""Fields of NovAtel's RAWIMUXA logs, counts of increments; others lack the first two."""


class _Shape(NamedTuple):
    """Where the columns of a text file are.

    Attributes:
        names: of the columns.
        delimiter: delimiter of the columns.
        begin: number of lines before the samples and the comments among them.
        description: of the file in words.
        units: cells of a row of units.
        clean: line -> line with single delimiters between its cells, None for no sample; None if
            lines are clean as they are.
    """

    names: list[str]
    delimiter: str
    begin: int
    description: str
    units: list[str]
    clean: Callable[[bytes], bytes | None] | None


class _TextRows(NamedTuple):
    """Consecutive samples of a delimited text file.

    Attributes:
        path: the file.
        delimiter: delimiter of the columns.
        lines: one per sample.
        rows: row of each line in the file, from 1.
        is_last: whether these are the last lines of the file.
        is_unterminated: whether the last of them has no line ending.
    """

    path: str | Path
    delimiter: str
    lines: list[bytes]
    rows: list[int]
    is_last: bool
    is_unterminated: bool

    def split_cells(self, k: int) -> list[str]:
        line = self.lines[k].decode(errors="replace")
        try:
            return next(csv.reader([line], delimiter=self.delimiter, strict=True))
        except csv.Error:
            kind = _DELIMITERS[self.delimiter]
            raise InputError(
                f"{self.path}: row {self.rows[k]}: not {kind}-separated text"
            ) from None


def open_csv(path: str | Path, columns: Sequence[str] = (), skip_rows: int = 0) -> ColumnTable:
    """Open text with columns between commas, semicolons, tabs or blanks.

    Args:
        path: the file.
        columns: names of all columns of a file that does not name them.
        skip_rows: number of lines before the names, or before the samples.

    Raises:
        InputError: the file cannot be read, or has only blank lines and comments.
    """
    batches = read_line_batches(path)
    head = next(batches)
    while not _data_rows(head.lines, skip_rows) and (more := next(batches, None)) is not None:
        head = more._replace(first=1, lines=head.lines + more.lines)
    shape = _find_shape(path, head.lines, columns, skip_rows)
    samples = head._replace(first=shape.begin + 1, lines=head.lines[shape.begin :])
    start = _select_samples(path, shape, samples)
    rows: list[NDArray[np.int64]] = []
    remarks: list[str] = []

    def read(
        wanted: Sequence[str],
        *,
        blanks: bool = False,
        dates: Collection[str] = (),
        labels: Labels = NO_LABELS,
    ) -> list[FloatArray]:
        wanted_columns = _WantedColumns(
            shape.names,
            find_columns(path, shape.names, wanted),
            blanks,
            [name in dates for name in wanted],
            [labels.get(name) for name in wanted],
        )

        def values() -> Iterator[list[NDArray[Any]]]:
            rest = (_select_samples(path, shape, batch) for batch in batches)
            for text in chain([start], rest):
                complete, remark = _drop_cut_row(text, shape.names)
                remarks.extend(remark)
                if complete.rows:
                    rows.append(np.asarray(complete.rows))
                    yield _read_batch(complete, wanted_columns)

        whole = join_batches(values(), len(wanted))
        if not rows:
            raise InputError(f"{path}: no samples after the header")
        rows[:] = [np.concatenate(rows)]
        return whole

    head_cells = _read_head(start, shape.names)
    non_numbers = _find_non_numbers(start, head_cells)
    return ColumnTable(
        shape.names,
        read,
        lambda k: int(rows[0][k]),
        "csv",
        numbers=set(shape.names) - non_numbers.keys(),
        dates={name for name, (_, cell) in non_numbers.items() if is_date(cell)},
        non_numbers=non_numbers,
        units=dict(zip(shape.names, shape.units, strict=False)),
        comments=[line.decode(errors="replace") for line in head.lines[: shape.begin]],
        description=shape.description,
        remarks=remarks,
        repetitive=[
            name for name, cells in head_cells.items()
            if shape.names.count(name) == 1 and len(set(cells)) <= MAX_LABELS
        ],
    )  # fmt: skip


def _is_data(line: bytes) -> bool:
    """Return whether a line is neither blank nor a comment."""
    text = line.lstrip()
    return bool(text) and not text.startswith(_COMMENTS)


def _data_rows(lines: list[bytes], skip_rows: int) -> list[int]:
    """Return the indices of the first lines that are neither blank nor comments."""
    found = (k for k in range(skip_rows, len(lines)) if _is_data(lines[k]))
    return [k for k, _ in zip(found, range(200), strict=False)]


def _find_shape(
    path: str | Path, lines: list[bytes], columns: Sequence[str], skip_rows: int
) -> _Shape:
    """Return where the columns of a file are, from its first lines."""
    data = _data_rows(lines, skip_rows)
    if not data:
        novatel = next((found for line in lines if (found := _NOVATEL.match(line))), None)
        if novatel is None:
            has_text = any(line.strip() for line in lines)
            raise InputError(
                f"{path}: the file has only {'comments' if has_text else 'blank lines'}"
            )
        names = [*(columns or _NOVATEL_NAMES[0 if novatel[1] else 2 :])]
        return _Shape(names, ",", skip_rows, "NovAtel RAWIMU log", [], _clean_novatel)
    cells = _split_cells(lines[data[0]])
    if len(cells) < MIN_COLUMNS and not columns:
        data = data[_count_preamble(lines, data) :]
        cells = _split_cells(lines[data[0]])
    delimiter = _find_delimiter(lines[data[0]])
    clean = _make_cleaner(delimiter, lines[data[-1]], len(columns or cells))
    kind, row = f"{_DELIMITERS[delimiter]}-separated text", data[0] + 1
    if columns:
        return _Shape([*columns], delimiter, row - 1, kind, [], clean)
    if sum(map(is_number, cells)) >= MIN_COLUMNS:
        if names := _names_in_comment(lines[: row - 1], len(cells)):
            return _Shape(names, delimiter, row - 1, f"{kind}, its names in a comment", [], clean)
        names = [f"column_{number}" for number in range(1, len(cells) + 1)]
        return _Shape(names, delimiter, row - 1, f"{kind} without names of its columns", [], clean)
    units = _split_cells(lines[data[1]]) if len(data) > 1 else []
    if len(units) != len(cells) or sum(map(_is_unit, units)) < MIN_COLUMNS:
        units = []
    kind += f", its {len(cells)} names in row {row}"
    return _Shape(cells, delimiter, data[1] + 1 if units else row, kind, units, clean)


def _count_preamble(lines: list[bytes], data: list[int]) -> int:
    """Return the number of data lines before those with the cells of an IMU; 0 for none."""
    counts = [
        (len(cells), sum(map(is_number, cells))) for cells in (_split_cells(lines[k]) for k in data)
    ]
    for place, (count, _) in enumerate(counts[:-1]):
        following, numbers = counts[place + 1]
        if count == following >= MIN_COLUMNS and numbers >= MIN_COLUMNS:
            return place
    return 0


def _names_in_comment(lines: list[bytes], count: int) -> list[str]:
    """Return the names in the last comment with as many cells as the samples; [] without one."""
    for line in reversed(lines):
        text = line.strip()
        if text.startswith(_COMMENTS):
            cells = _split_cells(text.lstrip(b"#%/ \t"))
            if len(cells) == count and not any(map(is_number, cells)):
                return cells
    return []


def _is_unit(cell: str) -> bool:
    text = cell.strip("[]() ")
    return any(parse_unit(text, sensor) is not None for sensor in ("gyro", "accel"))


def _find_delimiter(line: bytes) -> str:
    """Return the delimiter of a line: the commonest; blanks only without another one."""
    counts = {mark: line.count(mark.encode()) for mark in ",;\t"}
    best = max(counts, key=lambda mark: counts[mark])
    return best if counts[best] else " "


def _split_cells(line: bytes) -> list[str]:
    delimiter = _find_delimiter(line)
    text = (b" ".join(line.split()) if delimiter == " " else line).decode(errors="replace")
    try:
        return [cell.strip() for cell in next(csv.reader([text], delimiter=delimiter), [])]
    except csv.Error:
        return []


def _make_cleaner(
    delimiter: str, sample: bytes, count: int
) -> Callable[[bytes], bytes | None] | None:
    """Return the `_Shape.clean` of delimited text.

    Args:
        delimiter: of the columns.
        sample: one of its lines, which shows decimal commas and a delimiter at the end.
        count: number of columns.
    """
    mark = delimiter.encode()
    has_commas = delimiter != "," and re.search(rb"\d,\d", sample) is not None
    has_end = (
        delimiter != " " and sample.rstrip(b" \r").endswith(mark) and sample.count(mark) == count
    )

    if not (has_commas or has_end or delimiter == " "):
        return None

    def clean(line: bytes) -> bytes | None:
        if not _is_data(line):
            return None
        if delimiter == " ":
            line = b" ".join(line.split())
        if has_commas:
            line = line.replace(b",", b".")
        return line.rstrip(b" \r").removesuffix(mark) if has_end else line

    return clean


def _clean_novatel(line: bytes) -> bytes | None:
    """Return the fields of a NovAtel log between header and checksum, both y with their sign."""
    if not _NOVATEL.match(line):
        return None
    cells = line.partition(b";")[2].partition(b"*")[0].split(b",")
    for place in (-5, -2):
        if len(cells) > 5:
            cells[place] = (
                cells[place][1:] if cells[place].startswith(b"-") else b"-" + cells[place]
            )
    return b",".join(cells)


def _select_samples(path: str | Path, shape: _Shape, batch: Lines) -> _TextRows:
    numbered = enumerate(batch.lines, start=batch.first)
    if shape.clean is None:
        samples = [(row, line) for row, line in numbered if _is_data(line)]
    else:
        cleaned = ((row, shape.clean(line)) for row, line in numbered)
        samples = [(row, line) for row, line in cleaned if line is not None]
    return _TextRows(
        path,
        shape.delimiter,
        [line for _, line in samples],
        [row for row, _ in samples],
        batch.is_last,
        batch.is_unterminated
        and bool(samples)
        and samples[-1][0] == batch.first + len(batch.lines) - 1,
    )


def _read_head(text: _TextRows, names: list[str]) -> dict[str, list[str]]:
    """Return the cells of the first rows by column; a row that cannot be split has empty ones."""
    cells: dict[str, list[str]] = {name: [] for name in names}
    for k in range(min(HEAD_ROWS, len(text.rows))):
        try:
            row = text.split_cells(k)
        except InputError:
            row = []
        for name, cell in zip_longest(names, row[: len(names)], fillvalue=""):
            cells[name].append(cell.strip())
    return cells


def _find_non_numbers(text: _TextRows, head: dict[str, list[str]]) -> dict[str, tuple[int, str]]:
    """Return the row and the text of the first cell of each column that is not a number."""
    found: dict[str, tuple[int, str]] = {}
    for name, cells in head.items():
        for row, cell in zip(text.rows, cells, strict=False):
            if cell and not is_number(cell):
                found.setdefault(name, (row, cell))
    return found


def _drop_cut_row(text: _TextRows, names: list[str]) -> tuple[_TextRows, list[str]]:
    """Return samples without the last row if the file is cut off within it, and a remark."""
    if not (text.is_unterminated and len(text.rows) > 2):
        return text, []
    *earlier, last = (
        text.split_cells(k) for k in range(max(0, len(text.rows) - 500), len(text.rows))
    )
    is_whole = len(last) == len(names)
    if is_whole and not is_cut_short(last[-1], [cells[-1] for cells in earlier]):
        return text, []
    cut = text._replace(lines=text.lines[:-1], rows=text.rows[:-1])
    return cut, [cut_row_text(text.rows[-1])]


class _WantedColumns(NamedTuple):
    """The columns to read from a text file.

    Attributes:
        names: all columns of the file.
        places: positions of the wanted columns among them.
        blanks: whether cells may be empty.
        dates: for each wanted column, whether it contains dates with time.
        labels: for each wanted column, the numbers of its texts; None if it has numbers.
    """

    names: list[str]
    places: list[int]
    blanks: bool
    dates: list[bool]
    labels: list[dict[str, float] | None]


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
    has_text = zip(columns.dates, columns.labels, strict=True)
    kinds = [
        pa.string() if is_date or texts is not None else pa.float64() for is_date, texts in has_text
    ]
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
        entries = zip(table.columns, columns.dates, columns.labels, strict=True)
        return [
            number_texts(column, texts)
            if texts is not None
            else _iso_to_seconds(column)
            if is_date
            else column.to_numpy()
            for column, is_date, texts in entries
        ]
    except ValueError:  # including pyarrow's
        return None


def _iso_to_seconds(dates: pa.ChunkedArray) -> FloatArray:
    return np.array([parse_iso(date) for date in dates.to_pylist()])


def _number_text(numbers: dict[str, float], text: str) -> float:
    return numbers.setdefault(text.strip(), float(len(numbers)))


def _read_row_by_row(text: _TextRows, columns: _WantedColumns) -> list[NDArray[Any]]:
    """Read rows slowly, to name the first invalid one."""
    parse_plain = parse_number_or_nan if columns.blanks else parse_number
    parsers: list[Callable[[str], float]] = [
        parse_iso if is_date else parse_plain for is_date in columns.dates
    ]
    for number, texts in enumerate(columns.labels):
        if texts is not None:
            parsers[number] = partial(_number_text, texts)
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
