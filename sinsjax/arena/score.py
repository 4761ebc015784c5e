"""Scoring the results of a program outside sinsjax on the draws that were exported to it.

The attitudes pass through the metrics of every run (`arena.given`). Together with the rows of
sinsjax's own methods on the same draws they are a results directory like any other, in which the
program is a further method.
"""

import re
import warnings
from pathlib import Path
from typing import Any, NamedTuple

import jax
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
from sinsjax.arena.readme import RECORDS
from sinsjax.arena.results_file import AskedRuns, GivenResults, read_results
from sinsjax.arena.runs import ProgramPart, ProgramRuns
from sinsjax.arena.suspicions import suspect
from sinsjax.engine.batch import Chunk
from sinsjax.engine.metrics import Outcome
from sinsjax.errors import InputError, StudyWarning
from sinsjax.execution import directory as results_directory
from sinsjax.execution import resume
from sinsjax.execution.results import Results
from sinsjax.execution.run import ProgressCallback, run
from sinsjax.execution.schemas import summary_columns, variant_columns
from sinsjax.execution.store import write_table
from sinsjax.execution.tables import TableBuilder, make_table, replace_column
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

_LARGE_SIGMAS = 20
"""Ratio of sigmas to errors from which another unit is suspected; right units give 1 to 2."""

_SMALLER_UNIT = {"rad": "deg", "deg": "arcmin", "arcmin": "arcsec"}

_LISTED = 12
"""Most missing runs that a line lists."""


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


class Rows(NamedTuple):
    """The summary of a study's own methods.

    Attributes:
        study: their study.
        table: by run_id.
    """

    study: Study
    table: pa.Table


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
    directory, name = Path(directory), _check_name(Path(results).stem if name is None else name)
    study, manifest = read_export(directory)
    if fingerprint(study) != manifest["digest"]:
        text = "the attitude_file of its study has changed since (export the study again)"
        raise InputError(f"{directory}: {text}")
    target = directory / SCORES / name if out is None else results_directory.results_path(out)
    _check_target(target, directory, against, overwrite=overwrite)
    draws, exported = range(*manifest["draws"]), ProgramRuns(study)
    stored = None if against is None else _open_results(Path(against), study, manifest)
    source = _first_draws(study if stored is None else stored.study, draws)
    runs = ProgramRuns(source, name)
    with_program = runs.study  # its name is refused before anything is read or run
    asked = _asked_runs(exported, draws, manifest)
    given = read_results(results, asked, frame)
    own = _own_rows(source, stored, on_progress)
    program, missing = _judge(runs, exported, draws, given)
    table = _join(with_program, name, draws, program, own)
    comparison = compare(with_program, table, name, runs.keys)
    reading = _suspect(runs, exported, draws, given, table, comparison)
    doubts = _describe_doubts(name, asked, given, missing)
    doubts += _doubt_sigmas(table, name, given.sigma_unit)
    doubts += [*_doubt_floor(with_program, table, name), *([reading] if reading else [])]
    job = Job(
        with_program,
        curves=False,
        directory=target,
        overwrite=overwrite,
        manifest_state=resume.manifest_state(target),
        source=f"{with_program.name} with {Path(results).name}",
        warnings=tuple(doubts),
    )
    write_table(job, table, draws, **{_DIGEST: manifest["digest"]})
    return Score(target, with_program, comparison, asked.run_id[missing].tolist(), doubts)


def _check_name(name: str) -> str:
    """Return the name of a program, which is that of a folder too.

    Raises:
        InputError: it cannot be one.
    """
    if not re.fullmatch(_NAME, name):
        text = "must begin with a letter or digit, then have these, blanks and . _ + - (at most 60)"
        raise InputError(f"--name: {to_one_line(name)!r} {text}")
    return name


def _check_target(
    target: Path, directory: Path, against: str | Path | None, *, overwrite: bool
) -> None:
    """Refuse a directory for the results that is in use.

    Raises:
        InputError: it is the export or the sweep, or already contains results.
    """
    used = [directory, directory / RECORDS, *([] if against is None else [Path(against)])]
    if target.resolve() in [path.resolve() for path in used]:
        raise InputError(f"{target}: is read, and cannot be written to (give another with --out)")
    results_directory.check_unlocked(target)
    resume.check_available(target, overwrite=True, resume=False)
    if not overwrite and resume.manifest_state(target) is not None:
        raise InputError(f"{target}: already contains results (--overwrite replaces them)")


