"""The study of a stored tuning run. Reading it needs no JAX, so a report starts without it."""

from pathlib import Path

from sinsjax.errors import InputError
from sinsjax.execution import directory as places
from sinsjax.execution.directory import MANIFEST, STUDY
from sinsjax.study.identity import describe_differences
from sinsjax.study.load import load_study, study_to_toml
from sinsjax.study.study import Study
from sinsjax.tuning import history


def is_tuning(directory: Path) -> bool:
    """Whether a directory holds a tuning run, complete or not.

    Raises:
        InputError: a link or a pipe takes the place of one of its files or folders.
    """
    places.check_directory(directory)
    if (directory / MANIFEST).exists():  # plain results of a study with [tune]
        return False
    return stored_study(directory) is not None


def load_tuned_study(directory: Path) -> Study:
    """Load the study with [tune] of a tuning run.

    Raises:
        InputError: it cannot be read, or is not the study of the history.
    """
    remedy = "(delete it: `sinsjax tune --resume` writes it again)"
    tuned = history.read_study(directory)
    try:
        study = load_study(directory / STUDY)
    except InputError as error:
        raise InputError(f"{error} {remedy}" if tuned else str(error)) from None
    if tuned is not None and study_to_toml(tuned) != study_to_toml(study):
        differing = "; ".join(describe_differences(tuned, study, ("in the history", "in the file")))
        path = directory / STUDY
        raise InputError(f"{path}: is not the study of the history: {differing} {remedy}")
    return study


def stored_study(directory: Path) -> Study | None:
    """The study of a tuning run, from its history or else its file; None if there is none."""
    if (study := history.read_study(directory)) is not None:
        return study
    try:
        study = load_study(directory / STUDY)
    except InputError:
        return None
    return study if study.tune else None
