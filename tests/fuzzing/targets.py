"""Readers of the cases: each case must be accepted, or refused in one line."""

import contextlib
import re
import signal
import tomllib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

from hypothesis import strategies as st

from fuzzing import records, studies
from sinsjax.engine.scenario import Scenario
from sinsjax.errors import InputError
from sinsjax.execution import forecast, prepare
from sinsjax.execution.tables import TableBuilder
from sinsjax.messages import CONTROL
from sinsjax.study.from_record import make_study_text
from sinsjax.study.identity import fingerprint
from sinsjax.study.load import load_study, study_from_dict, study_to_toml
from sinsjax.study.study import Study

_LONGEST_LINE = 2000
_MAX_VARIANTS, _MAX_MEMORY = 500, 1e9
"""Number and bytes, beyond which a study is resolved no further."""


class BrokenCase(AssertionError):
    """A case that is neither accepted nor properly refused."""


class Target(NamedTuple):
    """A reader of user input: its cases, and what raises an error if it misbehaves at one."""

    name: str
    cases: st.SearchStrategy[Any]
    check: Callable[[Any], None]


def make_targets(folder: Path) -> list[Target]:
    """Return all targets, which write into a folder."""
    return [
        Target("studies", studies.study_files(), lambda case: check_study(folder / "s.toml", case)),
        Target("records", records.record_cases(), lambda case: check_record(folder, case)),
    ]


@contextlib.contextmanager
def limit_time(seconds: float) -> Iterator[None]:
    """Fail a block that takes too long; in the main thread only."""

    def raise_late(*_: Any) -> None:
        raise BrokenCase(f"takes more than {seconds:g} s")

    previous_handler = signal.signal(signal.SIGALRM, raise_late)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, previous_handler)


def check_error_lines(error: InputError, *names: object) -> str:
    """Return the first line of a refusal after checking the form of all lines.

    Args:
        error: the refusal.
        names: possible beginnings of the lines.
    """
    for line in error.lines:
        if len(line) > _LONGEST_LINE:
            raise BrokenCase(f"a line of {len(line)} characters: {line[:200]}...") from error
        if CONTROL.search(line):
            raise BrokenCase(f"control characters: {line[:200]!r}") from error
        if names and not line.startswith(tuple(map(str, names))):
            raise BrokenCase(f"names none of {names}: {line[:200]}") from error
    return error.lines[0]


_WHOLE_FILE_ERRORS = ("is not TOML", "is not UTF-8", "is nested too deeply", "cannot be read")
"""Errors about a whole file."""


def check_study(path: Path, content: bytes) -> None:
    """Load a study and resolve it as `run` does before compilation."""
    path.write_bytes(content)
    try:
        study = load_study(path)
    except InputError as error:
        line = check_error_lines(error, path)
        message = line.removeprefix(f"{path}: ")
        if not message.startswith(_WHOLE_FILE_ERRORS) and not re.search(r"\[.*\]", message):
            raise BrokenCase(f"names no key: {message}") from error
        return
    resolved_text = study_to_toml(study)
    path.write_text(resolved_text, encoding="utf-8")
    try:
        if fingerprint(load_study(path)) != fingerprint(study):
            raise BrokenCase("its resolved study is another one")
    except InputError as error:
        raise BrokenCase(f"its resolved study is refused: {error}") from error
    with contextlib.suppress(InputError):
        check_resolution(study)


def check_resolution(study: Study) -> None:
    """Check the resolution of a study before compilation; refusals are one line."""
    try:
        if study.study.rate_hz:
            forecast_of = forecast.forecast_tuning if study.tune else forecast.forecast_sweep
            expected = forecast_of(study)
            expected.describe(2)
            if study.n_variants > _MAX_VARIANTS or expected.memory > _MAX_MEMORY:
                return
        if not study.is_recorded:
            job = prepare.prepare_job(study)
            assert all("\n" not in line for line in (*job.warnings, *job.notes))
            Scenario(job.study)
            TableBuilder(job.study)
    except InputError as error:
        check_error_lines(error)
        raise


def check_record(folder: Path, case: records.Case) -> None:
    """Describe a record as `init record` does; read it and its reference as `align` does."""
    suffix = ".parquet" if case.study["record"].get("format") == "parquet" else ".csv"
    record, reference = folder / f"r{suffix}", folder / "reference.csv"
    record.write_bytes(case.record)
    if case.reference is not None:
        reference.write_bytes(case.reference)
    try:
        tomllib.loads(make_study_text(record, folder / "its.toml"))
    except InputError as error:
        check_error_lines(error, record)
    try:
        study = study_from_dict(case.study, "align")
    except InputError as error:
        check_error_lines(error, "align: ")
        return
    try:
        given = None if case.reference is None else reference
        job = prepare.prepare_job(study, None, record, given)
        for line in (*job.warnings, *job.notes):
            check_error_lines(InputError(line))
    except InputError as error:
        check_error_lines(error, record, reference, study.name)
