"""A complete tuning run: the searches of [tune], their evaluation on other draws, the tuned study.

In order: the searches; the evaluation of all best points, the baseline and the reset schedule by
the law on draws not used for tuning; ``tuned.toml`` with the best point on the tuning draws and a
new seed. Complete stages are kept when a tuning run is resumed.
"""

import threading
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from sinsjax import messages
from sinsjax.errors import InputError, StudyInterrupted
from sinsjax.execution import directory as places
from sinsjax.execution import forecast
from sinsjax.execution.directory import STUDY, DamagedError
from sinsjax.execution.prepare import check_and_annotate_job, issue_warnings, load_job
from sinsjax.execution.progress import callback_or_progress_bar
from sinsjax.execution.run import RunProgress
from sinsjax.execution.tasks import Job
from sinsjax.platform.files import unwritable_message, write_file
from sinsjax.records.reference import StoredRecord
from sinsjax.study.load import describe_differences, fingerprint, study_to_toml, with_point
from sinsjax.study.search_space import SearchSpace, add_baseline_of_same_keys
from sinsjax.study.study import Study
from sinsjax.tuning import gradient, history, search
from sinsjax.tuning.history import EVALUATION, TUNED, SearchResult
from sinsjax.tuning.results import TuningResults
from sinsjax.tuning.search import LAW, SearchSession, ShowProgress, require_tune


def tune(
    study: Study | str | Path,
    directory: str | Path,
    record: StoredRecord | None = None,
    *,
    overwrite: bool = False,
    resume: bool = False,
    progress: bool | None = None,
    stop: threading.Event | None = None,
) -> TuningResults:
    """Tune a study into a directory.

    At the end it holds ``tuned.toml`` (the study with the best point and a new seed), the results
    of each search and of the evaluation, and the history that `read_history` reads.

    Args:
        study: study with [tune], its file, or the name of a shipped study.
        directory: must hold no tuning run unless ``overwrite`` or ``resume``.
        record: the record of a recorded study, with a reference (`prepare.load_increments`).
        overwrite: whether to replace an earlier tuning run.
        resume: whether to keep complete searches of the same tuning run and do only the rest.
        progress: whether to show the progress; None shows it on a terminal or in a notebook, after
            two seconds.
        stop: event that ends the tuning run; complete stages are kept.

    Returns:
        The best point, its objective and that of the baseline on draws not used for tuning.

    Raises:
        InputError: no [tune] or no reference, a variable without a gradient, a record that does not
            fit, or a directory that cannot be used.
        StudyInterrupted: ``stop`` was set.

    Examples:
        >>> changes = {"study.rate_hz": 10.0, "tune.searches": ["grid"], "tune.grid_points": 2}
        >>> changes |= {"tune.tune_draws": 2, "tune.evaluation_draws": 4}
        >>> tuned = sinsjax.tune(sinsjax.load_study("tune_condition5", changes), "tuned")
        >>> tuned.score.value < tuned.baseline.value
        True
    """
    given: dict[str, Any] = {"directory": directory, "overwrite": overwrite, "resume": resume}
    job = issue_warnings(prepare_tuning(study, None, record, **given))
    name = job.study.name
    run_tuning(job, lambda stage: callback_or_progress_bar(f"{name}: {stage}", progress), stop)
    return TuningResults(directory)


def prepare_tuning(
    study: Path | str | Study,
    overrides: Mapping[str, Any] | None = None,
    record: StoredRecord | Path | str | None = None,
    reference: Path | str | None = None,
    **options: Any,
) -> Job:
    """Check a tuning run and forecast its cost, see `prepare.prepare_job`; errors as `tune`."""
    job = load_job(study, overrides, record, reference, **options)
    require_tune(job.study)
    if job.directory is not None:
        _check_available(job.directory, overwrite=job.overwrite, resume=job.resume)
    _read_complete_searches(job)
    job = check_and_annotate_job(job, forecast.forecast_tuning(job.study))
    if job.stored is not None and job.stored.reference is None:
        text = "tuning on a record needs a reference (give it with --reference)"
        raise InputError(f"{job.study.name}: [tune]: {text}")
    if search.GRADIENT in require_tune(job.study).searches:
        gradient.check_gradients(job.study)
    return job


