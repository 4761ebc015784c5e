"""Scoring the results of a program outside sinsjax on the draws that were exported to it.

Results are a row per run and time, with the columns that README.txt of an export lists. They pass
through the metrics of every run (`arena.runs`), and with the rows of sinsjax's own methods they are
a results directory like any other, in which the program is a further method.
"""

import io
import re
import warnings
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, Literal

import jax
import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.csv
import pyarrow.parquet as pq
from numpy.typing import NDArray

from sinsjax.arena import export
from sinsjax.arena.runs import GivenAttitudes, ProgramRuns, judge
from sinsjax.engine.batch import Chunk
from sinsjax.errors import InputError, StudyWarning
from sinsjax.execution.results import Results
from sinsjax.execution.run import ProgressCallback, run_into
from sinsjax.execution.store import write_table
from sinsjax.execution.tables import TableBuilder, make_table, replace_column, summary_columns
from sinsjax.execution.tasks import Job
from sinsjax.maths.rotations import correct, misalignment
from sinsjax.messages import format_count, shorten, to_one_line
from sinsjax.methods.method import AttitudeCovariance
from sinsjax.platform import runtime
from sinsjax.platform.files import read_regular_file
from sinsjax.study.load import fingerprint
from sinsjax.types import Quat, Vec3
from sinsjax.units import ARCMIN, DEG

_OWN, _SCORES = "own", "scores"  # folders in an export, of sinsjax's methods and of programs
_NAME = r"[^\W_][\w.+ -]{0,59}"
_ANGLES = ["pitch_deg", "roll_deg", "yaw_deg"]
_SIGMA = "sigma_yaw_deg"
_QUATERNION = ["q_w", "q_x", "q_y", "q_z"]
_TYPES = {"study": pa.string()} | dict.fromkeys(
    ["run_id", "time_s", *_ANGLES, *_QUATERNION, _SIGMA], pa.float64()
)
_LENGTH_TOLERANCE = 0.01
_LARGEST_DEG = 1e6
_LEAST = 30 * ARCMIN  # of median errors for which another reading may be suspected
_BETTER, _MUCH_BETTER = 0.25, 0.1  # largest share of it then, the second if it is still bad


def score_results(
    directory: str | Path,
    results: str | Path,
    *,
    name: str | None = None,
    on_progress: ProgressCallback | None = None,
) -> Results:
    """Return the results of a program with those of sinsjax's own methods on the same draws.

    The first score runs the study's own methods into ``own`` in the export, as a sweep of its
    ``study.toml`` to that directory would do. Results of the same name are replaced.

    Args:
        directory: directory of the export, see `sinsjax.export_study`.
        results: CSV or Parquet file of the program's results; README.txt in the directory lists the
            columns.
        name: name of the program; None for the stem of the file.
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
        >>> rows = (exported / "initial.csv").read_text()  # the first attitudes, as results
        >>> with open("results.csv", "w") as file:
        ...     _ = file.write(rows.replace("end_s", "time_s"))
        >>> scored = sinsjax.score_results(exported, "results.csv", name="first")
        >>> scored.directory.name, scored.study.methods
        ('first', ('kalman5', 'first'))
    """
    runtime.ensure_configured()
    directory, name = Path(directory), Path(results).stem if name is None else name
    if not re.fullmatch(_NAME, name):
        text = "must begin with a letter or digit, then have these, blanks and . _ + - (at most 60)"
        raise InputError(f"--name: {to_one_line(name)!r} {text}")
    source, frame = export.read_export_study_and_frame(directory)
    runs = ProgramRuns(source, name)
    attitudes, form = _read_attitudes_and_form(Path(results), runs, frame)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", StudyWarning)  # the study was exported with these
        own = run_into(source, directory / _OWN, resume=True, curves=False, on_progress=on_progress)
    judged, phi = _summary_and_end_phi(runs, attitudes)
    other_conventions = partial(_iter_readings, frame=frame, form=form)
    doubts = _iter_doubts(runs, attitudes, phi, other_conventions)
    job = Job(
        runs.study,
        curves=False,
        directory=directory / _SCORES / name,
        overwrite=True,
        source=f"{source.name} with {Path(results).name}",
        warnings=tuple(f"{name}: {line}" for line in doubts),
    )
    write_table(job, pa.concat_tables([judged, _renumber_methods(runs, own)]).sort_by("run_id"))
    return Results.read(directory / _SCORES / name)


