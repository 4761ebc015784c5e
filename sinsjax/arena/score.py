"""Scoring the results of a program outside sinsjax on the draws that were exported to it.

The attitudes pass through the metrics of every run (`arena.given`). Together with the rows of
sinsjax's own methods on the same draws they are a results directory like any other, in which the
program is a further method.
"""

import re
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from sinsjax.analysis.tables import numeric_column
from sinsjax.arena import given as engine
from sinsjax.arena.comparison import Comparison, compare
from sinsjax.arena.export import SCORES, read_export
from sinsjax.arena.frames import to_angles
from sinsjax.arena.given import GivenAttitudes
from sinsjax.arena.results_file import GivenResults, read_results
from sinsjax.arena.runs import ProgramRuns
from sinsjax.arena.suspicions import suspect
from sinsjax.engine.batch import Chunk
from sinsjax.errors import InputError, StudyWarning
from sinsjax.execution import directory as results_directory
from sinsjax.execution.results import Results
from sinsjax.execution.run import ProgressCallback, run
from sinsjax.execution.store import write_table
from sinsjax.execution.tables import (
    TableBuilder,
    make_table,
    replace_column,
    summary_columns,
)
from sinsjax.execution.tasks import Job
from sinsjax.messages import format_count, shorten, to_one_line
from sinsjax.methods.method import AttitudeCovariance
from sinsjax.platform import runtime
from sinsjax.study.identity import describe_differences, fingerprint, with_draws
from sinsjax.study.study import Study
from sinsjax.study.success import FLOOR_COLUMNS, success_criteria
from sinsjax.types import Quat
from sinsjax.units import ARCMIN

_BLOCK_RECORDS = 2**20
"""Attitudes judged at once, some 200 MB."""

_DIGEST = "exported_digest"
"""Entry of the manifest with the digest of the exported study."""

_NAME = r"[^\W_][\w.+ -]{0,59}"
"""Names of programs: a letter or digit first."""


class Score(NamedTuple):
    """The results of a program, compared with those of sinsjax's own methods.

    Attributes:
        directory: results directory with all of them.
        study: the study with the program as a further method.
        comparison: the program against the best method of sinsjax.
        missing: run_id of the runs without a result at their end.
        warnings: doubts about the results, one line each.

    Examples:
        >>> sinsjax.Score._fields  # what `sinsjax.score_results` returns
        ('directory', 'study', 'comparison', 'missing', 'warnings')
    """

    directory: Path
    study: Study
    comparison: Comparison
    missing: list[int]
    warnings: list[str]


def score_results(
    directory: str | Path,
    results: str | Path,
    *,
    name: str | None = None,
    against: str | Path | None = None,
    out: str | Path | None = None,
    frame: str | None = None,
    overwrite: bool = False,
    on_progress: ProgressCallback | None = None,
) -> Score:
    r"""Compare the results of a program with those of sinsjax's own methods on the same draws.

    Args:
        directory: directory of the export, see `sinsjax.export_study`.
        results: CSV or Parquet file of the program's results; README.txt in the directory lists the
            columns.
        name: of the program; None for the stem of the file.
        against: results directory of a sweep of the same study; None runs the study here.
        out: results directory to write; None for ``scores/NAME`` in that of the export.
        frame: "enu" or "ned", of the attitudes; None for that of the file or the export.
        overwrite: whether to replace results in ``out``.
        on_progress: called with the progress of the study's own runs.

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
        >>> score = sinsjax.score_results(exported, "results.csv", name="zeros")
        >>> score.directory.name, score.study.methods, score.missing
        ('zeros', ('kalman5', 'zeros'), [])
    """
    runtime.ensure_configured()
    directory, name = Path(directory), Path(results).stem if name is None else name
    if not re.fullmatch(_NAME, name):
        text = "must begin with a letter or digit, then have these, blanks and . _ + - (at most 60)"
        raise InputError(f"--name: {to_one_line(name)!r} {text}")
    study, manifest = read_export(directory)
    target = directory / SCORES / name if out is None else Path(out)
    if target.resolve() in {Path(path).resolve() for path in (directory, against) if path}:
        raise InputError(f"{target}: is read, and cannot be written to (give another with --out)")
    results_directory.check_available(target, overwrite=True, resume=False)
    if not overwrite and (target / results_directory.MANIFEST).exists():
        raise InputError(f"{target}: already contains results (--overwrite replaces them)")
    exported = ProgramRuns(study, range(*manifest["draws"]))
    stored = None if against is None else _open_results(Path(against), exported)
    own = with_draws(_without_stopping(stored.study if stored else study), study.n_draws)
    runs = ProgramRuns(own, exported.draws, name)
    with_program = runs.study  # its name is refused before anything is read or run
    given = read_results(Path(results), exported, manifest["frame"], frame)
    if stored is not None:
        own_rows = stored.summary
    else:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", StudyWarning)  # the export is of the same study
            own_rows = run(own, curves=False, on_progress=on_progress).summary
    table = _join(runs, own_rows, _judge(runs, given))
    comparison = compare(with_program, table, name, runs.keys)
    at_end = given.select(np.flatnonzero(given.time_s > runs.end_s - 0.5 / study.rate_hz))
    missing = np.delete(exported.run_id, at_end.run).tolist()
    rows = table.filter(pc.equal(table["method"], name))
    doubts = [f"{name}: {line}" for line in _doubts(runs, given, missing, rows)]
    if reading := _suspect(runs, at_end, table, comparison):
        doubts.append(f"the attitudes of {name}: {reading}")
    job = Job(
        with_program,
        curves=False,
        directory=target,
        overwrite=overwrite,
        source=f"{study.name} with {Path(results).name}",
        warnings=tuple(doubts),
    )
    write_table(job, table, runs.draws, **{_DIGEST: manifest["digest"]})
    return Score(target, with_program, comparison, missing, doubts)