def run_tuning(job: Job, show_progress: ShowProgress, stop: threading.Event | None = None) -> None:
    """Run the searches of a job of `prepare_tuning`, evaluate them, and write the tuned study.

    ``stop`` ends it with `StudyInterrupted`; complete stages are kept.
    """
    session = SearchSession(job, show_progress, stop or threading.Event())
    study, directory = job.study, session.directory
    with places.lock_directory(directory):
        # Again, since the directory may have changed before it was locked.
        _check_available(directory, overwrite=job.overwrite, resume=job.resume)
        found = {result.search: result for result in _read_complete_searches(job)}
        try:
            for path in (*places.stale_temp_files(directory), directory / TUNED):
                path.unlink(missing_ok=True)
        except OSError as error:
            raise InputError(unwritable_message(directory, error)) from error
        history.write_history(directory, study, found.values())
        write_file(directory / STUDY, study_to_toml(study).encode())
        for name in require_tune(study).searches:
            if name != search.GRADIENT:  # points that are stored are not run again
                found[name] = search.search_points(study, name, session)
            elif name not in found:
                found[name] = _descend(study, session)
            history.write_history(directory, study, found.values())
        best = min(found.values(), key=lambda result: result.best.objective)
        _evaluate_searches_baseline_and_law(study, found.values(), best.best.candidate, session)
        tuned = search.make_tuned_study(study, best.point(SearchSpace.from_study(study)))
        text = study_to_toml(tuned)
        if not study.is_recorded:
            text = f"# The seed is new: its draws neither tuned nor evaluated.\n{text}"
        write_file(directory / TUNED, text.encode())


def _check_available(directory: Path, *, overwrite: bool, resume: bool) -> None:
    """Reject a directory with foreign files, or with a tuning run that may not be used."""
    if not history.is_tuning(directory):
        for name in (STUDY, TUNED, "figures", *search.DESIGNS, EVALUATION):
            if (directory / name).exists():
                text = f"holds a {name} that is not of a tuning run (give another directory)"
                raise InputError(f"{directory}: {text}")
    elif not (overwrite or resume):
        raise InputError(
            f"{directory}: already holds a tuning run (give --resume to continue it, or --overwrite"
            " to replace it; in Python resume=True or overwrite=True)"
        )


def _read_complete_searches(job: Job) -> list[SearchResult]:
    """Return the searches that a job continues, none if damaged; refuse those of another study."""
    directory, tune = job.directory, require_tune(job.study)
    if directory is None or not job.resume or not history.is_tuning(directory):
        return []
    try:
        stored = history.load_tuned_study(directory)
        known = history.read_searches(directory, SearchSpace.from_study(stored))
    except DamagedError:
        return []
    old, new = require_tune(stored).model_dump(), tune.model_dump()
    differ = [f"[tune] {key}" for key in old if old[key] != new[key]]
    if fingerprint(stored) != fingerprint(job.study):
        differ += describe_differences(stored, job.study)
    if differ:
        raise InputError(f"{directory}: holds a tuning run of another study: {'; '.join(differ)}")
    for result in known:
        if result.search not in tune.searches:
            raise InputError(
                f"{directory}: has the search '{result.search}', which {messages.GONE_MARK}"
                " (`sinsjax report` reads it; --overwrite repeats the tuning without)"
            )
    return known


def _descend(study: Study, session: SearchSession) -> SearchResult:
    """Run the gradient search, which stores nothing but its history."""
    with session.show_progress(search.GRADIENT) as on_progress:

        def report_or_stop(progress: RunProgress) -> None:
            if session.stop.is_set():
                raise StudyInterrupted(f"the complete searches are in {session.directory}")
            if on_progress is not None:
                on_progress(progress)

        return gradient.descend(study, session.job.stored, on_progress=report_or_stop)


def _evaluate_searches_baseline_and_law(
    study: Study, results: Iterable[SearchResult], combination: int, session: SearchSession
) -> None:
    """Run the best points, the baseline and the law's schedule on draws not used for tuning.

    The law's schedule is that of a combination of candidates. Equal points are run once.
    """
    space, baseline = SearchSpace.from_study(study), with_point(study, require_tune(study).baseline)
    points = {result.search: result.point(space) for result in results}
    if (law := search.reset_law_schedule_in_unit_box(study, combination)) is not None:
        (points[LAW],) = (one.keys(space) for one in search.points_at(space, combination, [law]))
    names: dict[tuple[object, ...], list[str]] = {}
    every = add_baseline_of_same_keys(study, baseline, points)
    for name, point in every.items():
        names.setdefault(tuple(point.values()), []).append(name)
    labelled = {", ".join(equal): every[equal[0]] for equal in names.values()}
    session.run(search.derive_study(study, labelled, name=study.name, evaluation=True), EVALUATION)
