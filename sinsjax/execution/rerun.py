"""Repeating a single run of a study with its curve; its row must be identical."""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from rich.console import Console

from sinsjax import console as screen
from sinsjax import plots
from sinsjax.engine.build import Scenario
from sinsjax.errors import InputError
from sinsjax.execution import directory as places
from sinsjax.execution import results
from sinsjax.execution.directory import RERUN
from sinsjax.execution.outputs import output_of
from sinsjax.execution.prepare import load_increments
from sinsjax.execution.tasks import Job
from sinsjax.messages import to_one_line
from sinsjax.methods.registry import packages_of
from sinsjax.platform.files import atomic_write, make_folder
from sinsjax.records.reference import StoredRecord
from sinsjax.study.study import Study

_ROUNDING = 1e-6
"""More than a difference in last bits grows to, of angles in deg or arcmin."""


class Rerun(NamedTuple):
    """A repeated run.

    Attributes:
        row: its row of the summary.
        curve: one row per record time.
    """

    row: pa.Table
    curve: pa.Table


def rerun(study: Study, run_id: int, stored_record: StoredRecord | None = None) -> Rerun:
    """Repeat one run of a study, with its curve; the row equals that of the study bit for bit.

    Raises:
        InputError: the study has no such run, or the record does not fit it.
    """
    _check_number(study, run_id, study.name)
    draw, variant = divmod(run_id, study.n_variants)
    scenario = Scenario(study, stored_record, curves=True)
    number = next(i for i, ids in enumerate(scenario.variant_ids) if variant in ids)
    ids = scenario.variant_ids[number]
    place = int(np.flatnonzero(ids == variant)[0])
    output = output_of(scenario)
    group = output.group(scenario.part(number, range(draw, draw + 1)).group)
    # The smallest possible call: a run's bits do not depend on its lane or call.
    calls = output.calls(group, 1)
    first = int(np.flatnonzero(group.draws.draw_id == draw)[0])
    made = output.tables(calls.chunk(calls.plan.call_of(first, place)), ids)
    asked = (made["summary"], made["curves"])
    return Rerun(*(table.filter(pa.compute.equal(table["run_id"], run_id)) for table in asked))


def _check_number(study: Study, run_id: int, source: str | Path) -> None:
    if study.is_estimated:
        raise InputError(f"{source}: a covariance estimate has no run to repeat")
    runs = study.n_draws * study.n_variants
    if not 0 <= run_id < runs:
        raise InputError(f"{source}: has no run {run_id} (runs are numbered 0 to {runs - 1})")


