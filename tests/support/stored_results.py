"""Directories of synthetic results, for tests of their readers."""

import io
import json
import os
from unittest import mock

import pyarrow.parquet as pq
from rich.console import Console

from sinsjax import report
from sinsjax.columns import SCHEMA_VERSION
from sinsjax.execution.directory import MANIFEST, STUDY, to_sealed_json, to_sealed_parquet
from sinsjax.execution.results import CHUNK_METADATA, STUDY_METADATA
from sinsjax.execution.tasks import Job
from sinsjax.study.load import fingerprint, sections_to_json, study_to_toml


def write_part(path, table, identity):
    """Write a table as the part of a results directory that its path names, sealed."""
    chunk = {"dataset": path.parent.name, "name": path.stem, "chunk_runs": None}
    chunk["rows"] = table.num_rows
    marks = {STUDY_METADATA: identity, CHUNK_METADATA: json.dumps(chunk)}
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(to_sealed_parquet(table, marks))


def write_manifest(directory, study, **entries):
    """Write a sealed manifest of the existing parts; ``entries`` replace some entries."""
    parts = directory.glob("summary/part-*.parquet")
    defaults = {
        "schema": SCHEMA_VERSION,
        "config": f"{study.name}.toml",
        "fingerprint": fingerprint(study),
        "identity": Job(study).input_hash,
        "curves": None,
        "chunk_runs": None,
        "study": sections_to_json(study),
        "runs_done": sum(pq.read_metadata(path).num_rows for path in parts),
    }
    (directory / MANIFEST).write_bytes(to_sealed_json(defaults | entries))


def store_results(directory, study, summary=None, curves=None, **entries):
    """Write tables as the results of a study; return the directory."""
    for name, table in {"summary": summary, "curves": curves}.items():
        if table is not None:
            write_part(directory / name / "part-0000-000000.parquet", table, Job(study).input_hash)
    (directory / STUDY).write_text(study_to_toml(study))
    write_manifest(directory, study, **entries)
    return directory


def report_text(*directories, html=None, full=True, width=1000):
    """Return the printed report of some results, of this width; None for that of a pipe."""
    file = io.StringIO()
    with mock.patch.dict(os.environ, {} if width is None else {"COLUMNS": str(width)}):
        report.print_reports(directories, Console(file=file), html, full=full)
    return file.getvalue()
