"""Directories of results that no engine made, for the tests of what reads them."""

import io
import json
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
from rich.console import Console

from sinsjax import report
from sinsjax.study.load import Study, study_to_toml


def store(directory: Path, study: Study, summary: pa.Table, curves: pa.Table | None = None) -> Path:
    """Writes tables as the results of a study; gives the directory."""
    for name, table in {"summary": summary, "curves": curves}.items():
        if table is not None:
            (directory / name).mkdir(parents=True)
            pq.write_table(table, directory / name / "part-0000.parquet")
    (directory / "study.toml").write_text(study_to_toml(study))
    (directory / "manifest.json").write_text(json.dumps({"config": f"{study.name}.toml"}))
    return directory


def told(*directories: Path, page: Path | None = None, html: Path | None = None) -> str:
    """What a report of some results prints."""
    file = io.StringIO()
    report.summarise(directories, Console(file=file), page, html)
    return file.getvalue()
