"""A results directory: its manifest, its lock, and the files that sinsjax owns.

It contains ``summary/`` and optionally ``curves/`` (Parquet datasets, a part per chunk),
``study.toml`` (the resolved study), ``manifest.json`` (state, identity, versions), ``figures/`` and
``reruns/``. Its author may be unknown, so nothing in it is opened through a link. The directory
itself may be a link.
"""

import os
import re
from collections.abc import Iterable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any

import filelock
from pydantic import AliasPath, BaseModel, ConfigDict, Field, ValidationError

from sinsjax import columns
from sinsjax.errors import InputError
from sinsjax.execution import sealed
from sinsjax.execution.sealed import DamagedError
from sinsjax.messages import explain_error, shorten, to_one_line
from sinsjax.platform.files import make_folder, read_regular_file, unwritable_message

MANIFEST, STUDY, LOCK = "manifest.json", "study.toml", ".lock"
DATASETS = ("summary", "curves")
"""A part of the summary is written last: it implies its counterpart in the curves."""

RERUN_FILES = ("summary.parquet", "curve.parquet", "curve.png")
"""Files of a repeated run."""

_TUNING = ("tuned.toml", "history.parquet", "grid", "sobol", "evaluation")
_NAMES = (MANIFEST, STUDY, LOCK, *DATASETS, "figures", "reruns", *_TUNING)
_FIGURE_MARK = b"Software\0sinsjax"  # as `plots.render_png` writes it, before the pixels


class Manifest(BaseModel):
    """The entries of a manifest that sinsjax itself reads.

    Attributes:
        identity: of the job, see `tasks.Job.identity`.
        fingerprint: of the study.
        state: "running", "interrupted" or "complete".
        curves: whether curves are kept; None follows the study.
        chunk_runs: runs per chunk, as given to the job.
        extended_at: numbers of draws before each extension, as in the job.
        runs_done: number of runs that were stored when it was written.
        started_unix_s: start time, s since 1970.
        wall_s: duration of all sessions, s.
        versions: of the packages that may change the rows.
        instructions: instruction set that computed the rows.
        config: the study's file, or another label.
        warnings: doubts about the study before it ran, one line each.
        record_latitude_deg: latitude in the record's header, deg.
        study: sections of the resolved study.
        draws: number of draws of that study; None for a record.
        external: programs outside sinsjax of that study.
    """

    model_config = ConfigDict(allow_inf_nan=False)

    identity: str
    fingerprint: str = ""
    state: str = ""
    curves: bool | None = None
    chunk_runs: Annotated[int, Field(ge=1)] | None = None
    extended_at: tuple[Annotated[int, Field(ge=1)], ...] = ()
    runs_done: int = 0
    started_unix_s: float | None = None
    wall_s: float | None = None
    versions: dict[str, str] = {}
    instructions: str | None = None
    config: str | None = None
    warnings: list[str] = []
    record_latitude_deg: float | None = None
    study: dict[str, Any] = {}
    draws: int | None = Field(default=None, validation_alias=AliasPath("study", "study", "draws"))
    external: tuple[str, ...] = Field(
        default=(), validation_alias=AliasPath("study", "study", "external")
    )

    @classmethod
    def read(cls, directory: Path) -> "Manifest":
        """Read the manifest of a results directory; it is refused as by `read_manifest`."""
        entries = read_manifest(directory)
        try:
            return cls.model_validate(entries)
        except ValidationError as error:
            first = error.errors()[0]
            text = to_one_line(f"{'.'.join(map(str, first['loc']))}: {explain_error(first)}")
            raise DamagedError(f"{directory / MANIFEST}: {text}") from None

    @classmethod
    def find(cls, directory: Path) -> "Manifest | None":
        """Return the manifest of a results directory, None without one; refused as by `read`."""
        return cls.read(directory) if (directory / MANIFEST).exists() else None


class OtherVersionError(InputError):
    """Results written by another version of sinsjax."""


def read_manifest(directory: str | Path) -> dict[str, Any]:
    """Read the manifest of a results directory.

    Args:
        directory: results directory.

    Returns:
        Its entries, as JSON values.

    Raises:
        InputError: there is no manifest, it has changed since it was written (`DamagedError`), or
            another version wrote it (`OtherVersionError`).

    Examples:
        >>> study = sinsjax.load_study("paper1_resets", {"study.draws": 2, "study.rate_hz": 10.0})
        >>> _ = sinsjax.run_into(study, "out")
        >>> manifest = sinsjax.read_manifest("out")
        >>> manifest["state"], manifest["runs_done"], manifest["seed"]
        ('complete', 6, 1)
    """
    directory = Path(directory)
    try:
        manifest = sealed.read_sealed_json(directory / MANIFEST)
    except FileNotFoundError:
        raise InputError(f"{directory}: contains no results ({MANIFEST} is missing)") from None
    except DamagedError as error:
        remedy = "restore it; `sinsjax.read_summary` with verify=False reads the rows"
        raise DamagedError(f"{error} ({remedy})") from None
    schema = shorten(to_one_line(str(manifest.get("schema", columns.SCHEMA_VERSION))), 20)
    if schema != columns.SCHEMA_VERSION:
        versions = manifest.get("versions")
        version = versions.get("sinsjax", "") if isinstance(versions, dict) else ""
        raise OtherVersionError(
            f"{directory}: contains results of {shorten(to_one_line(f'sinsjax {version}'), 40)},"
            f" whose columns (schema {schema}) this version does not read (run the study again,"
            " into another directory or with --overwrite, or use that version)"
        )
    return manifest


