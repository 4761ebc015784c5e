"""Access to a summary: columns as numbers, groups of runs, pairs by draw, and grids over axes."""

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from sinsjax.errors import InputError


def require_column(table: pa.Table, name: str) -> pa.ChunkedArray:
    """A column of a table; `InputError` if it is missing."""
    if name not in table.column_names:
        raise InputError(f"summary: column {name} is missing")
    return table[name]


def numeric_column(table: pa.Table, column: str) -> NDArray:
    """A numeric column as float64, shape (rows,); null becomes NaN.

    The column ``status=ok`` is whether each run ended with this status, 0 or 1.

    Raises:
        InputError: the column is missing.
    """
    name, _, status = column.partition("=")
    values = require_column(table, name)
    if status:
        values = pc.equal(values, status).fill_null(False)
    return values.cast(pa.float64()).to_numpy()


def has_truth(table: pa.Table) -> bool:
    """Return whether the runs have a truth or a reference.

    Without one every misalignment is null. That of the heading also is if no run is finite, or if
    the method finds no heading.
    """
    known = bool(np.isfinite(numeric_column(table, "phi_u_arcmin")).any())
    failed = (numeric_column(table, f"status={name}") for name in ("nonfinite", "no_north"))
    return known or any(each.any() for each in failed)


def pair_by_draw(a: pa.Table, b: pa.Table, column: str) -> tuple[NDArray, NDArray]:
    """One column of two tables with one row per draw, each in ascending order of ``draw_id``.

    The column is as for `numeric_column`.

    Raises:
        InputError: a missing column, a repeated draw, or draws that differ.
    """
    (draws, first), (others, second) = (
        np.unique(numeric_column(t, "draw_id"), return_index=True) for t in (a, b)
    )
    if draws.size < a.num_rows or others.size < b.num_rows:
        raise InputError("summary: draw_id repeats, so runs cannot be paired by draw")
    if not np.array_equal(draws, others):
        raise InputError("summary: the draws differ, so runs cannot be paired by draw")
    return numeric_column(a, column)[first], numeric_column(b, column)[second]


def group_rows(table: pa.Table, by: Sequence[str]) -> Iterator[tuple[dict[str, Any], pa.Table]]:
    """Split a table by the values of some columns, into groups by first appearance.

    Keys are of any type, including lists; null is a key like any other. Without keys there is one
    group.

    Yields:
        The key values and the group's rows in their order.

    Raises:
        InputError: a key column is missing.
    """
    number = _group_numbers(table, by)
    ordered, start = table.take(np.argsort(number, kind="stable")), 0
    for size in np.bincount(number).tolist():
        rows = ordered.slice(start, size)
        yield {name: rows[name][0].as_py() for name in by}, rows
        start += size


def _group_numbers(table: pa.Table, by: Sequence[str]) -> NDArray:
    """The number of the group of each row, by first appearance, see `group_rows`; (rows,)."""
    number = np.zeros(table.num_rows, dtype=np.int64)
    for name in by:
        column = require_column(table, name).combine_chunks()
        if pa.types.is_nested(column.type) or pa.types.is_dictionary(column.type):
            column = pa.array(map(repr, column.to_pylist()), pa.string())
        encoded = pc.dictionary_encode(column, null_encoding="encode").indices.to_numpy()
        # Renumbered after each key, so that the product of many keys cannot overflow.
        number = number * (table.num_rows + 1) + encoded
        _, first, number = np.unique(number, return_index=True, return_inverse=True)
        number = np.argsort(np.argsort(first))[number]
    return number


class Grid(NamedTuple):
    """Runs by the points of some axes, and by draw: the row of each run, shape (*axes, draws).

    The points of each axis are values of its keys, by these keys. The table has one row per run.
    """

    axes: dict[tuple[str, ...], list[tuple[Any, ...]]]
    table: pa.Table
    rows: NDArray

    @classmethod
    def from_table(cls, table: pa.Table, *axes: Sequence[str]) -> "Grid":
        """Lay the runs of a table, ordered by draw within each variant, out over axes.

        Axes are given by their keys; runs that differ in other keys alone share a point. Points are
        in the order of their first appearance.

        Raises:
            InputError: a key is missing, or the points do not have as many runs each.
        """
        numbers = [_group_numbers(table, keys) for keys in axes]
        points = {
            tuple(keys): [
                tuple(table[key][row].as_py() for key in keys)
                for row in np.unique(number, return_index=True)[1].tolist()
            ]
            for keys, number in zip(axes, numbers, strict=True)
        }
        shape = tuple(map(len, points.values()))
        place = np.ravel_multi_index(numbers, shape)
        if np.ptp(np.bincount(place, minlength=np.prod(shape))):
            raise InputError(
                f"{', '.join(key for keys in axes for key in keys)}: the runs form no full grid of"
                " these keys with equally many runs per cell (name the other varying keys in `by`)"
            )
        return cls(points, table, np.argsort(place, kind="stable").reshape(*shape, -1))

    def column(self, name: str) -> NDArray:
        """A column as numbers, shape (*axes, draws); null is NaN."""
        return numeric_column(self.table, name)[self.rows]


def to_key_list(by: str | Sequence[str]) -> list[str]:
    """A key, or several, as a list."""
    return [by] if isinstance(by, str) else list(by)


def to_arrow_table(runs: Any) -> pa.Table:
    """Return an Arrow table unchanged, a pandas frame without its index; else `InputError`."""
    if isinstance(runs, pa.Table):
        return runs
    if hasattr(runs, "to_numpy") and hasattr(runs, "columns"):
        return pa.Table.from_pandas(runs, preserve_index=False)
    raise InputError(
        f"{type(runs).__name__}: is not a table (give a pyarrow table or a pandas frame)"
    )
