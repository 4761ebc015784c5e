"""Access to a summary: columns as numbers, groups of runs, runs paired by draw."""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from sinsjax.errors import InputError


def require_column(table: pa.Table, name: str) -> pa.ChunkedArray:
    """A column of a table.

    Raises:
        InputError: it is missing.
    """
    if name not in table.column_names:
        raise InputError(f"summary: column {name} is missing")
    return table[name]


def numeric_column(table: pa.Table, column: str) -> NDArray:
    """A numeric column as float64, shape (rows,); null becomes NaN.

    Raises:
        InputError: the column is missing.
    """
    return require_column(table, column).cast(pa.float64()).to_numpy()


def status_mask(table: pa.Table, status: str) -> NDArray:
    """Return which runs ended with a status, shape (rows,), bool; null is no status.

    Raises:
        InputError: the column ``status`` is missing.
    """
    return pc.equal(require_column(table, "status"), status).fill_null(False).to_numpy()


def has_truth(table: pa.Table) -> bool:
    """Return whether the runs have a truth or a reference.

    Without one every misalignment is null. That of the heading also is if no run is finite, or if
    the method finds no heading.

    Raises:
        InputError: a column is missing.
    """
    known = bool(np.isfinite(numeric_column(table, "phi_u_arcmin")).any())
    return known or any(status_mask(table, name).any() for name in ("nonfinite", "no_north"))


def pair_by_draw(a: pa.Table, b: pa.Table, column: str) -> tuple[NDArray, NDArray]:
    """One column of two tables, paired by draw.

    Args:
        a: one row per draw, with ``draw_id``.
        b: the same draws, in any order.
        column: a numeric column of both, or ``status=ok`` for the runs with this status.

    Returns:
        The column in a and in b, each in ascending order of ``draw_id``; null is NaN.

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
    return column_values(a, column)[first], column_values(b, column)[second]


def column_values(table: pa.Table, column: str) -> NDArray:
    """A column as numbers, or for ``status=ok`` whether each run has this status."""
    _, _, status = column.partition("=")
    return status_mask(table, status) if status else numeric_column(table, column)


def group_rows(table: pa.Table, by: Sequence[str]) -> Iterator[tuple[dict[str, Any], pa.Table]]:
    """Split a table by the values of some columns.

    Args:
        table: any table.
        by: key columns of any type, including lists; null is a key like any other. Without
            columns there is one group.

    Yields:
        The key values and the group's rows in their order; groups by first appearance.

    Raises:
        InputError: a key column is missing.
    """
    number = group_numbers(table, by)
    ordered, start = table.take(np.argsort(number, kind="stable")), 0
    for size in np.bincount(number).tolist():
        rows = ordered.slice(start, size)
        yield {name: rows[name][0].as_py() for name in by}, rows
        start += size


def group_numbers(table: pa.Table, by: Sequence[str]) -> NDArray:
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


def to_key_list(by: str | Sequence[str]) -> list[str]:
    """A key, or several, as a list."""
    return [by] if isinstance(by, str) else list(by)


def to_arrow_table(runs: Any) -> pa.Table:
    """Return runs as a table: an Arrow table unchanged, a pandas data frame without its index.

    Raises:
        InputError: they are neither.
    """
    if isinstance(runs, pa.Table):
        return runs
    if hasattr(runs, "to_numpy") and hasattr(runs, "columns"):
        return pa.Table.from_pandas(runs, preserve_index=False)
    raise InputError(
        f"{type(runs).__name__}: is not a table (give a pyarrow table or a pandas frame)"
    )
