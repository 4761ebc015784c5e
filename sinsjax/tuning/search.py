"""Searches without a gradient: a sweep over points of the box, and the best one of them.

A search is a study of its own, with the points as its cases and the tuning draws as its draws: a
directory of results as any other.
"""

import threading
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from sinsjax.execution import run as study_run
from sinsjax.execution import tables as result_tables
from sinsjax.execution.run import Tell
from sinsjax.records.reference import StoredRecord
from sinsjax.study import sampling, search_space
from sinsjax.study.load import study_from_dict, tables_of
from sinsjax.study.resolved import Dimension
from sinsjax.study.search_space import SearchSpace
from sinsjax.study.study import Study, TomlTable, dimensions_of
from sinsjax.tuning import objective
from sinsjax.tuning.history import Evaluation, Found

_SEEDS = 2**63


class SearchSession(NamedTuple):
    """How the runs of a tuning are made.

    Attributes:
        directory: of the tuning.
        tape: the record of a recorded study.
        overwrite: whether earlier results are removed.
        resume: whether whole results are kept.
        watch: gives, by a name, what is told how far something is.
        stop: set from elsewhere, it ends the tuning.
        source: the study's file, named in manifests.
    """

    directory: Path
    tape: StoredRecord | None
    overwrite: bool
    resume: bool
    watch: Callable[[str], AbstractContextManager[Tell | None]]
    stop: threading.Event
    source: Path | None

    def run(self, study: Study, name: str) -> Path:
        """Runs a study into a folder of the directory, without curves; gives the folder."""
        with self.watch(name) as tell:
            study_run.run_into(
                study,
                self.directory / name,
                self.tape,
                curves=False,
                overwrite=self.overwrite,
                resume=self.resume,
                tell=tell,
                stop=self.stop,
                source=self.source,
            )
        return self.directory / name


class Design(NamedTuple):
    """The points of a search.

    Attributes:
        candidate: (n,) number of the combination of each point.
        box: (n, p) places from 0 to 1; NaN for variables that are not used.
    """

    candidate: NDArray
    box: NDArray


def grid(space: SearchSpace, points: int) -> Design:
    """All points of a grid, ends included, the last variable fastest.

    Args:
        space: of the tuning.
        points: a variable.
    """
    places = np.linspace(0.0, 1.0, points)

    def own(_: int, count: int) -> NDArray:
        return np.array(list(product(places, repeat=count))).reshape(-1, count)

    return _design(space, own)


def sobol(space: SearchSpace, counts: Sequence[int], seed: np.random.SeedSequence) -> Design:
    """Scrambled Sobol points.

    Args:
        space: of the tuning.
        counts: of points, one a combination.
        seed: of the scrambling.
    """
    # A second or more to import, and few studies need it.
    from scipy.stats import qmc

    seeds = seed.spawn(len(counts))

    def own(number: int, count: int) -> NDArray:
        engine = qmc.Sobol(count, rng=np.random.Generator(np.random.PCG64(seeds[number])))
        # One point at first: scipy warns where a first call asks for another number than 2^m.
        return np.concatenate([engine.random(1), engine.random(counts[number] - 1)])

    return _design(space, own)


def random(space: SearchSpace, counts: Sequence[int], seed: np.random.SeedSequence) -> Design:
    """Independent points; arguments as those of `sobol`."""
    seeds = seed.spawn(len(counts))

    def own(number: int, count: int) -> NDArray:
        return np.random.Generator(np.random.PCG64(seeds[number])).random((counts[number], count))

    return _design(space, own)


def _design(space: SearchSpace, own: Callable[[int, int], NDArray]) -> Design:
    """A design from the points of each combination, by its number and its number of variables."""
    candidates, boxes = [], []
    for number, combination in enumerate(space.combinations):
        used = space.used(combination)
        points = own(number, len(used)) if used else np.empty((1, 0))
        box = np.full((len(points), len(space.variables)), np.nan)
        box[:, used] = points
        boxes.append(box)
        candidates.append(np.full(len(points), number))
    return Design(np.concatenate(candidates), np.concatenate(boxes))


def seed_of(study: Study, name: str) -> np.random.SeedSequence:
    """The seed of what is drawn for a search: of the study and of its name."""
    return np.random.SeedSequence(study.seed, spawn_key=tuple(name.encode()))


