"""A results directory: its manifest, its lock, its sealed files and the others that sinsjax owns.

It contains ``summary/`` and optionally ``curves/`` (Parquet datasets, a part per chunk),
``study.toml`` (the resolved study), ``manifest.json`` (state, identity, versions), ``figures/`` and
``reruns/``. Its author may be unknown, so nothing in it is opened through a link. The directory
itself may be a link.

The checksums of Parquet pages do not cover the footer, and JSON has none. A sealed file contains
the SHA-256 of its own bytes, computed with zeros in place of the 64 digits. It needs no second file
and remains valid when the file is copied or renamed.
"""

import hashlib
import json
import re
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any

import filelock
import pyarrow as pa
import pyarrow.parquet as pq
from pydantic import AliasPath, BaseModel, ConfigDict, Field, ValidationError

from sinsjax import columns
from sinsjax.errors import InputError
from sinsjax.messages import explain_error, shorten
from sinsjax.platform.files import make_folder, read_regular_file, unwritable_message

SEAL_KEY = "sinsjax.sha256"
_BLANK_DIGEST = "0" * 64
# The separators of key and value in JSON, and in the footer of a Parquet file.
_SEAL = re.compile(rb'sinsjax\.sha256(?:": "|\x18\x40)([0-9a-f]{64})')


class DamagedError(InputError):
    """A sealed file that has changed since it was written, or has no seal."""


def to_sealed_json(content: Mapping[str, Any]) -> bytes:
    """Return a JSON object as text, sealed by its last entry."""
    text = json.dumps({**content, SEAL_KEY: _BLANK_DIGEST}, indent=1, allow_nan=False)
    return _fill_seal(f"{text}\n".encode())


def to_sealed_parquet(table: pa.Table, extra_metadata: Mapping[str, str] | None = None) -> bytes:
    """Return a table as a sealed Parquet file with more metadata; equal ones give equal bytes."""
    metadata = {key.decode(): value for key, value in (table.schema.metadata or {}).items()}
    metadata.pop(SEAL_KEY, None)  # that of the file from which the rows were read
    schema = table.schema.with_metadata(metadata | dict(extra_metadata or {}))
    sink = pa.BufferOutputStream()
    # Numbers seldom repeat: a dictionary would make them larger and three times as slow.
    options = {"compression": "zstd", "use_dictionary": False, "write_page_checksum": True}
    with pq.ParquetWriter(sink, schema, **options) as writer:
        writer.write_table(table.replace_schema_metadata(schema.metadata))
        # In the footer only: the schema would store a second copy, in another encoding.
        writer.add_key_value_metadata({SEAL_KEY: _BLANK_DIGEST})
    return _fill_seal(sink.getvalue().to_pybytes())


def read_sealed_json(path: Path) -> dict[str, Any]:
    """Read a sealed JSON object, or raise as `read_sealed_parquet`."""
    entries: dict[str, Any] = json.loads(_read_intact(path))
    return entries


def read_sealed_parquet(path: Path) -> pa.Table:
    """Read a sealed Parquet file; `DamagedError`, `FileNotFoundError` or another `InputError`."""
    return pq.read_table(pa.BufferReader(_read_intact(path)))


def is_intact(content: bytes) -> bool:
    """Return whether a file's content matches its seal; False without one."""
    return content != b"" and _fill_seal(content) == content


def _read_intact(path: Path) -> bytes:
    content = read_regular_file(path)
    if not is_intact(content):
        text = "has changed since it was written (its checksum does not match)"
        raise DamagedError(f"{path}: {text}")
    return content


def _fill_seal(content: bytes) -> bytes:
    """Return content with the SHA-256 of all the rest in its last seal; nothing without one."""
    start = content.rfind(SEAL_KEY.encode())
    seal = _SEAL.match(content, start) if start >= 0 else None
    if seal is None:
        return b""
    before, after = memoryview(content)[: seal.start(1)], memoryview(content)[seal.end(1) :]
    digest = hashlib.sha256(before)
    digest.update(_BLANK_DIGEST.encode())
    digest.update(after)
    return b"".join([before, digest.hexdigest().encode(), after])


MANIFEST, STUDY, LOCK = "manifest.json", "study.toml", ".lock"
DATASETS = ("summary", "curves")
"""A part of the summary is written last: it implies its counterpart in the curves."""

RERUN_FILES = ("summary.parquet", "curve.parquet", "curve.png")
"""Files of a repeated run."""

_TUNING = ("tuned.toml", "history.parquet", "grid", "sobol", "evaluation")
_NAMES = (MANIFEST, STUDY, LOCK, *DATASETS, "figures", "reruns", *_TUNING)
_FIGURE_MARK = b"Software\0sinsjax"  # as `plots.render_png` writes it, before the pixels


