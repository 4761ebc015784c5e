"""The runs of a program outside sinsjax: a study's variants as far as data and start differ.

Variants that differ only in a method and its settings are one run for a program. A record belongs
to a draw and to an environment: Earth, motion of the base, sensors.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sinsjax.arena.given import build_external
from sinsjax.engine.batch import Batch
from sinsjax.engine.scenario import Scenario
from sinsjax.errors import InputError
from sinsjax.execution.checks import refuse_external
from sinsjax.execution.success import require_floor
from sinsjax.methods.method import INITIAL_KEYS
from sinsjax.methods.registry import register_external
from sinsjax.study.keys import TomlTable, is_condition_key
from sinsjax.study.load import study_from_dict, study_to_tables
from sinsjax.study.study import Study

ANY_PROGRAM = "external"
"""Name of a program that has none yet."""


class ProgramPart(NamedTuple):
    """Runs of a program that the engine judges together.

    Attributes:
        number: of the part among those of `ProgramRuns.scenario`.
        ids: (variants,) its variants in the study with the program.
        places: (tasks,) the first variant of each task, as places in ``ids``.
        task: (variants,) the task of each variant.
        points: values of the `condition_keys` of each task.
        environment: number of the environment, whose records it reads.
    """

    number: int
    ids: NDArray
    places: NDArray
    task: NDArray
    points: list[tuple[Any, ...]]
    environment: int


class Tasks(NamedTuple):
    """Runs that a program is asked for, by run_id; leaves (runs,).

    Attributes:
        environment: number of the environment.
        draw: number of the draw.
        variant: first variant with its conditions in the study without the program.
        run_id: of that variant.
        point: place of its conditions in `ProgramRuns.points`.
    """

    environment: NDArray
    draw: NDArray
    variant: NDArray
    run_id: NDArray
    point: NDArray


class Point(NamedTuple):
    """Conditions of a run.

    Attributes:
        number: of the point.
        variant: the first one with these conditions in the study without the program.
        has_start: whether a run starts from a given attitude.
    """

    number: int
    variant: int
    has_start: bool


@dataclass(frozen=True)
class ProgramRuns:
    """The runs of a program on a simulated study.

    Attributes:
        source: the study without the program.
        name: of the program.
    """

    source: Study
    name: str = ANY_PROGRAM

    @cached_property
    def study(self) -> Study:
        """The study with the program as a further method."""
        return add_program(self.source, self.name)

    @cached_property
    def scenario(self) -> Scenario:
        """That study, ready for its runs to be judged."""
        require_floor(self.study)
        return Scenario(self.study, curves=False)

    @cached_property
    def keys(self) -> list[str]:
        """The keys whose values distinguish runs of the program."""
        return condition_keys(self.source)

    @cached_property
    def points(self) -> dict[tuple[Any, ...], "Point"]:
        """The conditions of the runs: data and start."""
        acts = ~self.source.without_effect("phi_u0_deg")
        found: dict[tuple[Any, ...], Point] = {}
        for variant, values in enumerate(_points(self.source, self.keys)):
            point = found.setdefault(values, Point(len(found), variant, has_start=False))
            found[values] = point._replace(has_start=point.has_start or bool(acts[variant]))
        return found

    @cached_property
    def parts(self) -> list[ProgramPart]:
        """The parts of the program, some of which may have the same conditions."""
        points = _points(self.study, self.keys)
        of_environment = [i for i, key in enumerate(self.keys) if key not in INITIAL_KEYS]
        methods = self.study.values("method")
        environments: dict[tuple[Any, ...], int] = {}
        found = []
        for number, ids in enumerate(self.scenario.variant_ids):
            if methods[ids[0]] != self.name:
                continue
            tasks: dict[Any, int] = {}
            task = np.array([tasks.setdefault(points[i], len(tasks)) for i in ids])
            places = np.unique(task, return_index=True)[1]
            key = tuple(points[ids[0]][i] for i in of_environment)
            environment = environments.setdefault(key, len(environments))
            found.append(ProgramPart(number, ids, places, task, list(tasks), environment))
        return found

    def part_of(self, environment: int) -> ProgramPart:
        """Return the first part of an environment."""
        return next(part for part in self.parts if part.environment == environment)

    @cached_property
    def environments(self) -> int:
        """Number of environments, each with its own records."""
        return 1 + max(part.environment for part in self.parts)

    def tasks(self, draws: range) -> Tasks:
        """Return the runs on some draws, one for each point and draw."""
        environment_of = {p: part.environment for part in self.parts for p in part.points}
        numbers = np.array([environment_of[point] for point in self.points])
        variants = np.array([point.variant for point in self.points.values()])
        draw = np.repeat(list(draws), len(self.points))
        run_id = draw * self.source.n_variants + np.tile(variants, len(draws))
        columns = (
            np.tile(numbers, len(draws)),
            draw,
            np.tile(variants, len(draws)),
            run_id,
            np.tile(np.arange(len(self.points)), len(draws)),
        )
        order = np.argsort(run_id, kind="stable")
        return Tasks(*(column[order] for column in columns))

    def batch(self, part: ProgramPart, draws: range) -> Batch:
        """Return the runs of a part with its tasks as variants."""
        return self.scenario.batch(part.number, draws, variants=part.places)

    @property
    def samples(self) -> int:
        """Number of samples of a record."""
        return self.study.records * self.study.record_every

    @property
    def end_s(self) -> float:
        """Length of a run, s."""
        return self.samples / self.study.rate_hz


def condition_keys(study: Study) -> list[str]:
    """Return the swept keys that decide the data or the start of a run."""

    def acts(key: str) -> bool:
        return key not in INITIAL_KEYS or not study.without_effect(key).all()

    swept = (key for key in study.axis_keys if is_condition_key(key))
    return [key for key in swept if acts(key)]


def _points(study: Study, keys: list[str]) -> list[tuple[Any, ...]]:
    """Return the values of some keys, (variants,)."""
    if not keys:
        return [()] * study.n_variants
    return list(zip(*(study.values(key) for key in keys), strict=True))


def check_simulated(study: Study) -> None:
    """Refuse a study whose draws cannot be given to a program.

    Raises:
        InputError: it reads a record, or one repeatedly, or has results of a program.
    """
    if study.is_recorded:
        text = "reads a record: give that to the program (a simulated study has draws)"
        raise InputError(f"{study.name}: [record]: {text}")
    if study.passes is not None:
        text = "a program reads a record once (--set passes={} drops the section)"
        raise InputError(f"{study.name}: [passes]: {text}")
    refuse_external(study.study.external, study.name)


def add_program(study: Study, name: str) -> Study:
    """Return a study with a program as a further method, which has every condition of the others.

    Raises:
        InputError: the name cannot be that of a program.
    """
    register_external([name], build_external)
    if name in study.methods:
        raise InputError(f"{study.name}: has results of {name!r} already (give another --name)")
    tables = study_to_tables(study)
    for section in ("tune", "stop_when"):
        tables.pop(section, None)
    tables["study"]["external"] = [*(study.study.external or ()), name]
    _add_method(tables, name)
    return study_from_dict(tables, study.name)


def _add_method(tables: TomlTable, name: str) -> None:
    """Add a method to the axis of methods, and for each condition that varies with it."""
    axes = dict(tables.get("axes", {}))
    joint = next((key for key, values in axes.items() if "method" in _keys_of(values)), None)
    if any("method" in case for case in tables.get("cases", ())):
        rows = [dict(case) for case in tables["cases"]]
        tables["cases"] = [*rows, *_rows_of_program(rows, name)]
        return
    if joint is not None and isinstance(axes[joint], dict):
        columns = axes[joint]
        rows = [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]
        rows += _rows_of_program(rows, name)
        axes[joint] = {key: [row[key] for row in rows] for key in columns}
    elif "method" in axes:
        axes["method"] = [*axes["method"], name]
    else:
        method = tables["alignment"].pop("method")
        axes = {"method": [method, name], **axes}
    tables["axes"] = axes


def _keys_of(values: Any) -> Any:
    return values if isinstance(values, dict) else ()


def _rows_of_program(rows: list[TomlTable], name: str) -> list[TomlTable]:
    """Return a row of the program for each distinct condition of some rows."""
    first: dict[Any, TomlTable] = {}
    for row in rows:
        condition = tuple((key, row[key]) for key in row if is_condition_key(key))
        first.setdefault(condition, row)
    labels = {c: name if len(first) == 1 else f"{name}, {r.get('case')}" for c, r in first.items()}
    return [
        row | {"method": name} | ({"case": labels[condition]} if "case" in row else {})
        for condition, row in first.items()
    ]
