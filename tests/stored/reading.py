"""The tables and numbers of stored results, as public functions and commands give them.

    python tests/stored/reading.py FOLDER

continues, repeats and scores again the results in a copy of this folder, and prints the tables as
JSON: it runs in a process of its own, with the instruction set that they were computed with.
"""

import json
import sys
from pathlib import Path
from typing import Any
from unittest import mock

import pyarrow as pa
import pyarrow.parquet as pq
from golden.golden_studies import run_command

import sinsjax

HERE = Path(__file__).parent
EXPECTED = HERE / "expected.json"
RESULTS = ("draws", "methods", "extended", "killed", "aligned", "exported/scores/leveller")
TUNED = "tuned"
DIRECTORIES = (*RESULTS, TUNED)

MORE_DRAWS = 7
"""Draws that the extended results get."""

RERUNS = {"draws": 5, "extended": 9, "aligned": 1}
"""Runs that are repeated."""


def read_tables(directory: Path) -> dict[str, pa.Table]:
    """Return all tables of a results directory, by name."""
    if directory.name == TUNED:
        tables = {"history": sinsjax.read_history(directory)}
        folders = ("sobol", "evaluation")
        return tables | {name: sinsjax.read_summary(directory / name) for name in folders}
    tables = {"summary": sinsjax.read_summary(directory)}
    if (directory / "curves").is_dir():
        tables["curves"] = sinsjax.read_curves(directory)
    return tables


def summarised(table: pa.Table) -> dict[str, Any]:
    """Return rows, and kind, unit, first and last value of each column, by name."""
    ends = table.slice(0, 1).to_pylist() + table.slice(table.num_rows - 1).to_pylist()
    columns = {}
    for field in table.schema:
        unit = (field.metadata or {}).get(b"unit", b"").decode()
        kind = f"{field.type} {unit}".strip()
        columns[field.name] = {"kind": kind, "sample": [row[field.name] for row in ends]}
    return {"rows": table.num_rows, "columns": columns}


def continue_all(folder: Path) -> dict[str, pa.Table]:
    """Continue, repeat and score stored results in a copy of them; return the tables by name.

    Rows of other versions and instruction sets are refused: both checks are left out here.
    """
    from sinsjax.execution import store

    with mock.patch.object(store, "_refuse_rows_of_other_versions"):
        more = {"killed": {}, "extended": {"study.draws": MORE_DRAWS}}
        for name, changes in more.items():
            study = sinsjax.load_study(folder / name / "study.toml", changes)
            sinsjax.run_into(study, folder / name, resume=True)
        tuned = folder / TUNED
        sinsjax.tune(sinsjax.load_study(tuned / "study.toml"), tuned, resume=True)
    tables = {f"resumed {name}": sinsjax.read_summary(folder / name) for name in more}
    record = [folder / "record" / name for name in ("log.csv", "reference.csv")]
    for name, run_id in RERUNS.items():
        files = ("--record", record[0], "--reference", record[1]) if name == "aligned" else ()
        run_command("rerun", folder / name, "--run-id", run_id, *files)
        rerun = folder / name / "reruns" / str(run_id)
        tables[f"repeated {name}"] = pq.read_table(rerun / "summary.parquet")
    export = folder / "exported"
    tables["scored"] = sinsjax.score_results(export, export / "results.csv").summary
    return tables


if __name__ == "__main__":
    sinsjax.configure(devices=1)
    continued = continue_all(Path(sys.argv[1]))
    print(json.dumps({name: summarised(table) for name, table in continued.items()}))
