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
from sinsjax.execution.directory import RERUN_FILES, Manifest
from sinsjax.execution.prepare import load_increments
from sinsjax.execution.results import Results, read_summary
from sinsjax.execution.tables import TableBuilder
from sinsjax.execution.tasks import Job
from sinsjax.messages import to_one_line
from sinsjax.methods.registry import packages_of
from sinsjax.platform import runtime
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
    study, manifest = Results.read(directory).study, Manifest.read(directory)
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
    if not stored.num_rows:
        raise InputError(f"{directory}: run {run_id} has no row yet (continue with `--resume`)")
    if stored.num_rows > 1:
        text = f"has {stored.num_rows} rows of run {run_id}: a foreign part is among them"
        raise InputError(f"{directory / 'summary'}: {text}")
    if out is not None and (existing := [name for name in RERUN_FILES if (out / name).exists()]):
        raise InputError(f"{out}: already contains {existing[0]} (give another directory)")
    target = directory / "reruns" / str(run_id) if out is None else out
    if target.is_symlink() and out is None:
        raise InputError(f"{target}: is a symbolic link (remove it, or give another directory)")
    repeated = repeat_run(study, run_id, record)
    _write_rerun(target, repeated, study)
    (before,), (now,) = stored.to_pylist(), repeated.row.to_pylist()
    differing = [name for name in before | now if before.get(name) != now.get(name)]
    width = max(map(len, now))
    for line in [
        *(f"{name:>{width}}  {value}" for name, value in now.items()),
        "",
        _describe_comparison(before, now, differing, manifest),
        f"Row, curve and figure: {target}",
    ]:
        screen.print_line(console, line)
    return not differing


def _write_rerun(target: Path, run: Rerun, study: Study) -> None:
    make_folder(target)
    for name, table in (("summary", run.row), ("curve", run.curve)):
        with atomic_write(target / f"{name}.parquet") as file:
            pq.write_table(table, file, compression="zstd")
    with atomic_write(target / "curve.png") as file:
        title = f"{study.name}, run {run.row['run_id'][0].as_py()}"
        file.write(plots.render_png(plots.plot_curves(run.curve, run.row, title=title)))


def _describe_comparison(
    stored: dict[str, Any], repeated: dict[str, Any], differing: list[str], manifest: Manifest
) -> str:
    """Return whether two rows are identical, or where they differ and which versions do."""
    if not differing:
        return f"The row is identical to the stored one in all {len(stored)} columns."
    examples = ", ".join(
        f"{name} {stored.get(name)} there, {repeated.get(name)} here" for name in differing[:3]
    )
    current = runtime.relevant_versions() | packages_of([repeated["method"]])
    versions = [
        f"{name} {to_one_line(manifest.versions[name])} (here {current[name]})"
        for name in current
        if manifest.versions.get(name, current[name]) != current[name]
    ]
    cause = (
        "Last bits depend on jaxlib, its flags and the processor; `manifest.json` lists those of"
        " the stored row."
    )
    if versions:
        cause = f"The stored row was computed with {', '.join(versions)}."
    summary = f"{len(differing)} of {len(stored)} columns differ from the stored row"
    return f"{summary}: {examples}. {cause}"
