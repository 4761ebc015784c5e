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
from sinsjax.study.load import study_from_dict
from sinsjax.study.study import Study, study_to_tables

ANY_PROGRAM = "external"
"""Name of a program that has none yet."""


class ProgramPart(NamedTuple):
    """Variants of a program that the engine judges together, in one environment.

    Attributes:
        number: number of the part in `ProgramRuns.scenario`.
        ids: (variants,) its variants in the study with the program.
        point: (variants,) number of their conditions in `ProgramRuns.points`.
    """

    number: int
    ids: NDArray
    point: NDArray


@dataclass(frozen=True)
class ProgramRuns:
    """The runs of a program on a simulated study, by draw, then by conditions.

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
    def points(self) -> list[tuple[Any, ...]]:
        """The conditions of the runs: data and start, as values of `keys`."""
        return list(dict.fromkeys(_points(self.source, self.keys)))

    @cached_property
    def variants(self) -> NDArray:
        """(points,) The first variant with each conditions in the study without the program."""
        values = _points(self.source, self.keys)
        return np.array([values.index(point) for point in self.points])

    @cached_property
    def has_start(self) -> NDArray:
        """(points,) Whether a run starts from a given attitude."""
        starts, values = ~self.source.without_effect("phi_u0_deg"), _points(self.source, self.keys)
        given = {point for point, starting in zip(values, starts, strict=True) if starting}
        return np.array([point in given for point in self.points])

    @cached_property
    def environments(self) -> NDArray:
        """(points,) Number of the environment, each of which has its own records."""
        kept = [i for i, key in enumerate(self.keys) if key not in INITIAL_KEYS]
        values = [tuple(point[i] for i in kept) for point in self.points]
        distinct = list(dict.fromkeys(values))
        return np.array([distinct.index(value) for value in values])

    @cached_property
    def parts(self) -> list[ProgramPart]:
        """The parts of the program, some of which may have the same conditions."""
        numbers = {point: number for number, point in enumerate(self.points)}
        point = np.array([numbers.get(p, -1) for p in _points(self.study, self.keys)])
        methods = self.study.values("method")
        return [
            ProgramPart(number, ids, point[ids])
            for number, ids in enumerate(self.scenario.variant_ids)
            if methods[ids[0]] == self.name
        ]

    def part_of(self, environment: int) -> ProgramPart:
        """Return a part in an environment."""
        return next(part for part in self.parts if self.environments[part.point[0]] == environment)

    def places(self, part: ProgramPart, draws: range, first: int) -> NDArray:
        """Return the places of the runs of a batch among all runs of the draws from ``first``."""
        return np.add.outer((np.array(draws) - first) * len(self.points), part.point).ravel()

    def batch(self, part: ProgramPart, draws: range) -> Batch:
        """Return the runs of a part."""
        return self.scenario.batch(part.number, draws)

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
    swept = (key for key in study.axis_keys if is_condition_key(key))
    return [k for k in swept if k not in INITIAL_KEYS or not study.without_effect(k).all()]


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
    axes = dict(tables.get("axes", {}))
    joint = next((k for k, v in axes.items() if isinstance(v, dict) and "method" in v), None)
    if any("method" in case for case in tables.get("cases", ())):
        tables["cases"] = _with_program([dict(case) for case in tables["cases"]], name)
    elif joint is not None:
        columns = axes[joint]
        rows = [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]
        rows = _with_program(rows, name)
        axes[joint] = {key: [row[key] for row in rows] for key in columns}
    elif "method" in axes:
        axes["method"] = [*axes["method"], name]
    else:
        axes = {"method": [tables["alignment"].pop("method"), name], **axes}
    return study_from_dict(tables | {"axes": axes}, study.name)


def _with_program(rows: list[TomlTable], name: str) -> list[TomlTable]:
    """Return rows of methods, and a row of the program for each distinct condition of them."""
    first: dict[Any, TomlTable] = {}
    for row in rows:
        condition = tuple((key, row[key]) for key in row if is_condition_key(key))
        first.setdefault(condition, row)
    more = []
    for row in first.values():
        label = name if len(first) == 1 else f"{name}, {row.get('case')}"
        more.append(row | {"method": name} | ({"case": label} if "case" in row else {}))
    return [*rows, *more]
