"""Tuning from Python: a study is tuned into a directory, and the best point is returned."""

import threading
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from sinsjax.analysis import Estimate, format_estimate
from sinsjax.execution.prepare import RunOptions, issue_warnings
from sinsjax.execution.progress import python_progress
from sinsjax.records.reference import StoredRecord
from sinsjax.study import display
from sinsjax.study.changes import copy_tables
from sinsjax.study.keys import TomlTable
from sinsjax.study.search_space import SearchSpace
from sinsjax.study.study import Study
from sinsjax.tuning import results
from sinsjax.tuning.run_tuning import LAW, prepare_tuning, run_tuning


@dataclass(frozen=True, repr=False)
class TuningResults:
    """Results of a tuning run, read from its directory when needed.

    Attributes:
        directory: directory of the tuning run.

    Examples:
        >>> changes = {"study.rate_hz": 10.0, "tune.searches": ["grid"], "tune.grid_points": 2}
        >>> changes |= {"tune.tune_draws": 2, "tune.evaluation_draws": 4}
        >>> tuned = sinsjax.tune(sinsjax.load_study("tune_condition5", changes), "tuned")
        >>> tuned.best
        {'reset_times_s': [2.0, 20.0]}
        >>> tuned.study.n_variants, tuned.score.n
        (1, 4)
    """

    directory: Path

    @property
    def study(self) -> Study:
        """The study with the best point and without [tune], as in ``tuned.toml``.

        Its seed is new, so that its draws neither tuned nor evaluated.
        """
        return self._tuning.tuned

    @cached_property
    def best(self) -> TomlTable:
        """The best point on the tuning draws: values by key, in the units of the file."""
        found = self._tuning.searches[self._tuning.best]
        return copy_tables(found.point(SearchSpace.from_study(self._tuning.search_study)))

    @property
    def search(self) -> str:
        """The search that found the best point."""
        return results.SEARCH_LABELS[self._tuning.best]

    @property
    def objective(self) -> str:
        """The minimised quantity, with its unit."""
        return results.objective_label(self._tuning.search_study)

    @cached_property
    def score(self) -> Estimate:
        """The objective of the best point on the evaluation draws, with its 95 % interval."""
        return self._tuning.score(self._tuning.best)

    @cached_property
    def baseline(self) -> Estimate:
        """The objective of the baseline on the same draws, with its 95 % interval."""
        return self._tuning.score("baseline")

    @cached_property
    def law(self) -> Estimate | None:
        """The objective of the reset schedule by the law on the same draws; None without one."""
        tuning = self._tuning
        return tuning.score(LAW) if LAW in tuning.case_numbers else None

    @cached_property
    def _tuning(self) -> results.Tuning:
        return results.Tuning.read(self.directory)

    def __repr__(self) -> str:
        """Return five short lines: objective, best point, its score, the baseline's, place."""
        return display.format_text(f"Tuning of {self._tuning.search_study.name}", self._facts())

    def _facts(self) -> dict[str, str]:
        point = ", ".join(f"{key} = {_value_text(value)}" for key, value in self.best.items())
        score, baseline = map(format_estimate, (self.score, self.baseline))
        return {
            "objective": self.objective,
            "best": f"{point} ({self.search})",
            "score": f"{score}; baseline {baseline}",
            "stored": f"in {self.directory}",
        }


def _value_text(value: object) -> str:
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(_value_text, value))}]"
    return f"{value:.5g}" if isinstance(value, float) else str(value)


def tune(
    study: Study | str | Path,
    directory: str | Path,
    record: StoredRecord | None = None,
    *,
    overwrite: bool = False,
    resume: bool = False,
    progress: bool | None = None,
    stop: threading.Event | None = None,
    source: Path | str | None = None,
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
        source: words for the study in manifests; None for its file.

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
    options = RunOptions(directory, overwrite=overwrite, resume=resume, source=source)
    job = issue_warnings(prepare_tuning(study, None, record, None, options))
    name = job.study.name
    run_tuning(job, lambda search: python_progress(f"{name}: {search}", progress), stop)
    assert job.directory is not None
    return TuningResults(job.directory)
