"""A complete tuning run: the searches of [tune], their evaluation on other draws, the tuned study.

In order: the searches; the evaluation of all best points, the baseline and the reset schedule by
the law on draws not used for tuning; ``tuned.toml`` with the best point on the tuning draws and a
new seed. Complete stages are kept when a tuning run is resumed.
"""

import threading
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from sinsjax import gone
from sinsjax.errors import InputError, StudyInterrupted
from sinsjax.execution import directory as places
from sinsjax.execution import forecast
from sinsjax.execution.directory import STUDY
from sinsjax.execution.prepare import finish_job, load_job
from sinsjax.execution.run import RunProgress
from sinsjax.execution.sealed import DamagedError
from sinsjax.execution.tasks import Job
from sinsjax.platform.files import atomic_write, unwritable_message
from sinsjax.records.reference import StoredRecord
from sinsjax.study.identity import describe_differences, fingerprint
from sinsjax.study.keys import TomlTable
from sinsjax.study.load import study_to_toml, with_point
from sinsjax.study.schema import TuneSection
from sinsjax.study.search_space import SearchSpace, comparable_points
from sinsjax.study.study import Study
from sinsjax.tuning import gradient, history, search
from sinsjax.tuning.history import SearchResult, is_tuning, load_stored_study
from sinsjax.tuning.law_point import law_point
from sinsjax.tuning.search import SearchSession, ShowProgress

TUNED, EVALUATION = "tuned.toml", "evaluation"
LAW = "law"
"""Name of the reset schedule by the law among the evaluated points."""

GRADIENT = gradient.NAME
_SEARCHES = ("grid", "sobol", "random", "equal_cost")  # the last two are of version 1.0
_NAMES = (STUDY, TUNED, history.FILE, "figures", *_SEARCHES, EVALUATION)


def prepare_tuning(
    study: Path | str | Study,
    overrides: Mapping[str, Any] | None = None,
    record: StoredRecord | Path | str | None = None,
    reference: Path | str | None = None,
    **options: Any,
) -> Job:
    """Check a tuning run and forecast what it takes, see `prepare.prepare_job`.

    Raises:
        InputError: as `from_python.tune`.
    """
    job = load_job(study, overrides, record, reference, **options)
    require_tune(job.study)
    if job.directory is not None:
        check_directory(job.directory, overwrite=job.overwrite, resume=job.resume)
        if job.resume:
            _check_same_study(job)
    job = finish_job(job, forecast.forecast_tuning(job.study))
    if job.stored is not None and job.stored.reference is None:
        text = "tuning on a record needs a reference (give it with --reference)"
        raise InputError(f"{job.study.name}: [tune]: {text}")
    if GRADIENT in require_tune(job.study).searches:
        gradient.check_gradients(job.study)
    return job


def run_tuning(job: Job, show_progress: ShowProgress, stop: threading.Event | None = None) -> None:
    """Run the searches of a prepared tuning run, evaluate them, and write the tuned study.

    Args:
        job: from `prepare_tuning`.
        show_progress: gives the progress callback for the name of a search.
        stop: event that ends the tuning run; complete stages are kept.

    Raises:
        InputError: the directory cannot be written, or another process has written there.
        StudyInterrupted: ``stop`` was set.
    """
    session = SearchSession(job, show_progress, stop or threading.Event())
    study, directory = job.study, session.directory
    with places.lock_directory(directory):
        # Again, since the directory may have changed before it was locked.
        check_directory(directory, overwrite=job.overwrite, resume=job.resume)
        known, results = _prepare_directory(study, session), list[SearchResult]()
        for name in require_tune(study).searches:
            results.append(_run_search(study, name, session, known))
            history.write_history(directory, study, results)
        best = min(results, key=lambda result: result.best.objective)
        _evaluate_best_points(study, results, best.best.candidate, session)
        tuned = make_tuned_study(study, best.point(SearchSpace.from_study(study)))
        text = study_to_toml(tuned)
        if not study.is_recorded:
            text = f"# The seed is new: its draws neither tuned nor evaluated.\n{text}"
        with atomic_write(directory / TUNED) as file:
            file.write(text.encode())


def make_tuned_study(study: Study, point: TomlTable) -> Study:
    """Return the study of ``tuned.toml``: with a point, on draws not used so far."""
    tuned = with_point(study, point)
    if study.is_recorded:
        return tuned
    return tuned.replace({"study.seed": search.unused_seed(study)})