def _open_results(against: Path, exported: ProgramRuns) -> Results:
    """Return the results of a sweep of the exported study, or of it with other programs.

    Raises:
        InputError: they are of another study, or lack draws.
    """
    source, study = Results.read(against), _without_stopping(exported.source)
    there = _without_stopping(source.study)
    if study.drawn is None or study.drawn.sampling == "random":  # else fewer draws are others
        there = with_draws(there, study.n_draws)
    digest = results_directory.read_manifest(against).get(_DIGEST)
    if digest != fingerprint(exported.source) and fingerprint(there) != fingerprint(study):
        differing = "; ".join(describe_differences(study, there, ("exported", "there")))
        text = f"contains results of another study: {shorten(differing, 300)}"
        raise InputError(f"{against}: {text}")
    draw, rows = np.unique(source.rows(["draw_id"])["draw_id"].to_numpy(), return_counts=True)
    whole = draw[rows == source.study.n_variants]
    if not np.isin(exported.draws, whole).all():
        end = exported.draws.stop
        text = f"has {len(whole)} whole draws, {exported.draws.start}:{end} are exported"
        raise InputError(f"{against}: {text} (`sinsjax sweep` with --draws {end}, --resume)")
    return source


def _without_stopping(study: Study) -> Study:
    return study.model_copy(update={"stop_when": None, "tune": None})


