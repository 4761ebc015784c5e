"""The runs of a program outside sinsjax: a study's variants as far as data and start differ.

Variants that differ only in a method and its settings are one run for a program: they have the
same condition. A record belongs to a draw and to an environment: Earth, motion, sensors.
"""

from collections.abc import Hashable, Iterable, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sinsjax.arena.given import build_external
from sinsjax.engine.batch import Batch
from sinsjax.engine.scenario import Scenario
from sinsjax.errors import InputError
from sinsjax.execution.prepare import refuse_external
from sinsjax.execution.success import require_floor
from sinsjax.methods.method import INITIAL_KEYS
from sinsjax.methods.registry import register_external
from sinsjax.study.keys import is_condition_key
from sinsjax.study.load import study_from_dict
from sinsjax.study.study import Study, study_to_tables

ANY_PROGRAM = "external"
"""Name of a program that has none yet."""


class ProgramRuns:
    """The runs of a program on a simulated study, (draws, conditions).

    Attributes:
        source: the study without the program.
        study: the study with the program as a further method.
        name: of the program.
        keys: swept keys whose values distinguish conditions.
        condition: (variants,) number of the condition of each variant of ``source``.
        variants: (conditions,) the first variant of each in ``source``, ascending.
        has_start: (conditions,) whether a run starts from a given attitude.
        environments: (conditions,) number of the environment, each of which has its own records.
        run_id: (draws, conditions) their numbers in ``source``.
        end_s: length of a run, s.
    """

    def __init__(self, source: Study, name: str = ANY_PROGRAM) -> None:
        """Lay out the runs of a program; its name is refused as by `add_program`."""
        self.source, self.name, self.study = source, name, add_program(source, name)
        swept = (key for key in source.axis_keys if is_condition_key(key))
        starts_vary = not source.without_effect("phi_u0_deg").all()
        self.keys = [key for key in swept if starts_vary or key not in INITIAL_KEYS]
        self.condition = self._conditions(source, range(source.n_variants))
        self.variants = np.unique(self.condition, return_index=True)[1]
        starting = self.condition[~source.without_effect("phi_u0_deg")]
        self.has_start = np.isin(np.arange(len(self.variants)), starting)
        data = [source.values(key) for key in self.keys if key not in INITIAL_KEYS]
        self.environments = _number(tuple(v[i] for v in data) for i in self.variants)
        first = source.n_variants * np.arange(source.n_draws)
        self.run_id = np.add.outer(first, self.variants)
        self.end_s = source.records * source.record_every / source.rate_hz

    def _conditions(self, study: Study, variants: Iterable[int]) -> NDArray:
        """Return the number of the condition of some variants, by first appearance."""
        columns = [study.values(key) for key in self.keys]
        return _number(tuple(column[i] for column in columns) for i in variants)

    def batches(self) -> Iterator[tuple[Batch, NDArray]]:
        """Yield the program's runs by environment, and the condition of each of their variants."""
        require_floor(self.study)
        methods = self.study.values("method")
        program = [i for i, method in enumerate(methods) if method == self.name]
        condition = dict(zip(program, self._conditions(self.study, program), strict=True))
        scenario = Scenario(self.study, curves=False)
        for number, ids in enumerate(scenario.variant_ids):
            if ids[0] in condition:
                yield scenario.batch(number), np.array([condition[i] for i in ids])


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
        InputError: the name is that of a method of sinsjax, or [axes] zips methods with other keys.
    """
    register_external([name], build_external)
    tables = study_to_tables(study)
    tables["study"]["external"] = [name]
    axes, cases = dict(tables.get("axes", {})), list(tables.get("cases", ()))
    if any(isinstance(axis, dict) and "method" in axis for axis in axes.values()):
        text = "zips methods with other keys (give them as [[cases]])"
        raise InputError(f"{study.name}: [axes]: {text}")
    if any("method" in case for case in cases):
        first: dict[Any, Any] = {}  # the first case of each condition
        for case in cases:
            first.setdefault(tuple((k, case[k]) for k in case if is_condition_key(k)), case)
        for case in first.values():
            label = name if len(first) == 1 else f"{name}, {case.get('case')}"
            cases.append(case | {"method": name} | ({"case": label} if "case" in case else {}))
        tables["cases"] = cases
    elif "method" in axes:
        axes["method"] = [*axes["method"], name]
    else:
        axes = {"method": [tables["alignment"].pop("method"), name], **axes}
    return study_from_dict(tables | {"axes": axes}, study.name)