def _open_results(against: Path, study: Study, manifest: dict[str, Any]) -> Results:
    """Return the results of a sweep of the exported study, or of it with other programs.

    Raises:
        InputError: they are of another study, or lack draws.
    """
    source = Results.read(against)
    is_same = results_directory.read_manifest(against).get(_DIGEST) == manifest["digest"]
    same_draws = with_draws(_without_stopping(source.study), study.n_draws)
    if not is_same and fingerprint(same_draws) != fingerprint(_without_stopping(study)):
        differing = describe_differences(study, same_draws, ("exported", "there"))
        text = shorten("; ".join(differing), 300)
        raise InputError(f"{against}: contains results of another study: {text}")
    first, end = manifest["draws"]
    wanted = np.arange(first, end)
    whole = np.unique(source.rows(["draw_id"])["draw_id"].to_numpy(), return_counts=True)
    present = whole[0][whole[1] == source.study.n_variants]
    if not np.isin(wanted, present).all():
        text = f"has {len(present)} whole draws, {first}:{end} are exported"
        raise InputError(f"{against}: {text} (`sinsjax sweep` with --draws {end}, --resume)")
    return source


def _without_stopping(study: Study) -> Study:
    return study.model_copy(update={"stop_when": None, "tune": None})


def _first_draws(study: Study, draws: range) -> Study:
    """Return a study without the draws after the exported ones, where they can be left out."""
    study = _without_stopping(study)
    nested = study.drawn is None or study.drawn.sampling == "random"
    return with_draws(study, draws.stop) if nested and draws.stop < study.n_draws else study


def _asked_runs(exported: ProgramRuns, draws: range, manifest: dict[str, Any]) -> AskedRuns:
    tasks = exported.tasks(draws)
    return AskedRuns(
        manifest["digest"],
        manifest["frame"],
        tasks.run_id,
        tasks.draw,
        tasks.variant,
        np.full(len(tasks.run_id), exported.end_s),
        1 / exported.source.rate_hz,
    )


def _own_rows(study: Study, stored: Results | None, on_progress: ProgressCallback | None) -> Rows:
    """Return the summary of a study's own methods, read or run here."""
    if stored is not None:
        return Rows(stored.study, stored.summary)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", StudyWarning)  # the export is of the same study
        return Rows(study, run(study, curves=False, on_progress=on_progress).summary)


