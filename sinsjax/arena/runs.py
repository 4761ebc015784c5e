"""The runs of a program outside sinsjax: a study's variants as far as data and start differ.

Variants that differ only in a method and its settings are one run for a program: they have the
same condition. A record belongs to a draw and to an environment: Earth, motion of the base,
sensors.
"""

from collections.abc import Hashable, Iterable
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
        condition: (variants,) number of their conditions, some of which may be the same.
    """

    number: int
    ids: NDArray
    condition: NDArray


class ProgramRuns:
    """The runs of a program on a simulated study, by draw, then by condition.

    Attributes:
        source: the study without the program.
        study: the study with the program as a further method.
        name: of the program.
        draws: the draws.
        keys: swept keys whose values distinguish conditions.
        conditions: the conditions, as values of them.
        variants: (conditions,) the first variant of each in ``source``, ascending.
        has_start: (conditions,) whether a run starts from a given attitude.
        environments: (conditions,) number of the environment, each of which has its own records.
        run_id: (runs,) their numbers in ``source``.
        samples: number of samples of a record.
        end_s: length of a run, s.
    """

    def __init__(self, source: Study, draws: range, name: str = ANY_PROGRAM) -> None:
        """Lay out the runs of a program; its name is refused as by `add_program`."""
        self.source, self.name, self.draws = source, name, draws
        self.study, self.keys = add_program(source, name), condition_keys(source)
        of_variant = conditions_of(source, self.keys)
        self.conditions = list(dict.fromkeys(of_variant))
        number = _number(of_variant)
        self.variants = np.unique(number, return_index=True)[1]
        starting = number[~source.without_effect("phi_u0_deg")]
        self.has_start = np.isin(np.arange(len(self.conditions)), starting)
        kept = [i for i, key in enumerate(self.keys) if key not in INITIAL_KEYS]
        self.environments = _number(tuple(point[i] for i in kept) for point in self.conditions)
        self.run_id = np.add.outer(np.array(draws) * source.n_variants, self.variants).ravel()
        self.samples = source.records * source.record_every
        self.end_s = self.samples / source.rate_hz

    @cached_property
    def scenario(self) -> Scenario:
        """The study with the program, ready for its runs to be judged."""
        require_floor(self.study)
        return Scenario(self.study, curves=False)

    @cached_property
    def parts(self) -> list[ProgramPart]:
        """The parts of the program."""
        is_program = np.array(self.study.values("method")) == self.name
        condition = np.full(len(is_program), -1)
        points = conditions_of(self.study, self.keys)
        condition[is_program] = _number(points[i] for i in np.flatnonzero(is_program))
        return [
            ProgramPart(number, ids, condition[ids])
            for number, ids in enumerate(self.scenario.variant_ids)
            if is_program[ids[0]]
        ]

    def part_of(self, environment: int) -> ProgramPart:
        """Return a part in an environment."""
        return next(p for p in self.parts if self.environments[p.condition[0]] == environment)

    def places(self, part: ProgramPart, draws: range) -> NDArray:
        """Return the places of the runs of a batch, by draw and variant, among all runs."""
        draw = np.array(draws) - self.draws.start
        return np.add.outer(draw * len(self.conditions), part.condition).ravel()

    def batch(self, part: ProgramPart, draws: range | None = None) -> Batch:
        """Return the runs of a part, on all draws or some of them."""
        return self.scenario.batch(part.number, draws or self.draws)


def condition_keys(study: Study) -> list[str]:
    """Return the swept keys that decide the data or the start of a run."""
    swept = (key for key in study.axis_keys if is_condition_key(key))
    return [k for k in swept if k not in INITIAL_KEYS or not study.without_effect(k).all()]


def conditions_of(study: Study, keys: list[str]) -> list[tuple[Any, ...]]:
    """Return the condition of each variant, as values of some keys."""
    columns = [study.values(key) for key in keys]
    return [tuple(column[i] for column in columns) for i in range(study.n_variants)]


def _number(values: Iterable[Hashable]) -> NDArray:
    """Return a number for each distinct value, by first appearance."""
    numbers: dict[Hashable, int] = {}
    return np.array([numbers.setdefault(value, len(numbers)) for value in values])


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
        first.setdefault(tuple((k, row[k]) for k in row if is_condition_key(k)), row)
    more = []
    for row in first.values():
        label = name if len(first) == 1 else f"{name}, {row.get('case')}"
        more.append(row | {"method": name} | ({"case": label} if "case" in row else {}))
    return [*rows, *more]
