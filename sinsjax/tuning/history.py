"""History of a tuning run: one row per evaluated point, in order of evaluation."""

import tomllib
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from sinsjax.columns import SCHEMA_VERSION, Column, arrow_schema
from sinsjax.errors import InputError
from sinsjax.execution import sealed
from sinsjax.messages import escape_controls
from sinsjax.platform.files import atomic_write
from sinsjax.study.keys import TomlTable, meaning
from sinsjax.study.load import study_from_dict, study_to_toml
from sinsjax.study.search_space import SearchSpace
from sinsjax.study.study import Study
from sinsjax.units import split_unit

FILE = "history.parquet"
_STUDY_MARK = "sinsjax.tuning"
_F, _I, _S = pa.float64(), pa.int64(), pa.string()


class Evaluation(NamedTuple):
    """A point evaluated by a search.

    Attributes:
        step: number of the evaluation, or of the step of a descent, from 0.
        candidate: number of the combination of candidates.
        values: one per variable, in the units of the file; NaN for unused variables.
        objective: over the tuning draws; relaxed where a sharpness is given.
        cost: steps of the search so far, in steps of a plain run, tangents included.
        start: number of the descent; None for other searches.
        window_s: half width of the relaxed resets, s; None if none is relaxed.
        sharpness: sharpness of the band's relaxed edge; None if the objective is not relaxed.
        estimated: whether by covariance analysis rather than by draws.
    """

    step: int
    candidate: int
    values: Sequence[float]
    objective: float
    cost: int
    start: int | None = None
    window_s: float | None = None
    sharpness: float | None = None
    estimated: bool = False


class Found(NamedTuple):
    """Result of a search.

    Attributes:
        search: name of the search.
        looks: all evaluations, in their order.
    """

    search: str
    looks: Sequence[Evaluation]

    @property
    def best(self) -> Evaluation:
        """The best evaluation by draws that is not relaxed; the first of equals."""
        hard = (look for look in self.looks if look.sharpness is None and not look.estimated)
        return min(hard, key=lambda look: look.objective)

    @property
    def cost(self) -> int:
        """Cost of the whole search, in steps of a plain run."""
        return max(look.cost for look in self.looks)

    @property
    def relaxed(self) -> list[Evaluation]:
        """The relaxed evaluations, those of descents."""
        return [look for look in self.looks if look.sharpness is not None]

    @property
    def course(self) -> tuple[NDArray, NDArray, bool]:
        """Cost and best objective so far, and whether that is relaxed or estimated.

        Of descents the best of all of them at each step.
        """
        if relaxed := self.relaxed:
            steps = dict.fromkeys(look.step for look in relaxed)
            own = [[look for look in relaxed if look.step == step] for step in steps]
            cost = np.array([max(look.cost for look in at) for at in own])
            return cost, np.array([min(look.objective for look in at) for at in own]), True
        estimated = [look for look in self.looks if look.estimated]
        looks = estimated or self.looks
        best = np.minimum.accumulate([look.objective for look in looks])
        return np.array([look.cost for look in looks]), best, bool(estimated)

    def point(self, space: SearchSpace) -> TomlTable:
        """The keys and values of the best point."""
        # The value of an unused variable does not matter.
        values = np.nan_to_num(self.best.values)
        return space.point(list(values), space.combinations[self.best.candidate])


def columns_of(space: SearchSpace) -> tuple[Column, ...]:
    """The columns of a history."""
    return (
        Column("search", _S, "", "name of the search"),
        Column("step", _I, "", "number of the evaluation, or of the step of a descent"),
        Column("start", _I, "", "number of the descent"),
        Column("candidate", _I, "", "number of the combination of candidates"),
        Column("objective", _F, "", "over the tuning draws; relaxed where a sharpness is given"),
        *(
            Column(v.name, _F, split_unit(v.key)[1], f"{meaning(v.key)}; null if not used")
            for v in space.variables
        ),
        Column("cost", _I, "", "steps so far, in steps of a plain run, tangents included"),
        Column("window_s", _F, "s", "half width of relaxed resets; null if none is relaxed"),
        Column("sharpness", _F, "", "sharpness of the band's relaxed edge; null if not relaxed"),
        Column("estimated", pa.bool_(), "", "objective by covariance analysis, not by draws"),
    )


def write(directory: Path, study: Study, found: Iterable[Found]) -> None:
    """Write the history of some searches atomically, sealed and with the study that they tune.

    Args:
        directory: directory of the tuning run.
        study: study with [tune].
        found: searches.

    Raises:
        InputError: the file cannot be written.
    """
    table = _table(SearchSpace.from_study(study), found)
    with atomic_write(directory / FILE) as file:
        file.write(sealed.sealed_parquet(table, {_STUDY_MARK: study_to_toml(study)}))


def read_study(directory: Path) -> Study | None:
    """Return the study that a history tunes; None if there is no intact history."""
    try:
        text = (_read(directory).schema.metadata or {})[_STUDY_MARK.encode()].decode()
        return study_from_dict(tomllib.loads(text), str(directory / FILE))
    except (InputError, KeyError, ValueError):
        return None


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
    return pa.Table.from_arrays(arrays, schema=arrow_schema(layout))


def read_history(directory: str | Path) -> pa.Table:
    """Read the history of a tuning run.

    Args:
        directory: directory of the tuning run.

    Returns:
        One row per evaluated point, in order of evaluation: ``search``, ``step``, ``start``,
        ``candidate``, ``objective``, one column per variable, ``cost``, ``window_s``,
        ``sharpness`` and ``estimated``; the schema has units and meanings.

    Raises:
        InputError: there is no history, or it has changed since it was written.

    Examples:
        >>> changes = {"study.rate_hz": 10.0, "tune.searches": ["grid"], "tune.grid_points": 2}
        >>> changes |= {"tune.tune_draws": 2, "tune.evaluation_draws": 4}
        >>> _ = sinsjax.tune(sinsjax.load_study("tune_condition5", changes), "tuned")
        >>> sinsjax.read_history("tuned").select(["search", "reset_times_s[0]"]).num_rows
        4
    """
    table = _read(Path(directory))
    return table.replace_schema_metadata({"sinsjax.schema": SCHEMA_VERSION})


def _read(directory: Path) -> pa.Table:
    path = directory / FILE
    try:
        return sealed.read_parquet(path)
    except FileNotFoundError:
        raise InputError(f"{path}: there is no such file") from None
    except sealed.Damaged as error:
        raise sealed.Damaged(f"{error} (`sinsjax tune --resume` makes it again)") from None


def read(directory: Path, space: SearchSpace) -> list[Found]:
    """Read the searches of a history, in their order.

    Args:
        directory: directory of the tuning run.
        space: search space of its study.

    Raises:
        InputError: the history cannot be read, or is of other variables.
    """
    table = read_history(directory)
    missing = {column.name for column in columns_of(space)}.difference(table.column_names)
    if missing:
        raise InputError(f"{directory / FILE}: column {sorted(missing)[0]} is missing")
    return list(_grouped(table.to_pylist(), [v.name for v in space.variables]))


def _grouped(rows: list[TomlTable], names: list[str]) -> Iterator[Found]:
    for search in dict.fromkeys(row["search"] for row in rows):
        yield Found(
            escape_controls(search),
            [
                Evaluation(
                    **{key: row[key] for key in Evaluation._fields if key != "values"},
                    values=[np.nan if row[name] is None else row[name] for name in names],
                )
                for row in rows
                if row["search"] == search
            ],
        )