def results_path(directory: str | Path) -> Path:
    """Return the path of a results directory.

    Raises:
        InputError: the path is empty.
    """
    if not str(directory):
        raise InputError("the results directory must not be empty (use '.' for the current one)")
    return Path(directory)


def check_directory(directory: Path) -> None:
    """Reject a directory in which a link or a pipe replaces a file or folder of results.

    Raises:
        InputError: names the entry, or the directory is a file, cannot be read, or has a name that
            is not UTF-8, which Arrow cannot open.
    """
    try:
        os.fspath(directory).encode()
        if directory.exists() and not directory.is_dir():
            raise InputError(f"{directory}: is a file, not a directory")
        for path in (directory / name for name in _NAMES):
            if path.is_symlink() or (path.exists() and not path.is_file() and not path.is_dir()):
                text = "is a link or a pipe, through which no results are read or written"
                raise InputError(f"{path}: {text} (remove it, or give another directory)")
    except UnicodeEncodeError:
        text = "results cannot be stored under a name that is not UTF-8 (rename it)"
        raise InputError(f"{directory}: {text}") from None
    except OSError as error:
        raise InputError(unwritable_message(directory, error)) from error


def list_parts(directory: Path, dataset: str) -> list[Path]:
    """Return the parts of a dataset by name; a file has its final name only once it is complete."""
    is_part = re.compile(r"part-\d{4,}-\d{6,}\.parquet").fullmatch
    return sorted(path for path in directory.glob(f"{dataset}/*.parquet") if is_part(path.name))


# --- one writer at a time -----------------------------------------------------------------------


def lock_directory(directory: Path) -> filelock.FileLock:
    """Lock a directory, created if missing, against other writers.

    The operating system releases the lock when the process ends, in whatever way.

    Raises:
        InputError: another process is writing there, or the directory is not writable.
    """
    make_folder(directory)
    check_directory(directory)
    file_lock = filelock.FileLock(directory / LOCK)
    try:
        file_lock.acquire(blocking=False)
    except filelock.Timeout:
        text = "another process is writing there (wait until it ends)"
        raise InputError(f"{directory}: {text}") from None
    except OSError as error:
        raise InputError(unwritable_message(directory, error)) from error
    return file_lock


def check_unlocked(directory: Path) -> None:
    """Reject a directory that another process is writing to.

    This check precedes all others, since the content is changing.

    Raises:
        InputError: there is such a process, or the lock cannot be acquired.
    """
    check_directory(directory)
    if (directory / LOCK).exists():
        lock_directory(directory).release()


# --- the files that sinsjax wrote; it removes no others -------------------------------------------


def stale_temp_files(directory: Path) -> list[Path]:
    """Return temporary files left by processes killed while writing results or a tuning run."""
    is_ours = re.compile(r"\..+\.(json|toml|parquet|png)\.\d+\.tmp").fullmatch
    folders = (".", *DATASETS, "figures")
    candidates = (path for folder in folders for path in directory.glob(f"{folder}/.*.tmp"))
    return [path for path in candidates if is_ours(path.name)]


def owned_files(directory: Path) -> list[Path]:
    """Return the files that sinsjax wrote, identified by name, and figures by their mark.

    This excludes files added by the user, and figures that another program has written since.
    """
    parts = (path for name in DATASETS for path in list_parts(directory, name))
    numbers = (path for path in directory.glob("reruns/*") if re.fullmatch(r"\d+", path.name))
    reruns = (path / name for path in numbers if not path.is_symlink() for name in RERUN_FILES)
    named = (path for path in (*reruns, directory / STUDY) if path.is_file())
    return [*parts, *named, *_list_figures(directory)]


def remove_other_figures(directory: Path, names: Iterable[str]) -> None:
    """Remove the figures that sinsjax drew in a directory under other names than these."""
    for path in _list_figures(directory):
        if path.name not in names:
            with suppress(OSError):  # the directory may be read only
                path.unlink()


def _list_figures(directory: Path) -> Iterator[Path]:
    for path in sorted(directory.glob("figures/*.png")):
        with suppress(OSError, InputError):
            if _FIGURE_MARK in read_regular_file(path)[:200]:
                yield path