def _judge(
    runs: ProgramRuns, exported: ProgramRuns, draws: range, given: GivenResults
) -> tuple[pa.Table, NDArray]:
    """Return the rows of a program, and the places of runs without a result at their end."""
    builder, tables = TableBuilder(runs.study), []
    places = _places(exported, draws)
    missing = np.zeros(len(places), bool)
    records = runs.study.records
    for part in runs.parts:
        tasks = len(part.places)
        block = max(1, _BLOCK_RECORDS // (records * tasks))
        for first in range(draws.start, draws.stop, block):
            some = range(first, min(first + block, draws.stop))
            run = np.array([places[point, draw] for draw in some for point in part.points])
            attitudes, final_only = _attitudes(runs.study, records, given, run, len(missing))
            missing[run] = ~np.isfinite(attitudes.attitude.w[-1])
            outcome = engine.judge(runs.batch(part, some), attitudes)
            tables.append(_program_rows(runs, builder, part, some, outcome, final_only))
    return pa.concat_tables(tables), np.flatnonzero(missing)


def _places(exported: ProgramRuns, draws: range) -> dict[tuple[Any, int], int]:
    """Return the place of each exported run by its conditions and draw."""
    tasks, points = exported.tasks(draws), list(exported.points)
    keys = zip(tasks.point.tolist(), tasks.draw.tolist(), strict=True)
    return {(points[point], draw): place for place, (point, draw) in enumerate(keys)}


def _attitudes(
    study: Study, records: int, given: GivenResults, run: NDArray, count: int
) -> tuple[GivenAttitudes, NDArray]:
    """Return the attitudes of some runs at record times, and which have only the last one.

    Rows between record times do not count. A run counts as outside every band before its first row,
    unless its last row is the only one.
    """
    lane = np.full(count, -1)
    lane[run] = np.arange(len(run))
    interval_s = study.record_every / study.rate_hz
    record = np.round(given.time_s / interval_s).astype(int) - 1
    late_s = np.abs(given.time_s - (record + 1) * interval_s)
    used = (lane[given.run] >= 0) & (record >= 0) & (record < records)
    used &= late_s < 0.5 / study.rate_hz
    rows = given.select(np.flatnonzero(used))
    at = record[used], lane[rows.run]
    shape = records, len(run)

    def spread(values: NDArray) -> NDArray:
        whole = np.full(shape, np.nan)
        whole[at] = values
        return whole

    present = np.zeros(shape, bool)
    present[at] = True
    first = np.where(present.any(axis=0), present.argmax(axis=0), 0)
    final_only = (present.sum(axis=0) == 1) & present[-1]
    present[-1] = True
    unknown_until = np.where((first == 0) | final_only, 0.0, (first + 1) * interval_s)
    attitude = rows.attitude
    covariance = AttitudeCovariance(*map(spread, _covariance(rows, attitude)))
    spread_attitude = Quat(*(spread(np.asarray(part)) for part in attitude))
    return GivenAttitudes(present, spread_attitude, covariance, unknown_until), final_only


def _covariance(rows: GivenResults, attitude: Quat) -> tuple[NDArray, ...]:
    """Return the covariance of the misalignment in n from sigmas of pitch, roll and yaw.

    Pitch is about right and roll about front, both level to first order.
    """
    pitch, roll, yaw = rows.sigma.T**2
    heading = to_angles(attitude, "enu")[:, 2]
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


def _program_rows(
    runs: ProgramRuns,
    builder: TableBuilder,
    part: ProgramPart,
    draws: range,
    outcome: Outcome,
    final_only: NDArray,
) -> pa.Table:
    """Return the rows of all variants of a part from the outcomes of its tasks."""
    variants, tasks = len(part.ids), len(part.places)
    run = (np.arange(len(draws))[:, None] * tasks + part.task).ravel()
    chunk = Chunk(
        np.repeat(list(draws), variants),
        np.tile(np.arange(variants), len(draws)),
        jax.tree.map(lambda a: a[run], outcome),
        None,
    )
    table = builder.summary_table(chunk, part.ids)
    end_s = pa.scalar(runs.end_s)
    for name in (n for n in table.column_names if n.startswith("settle_")):
        # All that is known of them is that they are settled at their end.
        at_end = pa.array(final_only[run] & table[name].is_valid().to_numpy())
        settled = pc.if_else(at_end, end_s, table[name]).combine_chunks()
        table = replace_column(table, name, settled)
    return table


def _join(study: Study, name: str, draws: range, program: pa.Table, own: Rows) -> pa.Table:
    """Return the rows of all methods, by run_id."""
    schema, variants = summary_columns(study), np.arange(study.n_variants)
    is_own = np.array(study.values("method")) != name
    keys = ["method", *own.study.axis_keys]
    there = {p: i for i, p in enumerate(zip(*map(own.study.values, keys), strict=True))}
    here = list(zip(*map(study.values, keys), strict=True))
    variant = np.tile(variants[is_own], len(draws))
    draw = np.repeat(list(draws), int(is_own.sum()))
    wanted = draw * own.study.n_variants + np.array([there[here[v]] for v in variant])
    run_id = own.table["run_id"].to_numpy()
    place = np.minimum(np.searchsorted(run_id, wanted), len(run_id) - 1)
    assert (run_id[place] == wanted).all()
    rows = own.table.take(pa.array(place))
    values = {c.name: pa.nulls(len(rows), c.dtype) for c in schema}
    values |= {c: rows[c].combine_chunks() for c in rows.column_names if c in values}
    values |= {
        key: column.take(pa.array(variant))
        for key, column in variant_columns(study, schema).items()
    }
    values |= {
        "run_id": draw * study.n_variants + variant,
        "draw_id": draw,
        "variant_id": variant,
    }
    return pa.concat_tables([program, make_table(schema, values)]).sort_by("run_id")


def _suspect(
    runs: ProgramRuns,
    exported: ProgramRuns,
    draws: range,
    given: GivenResults,
    table: pa.Table,
    comparison: Comparison,
) -> str | None:
    """Return another convention that the results seem to have, in one line."""
    last = np.flatnonzero(np.diff(given.run, append=-1))
    rows, places = given.select(last), _places(exported, draws)
    truth = np.full((len(places), 4), np.nan)
    rivals = comparison.rivals
    references = np.full((len(rivals), len(places), 3), np.nan)
    phi = np.stack(
        [table[f"phi_{a}_arcmin"].to_numpy(zero_copy_only=False) for a in "enu"], axis=-1
    )
    for part in runs.parts:
        attitudes = engine.true_attitudes_at_records(runs.batch(part, draws))
        for point in part.points:
            for at, draw in enumerate(draws):
                place = places[point, draw]
                truth[place] = [a[-1, at] for a in attitudes]
                first = (draw - draws.start) * runs.study.n_variants
                for number, rival in enumerate(rivals):
                    references[number, place] = phi[first + rival[point]] * ARCMIN
    at_end = np.abs(rows.time_s - runs.end_s) < 0.5 / runs.study.rate_hz
    rows = rows.select(np.flatnonzero(at_end))
    if not len(rows.run):
        return None
    found = suspect(rows, Quat(*truth[rows.run].T), references[:, rows.run])
    return found and f"the attitudes of {runs.name}: {found}"


def _describe_doubts(
    name: str, asked: AskedRuns, given: GivenResults, missing: NDArray
) -> list[str]:
    """Return what a reader of the results must know, one line each."""
    lines = []
    if len(missing):
        ids = ", ".join(map(str, asked.run_id[missing][:_LISTED].tolist()))
        more = ", ..." if len(missing) > _LISTED else ""
        lines.append(
            f"{name}: {len(missing):,} of {len(asked.run_id):,} runs have no row at their end and"
            f" count as failures: run_id {ids}{more}"
        )
        at_end = np.zeros(len(asked.run_id))
        np.maximum.at(at_end, given.run, given.time_s)
        ended = at_end[missing]
        if (near := (ended > 0.5 * asked.end_s[missing])).any():
            run = missing[near][0]
            lines.append(
                f"{name}: run_id {asked.run_id[run]} ends at {at_end[run]:.12g} s, expected a row"
                f" at {asked.end_s[run]:.12g} s"
            )
    rows = np.bincount(given.run, minlength=len(asked.run_id))
    if single := int((rows == 1).sum()):
        lines.append(
            f"{name}: {format_count(single, 'run')} with one row only: settled at the end of a run"
            " is all that is known of the settling time"
        )
    has_sigma = np.isfinite(given.sigma).any(axis=0)
    if has_sigma.any() and not has_sigma.all():
        lines.append(f"{name}: no NEES, which needs sigma_yaw, sigma_pitch and sigma_roll")
    return lines


def _doubt_sigmas(table: pa.Table, name: str, unit: str) -> list[str]:
    """Return that the sigmas of the heading are so far above its errors that their unit is wrong.

    Far below may be right: filters know nothing of the biases that cause most of the error.
    """
    rows = table.filter(pc.equal(table["method"], name))
    error, sigma = (numeric_column(rows, f"{column}_u_arcmin") for column in ("phi", "sigma"))
    ratios = sigma[error != 0] / np.abs(error[error != 0])
    ratios = ratios[np.isfinite(ratios)]
    if not len(ratios) or np.median(ratios) < _LARGE_SIGMAS:
        return []
    text = f"its sigmas of the heading are {np.median(ratios):.2g} times its errors"
    return [f"{name}: {text}: are they in {_SMALLER_UNIT[unit]}, not {unit}?"]


def _doubt_floor(study: Study, table: pa.Table, name: str) -> list[str]:
    """Return that runs end nearer to north than their bias floor, if the study judges from it."""
    criteria = success_criteria(study)
    if criteria.from_truth:
        return []
    rows = table.filter(pc.equal(table["method"], name))
    error, floor = (np.abs(numeric_column(rows, column)) for column in FLOOR_COLUMNS)
    better = int((error < floor - criteria.band_arcmin).sum())
    if not better:
        return []
    return [
        f"{name}: {format_count(better, 'run')} nearer to north than the bias floor, from which"
        " this study judges: no success there (--set study.judged_from='truth' for the export)"
    ]
