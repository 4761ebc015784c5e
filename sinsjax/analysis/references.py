"""Which group of runs others are compared with."""

from collections.abc import Sequence
from typing import Any

import pyarrow as pa

from sinsjax.analysis.summaries import compare
from sinsjax.analysis.tables import groups


def compare_with_first(
    table: pa.Table, by: Sequence[str], given: Sequence[str]
) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """Compare each group of runs with the first one, under the same conditions where there is one.

    Args:
        table: the summary, one row per run.
        by: key columns, as for `compare`.
        given: those of them that are conditions, such as the initial heading error.

    Returns:
        The keys that tell the first group, without the conditions if these are the same in each
        comparison, and the rows of `compare`.

    Raises:
        InputError: as `compare`.
    """
    alike = [rows for _, rows in groups(table, given)]
    others = [key for key in by if key not in given]
    firsts = [_first(rows, others) for rows in alike]
    if not others or any(one != firsts[0] for one in firsts):
        alike, firsts = [table], [_first(table, by)]
    found = [row for rows in alike for row in compare(rows, by, _first(rows, by)).to_pylist()]
    return firsts[0], found


def _first(rows: pa.Table, keys: Sequence[str]) -> dict[str, Any]:
    return {key: rows[key][0].as_py() for key in keys}
