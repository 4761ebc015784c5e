"""Reading results from Parquet; every part is verified once per process."""

import json
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from sinsjax import columns, gone
from sinsjax.errors import InputError
from sinsjax.execution import sealed
from sinsjax.execution.directory import (
    ESTIMATES,
    STUDY,
    FileState,
    Manifest,
    check_directory,
    find_manifest,
    list_parts,
    read_manifest,
)
from sinsjax.messages import first_error_line, to_one_line
from sinsjax.platform import runtime
from sinsjax.platform.files import read_regular_file
from sinsjax.study.attitude_file import attitude_file
from sinsjax.study.identity import describe_differences, fingerprint, sections_to_json
from sinsjax.study.load import load_study
from sinsjax.study.study import Study
from sinsjax.study.sweep import without_gone_settings

STUDY_METADATA, CHUNK_METADATA = "sinsjax.study", "sinsjax.chunk"
"""Metadata of a part: identity of its job, and its chunk as JSON."""

_RESUME_HINT = "`--resume` computes damaged parts again"
_READERS = 4  # threads; hashing releases Python's lock


_verified: dict[FileState, str] = {}
"""Identity of the job of each part verified by this process."""


def read_summary(
    directory: str | Path,
    names: Sequence[str] | None = None,
    *,
    run_ids: list[int] | None = None,
    verify: bool = True,
) -> pa.Table:
    """Read rows of the summary, ordered by run_id.

    Args:
        directory: results directory.
        names: columns to read, in this order; None for all.
        run_ids: runs to read; None for all.
        verify: whether to verify the checksum of every part, once per process.

    Raises:
        InputError: the directory contains no results, a part has changed, or a column is missing.

    Examples:
        >>> study = sinsjax.load_study("paper1_resets", {"study.draws": 2, "study.rate_hz": 10.0})
        >>> _ = sinsjax.run_into(study, "out")
        >>> sinsjax.read_summary("out", ["run_id", "status"], run_ids=[4]).to_pylist()
        [{'run_id': 4, 'status': 'ok'}]
    """
    rows = None if run_ids is None else pc.field("run_id").isin(run_ids)
    return _read_sorted(directory, "summary", names, ["run_id"], verify=verify, rows=rows)


def read_curves(
    directory: str | Path, run_ids: list[int] | None = None, *, verify: bool = True
) -> pa.Table:
    """Read rows of the curves, ordered by run_id and time; empty if none were stored.

    Args:
        directory: results directory.
        run_ids: runs to read; None for all.
        verify: whether to verify the checksum of every part, once per process.

    Raises:
        InputError: a part has changed or cannot be read.

    Examples:
        >>> study = sinsjax.load_study("paper1_resets", {"study.draws": 2, "study.rate_hz": 10.0})
        >>> _ = sinsjax.run_into(study, "out")
        >>> sinsjax.read_curves("out", [4]).num_rows
        900
    """
    if not has_dataset(directory, "curves", verify=verify):
        return columns.arrow_schema(columns.CURVES).empty_table()
    rows = None if run_ids is None else pc.field("run_id").isin(run_ids)
    return _read_sorted(directory, "curves", None, ["run_id", "time_s"], verify=verify, rows=rows)


def count_runs(directory: str | Path) -> int:
    """Return the number of rows of the summary, after verifying every part.

    Raises:
        InputError: the directory contains no results, or a part has changed.
    """
    return query_dataset(directory, "summary", lambda dataset: dataset.count_rows())


def load_stored_study(directory: Path) -> Study:
    """Load the study of a results directory.

    Raises:
        InputError: it cannot be read (names packages that provided methods when it was computed and
            are not installed here); or it is not the study of the results.
    """
    try:
        study = load_study(directory / STUDY)
    except InputError as error:
        if any(gone.MARK in line for line in error.lines):
            text = to_one_line("; ".join(error.lines))
            raise InputError(f"{text}; `sinsjax.read_summary` still reads the rows") from None
        missing = " and ".join(
            f"{name} {version}" for name, version in _missing_packages(directory)
        )
        if not missing:
            raise
        raise InputError(
            f"{directory}: was computed with {missing}, not installed here, which may be why:"
            f" {error}"
        ) from error
    manifest = find_manifest(directory)
    if manifest is not None and not _is_study_of(manifest, study):
        differing = describe_differences(manifest.study, study, ("in the results", "in the file"))
        text = to_one_line("; ".join(differing))
        raise InputError(
            f"{directory / STUDY}: is not the study of the results: {text}"
            " (restore it, or delete it: `--resume` writes it again)"
        )
    return study


def _is_study_of(manifest: Manifest, study: Study) -> bool:
    """Return whether a manifest is of a study, whose attitude_file may be gone."""
    if attitude_file(study) is not None:
        return without_gone_settings(manifest.study) == sections_to_json(study)
    return manifest.fingerprint == fingerprint(study)


def _missing_packages(directory: Path) -> list[tuple[str, str]]:
    """Return the packages in the manifest that are not installed, and their versions."""
    stored = read_manifest(directory).get("versions")
    versions = stored if isinstance(stored, dict) else {}
    others = (name for name in versions if name not in ("python", *runtime.RESULT_PACKAGES))
    return [
        (name, versions[name]) for name in others if runtime.installed_version_or_none(name) is None
    ]


