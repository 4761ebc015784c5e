"""A complete tuning run: the searches of [tune], their evaluation on other draws, the tuned study.

In order: the searches; after a gradient search, a Sobol search of equal cost; the evaluation of all
best points and the baseline on draws not used for tuning; ``tuned.toml`` with the best point on the
tuning draws. Complete stages are kept when a tuning run is resumed.
"""

import threading
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext, suppress
from pathlib import Path
from typing import Any

from sinsjax.errors import InputError, StudyInterrupted
from sinsjax.execution import directory as places
from sinsjax.execution import forecast
from sinsjax.execution.directory import STUDY
from sinsjax.execution.prepare import Kind, Options, prepare
from sinsjax.execution.run import RunProgress, Tell
from sinsjax.execution.sealed import Damaged
from sinsjax.execution.tasks import Job
from sinsjax.platform.files import atomic_write, unwritable_message
from sinsjax.records.reference import StoredRecord
from sinsjax.study.identity import differences, fingerprint
from sinsjax.study.keys import TomlTable
from sinsjax.study.load import study_to_toml, with_point
from sinsjax.study.schema import TuneSection
from sinsjax.study.search_space import SearchSpace, comparable_points
from sinsjax.study.study import Study
from sinsjax.tuning import evolution, history, search
from sinsjax.tuning.history import Found
from sinsjax.tuning.relaxation import Relaxation
from sinsjax.tuning.search import SearchSession
from sinsjax.tuning.stored import is_tuning, stored_study

TUNED, EVALUATION = "tuned.toml", "evaluation"
GRADIENT, EQUAL_COST, COVARIANCE = "gradient", "equal_cost", evolution.NAME
_SEARCHES = ("grid", "sobol", "random", EQUAL_COST, EVALUATION)
_NAMES = (STUDY, TUNED, history.FILE, "figures", *_SEARCHES)

Watch = Callable[[str], AbstractContextManager[Tell | None]]


def prepare_tuning(
    source: Path | str | Study,
    overrides: Mapping[str, Any] | None,
    record: StoredRecord | Path | str | None,
    reference: Path | str | None,
    options: Options,
) -> Job:
    """Check a tuning run and forecast what it takes, see `prepare.prepare`.

    Raises:
        InputError: as `from_python.tune`.
    """
    kind = Kind(check_free, forecast.of_tuning, _check_same, require_tune)
    job = prepare(source, overrides, record, reference, options, kind=kind)
    if job.stored is not None and job.stored.reference is None:
        text = "tuning on a record needs a reference (give it with --reference)"
        raise InputError(f"{job.study.name}: [tune]: {text}")
    check_searches(job.study, job.stored)
    return job


def run_tuning(
    job: Job, *, watch: Watch | None = None, stop: threading.Event | None = None
) -> None:
    """Run the searches of a prepared tuning run, evaluate them, and write the tuned study.

    Args:
        job: from `prepare_tuning`.
        watch: gives the progress callback for the name of a search.
        stop: event that ends the tuning run; complete stages are kept.

    Raises:
        InputError: the directory cannot be written, or another process has written there.
        StudyInterrupted: ``stop`` was set.
    """
    session = SearchSession(job, watch or (lambda name: nullcontext()), stop or threading.Event())
    lock = places.lock(session.directory)
    try:
        # Again, since the directory may have changed before it was locked.
        check_free(session.directory, overwrite=job.overwrite, resume=job.resume)
        _search_and_evaluate(job.study, session)
    finally:
        lock.release()


def check_searches(study: Study, record: StoredRecord | None = None) -> None:
    """Refuse searches that do not go with the variables, before anything runs.

    Args:
        study: study with [tune], at the rate of its record.
        record: the record of a recorded study; without it what other packages' methods say of
            gradients is not evaluated.

    Raises:
        InputError: a variable without a gradient, or a method of another package whose numbers do
            not follow its keys.
    """
    space = SearchSpace.from_study(study)
    if GRADIENT in require_tune(study).searches:
        for combination in space.combinations:
            relaxation = Relaxation(study, space, combination)
            if study.is_recorded == (record is not None):
                relaxation.check_changes(record)


def _search_and_evaluate(study: Study, session: SearchSession) -> None:
    directory, space = session.directory, SearchSpace.from_study(study)
    known = _begin(study, space, session)
    found: list[Found] = []
    for name in require_tune(study).searches:
        found.append(_search(study, space, name, session, known))
        history.write(directory, study, found)
        if name == GRADIENT:
            counts = _counts(study, space, found[-1].cost)
            design = search.sobol(space, counts, search.seed_of(study, EQUAL_COST))
            found.append(search.evaluate(study, EQUAL_COST, design, session))
            history.write(directory, study, found)
    _evaluate(study, space, found, session)
    best = min(found, key=lambda one: one.best.objective)
    tuned = study_to_toml(with_point(study, best.point(space)))
    with atomic_write(directory / TUNED) as file:
        file.write(tuned.encode())


