"""Scoring the results of a program outside sinsjax on the draws that were exported to it.

The attitudes pass through the metrics of every run (`arena.runs`). Together with the rows of
sinsjax's own methods on the same draws they are a results directory like any other, in which the
program is a further method.
"""

import re
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from sinsjax.arena.export import read_export
from sinsjax.arena.frames import to_angles
from sinsjax.arena.results_file import GivenResults, read_results, suspect
from sinsjax.arena.runs import GivenAttitudes, ProgramRuns, judge
from sinsjax.engine.batch import Chunk
from sinsjax.errors import InputError, StudyWarning
from sinsjax.execution.results import Results
from sinsjax.execution.run import ProgressCallback, run_into
from sinsjax.execution.store import write_table
from sinsjax.execution.tables import TableBuilder, make_table, replace_column, summary_columns
from sinsjax.execution.tasks import Job
from sinsjax.messages import format_count, shorten, to_one_line
from sinsjax.methods.method import AttitudeCovariance
from sinsjax.platform import runtime
from sinsjax.types import Quat

OWN, SCORES = "own", "scores"
"""Folders in an export: the results of sinsjax's own methods, and those that were scored."""

_NAME = r"[^\W_][\w.+ -]{0,59}"
"""Names of programs: a letter or digit first."""


def score_results(
    directory: str | Path,
    results: str | Path,
    *,
    name: str | None = None,
    on_progress: ProgressCallback | None = None,
) -> Results:
    r"""Return the results of a program with those of sinsjax's own methods on the same draws.

    The first score runs the study's own methods into ``own`` in the export, as a sweep of its
    ``study.toml`` to that directory would do. Results of the same name are replaced.

    Args:
        directory: directory of the export, see `sinsjax.export_study`.
        results: CSV or Parquet file of the program's results; README.txt in the directory lists the
            columns.
        name: of the program; None for the stem of the file.
        on_progress: called with the progress of the study's own runs.

    Returns:
        The results in ``scores/NAME`` of the export, with doubts about them as warnings. Runs
        without a row at their end have the status "nonfinite".

    Raises:
        InputError: the export has changed or is unfinished, the results do not belong to it or
            cannot be read, or the directory cannot be used. Nothing is written then.

    Examples:
        >>> study = sinsjax.load_study("paper1_resets", {"study.draws": 2, "study.rate_hz": 10.0})
        >>> exported = sinsjax.export_study(study, "draws")
        >>> rows = (exported / "initial.csv").read_text().splitlines()
        >>> digest = rows[1].split(",")[-1]
        >>> lines = [f"{row.split(',')[0]},900,0.1,0.0,0.0,{digest}" for row in rows[1:]]
        >>> header = "run_id,time_s,yaw_deg,pitch_deg,roll_deg,study"
        >>> with open("results.csv", "w") as file:
        ...     print(header, *lines, sep="\n", file=file)
        >>> scored = sinsjax.score_results(exported, "results.csv", name="zeros")
        >>> scored.directory.name, scored.study.methods
        ('zeros', ('kalman5', 'zeros'))
    """
    runtime.ensure_configured()
    directory, name = Path(directory), Path(results).stem if name is None else name
    if not re.fullmatch(_NAME, name):
        text = "must begin with a letter or digit, then have these, blanks and . _ + - (at most 60)"
        raise InputError(f"--name: {to_one_line(name)!r} {text}")
    source, frame = read_export(directory)
    runs = ProgramRuns(source, name)
    given = read_results(Path(results), runs, frame)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", StudyWarning)  # the study was exported with these
        own = run_into(source, directory / OWN, resume=True, curves=False, on_progress=on_progress)
    judged, phi = _judge(runs, given)
    job = Job(
        runs.study,
        curves=False,
        directory=directory / SCORES / name,
        overwrite=True,
        source=f"{source.name} with {Path(results).name}",
        warnings=tuple(f"{name}: {line}" for line in _iter_doubts(runs, given, phi)),
    )
    write_table(job, pa.concat_tables([judged, _renumber(runs, own.summary)]).sort_by("run_id"))
    return Results.read(directory / SCORES / name)


