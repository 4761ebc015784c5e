"""The history of a tuning run: one row per evaluated point, sealed with the study that it tunes.

Reading it needs no JAX, so a report starts without it.
"""

import tomllib
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pyarrow as pa

from sinsjax.columns import SCHEMA_VERSION, Column, arrow_schema
from sinsjax.errors import InputError
from sinsjax.execution import directory as places
from sinsjax.execution.directory import DamagedError, read_sealed_parquet, to_sealed_parquet
from sinsjax.messages import escape_controls
from sinsjax.platform.files import write_file
from sinsjax.study.keys import TomlTable, key_meaning
from sinsjax.study.load import study_from_dict, study_to_toml
from sinsjax.study.search_space import SearchSpace
from sinsjax.study.study import Study
from sinsjax.units import split_unit

FILE, TUNED, EVALUATION = "history.parquet", "tuned.toml", "evaluation"
"""Names in the directory of a tuning run."""
_STUDY_MARK = "sinsjax.tuning"
_F, _I, _S = pa.float64(), pa.int64(), pa.string()


class SearchPoint(NamedTuple):
    """A point of a search space."""

    candidate: int  # number of its combination of candidates
    values: Sequence[float]  # one per variable, in the units of the file; NaN for unused variables

    def keys(self, space: SearchSpace) -> TomlTable:
        """Return its keys and values; the values of unused variables do not matter."""
        return space.make_point(
            list(np.nan_to_num(self.values)), space.combinations[self.candidate]
        )


class Evaluation(NamedTuple):
    """A point evaluated by a search."""

    step: int  # number of the evaluation, or of the step of a descent, from 0
    candidate: int  # number of the combination of candidates
    values: Sequence[float]  # one per variable, in the units of the file; NaN for unused variables
    objective: float  # over the tuning draws; relaxed where a sharpness is given
    cost: int  # steps of the search so far, in steps of a plain run, tangents included
    start: int | None = None  # number of the descent; None for other searches
    window_s: float | None = None  # half width of the relaxed resets, s; None if none is relaxed
    # sharpness of the band's relaxed edge; None if the objective is not relaxed
    sharpness: float | None = None


class SearchResult(NamedTuple):
    """Result of a search."""

    search: str  # name of the search
    evaluations: Sequence[Evaluation]  # all evaluations, in their order

    @property
    def best(self) -> Evaluation:
        """The best evaluation that is not relaxed; the first of equals."""
        hard = (e for e in self.evaluations if e.sharpness is None)
        return min(hard, key=lambda evaluation: evaluation.objective)

    @property
    def cost(self) -> int:
        """Cost of the whole search, in steps of a plain run."""
        return max(evaluation.cost for evaluation in self.evaluations)

    def point(self, space: SearchSpace) -> TomlTable:
        """Return the keys and values of the best point."""
        return SearchPoint(self.best.candidate, self.best.values).keys(space)


def history_columns(space: SearchSpace) -> tuple[Column, ...]:
    """Return the columns of a history."""
    return (
        Column("search", _S, "", "name of the search"),
        Column("step", _I, "", "number of the evaluation, or of the step of a descent"),
        Column("start", _I, "", "number of the descent"),
        Column("candidate", _I, "", "number of the combination of candidates"),
        Column("objective", _F, "", "over the tuning draws; relaxed where a sharpness is given"),
        *(
            Column(v.name, _F, split_unit(v.key)[1], f"{key_meaning(v.key)}; null if not used")
            for v in space.variables
        ),
        Column("cost", _I, "", "steps so far, in steps of a plain run, tangents included"),
        Column("window_s", _F, "s", "half width of relaxed resets; null if none is relaxed"),
        Column("sharpness", _F, "", "sharpness of the band's relaxed edge; null if not relaxed"),
    )


def write_history(directory: Path, study: Study, searches: Iterable[SearchResult]) -> None:
    """Write the history of some searches atomically, sealed and with the study that they tune."""
    space = SearchSpace.from_study(study)
    rows = [
        e._asdict() | {"search": result.search} | dict(zip(space.names, e.values, strict=True))
        for result in searches
        for e in result.evaluations
    ]
    layout = history_columns(space)
    arrays = [
        pa.array([row[c.name] for row in rows], c.dtype, from_pandas=c.name in space.names)
        for c in layout
    ]
    table = pa.Table.from_arrays(arrays, schema=arrow_schema(layout))
    content = to_sealed_parquet(table, {_STUDY_MARK: study_to_toml(study)})
    write_file(directory / FILE, content)


def read_history(directory: str | Path) -> pa.Table:
    """Read the history of a tuning run.

    Args:
        directory: directory of the tuning run.

    Returns:
        One row per evaluated point, in order of evaluation: ``search``, ``step``, ``start``,
        ``candidate``, ``objective``, one column per variable, ``cost``, ``window_s`` and
        ``sharpness``; the schema has units and meanings.

    Raises:
        InputError: there is no history, or it has changed since it was written.

    Examples:
        >>> changes = {"study.rate_hz": 10.0, "tune.searches": ["grid"], "tune.grid_points": 2}
        >>> changes |= {"tune.tune_draws": 2, "tune.evaluation_draws": 4}
        >>> _ = sinsjax.tune(sinsjax.load_study("tune_condition5", changes), "tuned")
        >>> sinsjax.read_history("tuned").select(["search", "reset_times_s[0]"]).num_rows
        5
    """
    table = _read_sealed(Path(directory))
    return table.replace_schema_metadata({"sinsjax.schema": SCHEMA_VERSION})


def read_searches(directory: Path, space: SearchSpace) -> list[SearchResult]:
    """Read the searches of a history, in their order."""
    searches: dict[str, list[Evaluation]] = {}
    for row in read_history(directory).to_pylist():
        values = [np.nan if row[name] is None else row[name] for name in space.names]
        fields = {key: row[key] for key in Evaluation._fields if key != "values"}
        searches.setdefault(row["search"], []).append(Evaluation(**fields, values=values))
    return [
        SearchResult(escape_controls(name).replace("_", " "), found)
        for name, found in searches.items()
    ]


def is_tuning(directory: Path) -> bool:
    """Return whether a directory holds a tuning run, complete or not; links in it are refused."""
    places.refuse_links(directory)
    return (directory / FILE).exists()


def load_tuned_study(directory: Path) -> Study:
    """Load the study with [tune] of a tuning run, from its history."""
    text = (_read_sealed(directory).schema.metadata or {}).get(_STUDY_MARK.encode(), b"")
    return study_from_dict(tomllib.loads(text.decode()), str(directory / FILE))


def _read_sealed(directory: Path) -> pa.Table:
    path = directory / FILE
    try:
        return read_sealed_parquet(path)
    except FileNotFoundError:
        raise InputError(f"{path}: there is no such file") from None
    except DamagedError as error:
        raise DamagedError(f"{error} (`sinsjax tune --resume` makes it again)") from None