def _judge(runs: ProgramRuns, given: GivenResults) -> pa.Table:
    """Return the rows of a program."""
    builder, tables, end_s = TableBuilder(runs.study), [], pa.scalar(runs.end_s)
    for part in runs.parts:
        block = max(1, _BLOCK_RECORDS // (runs.study.records * len(part.ids)))
        for first in range(runs.draws.start, runs.draws.stop, block):
            some = range(first, min(first + block, runs.draws.stop))
            attitudes, final_only = _attitudes(runs, given, runs.places(part, some))
            draw, variant = np.divmod(np.arange(len(some) * len(part.ids)), len(part.ids))
            outcome = engine.judge(runs.batch(part, some), attitudes)
            table = builder.summary_table(Chunk(first + draw, variant, outcome, None), part.ids)
            for name in (n for n in table.column_names if n.startswith("settle_")):
                # All that is known of them is that they are settled at their end.
                at_end = pa.array(final_only & table[name].is_valid().to_numpy())
                settled = pc.if_else(at_end, end_s, table[name]).combine_chunks()
                table = replace_column(table, name, settled)
            tables.append(table)
    return pa.concat_tables(tables)


def _attitudes(
    runs: ProgramRuns, given: GivenResults, places: NDArray
) -> tuple[GivenAttitudes, NDArray]:
    """Return the attitudes of some runs at record times, and which have only the last one.

    Rows between record times do not count. A run counts as outside every band before its first row,
    unless its last row is the only one.

    Args:
        runs: of the program.
        given: all results.
        places: (runs,) places of the runs in the results; several may be the same.
    """
    study = runs.study
    interval_s = study.record_every / study.rate_hz
    record = np.round(given.time_s / interval_s).astype(int) - 1
    late_s = np.abs(given.time_s - (record + 1) * interval_s)
    used = (record >= 0) & (record < study.records) & (late_s < 0.5 / study.rate_hz)
    row = np.full((study.records, len(runs.run_id)), len(used))  # beyond the last row: none
    row[record[used], given.run[used]] = np.flatnonzero(used)
    row = row[:, places]
    present = row < len(used)
    first = np.where(present.any(axis=0), present.argmax(axis=0), 0)
    final_only = (present.sum(axis=0) == 1) & present[-1]
    unknown_until = np.where((first == 0) | final_only, 0.0, (first + 1) * interval_s)
    present[-1] = True
    parts = [np.append(part, np.nan)[row] for part in (*given.attitude, *_covariance(given))]
    shown = GivenAttitudes(present, Quat(*parts[:4]), AttitudeCovariance(*parts[4:]), unknown_until)
    return shown, final_only


def _covariance(given: GivenResults) -> tuple[NDArray, ...]:
    """Return the covariance of the misalignment in n from sigmas of pitch, roll and yaw.

    Pitch is about right and roll about front, both level to first order.
    """
    pitch, roll, yaw = given.sigma.T**2
    heading = to_angles(given.attitude, "enu")[:, 2]
    cos, sin = np.cos(heading), np.sin(heading)
    zero = 0.0 * yaw
    return (
        pitch * cos**2 + roll * sin**2,
        (pitch - roll) * cos * sin,
        zero,
        pitch * sin**2 + roll * cos**2,
        zero,
        yaw,
    )


def _join(runs: ProgramRuns, own_rows: pa.Table, program: pa.Table) -> pa.Table:
    """Return the rows of a study's own methods and of a program, by run_id."""
    study, own, keys = runs.study, runs.source, ["method", *runs.source.axis_keys]
    variants = {p: i for i, p in enumerate(zip(*map(study.values, keys), strict=True))}
    renumbered = np.array([variants[p] for p in zip(*map(own.values, keys), strict=True)])
    rows = own_rows.filter(pc.is_in(own_rows["draw_id"], pa.array(list(runs.draws), pa.int64())))
    schema, variant = summary_columns(study), renumbered[rows["variant_id"].to_numpy()]
    values: dict[str, Any] = {c.name: pa.nulls(len(rows), c.dtype) for c in schema}
    values |= {c: rows[c].combine_chunks() for c in rows.column_names if c in values}
    run_id = rows["draw_id"].to_numpy() * study.n_variants + variant
    values |= {"run_id": run_id, "variant_id": variant}
    return pa.concat_tables([program, make_table(schema, values)]).sort_by("run_id")


def _suspect(
    runs: ProgramRuns, at_end: GivenResults, table: pa.Table, comparison: Comparison
) -> str | None:
    """Return another convention that the results seem to have."""
    if not len(at_end.run):
        return None
    truth = np.empty((len(runs.run_id), 4))
    for part in runs.parts:
        attitudes = engine.true_attitudes_at_records(runs.batch(part))
        last = np.stack([a[-1] for a in attitudes], axis=-1)  # of each draw
        truth[runs.places(part, runs.draws)] = np.repeat(last, len(part.ids), axis=0)
    columns = [numeric_column(table, f"phi_{axis}_arcmin") for axis in "enu"]
    phi = np.stack(columns, axis=-1).reshape(len(runs.draws), -1, 3) * ARCMIN
    references = [
        phi[:, [rival[condition] for condition in runs.conditions]].reshape(-1, 3)[at_end.run]
        for rival in comparison.rivals
    ]
    return suspect(at_end, Quat(*truth[at_end.run].T), references)


def _doubts(
    runs: ProgramRuns, given: GivenResults, missing: list[int], rows: pa.Table
) -> Iterator[str]:
    """Yield what the file lacks, and runs that end too near to north to count."""
    count = len(runs.run_id)
    if missing:
        ids = shorten(", ".join(map(str, missing)), 60)
        yield (
            f"{len(missing):,} of {count:,} runs have no row at their end, {runs.end_s:.12g} s,"
            f" and count as failures: run_id {ids}"
        )
    if single := int((np.bincount(given.run, minlength=count) == 1).sum()):
        yield (
            f"{format_count(single, 'run')} with one row only: settled at the end of a run is all"
            " that is known of the settling time"
        )
    has_sigma = np.isfinite(given.sigma).any(axis=0)
    if has_sigma.any() and not has_sigma.all():
        yield "no NEES, which needs sigma_yaw_deg, sigma_pitch_deg and sigma_roll_deg"
    criteria = success_criteria(runs.study)
    error, floor = (np.abs(numeric_column(rows, column)) for column in FLOOR_COLUMNS)
    better = int((error < floor - criteria.band_arcmin).sum())
    if better and not criteria.from_truth:
        yield (
            f"{format_count(better, 'run')} nearer to north than the bias floor, from which this"
            " study judges: no success there (--set study.judged_from='truth' for the export)"
        )