def _read_attitudes_and_form(
    path: Path, runs: ProgramRuns, frame: str
) -> tuple[GivenAttitudes, Literal["angles", "quaternions"]]:
    """Return the attitudes of all runs at record times, and the form that the file gives them in.

    Rows between record times do not count. Before its first row an attitude is unknown, unless its
    last row is the only one.
    """
    table, first_row = _read_table_and_first_row_number(path, fingerprint(runs.source))
    rate_hz, end_s = runs.source.rate_hz, runs.end_s

    def refuse(rows: NDArray, text: str) -> None:
        if rows.any():
            raise InputError(f"{path}: row {first_row + int(rows.argmax())}: {text}")

    def read(name: str) -> NDArray:
        column = table[name].to_numpy()
        text = "is not finite (leave the row out: a run without one at its end counts as a failure)"
        refuse(~np.isfinite(column), f"column '{name}': {text}")
        return column

    place = {run_id: i for i, run_id in enumerate(runs.run_id.ravel().tolist())}
    run = np.array([place.get(run_id, -1) for run_id in read("run_id").tolist()])
    refuse(run < 0, "no run of the export has this run_id (see initial.csv)")
    time_s, half = read("time_s"), 0.5 / rate_hz
    refuse((time_s < 0) | (time_s > end_s + half), f"time_s is beyond its run, 0 to {end_s:.12g} s")
    order, repeated = np.lexsort((time_s, run)), np.zeros(len(run), bool)
    repeated[order[1:]] = (np.diff(run[order]) == 0) & (np.diff(time_s[order]) < half)
    refuse(repeated, "repeats its run_id and time_s")
    known = _SIGMA in table.column_names
    sigma = read(_SIGMA) * DEG if known else np.full(len(run), np.nan)
    refuse(sigma <= 0, f"{_SIGMA} must be above 0")
    if quaternions := "q_w" in table.column_names:
        values = np.stack([*map(read, _QUATERNION)], axis=-1)
        off = np.abs(np.linalg.norm(values, axis=-1) - 1) > _LENGTH_TOLERANCE
        refuse(off, f"{', '.join(_QUATERNION)} is no unit quaternion")
        attitude = export.from_quaternion(values, frame)
    else:
        values = np.stack([*map(read, _ANGLES)], axis=-1)
        large = (np.abs(values) > _LARGEST_DEG).any(axis=-1)
        refuse(large, f"an angle is beyond {_LARGEST_DEG:g} deg")
        attitude = export.from_angles(values * DEG, frame)

    interval_s = runs.source.record_every / rate_hz
    record = np.round(time_s / interval_s).astype(int) - 1
    used = (record >= 0) & (np.abs(time_s - (record + 1) * interval_s) < half)
    row = np.full((runs.source.records, runs.run_id.size), len(run))  # beyond the last: unknown
    row[record[used], run[used]] = np.flatnonzero(used)
    present = row < len(run)
    present |= ~np.logical_or.accumulate(present) & present[:-1].any(axis=0)
    present[-1] = True
    *q, uu = (np.append(part, np.nan)[row] for part in (*attitude, sigma**2))
    nan = np.full_like(uu, np.nan)
    covariance = AttitudeCovariance(nan, nan, nan, nan, nan, uu)
    return GivenAttitudes(present, Quat(*q), covariance), "quaternions" if quaternions else "angles"


def _read_table_and_first_row_number(path: Path, study_digest: str) -> tuple[pa.Table, int]:
    """Read the known columns of a file, and the number of their first row."""
    try:
        content = read_regular_file(path.resolve())
        if content[:1] in (b"#", b"%"):
            text = "must name its columns in the first line (the digest goes in a column 'study')"
            raise InputError(f"{path}: {text}")
        if content.startswith(b"PAR1"):
            table, first_row = pq.read_table(io.BytesIO(content)), 1
        else:
            serial = pa.csv.ReadOptions(use_threads=False)  # for messages with the row's number
            convert = pa.csv.ConvertOptions(column_types=_TYPES)
            table = pa.csv.read_csv(io.BytesIO(content), serial, convert_options=convert)
            first_row = 2
        names = [name for name in table.column_names if name in _TYPES]
        if repeated := [name for name in names if names.count(name) > 1]:
            raise InputError(f"{path}: repeats column '{repeated[0]}' (keep one)")
        table = table.select(names).cast(pa.schema([(name, _TYPES[name]) for name in names]))
    except FileNotFoundError:
        raise InputError(f"{path}: there is no such file") from None
    except (pa.ArrowException, UnicodeDecodeError) as error:
        # Arrow counts columns from 0, rows from 1.
        text = re.sub(r"In CSV column #(\d+)", lambda m: f"column {int(m[1]) + 1}", str(error))
        raise InputError(f"{path}: {shorten(to_one_line(text), 200)}") from None
    needed = ("study", "run_id", "time_s", *(_QUATERNION if "q_w" in names else _ANGLES))
    if missing := [name for name in needed if name not in names]:
        text = f"lacks {', '.join(missing)} in its first line (as in initial.csv; see README.txt)"
        raise InputError(f"{path}: {text}")
    found = [str(text) for text in table["study"].unique().to_pylist()]
    if found != [study_digest]:
        shown = shorten(to_one_line(", ".join(found) or "none"), 40)
        text = f"is of another study: digest {shown} there, {study_digest} exported"
        raise InputError(f"{path}: {text} (column 'study')")
    return table, first_row