def has_dataset(directory: str | Path, name: str, *, verify: bool = True) -> bool:
    """Return whether a dataset has any parts.

    Args:
        directory: results directory.
        name: name of the dataset.
        verify: whether to check the manifest too.

    Raises:
        InputError: the manifest lists parts, but the directory has none.
    """
    if list_parts(Path(directory), name):
        return True
    if verify:
        _verify_parts(Path(directory), name, ())
    return False


def query_dataset(
    directory: str | Path, name: str, function: Callable[[Any], Any], *, verify: bool = True
) -> Any:
    """Apply a function to a dataset.

    Args:
        directory: results directory.
        name: name of the dataset.
        function: function of the `pyarrow.dataset.Dataset` that returns the result.
        verify: whether to verify the parts first.

    Raises:
        InputError: there are no parts, or a part has changed or cannot be read.
    """
    directory = Path(directory)
    check_directory(directory)
    if not has_dataset(directory, name, verify=verify):
        text = f"no results (no part in {name}/)"
        if list_parts(directory, ESTIMATES):
            text = "estimates by covariance analysis, which only version 1.0 reads"
        raise InputError(f"{directory}: contains {text}")
    parts = list_parts(directory, name)
    import pyarrow.dataset as ds  # late: it imports pandas where that is installed

    try:
        if verify:
            _verify_parts(directory, name, parts)
        return function(ds.dataset(parts, format="parquet"))
    except (OSError, pa.ArrowException) as error:
        reason = first_error_line(error)
        raise InputError(
            f"{directory / name}: cannot be read: {reason} ({_RESUME_HINT})"
        ) from error


def read_part_metadata(content: bytes) -> dict[str, str] | None:
    """Return the marks of a part, see `tasks.TaskRunner.marks`; None if it is not intact.

    Args:
        content: content of the file.
    """
    if not sealed.is_intact(content):
        return None
    try:
        file_metadata = pq.read_metadata(pa.BufferReader(content))
        entries = file_metadata.metadata or {}
        metadata = {key: entries[key.encode()].decode() for key in (STUDY_METADATA, CHUNK_METADATA)}
        return (
            metadata
            if json.loads(metadata[CHUNK_METADATA])["rows"] == file_metadata.num_rows
            else None
        )
    except (KeyError, ValueError, TypeError, pa.ArrowException):
        return None


def _read_sorted(
    directory: str | Path,
    dataset: str,
    names: Sequence[str] | None,
    order: Sequence[str],
    *,
    verify: bool,
    rows: Any = None,
) -> pa.Table:
    def select_rows(dataset_: Any) -> pa.Table:
        known_columns = dataset_.schema.names
        selected = known_columns if names is None else list(names)
        if missing := [name for name in selected if name not in known_columns]:
            raise InputError(f"{directory}: {dataset}: column {missing[0]} is missing")
        table = dataset_.to_table(columns=sorted({*order, *selected}), filter=rows)
        return table.sort_by([(name, "ascending") for name in order]).select(selected)

    table = query_dataset(directory, dataset, select_rows, verify=verify)
    # The metadata of the first part does not apply to the others.
    return table.replace_schema_metadata({"sinsjax.schema": columns.SCHEMA_VERSION})


def _verify_parts(directory: Path, dataset: str, parts: Sequence[Path]) -> None:
    """Verify parts, and that no part listed in the manifest is missing."""
    manifest = find_manifest(directory)
    if manifest is not None:
        listed = {part.file for chunk in manifest.chunks for part in chunk.files}
        present = {f"{dataset}/{path.name}" for path in parts}
        for file in sorted(name for name in listed - present if name.startswith(f"{dataset}/")):
            # It may be newer than the list `parts`, but older than the manifest.
            if not (directory / file).exists():
                raise InputError(
                    f"{directory / file}: listed in the manifest but missing ({_RESUME_HINT})"
                )
    with ThreadPoolExecutor(_READERS) as pool:
        for path, identity in zip(parts, pool.map(_verified_identity, parts), strict=True):
            if manifest is not None and identity != manifest.identity:
                raise InputError(f"{path}: is a part of another study's results ({_RESUME_HINT})")


def _verified_identity(path: Path) -> str:
    """Verify a part and return the identity of its job."""
    file = FileState.from_path(path)
    if (identity := _verified.get(file)) is not None:
        return identity
    metadata = read_part_metadata(read_regular_file(path))
    if metadata is None:
        raise InputError(f"{path}: has changed since it was written ({_RESUME_HINT})")
    chunk = json.loads(metadata[CHUNK_METADATA])
    if (chunk["dataset"], chunk["name"]) != (path.parent.name, path.stem):
        text = f"is part {chunk['dataset']}/{chunk['name']} under another name"
        raise InputError(f"{path}: {text} ({_RESUME_HINT})")
    if file.is_settled:
        _verified[file] = metadata[STUDY_METADATA]
    return metadata[STUDY_METADATA]