class Manifest(BaseModel):
    """The manifest of a results directory: all entries as JSON, and those that sinsjax reads."""

    model_config = ConfigDict(allow_inf_nan=False)

    entries: dict[str, Any] = {}
    identity: str
    fingerprint: str = ""
    state: str = ""  # "running", "interrupted" or "complete"
    curves: bool | None = None
    chunk_runs: Annotated[int, Field(ge=1)] | None = None
    extended_at: tuple[Annotated[int, Field(ge=1)], ...] = ()
    runs_done: int = 0  # when it was written
    wall_s: float | None = None  # of all sessions
    versions: dict[str, str] = {}
    instructions: str | None = None
    config: str | None = None
    warnings: tuple[str, ...] = ()
    record_latitude_deg: float | None = None
    study: dict[str, Any] = {}
    draws: int | None = Field(default=None, validation_alias=AliasPath("study", "study", "draws"))

    @classmethod
    def read(cls, directory: Path, *, any_version: bool = False) -> "Manifest":
        """Read the manifest of a results directory; it is refused as by `read_manifest`."""
        refuse_links(directory)
        path = directory / MANIFEST
        try:
            entries = read_sealed_json(path)
        except FileNotFoundError:
            raise InputError(f"{directory}: contains no results ({MANIFEST} is missing)") from None
        except DamagedError as error:
            remedy = "restore it; `pyarrow.dataset.dataset` reads the rows of summary/"
            raise InputError(f"{error} ({remedy})") from None
        schema = shorten(str(entries.get("schema", columns.SCHEMA_VERSION)), 20)
        if schema != columns.SCHEMA_VERSION and not any_version:
            raise InputError(
                f"{directory}: its columns (schema {schema}) are those of another version of"
                f" sinsjax (use that one, which {MANIFEST} names, or give --overwrite)"
            )
        try:
            return cls.model_validate(entries | {"entries": entries})
        except ValidationError as error:
            first = error.errors()[0]
            key = ".".join(map(str, first["loc"]))
            raise InputError(f"{path}: {key}: {explain_error(first)}") from None

    @classmethod
    def find(cls, directory: Path) -> "Manifest | None":
        """Return the manifest of a results directory, None without one; refused as by `read`."""
        return cls.read(directory) if (directory / MANIFEST).exists() else None


def read_manifest(directory: str | Path) -> dict[str, Any]:
    """Read the manifest of a results directory.

    Args:
        directory: results directory.

    Returns:
        Its entries, as JSON values.

    Raises:
        InputError: there is no manifest, it has changed since it was written, or another version
            wrote it.

    Examples:
        >>> study = sinsjax.load_study("paper1_resets", {"study.draws": 2, "study.rate_hz": 10.0})
        >>> _ = sinsjax.run_into(study, "out")
        >>> manifest = sinsjax.read_manifest("out")
        >>> manifest["state"], manifest["runs_done"], manifest["seed"]
        ('complete', 6, 1)
    """
    return Manifest.read(Path(directory)).entries


def refuse_links(directory: Path) -> None:
    """Reject a directory in which a link or a pipe replaces a file or folder of results."""
    if str(directory) != str(directory).encode(errors="ignore").decode():
        raise InputError(f"{directory}: results need a folder whose name is UTF-8 (rename it)")
    try:
        if directory.exists() and not directory.is_dir():
            raise InputError(f"{directory}: is a file, not a directory")
        for path in (directory / name for name in _NAMES):
            if path.is_symlink() or (path.exists() and not path.is_file() and not path.is_dir()):
                text = "is a link or a pipe, through which no results are read or written"
                raise InputError(f"{path}: {text} (remove it, or give another directory)")
    except OSError as error:
        raise InputError(unwritable_message(directory, error)) from error


def refuse_existing_results(directory: Path, *, overwrite: bool, resume: bool) -> None:
    """Reject a directory with results that may not be used, or without, with other such files."""
    refuse_links(directory)
    names = (*DATASETS, "figures", STUDY)
    if not (directory / MANIFEST).exists():
        if existing := [name for name in names if (directory / name).exists()]:
            text = f"contains {existing[0]}, which is not a result (give another directory)"
            raise InputError(f"{directory}: {text}")
    elif Manifest.read(directory, any_version=overwrite) and not (overwrite or resume):
        raise InputError(
            f"{directory}: already contains results (give --resume to continue them, or --overwrite"
            " to replace them; in Python resume=True or overwrite=True)"
        )


def lock_directory(directory: Path) -> filelock.FileLock:
    """Lock a directory, created if missing, against other writers.

    The operating system releases the lock when the process ends, in whatever way.
    """
    make_folder(directory)
    refuse_links(directory)
    file_lock = filelock.FileLock(directory / LOCK)
    try:
        file_lock.acquire(blocking=False)
    except filelock.Timeout:
        text = "another process is writing there (wait until it ends)"
        raise InputError(f"{directory}: {text}") from None
    except OSError as error:
        raise InputError(unwritable_message(directory, error)) from error
    return file_lock


def list_parts(directory: Path, dataset: str) -> list[Path]:
    """Return the parts of a dataset by name; a file has its final name only once it is complete."""
    return sorted(directory.glob(f"{dataset}/part-[0-9]*-[0-9]*.parquet"))


def stale_temp_files(directory: Path) -> list[Path]:
    """Return temporary files left by processes that were killed."""
    folders = (".", *DATASETS, "figures")
    return [path for name in folders for path in directory.glob(f"{name}/.*.*.[0-9]*.tmp")]


def owned_files(directory: Path) -> list[Path]:
    """Return the files that sinsjax wrote but the manifest, by their names; figures by a mark."""
    parts = (path for name in DATASETS for path in list_parts(directory, name))
    reruns = (path for name in RERUN_FILES for path in directory.glob(f"reruns/[0-9]*/{name}"))
    return [*parts, *reruns, *directory.glob(STUDY), *_list_figures(directory)]


def remove_files(paths: Iterable[Path]) -> None:
    """Remove some files."""
    for path in paths:
        try:
            path.unlink()
        except OSError as error:
            raise InputError(unwritable_message(path, error)) from error


def remove_other_figures(directory: Path, names: Iterable[str]) -> None:
    """Remove the figures that sinsjax drew in a directory under other names than these."""
    with suppress(InputError):  # the directory may be read only
        remove_files(path for path in _list_figures(directory) if path.name not in names)


def _list_figures(directory: Path) -> Iterator[Path]:
    for path in sorted(directory.glob("figures/*.png")):
        with suppress(OSError, InputError):
            if _FIGURE_MARK in read_regular_file(path)[:200]:
                yield path
