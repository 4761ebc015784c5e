"""Heading errors at the report times of a study."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import pyarrow as pa

from sinsjax.analysis.summaries import read_estimate, summarise


def heading_error_statistics(
    table: pa.Table, by: Sequence[str], time_labels: Mapping[str, str]
) -> Iterator[dict[str, Any]]:
    """The heading error of each group of runs, whatever its sign, time by time.

    Args:
        table: the summary, one row a run.
        by: key columns, as for `summarise`.
        time_labels: text for the time of each column of heading errors, such as
            ``phi_u_at_60_arcmin``.

    Yields:
        The keys, ``n`` runs, ``at``, and as estimates in arcmin ``rms`` and ``q90``, which 90 % of
        the runs do not exceed.

    Raises:
        InputError: no runs, or a missing column.
    """
    ends = {"rms": "rms", "q90": "abs_q90"}
    names = [f"{column}_{end}" for column in time_labels for end in ends.values()]
    for row in summarise(table, by, names).to_pylist():
        keys = {key: row[key] for key in (*by, "n")}
        for column, at in time_labels.items():
            found = {name: read_estimate(row, f"{column}_{end}") for name, end in ends.items()}
            yield keys | {"at": at} | found
