"""The runs of a program outside sinsjax: a study's variants as far as data and start differ.

Variants that differ only in a method and its settings are one run for a program. A record belongs
to a draw and to a part, the variants of one environment and one length.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sinsjax.engine.build import Scenario
from sinsjax.engine.lanes import Group
from sinsjax.errors import InputError
from sinsjax.execution.checks import refuse_external
from sinsjax.methods.description import INITIAL_KEYS
from sinsjax.methods.registry import METHODS
from sinsjax.study.keys import PASS_KEYS, TomlTable, is_condition_key
from sinsjax.study.load import study_from_dict, study_to_tables
from sinsjax.study.study import Study

ANY_PROGRAM = "external"
"""Name of a program that has none yet."""


class ProgramPart(NamedTuple):
    """Runs of a program on records of one environment and one length.

    Attributes:
        number: of the part among those of `ProgramRuns.scenario`.
        ids: (variants,) all its variants in the study with the program.
        places: (tasks,) the first variant of each task, as places in ``ids``.
        task: (variants,) the task of each variant.
        variants: (tasks,) the first variant of each task in the study without the program.
        has_start: (tasks,) whether a run starts from a given attitude.
        points: values of the `condition_keys` of each task.
    """

    number: int
    ids: NDArray
    places: NDArray
    task: NDArray
    variants: NDArray
    has_start: NDArray
    points: list[tuple[Any, ...]]


class Tasks(NamedTuple):
    """Runs of a program in the order of their run_id; leaves (runs,).

    Attributes:
        part: place among `ProgramRuns.parts`.
        task: of the part.
        draw: number of the draw.
        variant: in the study without the program.
        run_id: of that study.
        end_s: length of the run, s.
    """

    part: NDArray
    task: NDArray
    draw: NDArray
    variant: NDArray
    run_id: NDArray
    end_s: NDArray


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
        return Scenario(self.study, curves=False)

    @cached_property
    def parts(self) -> list[ProgramPart]:
        """The parts of the program."""
        keys = condition_keys(self.source)
        first, has_start = self._first_variants(keys)
        points = _points(self.study, keys)
        methods = self.study.values("method")
        found = []
        for number, ids in enumerate(self.scenario.variant_ids):
            if methods[ids[0]] != self.name:
                continue
            tasks: dict[Any, int] = {}
            task = np.array([tasks.setdefault(points[i], len(tasks)) for i in ids])
            places = np.unique(task, return_index=True)[1]
            variants = np.array([first[point] for point in tasks])
            starts = np.array([has_start[point] for point in tasks])
            found.append(ProgramPart(number, ids, places, task, variants, starts, list(tasks)))
        return found

    def tasks(self, draws: range) -> Tasks:
        """Return the runs on some draws."""
        blocks = []
        for number, part in enumerate(self.parts):
            size = len(part.places)
            draw = np.repeat(list(draws), size)
            variant = np.tile(part.variants, len(draws))
            blocks.append(
                Tasks(
                    np.full(len(draw), number),
                    np.tile(np.arange(size), len(draws)),
                    draw,
                    variant,
                    draw * self.source.n_variants + variant,
                    np.full(len(draw), self.end_s(part)),
                )
            )
        joined = Tasks(*(np.concatenate(columns) for columns in zip(*blocks, strict=True)))
        order = np.argsort(joined.run_id, kind="stable")
        return Tasks(*(column[order] for column in joined))

    def group(self, part: ProgramPart, draws: range) -> Group:
        """Return the group of a part with its tasks as variants."""
        return self.scenario.part(part.number, draws, variants=part.places).group

    def samples(self, part: ProgramPart) -> int:
        """Return the number of samples of a record of a part."""
        span = self.study.spans[part.ids[0]]
        return span.records_read * self.study.record_every

    def end_s(self, part: ProgramPart) -> float:
        """Return the length of the runs of a part, s."""
        return float(self.study.spans_s[part.ids[0], 0])

    def _first_variants(self, keys: list[str]) -> tuple[dict[Any, int], dict[Any, bool]]:
        """Return the first variant of each point, and whether a method starts from an attitude."""
        acts = ~self.source.without_effect("phi_u0_deg")
        first: dict[Any, int] = {}
        has_start: dict[Any, bool] = {}
        for variant, point in enumerate(_points(self.source, keys)):
            first.setdefault(point, variant)
            has_start[point] = has_start.get(point, False) or bool(acts[variant])
        return first, has_start


def condition_keys(study: Study) -> list[str]:
    """Return the swept keys that decide the data or the start of a run."""

    def acts(key: str) -> bool:
        return key not in INITIAL_KEYS or not study.without_effect(key).all()

    swept = (key for key in study.axis_keys if is_condition_key(key) or key in PASS_KEYS)
    return [key for key in swept if acts(key)]


def _points(study: Study, keys: list[str]) -> list[tuple[Any, ...]]:
    """Return the values of some keys, (variants,)."""
    if not keys:
        return [()] * study.n_variants
    return list(zip(*(study.values(key) for key in keys), strict=True))


def check_simulated(study: Study) -> None:
    """Refuse a study whose draws cannot be given to a program.

    Raises:
        InputError: it reads a record, has estimates instead of draws, or results of a program.
    """
    if study.is_recorded:
        text = "reads a record: give that to the program (a simulated study has draws)"
        raise InputError(f"{study.name}: [record]: {text}")
    if study.is_estimated:
        text = "covariance estimates have no draws (--set study.estimate='draws')"
        raise InputError(f"{study.name}: [study] estimate: {text}")
    refuse_external(study.study.external, study.name)


def add_program(study: Study, name: str) -> Study:
    """Return a study with a program as a further method, which has every condition of the others.

    Raises:
        InputError: the name cannot be that of a program.
    """
    if name in METHODS and not METHODS[name].is_external:
        raise InputError(f"{name!r} is a method of sinsjax (give the program another name)")
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