def require_tune(study: Study) -> TuneSection:
    """Return the [tune] section of a study.

    Raises:
        InputError: there is none.
    """
    if study.tune is None:
        raise InputError(f"{study.name}: has no [tune] section")
    return study.tune


def check_directory(directory: Path, *, overwrite: bool, resume: bool) -> None:
    """Reject a directory with foreign files, or a tuning run that may be neither used nor replaced.

    Raises:
        InputError: the directory cannot be used.
    """
    places.check_directory(directory)
    taken = [name for name in _NAMES if (directory / name).exists()]
    if taken and not is_tuning(directory):
        raise InputError(
            f"{directory}: holds a {taken[0]} that is not of a tuning run (give another directory)"
        )
    if taken and not (overwrite or resume):
        raise InputError(
            f"{directory}: already holds a tuning run (give --resume to continue it, or --overwrite"
            " to replace it; in Python resume=True or overwrite=True)"
        )


def _prepare_directory(study: Study, session: SearchSession) -> list[SearchResult]:
    """Prepare the directory; return the searches of its history when resuming.

    Raises:
        InputError: a search is gone, whose points are evaluated, or a file cannot be written.
    """
    directory, known = session.directory, list[SearchResult]()
    places.remove_files(places.stale_temp_files(directory))
    try:
        if not session.job.resume:
            for name in (TUNED, history.FILE):
                (directory / name).unlink(missing_ok=True)
        elif (directory / history.FILE).exists():
            with suppress(DamagedError):  # its searches are repeated, from the stored parts
                known = history.read_searches(directory, SearchSpace.from_study(study))
    except OSError as error:
        raise InputError(unwritable_message(directory, error)) from error
    for result in known:
        if result.search not in require_tune(study).searches:
            raise InputError(
                f"{directory}: has the search '{result.search}', which {gone.MARK}"
                " (`sinsjax report` reads it; --overwrite repeats the tuning without)"
            )
    history.write_history(directory, study, known)
    with atomic_write(directory / STUDY) as file:
        file.write(study_to_toml(study).encode())
    return known


def _check_same_study(job: Job) -> None:
    """Reject resuming the tuning run of another study."""
    assert job.directory is not None
    stored = load_stored_study(job.directory)
    if stored is None:
        return
    old, new = (require_tune(study).model_dump() for study in (stored, job.study))
    differ = [f"[tune] {key}" for key in old if old[key] != new[key]]
    if fingerprint(stored) != fingerprint(job.study):
        differ += describe_differences(stored, job.study)
    if differ:
        text = "; ".join(differ)
        raise InputError(f"{job.directory}: holds a tuning run of another study: {text}")


def _run_search(
    study: Study, name: str, session: SearchSession, known: Sequence[SearchResult]
) -> SearchResult:
    """Run a search, or return it from the known ones."""
    settings = require_tune(study)
    if name == GRADIENT:
        done = [result for result in known if result.search == name]
        return done[0] if done else _descend(study, session)
    if name == "grid":
        design = search.grid_design(study, settings.grid_points)
    else:
        design = search.sobol_design(study, name, settings.sobol_points)
    return search.evaluate_design(study, name, search.add_law_points(study, design), session)


def _descend(study: Study, session: SearchSession) -> SearchResult:
    """Run the gradient search, which stores nothing but its history."""
    with session.show_progress(GRADIENT) as on_progress:

        def report_or_stop(progress: RunProgress) -> None:
            if session.stop.is_set():
                raise StudyInterrupted(f"the complete searches are in {session.directory}")
            if on_progress is not None:
                on_progress(progress)

        return gradient.descend(study, session.job.stored, on_progress=report_or_stop)


def _evaluate_best_points(
    study: Study, results: Sequence[SearchResult], candidate: int, session: SearchSession
) -> None:
    """Run the best points, the baseline and the law's schedule on draws not used for tuning.

    The law's schedule is that of a combination of candidates. Equal points are run once.
    """
    space, baseline = SearchSpace.from_study(study), with_point(study, require_tune(study).baseline)
    points = {result.search.replace("_", " "): result.point(space) for result in results}
    if (box := law_point(study, candidate)) is not None:
        values = space.to_values(np.nan_to_num(box))
        points[LAW] = space.make_point(values, space.combinations[candidate])
    cases: dict[tuple[object, ...], tuple[list[str], TomlTable]] = {}
    for name, point in comparable_points(study, baseline, points).items():
        cases.setdefault(tuple(point.values()), ([], point))[0].append(name)
    labelled = {", ".join(names): point for names, point in cases.values()}
    session.run(search.derive_study(study, labelled, name=study.name, evaluation=True), EVALUATION)
