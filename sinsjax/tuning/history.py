"""What a tuning has looked at: one row a point, in the order in which it was looked at."""

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from sinsjax.columns import Column, schema
from sinsjax.errors import InputError
from sinsjax.messages import first_line
from sinsjax.platform.files import replacing
from sinsjax.study.search_space import SearchSpace
from sinsjax.study.study import TomlTable, meaning
from sinsjax.units import split_unit

FILE = "history.parquet"
_F, _I, _S = pa.float64(), pa.int64(), pa.string()


class Evaluation(NamedTuple):
    """A point that a search looked at.

    Attributes:
        step: number of the look, or of the step of a descent, from 0.
        candidate: number of the combination of candidates.
        values: one a variable, in the units of the file; NaN for those that are not used.
        objective: of the tuning draws; relaxed where there is a window.
        cost: plain-run steps of the search up to here, tangents included.
        start: number of the descent; None for searches without one.
        window_s: half width of the relaxed resets, s; None for what is not relaxed.
        sharpness: of the band's relaxed edge; None for what is not relaxed.
    """

    step: int
    candidate: int
    values: Sequence[float]
    objective: float
    cost: int
    start: int | None = None
    window_s: float | None = None
    sharpness: float | None = None


class Found(NamedTuple):
    """What a search found.

    Attributes:
        search: its name.
        looks: all points, in the order in which they were looked at.
    """

    search: str
    looks: Sequence[Evaluation]

    @property
    def best(self) -> Evaluation:
        """The best of the looks that are not relaxed, the first of equals."""
        hard = (look for look in self.looks if look.window_s is None)
        return min(hard, key=lambda look: look.objective)

    @property
    def cost(self) -> int:
        """Plain-run steps of all of it."""
        return max(look.cost for look in self.looks)

    def point(self, space: SearchSpace) -> TomlTable:
        """The keys of the best look."""
        # A variable that is not used has no value, and any will do.
        values = np.nan_to_num(self.best.values)
        return space.point(list(values), space.combinations[self.best.candidate])


def columns_of(space: SearchSpace) -> tuple[Column, ...]:
    """The columns of a history."""
    return (
        Column("search", _S, "", "which search"),
        Column("step", _I, "", "number of the look, or of the step of a descent"),
        Column("start", _I, "", "number of the descent"),
        Column("candidate", _I, "", "number of the combination of candidates"),
        Column("objective", _F, "", "of the tuning draws; relaxed where there is a window"),
        *(
            Column(v.name, _F, split_unit(v.key)[1], f"{meaning(v.key)}; null where not used")
            for v in space.variables
        ),
        Column("cost", _I, "", "plain-run steps of the search up to here, tangents included"),
        Column("window_s", _F, "s", "half width of relaxed resets; null for what is not relaxed"),
        Column("sharpness", _F, "", "of the band's relaxed edge; null for what is not relaxed"),
    )


def write(directory: Path, space: SearchSpace, found: Iterable[Found]) -> None:
    """Writes the history of some searches, whole or not at all."""
    with replacing(directory / FILE) as file:
        pq.write_table(_table(space, found), file, compression="zstd")


def _table(space: SearchSpace, found: Iterable[Found]) -> pa.Table:
    rows = [(one.search, look) for one in found for look in one.looks]
    names = [v.name for v in space.variables]
    columns = {
        "search": [search for search, _ in rows],
        **{
            key: [getattr(look, key) for _, look in rows]
            for key in Evaluation._fields
            if key != "values"
        },
        **{
            name: pa.array([look.values[i] for _, look in rows], _F, from_pandas=True)
            for i, name in enumerate(names)
        },
    }
    layout = columns_of(space)
    arrays = [pa.array(columns[column.name], column.dtype) for column in layout]
    return pa.Table.from_arrays(arrays, schema=schema(layout))


def read_history(directory: str | Path) -> pa.Table:
    """Read what a tuning has looked at.

    Args:
        directory: of the tuning.

    Returns:
        One row a point looked at, in the order in which they were: ``search``, ``step``, ``start``,
        ``candidate``, ``objective``, a column a variable, ``cost``, ``window_s``, ``sharpness``;
        the schema has units and meanings.

    Raises:
        InputError: there is none, or it cannot be read.
    """
    path = Path(directory) / FILE
    try:
        return pq.read_table(path)
    except (OSError, pa.ArrowException) as error:
        raise InputError(f"{path}: cannot be read: {first_line(error)}") from error


def read(directory: Path, space: SearchSpace) -> list[Found]:
    """The searches of a history, in the order in which they were made.

    Raises:
        InputError: it cannot be read, or is that of other variables.
    """
    table = read_history(directory)
    missing = {column.name for column in columns_of(space)}.difference(table.column_names)
    if missing:
        raise InputError(f"{directory / FILE}: column {sorted(missing)[0]} is missing")
    return list(_grouped(table.to_pylist(), [v.name for v in space.variables]))


def _grouped(rows: list[TomlTable], names: list[str]) -> Iterator[Found]:
    for search in dict.fromkeys(row["search"] for row in rows):
        yield Found(
            search,
            [
                Evaluation(
                    **{key: row[key] for key in Evaluation._fields if key != "values"},
                    values=[np.nan if row[name] is None else row[name] for name in names],
                )
                for row in rows
                if row["search"] == search
            ],
        )