def _iter_readings(attitude: Quat, frame: str, form: str) -> Iterator[tuple[str, Quat]]:
    """Yield other readings of attitudes: what they suppose, in words, and attitudes."""
    angles = export.to_angles(attitude, frame)
    if form == "quaternions":
        w, x, y, z = export.to_quaternion(attitude, frame).T
        for words, parts in {
            "is the scalar of the quaternions last": (z, w, x, y),
            "are the quaternions from navigation to body axes": (w, -x, -y, -z),
            "is the scalar of the quaternions, from navigation to body axes, last": (z, -w, -x, -y),
        }.items():
            yield words, export.from_quaternion(np.stack(parts, axis=-1), frame)
    else:
        yield "are the angles in radians", export.from_angles(angles / DEG, frame)
    for words, sign, turn_deg in (
        ("is yaw mirrored (positive the other way round)", -1, 0),
        *((f"is yaw off by {turn} deg", 1, turn) for turn in (90, -90, 180)),
        ("is yaw mirrored and from east", -1, 90),
    ):
        pitch, roll, yaw = angles.T
        yaw = sign * (yaw - turn_deg * DEG)
        yield words, export.from_angles(np.stack([pitch, roll, yaw], axis=-1), frame)


def _summary_and_end_phi(runs: ProgramRuns, attitudes: GivenAttitudes) -> tuple[pa.Table, NDArray]:
    """Return the rows of a program, and the misalignments at the end of its runs, (runs, 3)."""
    builder, tables, phi = TableBuilder(runs.study), [], np.empty((runs.run_id.size, 3))
    final_only, (draws, conditions) = _has_one(attitudes), runs.run_id.shape
    for batch, condition in runs.batches_and_variant_conditions():
        draw, variant = np.divmod(np.arange(draws * len(condition)), len(condition))
        run = draw * conditions + condition[variant]
        outcome = judge(batch, jax.tree.map(lambda a, run=run: a[:, run], attitudes))
        phi[run] = np.stack(outcome.last.phi, axis=-1)
        table = builder.summary_table(Chunk(draw, variant, outcome, None), batch.variant_ids)
        for name in (n for n in table.column_names if n.startswith("settle_")):
            # All that is known of them is that they are settled at their end.
            at_end = pa.array(final_only[run] & table[name].is_valid().to_numpy())
            settled = pc.if_else(at_end, runs.end_s, table[name]).combine_chunks()
            table = replace_column(table, name, settled)
        tables.append(table)
    return pa.concat_tables(tables), phi


def _has_one(attitudes: GivenAttitudes) -> NDArray:
    """Return which runs have an attitude at their end alone, or none at all."""
    return attitudes.present.sum(axis=0) == 1


def _renumber_methods(runs: ProgramRuns, own_methods: Results) -> pa.Table:
    """Return the rows of the own methods as those of the study with the program."""
    study, keys, own = runs.study, ["method", *runs.source.axis_keys], own_methods.summary
    variants = {p: i for i, p in enumerate(zip(*map(study.values, keys), strict=True))}
    points = zip(*map(runs.source.values, keys), strict=True)
    variant = np.array([variants[p] for p in points])[own["variant_id"].to_numpy()]
    schema = summary_columns(study)
    values: dict[str, Any] = {c.name: pa.nulls(len(own), c.dtype) for c in schema}
    values |= {c: own[c].combine_chunks() for c in own.column_names if c in values}
    values |= {"run_id": own["draw_id"].to_numpy() * study.n_variants + variant}
    return make_table(schema, values | {"variant_id": variant})


def _iter_doubts(
    runs: ProgramRuns, attitudes: GivenAttitudes, phi: NDArray, other_conventions: Callable
) -> Iterator[str]:
    """Yield what the file lacks, and the convention that it seems to have, by other readings."""
    last = Quat(*(part[-1] for part in attitudes.attitude))
    ended = np.isfinite(last.w)
    if len(missing := runs.run_id.ravel()[~ended]):
        yield (
            f"{len(missing):,} of {len(ended):,} runs have no row at their end, {runs.end_s:.12g}"
            f" s, and count as failures: run_id {shorten(', '.join(map(str, missing)), 60)}"
        )
    if single := int((_has_one(attitudes) & ended).sum()):
        yield (
            f"{format_count(single, 'run')} with one row only: settled at the end of a run is all"
            " that is known of the settling time"
        )
    if not ended.any():
        return
    last, phi = jax.tree.map(lambda a: a[ended], (last, phi))
    q_true, error, found = jax.vmap(correct)(Vec3(*phi.T), last), _median_length(phi), []
    for words, other in other_conventions(last):
        now = _median_length(np.stack(jax.vmap(misalignment)(q_true, other), axis=-1))
        if error > _LEAST and now <= min(_BETTER * error, max(DEG, _MUCH_BETTER * error)):
            found.append((now, words))
    for now, words in sorted(found)[:1]:
        effect = f"the median error is {now / ARCMIN:.3g} arcmin instead of {error / ARCMIN:.3g}"
        yield f"{words}? Read so, {effect}"


def _median_length(phi: NDArray) -> float:
    return float(np.median(np.linalg.norm(phi, axis=-1)))