def rerun_into(
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
    places.check_entries(directory)
    study = results.load_stored_study(directory)
    if files[0] is None and files[1] is not None:
        raise InputError("--reference: requires --record")
    if study.is_recorded and files[0] is None:
        raise InputError(f"{directory}: its study needs a record (give it with --record)")
    stored_record = None if files[0] is None else load_increments(study, files[0], files[1])
    known = places.find_manifest(directory)
    extended_at = () if known is None else known.extended_at
    job = Job(study, stored_record, extended_at=extended_at)
    if known is not None and known.identity != job.identity:
        raise InputError(f"{directory}: the results are of another record or reference")
    _check_number(study, run_id, directory)
    stored = results.read_summary(directory, run_ids=[run_id])
    if not stored.num_rows:
        raise InputError(f"{directory}: has no row of run {run_id} yet")
    if stored.num_rows > 1:
        text = f"has {stored.num_rows} rows of run {run_id}: a part does not belong there"
        raise InputError(f"{directory / 'summary'}: {text}")
    if out is not None and (there := [name for name in RERUN if (out / name).exists()]):
        raise InputError(f"{out}: already holds a {there[0]} (give another directory)")
    target = directory / "reruns" / str(run_id) if out is None else out
    if target.is_symlink() and out is None:
        raise InputError(f"{target}: is a symbolic link (remove it, or give another directory)")
    made = rerun(study, run_id, stored_record)
    _write(target, made, study)
    differ = _differing(stored, made.row)
    for line in [
        *_printed(made.row),
        "",
        _verdict(stored, made.row, differ, _why(directory, stored, made.row)),
        f"Row, curve and figure: {target}",
    ]:
        screen.print_line(console, line)
    return not differ


def _write(target: Path, made: Rerun, study: Study) -> None:
    make_folder(target)
    for name, table in (("summary", made.row), ("curve", made.curve)):
        with atomic_write(target / f"{name}.parquet") as file:
            pq.write_table(table, file, compression="zstd")
    with atomic_write(target / "curve.png") as file:
        file.write(plots.render_png(_figure(made, study)))


def _figure(made: Rerun, study: Study) -> Any:
    run_id = made.row["run_id"][0].as_py()
    title = f"{study.name}, run {run_id}"
    shown = plots.group_curves(made.curve, {f"run {run_id}": [run_id]})
    if made.curve["phi_u_arcmin"].null_count == made.curve.num_rows:
        return plots.draw_attitude(shown, title)
    limit = made.row["floor_arcmin"][0].as_py()
    return plots.draw_misalignment(
        shown,
        title,
        floors=None if limit is None else {"u": limit},
        resets_s=made.row["reset_times_s"][0].as_py(),
        zoom_s=study.study.window_s,
        with_sigma=made.curve["sigma_u_arcmin"].null_count < made.curve.num_rows,
    )


def _printed(row: pa.Table) -> list[str]:
    (values,) = row.to_pylist()
    width = max(map(len, values))
    return [f"{name:>{width}}  {value}" for name, value in values.items()]


def _differing(stored: pa.Table, again: pa.Table) -> list[str]:
    """Columns in which two rows differ."""
    (one,), (other,) = stored.to_pylist(), again.to_pylist()
    return [name for name in dict.fromkeys((*one, *other)) if one.get(name) != other.get(name)]


def _why(directory: Path, stored: pa.Table, again: pa.Table) -> str:
    """What the difference of two rows may be due to.

    Args:
        directory: results directory of the stored row.
        stored: row.
        again: the same run's row made here.
    """
    packages = packages_of(again["method"].to_pylist())
    versions = places.read_manifest(directory).get("versions")
    told = versions if isinstance(versions, dict) else {}
    for name, here in packages.items():
        there = to_one_line(str(told.get(name, here)))
        if there != here:
            return f"The stored row was computed with {name} {there}, but here is {here}."
        if _beyond_last_bits(stored, again):
            return f"These are not last bits: the code of {name} {here} may have changed."
    return (
        "Last bits depend on jaxlib, its flags and the processor; `manifest.json` has those of the"
        " stored row."
    )


def _beyond_last_bits(stored: pa.Table, again: pa.Table) -> bool:
    """Whether an angle differs by more than rounding; a time may jump by a record interval."""
    (one,), (other,) = stored.to_pylist(), again.to_pylist()
    angles = [name for name in one if name.endswith(("_arcmin", "_deg"))]
    pairs = [(one[name], other.get(name)) for name in angles]
    return any(
        abs(a - b) > _ROUNDING * max(1.0, abs(a), abs(b))
        for a, b in pairs
        if isinstance(a, float) and isinstance(b, float)
    )


def _verdict(stored: pa.Table, again: pa.Table, differ: list[str], why: str) -> str:
    """A sentence on whether two rows are identical, or where they differ."""
    (one,), (other,) = stored.to_pylist(), again.to_pylist()
    if not differ:
        return f"The row is identical to the stored one in all {len(one)} columns."
    shown = [f"{name} {one.get(name)} there, {other.get(name)} here" for name in differ[:3]]
    there = f"{len(differ)} of {len(one)} columns differ from the stored row"
    return f"{there}: {', '.join(shown)}. {why}"
