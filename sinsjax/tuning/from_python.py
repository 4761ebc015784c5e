"""Tuning from Python: a study is tuned into a directory, and the best point is returned."""

import threading
from pathlib import Path
from typing import Any

from sinsjax.execution.prepare import issue_warnings
from sinsjax.execution.progress import python_progress
from sinsjax.records.reference import StoredRecord
from sinsjax.study.study import Study
from sinsjax.tuning.results import TuningResults
from sinsjax.tuning.run_tuning import prepare_tuning, run_tuning


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
    of each search and of the evaluation, and the history that `history.read_history` reads.

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
    run_tuning(job, lambda search: python_progress(f"{name}: {search}", progress), stop)
    return TuningResults(Path(directory))
