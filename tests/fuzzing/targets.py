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
from sinsjax.study.load import fingerprint, load_study, study_from_dict, study_to_toml
from sinsjax.study.study import Study

_LONGEST_LINE = 2000
_MAX_VARIANTS, _MAX_MEMORY = 500, 1e9
"""Number and bytes, beyond which a study is resolved no further."""
_WHOLE_FILE_ERRORS = ("is not TOML", "is not UTF-8", "is nested too deeply", "cannot be read")


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
        raise AssertionError(f"takes more than {seconds:g} s")

    previous_handler = signal.signal(signal.SIGALRM, raise_late)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, previous_handler)


@contextlib.contextmanager
def proper_refusals(*names: object) -> Iterator[None]:
    """Suppress refusals in short printable lines that begin with one of the names."""
    try:
        yield
    except InputError as error:
        for line in error.lines:
            assert len(line) <= _LONGEST_LINE, f"{len(line)} characters: {line[:200]}..."
            assert not CONTROL.search(line), f"control characters: {line[:200]!r}"
            assert line.startswith(tuple(map(str, names)) or ""), f"names none of {names}: {line}"


def check_study(path: Path, content: bytes) -> None:
    """Load a study and resolve it as `run` does before compilation."""
    path.write_bytes(content)
    study = None
    with proper_refusals(path):
        try:
            study = load_study(path)
        except InputError as error:
            message = error.lines[0].removeprefix(f"{path}: ")
            assert message.startswith(_WHOLE_FILE_ERRORS) or re.search(r"\[.*\]", message), message
            raise
    if study is not None:
        path.write_text(study_to_toml(study), encoding="utf-8")
        assert fingerprint(load_study(path)) == fingerprint(study), "resolved, it is another study"
        with proper_refusals():
            resolve(study)


def resolve(study: Study) -> None:
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


def check_record(folder: Path, case: records.Case) -> None:
    """Describe a record as `init record` does; read it and its reference as `align` does."""
    suffix = ".parquet" if case.study["record"].get("format") == "parquet" else ".csv"
    record, reference = folder / f"r{suffix}", None
    record.write_bytes(case.record)
    if case.reference is not None:
        reference = folder / "reference.csv"
        reference.write_bytes(case.reference)
    with proper_refusals(record):
        tomllib.loads(make_study_text(record, folder / "its.toml"))
    study = None
    with proper_refusals("align: "):
        study = study_from_dict(case.study, "align")
    if study is not None:
        with proper_refusals(record, *([reference] if reference else []), study.name):
            job = prepare.prepare_job(study, None, record, reference)
            assert all("\n" not in line for line in (*job.warnings, *job.notes))
