"""Results directories with an error in the manifest, the study or a part."""

import hashlib
import json
from pathlib import Path
from typing import Any, NamedTuple

import pyarrow as pa
from hypothesis import strategies as st
from support.studies import small_study

from fuzzing.edits import HiddenValue, edit_tables, mangle_bytes
from sinsjax import columns
from sinsjax.execution import schemas
from sinsjax.execution.results import CHUNK_METADATA, STUDY_METADATA
from sinsjax.execution.sealed import SEAL_KEY, to_sealed_json, to_sealed_parquet
from sinsjax.execution.tasks import Job
from sinsjax.platform import runtime
from sinsjax.study.identity import fingerprint, sections_to_json
from sinsjax.study.load import study_to_toml

STUDY = small_study(study={"curves": True})
MANIFEST, TEXT = "manifest.json", "study.toml"
PARTS = ("summary/part-0000-000000.parquet", "curves/part-0000-000000.parquet")


class Case(NamedTuple):
    """Changed files of a directory by name; the others remain."""

    files: dict[str, bytes | None]


def write_results(directory: Path) -> dict[str, bytes]:
    """Write the results of a run of `STUDY`, without numbers; return the files."""
    runs = list(range(STUDY.n_draws * STUDY.n_variants))
    tables = {
        PARTS[0]: _empty_table(schemas.summary_columns(STUDY), runs),
        PARTS[1]: _empty_table(
            schemas.curve_columns(STUDY), [run for run in runs for _ in range(STUDY.records)]
        ),
    }
    files: dict[str, bytes] = {TEXT: study_to_toml(STUDY).encode()}
    for name, table in tables.items():
        chunk = {"dataset": Path(name).parent.name, "name": Path(name).stem, "chunk_runs": None}
        chunk["rows"] = table.num_rows
        marks = {STUDY_METADATA: Job(STUDY).identity, CHUNK_METADATA: json.dumps(chunk)}
        files[name] = to_sealed_parquet(table, marks)
    files[MANIFEST] = to_sealed_json(_manifest_entries())
    for name, content in files.items():
        (directory / name).parent.mkdir(parents=True, exist_ok=True)
        (directory / name).write_bytes(content)
    return files


def _empty_table(layout: tuple[columns.Column, ...], runs: list[int]) -> pa.Table:
    arrays = [
        pa.array(runs) if c.name == "run_id" else pa.nulls(len(runs), c.dtype) for c in layout
    ]
    return pa.Table.from_arrays(arrays, schema=columns.arrow_schema(layout))


def _manifest_entries() -> dict[str, Any]:
    entries = [{"file": name, "rows": 3} for name in reversed(PARTS)]
    chunk = {
        "name": "part-0000-000000",
        "state": "done",
        "runs": 3,
        "seconds": 0.1,
        "files": entries,
    }
    session = runtime.describe_environment() | {"started_unix_s": 1.7e9, "wall_s": 1.0}
    return {
        "schema": columns.SCHEMA_VERSION,
        "state": "complete",
        "fingerprint": fingerprint(STUDY),
        "identity": Job(STUDY).identity,
        "seed": 1,
        "runs": 3,
        "runs_done": 3,
        "curves": True,
        "chunk_runs": None,
        "config": "small.toml",
        "warnings": ["one"],
        "sessions": [session],
        "study": sections_to_json(STUDY),
        "chunks": [chunk],
    }


def _seal_any_json(data: dict[str, Any]) -> bytes:
    """Seal JSON of any values, including NaN, which sinsjax does not write."""
    blank = "0" * 64
    others = {key: value for key, value in data.items() if key != SEAL_KEY}
    text = json.dumps({**others, SEAL_KEY: blank}, default=str).encode()
    head, tail = text.rsplit(blank.encode(), 1)
    return head + hashlib.sha256(text).hexdigest().encode() + tail


@st.composite
def manifest_cases(draw: st.DrawFn, files: HiddenValue) -> Case:
    """Draw a directory in which one or two files are changed, cut or removed."""
    changed: dict[str, bytes | None] = {}
    for _ in range(draw(st.integers(1, 2))):
        name = draw(st.sampled_from([MANIFEST] * 6 + [TEXT, *PARTS]))
        kind = draw(st.sampled_from(["edit"] * 5 + ["mangle"] * 2 + ["remove"]))
        if kind == "remove":
            changed[name] = None
        elif kind == "edit" and name == MANIFEST:
            data = draw(edit_tables(HiddenValue(json.loads(files.value[MANIFEST]))))
            is_sealed = isinstance(data, dict) and draw(st.booleans())  # reaches its entries
            changed[name] = (
                _seal_any_json(data) if is_sealed else json.dumps(data, default=str).encode()
            )
        else:
            changed[name] = draw(mangle_bytes(HiddenValue(files.value[name])))
    return Case(changed)
