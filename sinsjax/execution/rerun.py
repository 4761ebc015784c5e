"""Repeating a single run of a study with its curve; its row must be identical."""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from rich.console import Console

from sinsjax import console as screen
from sinsjax import plots
from sinsjax.engine.batch import Chunks
from sinsjax.engine.scenario import Scenario
from sinsjax.errors import InputError
from sinsjax.execution.checks import refuse_external
from sinsjax.execution.directory import RERUN_FILES
from sinsjax.execution.prepare import load_increments
from sinsjax.execution.results import Results, read_summary
from sinsjax.execution.tables import TableBuilder
from sinsjax.execution.tasks import Job
from sinsjax.platform.files import atomic_write, make_folder
from sinsjax.records.reference import StoredRecord
from sinsjax.study.study import Study


class Rerun(NamedTuple):
    """A repeated run.

    Attributes:
        row: its row of the summary.
        curve: one row per record time.
    """

    row: pa.Table
    curve: pa.Table


def repeat_run(study: Study, run_id: int, stored_record: StoredRecord | None = None) -> Rerun:
    """Repeat one run of a study, with its curve; the row equals that of the study bit for bit.

    Raises:
        InputError: the record does not fit the study.
    """
    draw, variant = divmod(run_id, study.n_variants)
    scenario = Scenario(study, stored_record, curves=True)
    number, place = scenario.find(variant)
    batch = scenario.batch(number, range(draw, draw + 1))
    # The smallest possible chunk: a run's bits do not depend on its lane or chunk.
    chunks = Chunks(batch, tiles_per_chunk=1)
    first = int(np.flatnonzero(batch.draws.draw_id == draw)[0])
    chunk = chunks.compute(chunks.layout.chunk_of(first, place))
    builder = TableBuilder(study, has_truth=scenario.has_truth, curves=True)
    tables = builder.make_tables(chunk, batch.variant_ids)
    rows = (tables[name].filter(pc.field("run_id") == run_id) for name in ("summary", "curves"))
    return Rerun(*rows)


def rerun_stored_run(
    directory: Path,
    run_id: int,
    console: Console,
    *,
    out: Path | None = None,
    files: tuple[Path | None, Path | None] = (None, None),
) -> bool:
    """Repeat one run of stored results, compare its row, and write row, curve and figure.

    Args:
        directory: results directory.
        run_id: number of the run.
        console: where to print the row and the comparison.
        out: directory to write to; None for ``reruns/RUN_ID`` in the results directory.
        files: record and reference of a recorded study.

    Returns:
        Whether the row is identical to the stored one.

    Raises:
        InputError: there are no results or no such run, the record is a different one, or the
            files cannot be written.
    """
    results = Results.read(directory)
    study, manifest = results.study, results.manifest
    refuse_external(study.study.external, directory)
    if files[0] is None and files[1] is not None:
        raise InputError("--reference: requires --record")
    if study.is_recorded and files[0] is None:
        raise InputError(f"{directory}: its study needs a record (give it with --record)")
    record = None if files[0] is None else load_increments(study, files[0], files[1])
    if manifest.identity != Job(study, record, extended_at=manifest.extended_at).identity:
        raise InputError(f"{directory}: the results are of another record or reference")
    runs = study.n_draws * study.n_variants
    if not 0 <= run_id < runs:
        raise InputError(f"{directory}: has no run {run_id} (runs are numbered 0 to {runs - 1})")
    stored = read_summary(directory, run_ids=[run_id], verify=False)  # verified above
    if stored.num_rows != 1:
        text = f"has {stored.num_rows} rows of run {run_id} (`--resume` computes missing ones)"
        raise InputError(f"{directory}: {text}")
    if out is not None and (existing := [name for name in RERUN_FILES if (out / name).exists()]):
        raise InputError(f"{out}: already contains {existing[0]} (give another directory)")
    target = directory / "reruns" / str(run_id) if out is None else out
    repeated = repeat_run(study, run_id, record)
    _write_rerun(target, repeated, study)
    (before,), (now,) = stored.to_pylist(), repeated.row.to_pylist()
    width = max(map(len, now))
    for line in [
        *(f"{name:>{width}}  {value}" for name, value in now.items()),
        "",
        _describe_comparison(before, now),
        f"Row, curve and figure: {target}",
    ]:
        screen.print_line(console, line)
    return before == now


def _write_rerun(target: Path, run: Rerun, study: Study) -> None:
    make_folder(target)
    for name, table in (("summary", run.row), ("curve", run.curve)):
        with atomic_write(target / f"{name}.parquet") as file:
            pq.write_table(table, file, compression="zstd")
    with atomic_write(target / "curve.png") as file:
        title = f"{study.name}, run {run.row['run_id'][0].as_py()}"
        file.write(plots.render_png(plots.plot_curves(run.curve, run.row, title=title)))


def _describe_comparison(stored: dict[str, Any], repeated: dict[str, Any]) -> str:
    """Return whether two rows are identical, or where they differ."""
    differing = [name for name in stored | repeated if stored.get(name) != repeated.get(name)]
    if not differing:
        return f"The row is identical to the stored one in all {len(stored)} columns."
    examples = ", ".join(
        f"{name} {stored.get(name)} there, {repeated.get(name)} here" for name in differing[:3]
    )
    return (
        f"{len(differing)} of {len(stored)} columns differ from the stored row: {examples}. Last"
        " bits depend on the versions, flags and processor that `manifest.json` lists."
    )