def require_tune(study: Study) -> TuneSection:
    """The [tune] section of a study.

    Raises:
        InputError: there is none.
    """
    if study.tune is None:
        raise InputError(f"{study.name}: has no [tune] section")
    return study.tune


def check_free(directory: Path, *, overwrite: bool, resume: bool) -> None:
    """Reject a directory that holds a tuning run, unless it may be used, or foreign files.

    Args:
        directory: directory of the tuning run, which may be missing.
        overwrite: whether a tuning run may be replaced.
        resume: whether a tuning run may be continued.

    Raises:
        InputError: the directory cannot be used.
    """
    taken = places.present_names(directory, _NAMES)
    if taken and not is_tuning(directory):
        raise InputError(
            f"{directory}: holds a {taken[0]} that is not of a tuning run (give another directory)"
        )
    if taken and not (overwrite or resume):
        raise InputError(
            f"{directory}: already holds a tuning run (give --resume to continue it, or --overwrite"
            " to replace it; in Python resume=True or overwrite=True)"
        )


def _begin(study: Study, space: SearchSpace, session: SearchSession) -> list[Found]:
    """Prepare a directory; gives the complete searches when resuming."""
    directory, known = session.directory, []
    try:
        for path in places.stale_temporary_files(directory):
            path.unlink()
        if session.job.resume and (directory / history.FILE).exists():
            with suppress(Damaged):  # its searches are made again, from the stored parts
                known = history.read(directory, space)
        elif not session.job.resume:
            for name in (TUNED, history.FILE):
                (directory / name).unlink(missing_ok=True)
    except OSError as error:
        raise InputError(unwritable_message(directory, error)) from error
    history.write(directory, study, known)
    with atomic_write(directory / STUDY) as file:
        file.write(study_to_toml(study).encode())
    return known


def _check_same(job: Job) -> Job:
    """Reject resuming the tuning run of another study."""
    assert job.directory is not None
    stored = stored_study(job.directory)
    if stored is None:
        return job
    old, new = (require_tune(study).model_dump() for study in (stored, job.study))
    differ = [f"[tune] {key}" for key in old if old[key] != new[key]]
    if fingerprint(stored) != fingerprint(job.study):
        differ += differences(stored, job.study)
    if differ:
        text = "; ".join(differ)
        raise InputError(f"{job.directory}: holds a tuning run of another study: {text}")
    return job


def _search(
    study: Study, space: SearchSpace, name: str, session: SearchSession, known: Sequence[Found]
) -> Found:
    """Run one search, or take it from the known ones."""
    settings = require_tune(study)
    if name in (GRADIENT, COVARIANCE):
        done = [one for one in known if one.search == name]
        return done[0] if done else _watched(name, study, session)
    if name == "grid":
        return search.evaluate(study, name, search.grid(space, settings.grid_points), session)
    draw = {"sobol": search.sobol, "random": search.random}[name]
    count = settings.sobol_points
    design = draw(space, [count] * len(space.combinations), search.seed_of(study, name))
    return search.evaluate(study, name, design, session)


def _watched(name: str, study: Study, session: SearchSession) -> Found:
    """A search that keeps no results but its history."""
    with session.watch(name) as tell:

        def tell_or_stop(progress: RunProgress) -> None:
            if session.stop.is_set():
                raise StudyInterrupted(f"the complete searches are in {session.directory}")
            if tell is not None:
                tell(progress)

        if name == COVARIANCE:
            return evolution.evolve(study, tell=tell_or_stop)
        # Optax is slow to import, and only this search needs it.
        from sinsjax.tuning import descent

        return descent.descend(study, session.job.stored, tell=tell_or_stop)


def _counts(study: Study, space: SearchSpace, cost: int) -> list[int]:
    """Number of points per combination for a search of a given cost."""
    point = space.point(space.values([0.5] * len(space.variables)), space.combinations[0])
    each = search.cost(search.derive(study, {"one": point}, name=study.name))
    count = len(space.combinations)
    points = max(count, round(cost / each))
    return [points // count + (number < points % count) for number in range(count)]


def _evaluate(
    study: Study, space: SearchSpace, found: Sequence[Found], session: SearchSession
) -> None:
    """Run the best points and the baseline on draws not used for tuning."""
    baseline = with_point(study, require_tune(study).baseline)
    points = {one.search.replace("_", " "): one.point(space) for one in found}
    cases: dict[tuple[object, ...], tuple[list[str], TomlTable]] = {}
    for name, point in comparable_points(study, baseline, points).items():
        cases.setdefault(tuple(point.values()), ([], point))[0].append(name)
    labelled = {", ".join(names): point for names, point in cases.values()}
    session.run(search.derive(study, labelled, name=study.name, judging=True), EVALUATION)
