"""Repeating a single run of a study with its curve; its row must be identical."""

from pathlib import Path

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
from sinsjax.execution.prepare import load_increments
from sinsjax.execution.results import Results, read_summary
from sinsjax.execution.tables import TableBuilder
from sinsjax.execution.tasks import Job
from sinsjax.platform.files import atomic_write, make_folder, write_file
from sinsjax.records.reference import StoredRecord
from sinsjax.study.study import Study


def repeat_run(
    study: Study, run_id: int, record: StoredRecord | None = None
) -> dict[str, pa.Table]:
    """Return the summary and curves of one run of a study, equal to those of a sweep to the bit."""
    draw, variant = divmod(run_id, study.n_variants)
    scenario = Scenario(study, record, curves=True)
    number, place = scenario.find(variant)
    batch = scenario.batch(number, range(draw, draw + 1))
    # The smallest possible chunk: a run's bits do not depend on its lane or chunk.
    chunks = Chunks(batch, tiles_per_chunk=1)
    first = int(np.flatnonzero(batch.draws.draw_id == draw)[0])
    chunk = chunks.compute(chunks.layout.chunk_of(first, place))
    builder = TableBuilder(study, has_truth=scenario.has_truth, curves=True)
    tables = builder.make_tables(chunk, batch.variant_ids)
    return {name: table.filter(pc.field("run_id") == run_id) for name, table in tables.items()}


def rerun_stored_run(
    directory: Path,
    run_id: int,
    console: Console,
    *,
    out: Path | None = None,
    files: tuple[Path | None, Path | None] = (None, None),
) -> bool:
    """Repeat one run of stored results, and write its row, curve and figure.

    They go to ``reruns/RUN_ID`` or to another directory. A recorded study needs the files of its
    record and reference. Return whether the row is identical to the stored one.
    """
    results = Results.read(directory)
    study, manifest, target = results.study, results.manifest, out or directory / f"reruns/{run_id}"
    refuse_external(study.study.external, directory)
    if files[0] is None and (study.is_recorded or files[1] is not None):
        raise InputError(f"{directory}: its study needs a record (give it with --record)")
    record = None if files[0] is None else load_increments(study, files[0], files[1])
    if manifest.identity != Job(study, record, extended_at=manifest.extended_at).identity:
        raise InputError(f"{directory}: the results are of another record or reference")
    stored = read_summary(directory, run_ids=[run_id])
    if stored.num_rows != 1:
        raise InputError(f"{directory}: has no run {run_id} (`--resume` computes missing ones)")
    tables = repeat_run(study, run_id, record)
    row, curve, title = tables["summary"], tables["curves"], f"{study.name}, run {run_id}"
    make_folder(target)
    for name, table in (("summary", row), ("curve", curve)):
        with atomic_write(target / f"{name}.parquet") as file:
            pq.write_table(table, file, compression="zstd")
    figure = plots.plot_curves(curve, row, title=title)
    write_file(target / "curve.png", plots.render_png(figure))
    (before,), (now,) = stored.to_pylist(), row.to_pylist()
    for name, value in now.items():
        screen.print_line(console, f"{name:>30}  {value}")
    differing = [name for name in before | now if before.get(name) != now.get(name)]
    verdict = f"The row is identical to the stored one in all {len(before)} columns."
    if differing:
        verdict = (
            f"{len(differing)} of {len(before)} columns differ from the stored row:"
            f" {', '.join(differing)}. Last bits depend on the versions, flags and processor that"
            " `manifest.json` lists."
        )
    screen.print_line(console, verdict)
    screen.print_line(console, f"Row, curve and figure: {target}")
    return not differing