def evaluate(study: Study, name: str, design: Design, session: SearchSession) -> Found:
    """Runs the points of a design on the tuning draws.

    Args:
        study: with [tune].
        name: of the search, and of the folder of its results.
        design: its points; those that come to the same keys are run once.
        session: how.

    Raises:
        InputError: a directory that cannot be used, or a record that does not fit.
        StudyInterrupted: the session was stopped.
    """
    assert study.tune is not None
    space = SearchSpace.of(study)
    values = np.array(space.values(design.box.T)).T if space.variables else design.box
    points = [
        space.point(list(np.nan_to_num(row)), space.combinations[candidate])
        for row, candidate in zip(values, design.candidate, strict=True)
    ]
    names = objective.columns_of(study.tune, study)
    scores, taken, each = scored(
        study,
        name,
        points,
        lambda derived: result_tables.read_summary(session.run(derived, name), names),
    )
    paid = np.maximum.accumulate(taken) + 1
    return Found(
        name,
        [
            Evaluation(number, int(design.candidate[number]), list(row), score, int(n) * each)
            for number, (row, score, n) in enumerate(zip(values, scores, paid, strict=True))
        ],
    )


def scored(
    study: Study, name: str, points: Sequence[TomlTable], run: Callable[[Study], pa.Table]
) -> tuple[list[float], list[int], int]:
    """The objective at some points, those that come to the same keys being run once.

    Args:
        study: with [tune].
        name: of the search.
        points: with the same keys each.
        run: gives the summary of a study, `objective.columns_of` it at least.

    Returns:
        By point its objective and the number of its case; and the steps of a case.
    """
    assert study.tune is not None
    cases: dict[str, TomlTable] = {}
    case_of: dict[tuple[Any, ...], int] = {}
    for number, point in enumerate(points):
        if case_of.setdefault(tuple(point.values()), len(cases)) == len(cases):
            cases[f"{name} {number}"] = point
    derived = derive(study, cases, name=f"{study.name}_{name}")
    found = run_values(study, derived, run(derived))
    by_case = [objective.score(study.tune, own) for own in found]
    taken = [case_of[tuple(point.values())] for point in points]
    return [by_case[case] for case in taken], taken, cost(derived) // len(cases)


def run_values(study: Study, derived: Study, table: pa.Table) -> NDArray:
    """The numbers of all runs that the objective is made of, (points, variants, draws).

    Args:
        study: with [tune].
        derived: the study of the runs, whose cases are the points.
        table: `objective.columns_of` its summary.
    """
    assert study.tune is not None
    found = objective.values(study.tune, derived, table)
    return found.reshape(len(derived.cases), -1, found.shape[-1])


def cost(study: Study) -> int:
    """Steps of all runs of a study."""
    records = study.lengths.each(lambda span: span.records, int)
    return int(records.sum()) * study.record_every * study.n_draws


def derive(
    study: Study, points: Mapping[str, TomlTable], *, name: str, judging: bool = False
) -> Study:
    """The study of some points on the tuning draws, or on those that judge.

    Args:
        study: with [tune]; what it sweeps itself is swept at every point.
        points: with the same keys each, by the label of their case.
        name: of the new study.
        judging: whether it has the draws that judge: those of another seed, or of the other start
            times of a record.

    Returns:
        A study without [tune], whose outermost dimension is the points.
    """
    tune = study.tune
    assert tune is not None
    keys = next(iter(points.values()))
    tables = search_space.cleared(tables_of(study), list(keys))
    tables["study"] = tables["study"] | {"name": name, "curves": False}
    if study.record:
        starts = study.record.start_s[1 if judging else 0 :: 2]
        tables["record"] = tables["record"] | {"start_s": starts}
    else:
        seed = (study.seed + judging) % _SEEDS
        draws = tune.evaluation_draws if judging else tune.tune_draws
        tables["study"] |= {"seed": seed, "draws": draws}
    if study.drawn:
        count = len(tables["record"]["start_s"]) if study.record else tables["study"]["draws"]
        tables["drawn"] = sampling.of_fewer(study.drawn, count)
    own = {key: values for key, values in _own_cases(study).items() if key != "case"}
    if own:  # labels are those of the points now
        tables["axes"] = tables.get("axes", {}) | {_free_name(study): own}
    tables["cases"] = [{"case": label} | point for label, point in points.items()]
    return study_from_dict(tables, name)


def _own_cases(study: Study) -> Dimension:
    return dimensions_of(study.cases, [], {})[0] if study.cases else {}


def _free_name(study: Study) -> str:
    """A name for the table of axes that a study's cases become."""
    name = "cases"
    while name in study.zips:
        name += "_"
    return name
