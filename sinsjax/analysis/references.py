"""Comparison of each group of runs with a reference group."""

from collections.abc import Sequence
from typing import Any

import pyarrow as pa

from sinsjax.analysis.summaries import compare_with_baseline
from sinsjax.analysis.tables import group_rows


def compare_with_first_group(
    table: pa.Table, by: Sequence[str], condition_keys: Sequence[str]
) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """Compare each group of runs with the first one, under the same conditions where there is one.

    Args:
        table: the summary, one row per run.
        by: key columns, as for `compare_with_baseline`.
        condition_keys: keys among them that are conditions, such as the initial heading error.

    Returns:
        The keys that identify the first group, without the conditions if these are the same in each
        comparison, and the rows of `compare_with_baseline`.

    Raises:
        InputError: as `compare_with_baseline`.
    """
    by_condition = [rows for _, rows in group_rows(table, condition_keys)]
    option_keys = [key for key in by if key not in condition_keys]
    firsts = [_first_row_values(rows, option_keys) for rows in by_condition]
    if not option_keys or any(first != firsts[0] for first in firsts):
        by_condition, firsts = [table], [_first_row_values(table, by)]
    found = [
        row
        for rows in by_condition
        for row in compare_with_baseline(rows, by, _first_row_values(rows, by)).to_pylist()
    ]
    return firsts[0], found


def _first_row_values(rows: pa.Table, keys: Sequence[str]) -> dict[str, Any]:
    return {key: rows[key][0].as_py() for key in keys}
