"""Directories of synthetic results, for tests of their readers."""

import io
import json
import os
from pathlib import Path
from typing import Any
from unittest import mock

import pyarrow as pa
import pyarrow.parquet as pq
from rich.console import Console

from sinsjax import report
from sinsjax.columns import SCHEMA_VERSION
from sinsjax.execution.directory import MANIFEST, STUDY, to_sealed_json, to_sealed_parquet
from sinsjax.execution.results import CHUNK_METADATA, STUDY_METADATA
from sinsjax.execution.tasks import Job
from sinsjax.study.load import fingerprint, sections_to_json, study_to_toml
from sinsjax.study.study import Study


def write_part(path: Path, table: pa.Table, identity: str) -> None:
    """Write a table as the part of a results directory that its path names, sealed."""
    chunk = {"dataset": path.parent.name, "name": path.stem, "chunk_runs": None}
    chunk["rows"] = table.num_rows
    marks = {STUDY_METADATA: identity, CHUNK_METADATA: json.dumps(chunk)}
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(to_sealed_parquet(table, marks))


def write_manifest(directory: Path, study: Study, **entries: Any) -> None:
    """Write a sealed manifest of the existing parts; ``entries`` replace some entries."""
    parts = directory.glob("summary/part-*.parquet")
    defaults = {
        "schema": SCHEMA_VERSION,
        "config": f"{study.name}.toml",
        "fingerprint": fingerprint(study),
        "identity": Job(study).identity,
        "curves": None,
        "chunk_runs": None,
        "study": sections_to_json(study),
        "runs_done": sum(pq.read_metadata(path).num_rows for path in parts),
    }
    (directory / MANIFEST).write_bytes(to_sealed_json(defaults | entries))


def store_results(
    directory: Path,
    study: Study,
    summary: pa.Table | None = None,
    curves: pa.Table | None = None,
    **entries: Any,
) -> Path:
    """Write tables as the results of a study; return the directory."""
    for name, table in {"summary": summary, "curves": curves}.items():
        if table is not None:
            write_part(directory / name / "part-0000-000000.parquet", table, Job(study).identity)
    (directory / STUDY).write_text(study_to_toml(study))
    write_manifest(directory, study, **entries)
    return directory


def report_text(
    *directories: Path,
    html: Path | None = None,
    full: bool = True,
    width: int | None = 1000,
) -> str:
    """Return the printed report of some results, of this width; None for that of a pipe."""
    file = io.StringIO()
    with mock.patch.dict(os.environ, {} if width is None else {"COLUMNS": str(width)}):
        report.print_reports(directories, Console(file=file), html, full=full)
    return file.getvalue()
