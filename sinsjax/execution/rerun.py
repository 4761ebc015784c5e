"""Repeating a single run of a study with its curve; its row must be identical."""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from rich.console import Console

from sinsjax import console as screen
from sinsjax import plots
from sinsjax.engine.batch import Chunks
from sinsjax.engine.scenario import Scenario
from sinsjax.errors import InputError
from sinsjax.execution import directory as results_directory
from sinsjax.execution import results
from sinsjax.execution.checks import refuse_external
from sinsjax.execution.directory import RERUN_FILES
from sinsjax.execution.prepare import load_increments
from sinsjax.execution.tables import TableBuilder
from sinsjax.execution.tasks import Job
from sinsjax.messages import to_one_line
from sinsjax.methods.registry import packages_of
from sinsjax.platform.files import atomic_write, make_folder
from sinsjax.records.reference import StoredRecord
from sinsjax.study.study import Study

_ROUNDING = 1e-6
"""Above the growth of a difference in last bits, of angles in deg or arcmin."""


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
        InputError: the study has no such run, or the record does not fit it.
    """
    _check_run_id(study, run_id, study.name)
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
    results = (tables["summary"], tables["curves"])
    return Rerun(*(table.filter(pa.compute.equal(table["run_id"], run_id)) for table in results))


def _check_run_id(study: Study, run_id: int, source: str | Path) -> None:
    runs = study.n_draws * study.n_variants
    if not 0 <= run_id < runs:
        raise InputError(f"{source}: has no run {run_id} (runs are numbered 0 to {runs - 1})")


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
    results_directory.check_directory(directory)
    study = results.load_stored_study(directory)
    refuse_external(study.study.external, directory)
    if files[0] is None and files[1] is not None:
        raise InputError("--reference: requires --record")
    if study.is_recorded and files[0] is None:
        raise InputError(f"{directory}: its study needs a record (give it with --record)")
    stored_record = None if files[0] is None else load_increments(study, files[0], files[1])
    entries = results_directory.read_manifest(directory)  # before the run, which takes a while
    manifest = results_directory.find_manifest(directory)
    extended_at = () if manifest is None else manifest.extended_at
    job = Job(study, stored_record, extended_at=extended_at)
    if manifest is not None and manifest.identity != job.identity:
        raise InputError(f"{directory}: the results are of another record or reference")
    _check_run_id(study, run_id, directory)
    stored = results.read_summary(directory, run_ids=[run_id])
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
    repeated_run = repeat_run(study, run_id, stored_record)
    _write_rerun(target, repeated_run, study)
    differing = _differing_columns(stored, repeated_run.row)
    for line in [
        *_format_row(repeated_run.row),
        "",
        _describe_comparison(
            stored,
            repeated_run.row,
            differing,
            _explain_difference(entries, stored, repeated_run.row),
        ),
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


def _format_row(row: pa.Table) -> list[str]:
    (values,) = row.to_pylist()
    width = max(map(len, values))
    return [f"{name:>{width}}  {value}" for name, value in values.items()]


def _differing_columns(stored: pa.Table, repeated: pa.Table) -> list[str]:
    """Return the columns in which two rows differ."""
    (stored_values,), (repeated_values,) = stored.to_pylist(), repeated.to_pylist()
    return [
        name
        for name in dict.fromkeys((*stored_values, *repeated_values))
        if stored_values.get(name) != repeated_values.get(name)
    ]


def _explain_difference(entries: dict[str, Any], stored: pa.Table, repeated: pa.Table) -> str:
    """Return a likely cause of the difference of two rows, as text.

    Args:
        entries: of the manifest of the stored row.
        stored: row.
        repeated: the same run's row, repeated here.
    """
    packages = packages_of(repeated["method"].to_pylist())
    versions = entries.get("versions")
    stored_versions = versions if isinstance(versions, dict) else {}
    for name, current_version in packages.items():
        stored_version = to_one_line(str(stored_versions.get(name, current_version)))
        if stored_version != current_version:
            return (
                f"The stored row was computed with {name} {stored_version}, but here is"
                f" {current_version}."
            )
        if _differs_beyond_rounding(stored, repeated):
            return f"This exceeds last bits: the code of {name} {current_version} may have changed."
    return (
        "Last bits depend on jaxlib, its flags and the processor; `manifest.json` lists those of"
        " the stored row."
    )


def _differs_beyond_rounding(stored: pa.Table, repeated: pa.Table) -> bool:
    """Whether an angle differs by more than rounding; a time may jump by a record interval."""
    (stored_values,), (repeated_values,) = stored.to_pylist(), repeated.to_pylist()
    angles = [name for name in stored_values if name.endswith(("_arcmin", "_deg"))]
    pairs = [(stored_values[name], repeated_values.get(name)) for name in angles]
    return any(
        abs(a - b) > _ROUNDING * max(1.0, abs(a), abs(b))
        for a, b in pairs
        if isinstance(a, float) and isinstance(b, float)
    )


def _describe_comparison(
    stored: pa.Table, repeated: pa.Table, differing: list[str], explanation: str
) -> str:
    """Return a sentence that states whether two rows are identical, or where they differ."""
    (stored_values,), (repeated_values,) = stored.to_pylist(), repeated.to_pylist()
    if not differing:
        return f"The row is identical to the stored one in all {len(stored_values)} columns."
    examples = [
        f"{name} {stored_values.get(name)} there, {repeated_values.get(name)} here"
        for name in differing[:3]
    ]
    summary = f"{len(differing)} of {len(stored_values)} columns differ from the stored row"
    return f"{summary}: {', '.join(examples)}. {explanation}"