def _judge(runs: ProgramRuns, given: GivenResults) -> tuple[pa.Table, NDArray]:
    """Return the rows of a program, and the misalignments at the end of its runs, (runs, 3)."""
    attitudes, builder, tables = _attitudes_at_records(runs, given), TableBuilder(runs.study), []
    final_only, shape = attitudes.present.sum(axis=0) == 1, runs.run_id.shape
    phi = np.empty((*shape, 3))
    for batch, condition in runs.batches():
        draw, variant = np.divmod(np.arange(shape[0] * len(condition)), len(condition))
        run = draw * shape[1] + condition[variant]
        outcome = judge(batch, jax.tree.map(lambda a, run=run: a[:, run], attitudes))
        phi.reshape(-1, 3)[run] = np.stack(outcome.last.phi, axis=-1)
        table = builder.summary_table(Chunk(draw, variant, outcome, None), batch.variant_ids)
        for name in (n for n in table.column_names if n.startswith("settle_")):
            # All that is known of them is that they are settled at their end.
            at_end = pa.array(final_only[run] & table[name].is_valid().to_numpy())
            settled = pc.if_else(at_end, runs.end_s, table[name]).combine_chunks()
            table = replace_column(table, name, settled)
        tables.append(table)
    return pa.concat_tables(tables), phi.reshape(-1, 3)


def _attitudes_at_records(runs: ProgramRuns, given: GivenResults) -> GivenAttitudes:
    """Return the attitudes of all runs at record times; rows between these do not count.

    Before its first row an attitude is unknown, unless its last row is the only one.
    """
    study = runs.source
    interval_s = study.record_every / study.rate_hz
    record = np.round(given.time_s / interval_s).astype(int) - 1
    late_s = np.abs(given.time_s - (record + 1) * interval_s)
    used = (record >= 0) & (record < study.records) & (late_s < 0.5 / study.rate_hz)
    row = np.full((study.records, runs.run_id.size), len(used))  # beyond the last row: unknown
    row[record[used], given.run[used]] = np.flatnonzero(used)
    present = row < len(used)
    present |= ~np.logical_or.accumulate(present) & present[:-1].any(axis=0)
    present[-1] = True
    parts = [np.append(part, np.nan)[row] for part in (*given.attitude, *_covariance(given))]
    return GivenAttitudes(present, Quat(*parts[:4]), AttitudeCovariance(*parts[4:]))


def _covariance(given: GivenResults) -> AttitudeCovariance:
    """Return the covariance of the misalignment in n from sigmas of pitch, roll and yaw.

    Pitch is about right and roll about front, both level to first order.
    """
    pitch, roll, yaw = given.sigma.T**2
    heading = to_angles(given.attitude, "enu")[:, 2]
    cos, sin = np.cos(heading), np.sin(heading)
    return AttitudeCovariance(
        ee=pitch * cos**2 + roll * sin**2,
        en=(pitch - roll) * cos * sin,
        eu=0.0 * yaw,
        nn=pitch * sin**2 + roll * cos**2,
        nu=0.0 * yaw,
        uu=yaw,
    )


def _renumber(runs: ProgramRuns, own: pa.Table) -> pa.Table:
    """Return the rows of the own methods as those of the study with the program."""
    study, keys = runs.study, ["method", *runs.source.axis_keys]
    variants = {p: i for i, p in enumerate(zip(*map(study.values, keys), strict=True))}
    points = zip(*map(runs.source.values, keys), strict=True)
    variant = np.array([variants[p] for p in points])[own["variant_id"].to_numpy()]
    schema = summary_columns(study)
    values: dict[str, Any] = {c.name: pa.nulls(len(own), c.dtype) for c in schema}
    values |= {c: own[c].combine_chunks() for c in own.column_names if c in values}
    values |= {"run_id": own["draw_id"].to_numpy() * study.n_variants + variant}
    return make_table(schema, values | {"variant_id": variant})


def _iter_doubts(runs: ProgramRuns, given: GivenResults, phi: NDArray) -> Iterator[str]:
    """Yield what the file lacks, and another convention that it seems to have."""
    rows = np.bincount(given.run, minlength=runs.run_id.size)
    at_end = np.flatnonzero(given.time_s > runs.end_s - 0.5 / runs.source.rate_hz)
    if len(missing := np.delete(runs.run_id.ravel(), given.run[at_end])):
        yield (
            f"{len(missing):,} of {len(rows):,} runs have no row at their end, {runs.end_s:.12g} s,"
            f" and count as failures: run_id {shorten(', '.join(map(str, missing)), 60)}"
        )
    if single := int((rows == 1).sum()):
        yield (
            f"{format_count(single, 'run')} with one row only: settled at the end of a run is all"
            " that is known of the settling time"
        )
    if len(at_end) and (reading := suspect(given, at_end, phi[given.run[at_end]])):
        yield reading
