"""Readers of the cases: each case must be accepted, or refused in one line."""

import contextlib
import re
import signal
import time
import tomllib
import traceback
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

from hypothesis import strategies as st
from support.memory import process_bytes

import sinsjax
from fuzzing import manifests, records, studies
from fuzzing.edits import HiddenValue
from sinsjax.engine.scenario import Scenario
from sinsjax.errors import InputError
from sinsjax.execution import forecast, prepare, store
from sinsjax.execution.directory import check_available, read_manifest
from sinsjax.execution.results import Results, read_curves, read_summary
from sinsjax.execution.tables import TableBuilder
from sinsjax.execution.tasks import Job
from sinsjax.messages import CONTROL
from sinsjax.study.from_record import make_study_text
from sinsjax.study.identity import fingerprint
from sinsjax.study.load import load_study, study_from_dict, study_to_toml
from sinsjax.study.study import Study
from sinsjax.tuning import history

MAX_S = 2.0
"""Longest time of a case, s."""

MAX_BYTES = 500e6
"""Largest memory of a case, bytes."""

_PACKAGE = Path(sinsjax.__file__).parent
_LONGEST_LINE = 2000
_MAX_VARIANTS, _MAX_MEMORY = 500, 1e9
"""Number and bytes, beyond which a study is resolved no further."""


class BrokenCase(AssertionError):
    """A case that is neither accepted nor properly refused."""


class Target(NamedTuple):
    """A reader of user input.

    Attributes:
        name: name of the reader.
        cases: its input.
        check: function that reads a case and raises an error if it misbehaves.
    """

    name: str
    cases: st.SearchStrategy[Any]
    check: Callable[[Any], None]


def make_targets(folder: Path) -> list[Target]:
    """Return all targets, which write into a folder."""
    stored = folder / "stored"
    files = manifests.write_results(stored)
    return [
        Target("studies", studies.study_files(), lambda case: check_study(folder / "s.toml", case)),
        Target(
            "manifests",
            manifests.manifest_cases(HiddenValue(files)),
            lambda case: check_directory(stored, files, case),
        ),
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


def error_signature(error: BaseException) -> str:
    """Return the signature of an error: its kind and where it was raised."""
    cause = error.__cause__ or error
    frames = traceback.extract_tb(cause.__traceback__)
    frames = [frame for frame in frames if Path(frame.filename).is_relative_to(_PACKAGE)]
    place = f"{Path(frames[-1].filename).name}:{frames[-1].lineno}" if frames else "no line of ours"
    message = re.sub(r"[\d.]+", "N", str(error))[:40] if isinstance(error, BrokenCase) else ""
    return f"{type(error).__name__} {message} at {place}"


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


def check_directory(directory: Path, files: dict[str, bytes], case: manifests.Case) -> None:
    """Read a results directory as reports, reruns and resumed sweeps do."""
    for name, content in case.files.items():
        (directory / name).unlink() if content is None else (directory / name).write_bytes(content)
    study, run_ids = manifests.STUDY, [0, 1]
    expected = forecast.forecast_sweep(study)
    questions: list[Callable[[], Any]] = [
        lambda: read_manifest(directory),
        lambda: read_summary(directory),
        lambda: read_summary(directory, ["run_id", "status"], run_ids=run_ids),
        lambda: read_curves(directory, run_ids),
        lambda: read_summary(directory).num_rows,
        lambda: check_available(directory, overwrite=False, resume=True),
        lambda: check_available(directory, overwrite=True, resume=False),
        lambda: store.continue_job(Job(study, directory=directory)),
        lambda: history.is_tuning(directory),
        lambda: Results.read(directory),
        lambda: forecast.check_disk(directory, expected),
    ]
    try:
        for question in questions:
            try:
                question()
            except InputError as error:
                check_error_lines(error, directory)
    finally:
        for name in case.files:
            (directory / name).write_bytes(files[name])


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


def measure_case(check: Callable[[Any], None], case: Any) -> None:
    """Check a case, with its time and memory.

    Raises:
        Broken: it took too long, or too much memory.
    """
    _reset_peak_memory()
    before, since = process_bytes("VmRSS"), time.process_time()
    with limit_time(10 * MAX_S):
        check(case)
    taken, grown = time.process_time() - since, process_bytes("VmHWM") - before
    if taken > MAX_S:
        raise BrokenCase(f"takes {taken:.1f} s of a core")
    if grown > MAX_BYTES:
        raise BrokenCase(f"takes {grown / 1e6:.0f} MB")


def _reset_peak_memory() -> None:
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5", encoding="ascii")
