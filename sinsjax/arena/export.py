"""Writing the draws of a study for programs outside sinsjax: a record per draw, and the starts.

A directory of an export has

    initial.csv     one row per run: record, first attitude, place, start and end
    imu/            one record per draw, per environment if there are several
    truth.parquet   true attitudes at record times, unless the export is blind
    study.toml      the study, from which `sinsjax score` makes the truth again
    README.txt      units, signs, the order of Euler angles, and the columns to return
    export.json     the options, and size and SHA-256 of every file; written last

An export without export.json is unfinished, and made again.
"""

import hashlib
import io
import os
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet as pq
from numpy.typing import NDArray

from sinsjax.arena import given
from sinsjax.arena.frames import BODY_AXES, FRAMES, to_angles, to_quaternion
from sinsjax.arena.readme import RECORDS, describe_export
from sinsjax.arena.runs import ProgramRuns, check_simulated
from sinsjax.arena.simulated_record import simulated_records
from sinsjax.errors import InputError
from sinsjax.execution import sealed
from sinsjax.execution.directory import STUDY, check_directory, lock_directory, results_path
from sinsjax.execution.progress import ProgressCallback, RunProgress
from sinsjax.platform import runtime
from sinsjax.platform.files import atomic_write, make_folder, read_regular_file
from sinsjax.records import write_record
from sinsjax.records.layout import RecordLayout
from sinsjax.study.identity import fingerprint, with_draws
from sinsjax.study.load import load_study, study_to_toml
from sinsjax.study.study import Study
from sinsjax.types import Quat
from sinsjax.units import DEG

INITIAL, TRUTH, README, MANIFEST = "initial.csv", "truth.parquet", "README.txt", "export.json"
SCORES = "scores"
"""Folder of the results that were scored."""

FORMATS = {"psins": ".txt", "csv": ".csv", "parquet": ".parquet"}
"""Formats of records, and the suffixes of their files."""

_CHOICES = {"format": FORMATS, "quantity": ("increments", "rates"), "frame": FRAMES}
_QUATERNION = ("q_w", "q_x", "q_y", "q_z")
_STARTS = ("yaw_deg", "pitch_deg", "roll_deg", *_QUATERNION, "v_east_m_per_s", "v_north_m_per_s")
"""Columns of the first solution, which runs without a start lack."""

_SCHEMA = 1


class Form(NamedTuple):
    """The form of an export.

    Attributes:
        format: "psins" (increments, blanks between columns, no names), "csv" or "parquet".
        quantity: "increments" (rad, m/s) or "rates" (rad/s, m/s^2, mean over each sample).
        frame: axes and signs, see `arena.frames`.
        blind: whether the truth is left out.
    """

    format: str = "csv"
    quantity: str = "increments"
    frame: str = "enu"
    blind: bool = False


def export_study(  # noqa: PLR0913
    study: Study | str | Path,
    directory: str | Path,
    *,
    draws: tuple[int, int] | None = None,
    format: str = "csv",
    quantity: str = "increments",
    frame: str = "enu",
    blind: bool = False,
    overwrite: bool = False,
    on_progress: ProgressCallback | None = None,
) -> Path:
    """Write the draws of a simulated study for a program outside sinsjax.

    Args:
        study: study, its file, or the name of a shipped study.
        directory: directory of the export.
        draws: first draw and the one after the last, -1 for the study's last; None for all.
        format: "csv", "parquet", or "psins": text of increments ``wx wy wz vx vy vz t``.
        quantity: "increments" (rad, m/s), or "rates" (rad/s, m/s^2) as means over each sample.
        frame: "enu" (right-front-up, yaw counter-clockwise) or "ned" (front-right-down, clockwise).
        blind: whether to leave out the truth.
        overwrite: whether to replace an export.
        on_progress: called with the number of written records.

    Returns:
        The directory.

    Raises:
        InputError: the study has no draws to export, an option is wrong, or the directory cannot be
            used.

    Examples:
        >>> study = sinsjax.load_study("paper1_resets", {"study.draws": 2, "study.rate_hz": 10.0})
        >>> exported = sinsjax.export_study(study, "draws")
        >>> sorted(path.name for path in exported.iterdir() if path.suffix)
        ['README.txt', 'export.json', 'initial.csv', 'study.toml', 'truth.parquet']
    """
    runtime.ensure_configured()
    study, form = load_study(study), Form(format, quantity, frame, blind)
    check_simulated(study)
    for option, choices in _CHOICES.items():
        if (value := getattr(form, option)) not in choices:
            raise InputError(f"{option}: {value!r} is not one of {', '.join(choices)}")
    if format == "psins" and (quantity, frame) != ("increments", "enu"):
        raise InputError("format: psins has increments of right-front-up axes only (give csv)")
    first, end = draws or (0, -1)
    end = study.n_draws if end < 0 else end
    if not 0 <= first < end <= study.n_draws:
        text = f"must be A:B with 0 <= A < B <= {study.n_draws}, the draws of {study.name}"
        raise InputError(f"draws: {first}:{end}: {text}")
    out = results_path(directory)
    _check_target(out, overwrite=overwrite)
    if study.drawn is None or study.drawn.sampling == "random":  # else fewer draws are others
        study = with_draws(study, end)
    runs = ProgramRuns(study, range(first, end))
    contents = {
        STUDY: study_to_toml(study).encode(),
        README: describe_export(study.name, fingerprint(study), **form._asdict()).encode(),
        INITIAL: _csv_bytes(pa.table(initial_rows(runs, form))),
        **({} if blind else {TRUTH: _truth_parquet(runs, form)}),
    }
    lock = lock_directory(out)
    try:
        _remove_export(out)
        make_folder(out / RECORDS)
        for name, content in contents.items():
            _write_file(out / name, content)
        names = _write_records(runs, form, out, on_progress)
        manifest = {
            "schema": _SCHEMA,
            "sinsjax": runtime.package_version(),
            "study": study.name,
            "digest": fingerprint(study),
            **form._asdict(),
            "draws": [first, end],
            "state": "complete",
            "files": {name: _file_entry(out / name) for name in (*contents, *names)},
        }
        _write_file(out / MANIFEST, sealed.to_sealed_json(manifest))
    finally:
        lock.release()
    return out


def _write_file(path: Path, content: bytes) -> None:
    with atomic_write(path) as file:
        file.write(content)


def record_name(runs: ProgramRuns, form: Form, environment: int, draw: int) -> str:
    """Return the path of a record in the directory."""
    number = f"set_{environment:03d}_" if runs.environments.any() else ""
    return f"{RECORDS}/{number}draw_{draw:05d}{FORMATS[form.format]}"


def _write_records(
    runs: ProgramRuns, form: Form, directory: Path, on_progress: ProgressCallback | None
) -> list[str]:
    """Write the records; return their paths in the directory."""
    layout, study, names = record_layout(form), runs.study, list[str]()
    n_environments = int(runs.environments.max()) + 1
    for number in range(n_environments):
        records = simulated_records(runs.batch(runs.part_of(number)), study.rate_hz, study.name)
        for draw, record in zip(runs.draws, records, strict=True):
            names.append(record_name(runs, form, number, draw))
            delimiter = " " if form.format == "psins" else ","
            write_record(record, directory / names[-1], layout, delimiter=delimiter)
            if on_progress is not None:
                total = n_environments * len(runs.draws)
                on_progress(RunProgress(len(names), total, None, 0, "records"))
    return names


def record_layout(form: Form) -> RecordLayout:
    """Return the layout of an export's records, with which sinsjax reads them."""
    if form.format == "psins":
        names = ("wx", "wy", "wz", "vx", "vy", "vz", "t")
        return RecordLayout(
            "csv", names, time_column="t", gyro_columns=names[:3], accel_columns=names[3:6]
        )
    rates = form.quantity == "rates"
    gyro_unit, accel_unit = ("rad_per_s", "m_per_s2") if rates else ("rad", "m_per_s")
    return RecordLayout(
        form.format,
        time_column="time_s",
        gyro_columns=tuple(f"gyro_{axis}_{gyro_unit}" for axis in "xyz"),
        accel_columns=tuple(f"accel_{axis}_{accel_unit}" for axis in "xyz"),
        gyro_unit=gyro_unit,
        accel_unit=accel_unit,
        axes_order=BODY_AXES[form.frame],
    )


def read_export(directory: Path) -> tuple[Study, dict[str, Any]]:
    """Return the study and the manifest of an export.

    Raises:
        InputError: it is no complete export, or one of its files has changed.
    """
    check_directory(directory)
    again = "(`sinsjax export` writes one, with --overwrite in place of this)"
    try:
        manifest = sealed.read_sealed_json(directory / MANIFEST)
    except FileNotFoundError:
        raise InputError(f"{directory}: contains no export, or an unfinished one {again}") from None
    if manifest.get("schema") != _SCHEMA or manifest.get("state") != "complete":
        raise InputError(f"{directory}: is unfinished or of another version {again}")
    for name, entry in manifest["files"].items():
        found = _file_entry(directory / name) if name != README else entry
        if found != entry and (found or name in (STUDY, INITIAL)):  # records may be deleted
            raise InputError(f"{directory / name}: has changed since it was exported {again}")
    study = load_study(directory / STUDY)
    if fingerprint(study) != manifest["digest"]:
        text = "the attitude_file of its study has changed since (export the study again)"
        raise InputError(f"{directory}: {text}")
    return study, manifest


def initial_rows(runs: ProgramRuns, form: Form) -> dict[str, NDArray]:
    """Return the columns of the initial solutions by name, one row per run, by run_id."""
    starts: dict[str, NDArray] = {}
    for part in runs.parts:
        for name, column in given.find_starts(runs.batch(part)).items():
            whole = starts.setdefault(name, np.empty(len(runs.run_id)))
            whole[runs.places(part, runs.draws)] = column
    attitude = Quat(*(starts[f"q_{axis}"] for axis in "wxyz"))
    pitch, roll, yaw = to_angles(attitude, form.frame).T / DEG
    starts |= {"yaw_deg": yaw, "pitch_deg": pitch, "roll_deg": roll}
    starts |= dict(zip(_QUATERNION, to_quaternion(attitude, form.frame).T, strict=True))
    known = np.tile(runs.has_start, len(runs.draws))
    draw, variant = np.divmod(runs.run_id, runs.source.n_variants)
    environment = np.tile(runs.environments, len(runs.draws)).tolist()
    names = zip(environment, draw.tolist(), strict=True)
    return {
        "run_id": runs.run_id,
        "draw_id": draw,
        "variant_id": variant,
        **{name: np.where(known, starts[name] + 0.0, np.nan) for name in _STARTS},  # no -0
        "latitude_deg": starts["latitude"] / DEG,
        "height_m": starts["height_m"],
        "gravity_m_per_s2": starts["gravity_m_per_s2"],
        "rate_hz": np.full(len(draw), float(runs.source.rate_hz)),
        "start_s": np.zeros(len(draw)),
        "end_s": np.full(len(draw), runs.end_s),
        "file": np.array([record_name(runs, form, *name) for name in names]),
        "study": np.full(len(draw), fingerprint(runs.source)),
    }


def _csv_bytes(table: pa.Table) -> bytes:
    sink = io.BytesIO()
    sink.write((",".join(table.column_names) + "\n").encode())
    options = pa.csv.WriteOptions(include_header=False, quoting_style="none")
    pa.csv.write_csv(table, sink, options)
    return sink.getvalue()


def _truth_parquet(runs: ProgramRuns, form: Form) -> bytes:
    """Return the true attitudes at record times, one row per record and time."""
    sink, tables = pa.BufferOutputStream(), []
    for number in range(runs.environments.max() + 1):
        part = runs.part_of(number)
        truth = given.true_attitudes_at_records(runs.batch(part))
        time_s = runs.study.update_times(runs.study.lengths.to_list()[part.ids[0]])
        names = [record_name(runs, form, number, draw) for draw in runs.draws]
        pitch, roll, yaw = to_angles(Quat(*(a.T.ravel() for a in truth)), form.frame).T / DEG
        columns = {
            "file": np.repeat(names, len(time_s)),
            "draw_id": np.repeat(runs.draws, len(time_s)),
            "time_s": np.tile(time_s, len(names)),
        }
        angles = {"yaw_deg": yaw, "pitch_deg": pitch, "roll_deg": roll}
        tables.append(pa.table(columns | angles))
    pq.write_table(pa.concat_tables(tables), sink, compression="zstd")
    return sink.getvalue().to_pybytes()


def _check_target(directory: Path, *, overwrite: bool) -> None:
    """Refuse a directory with an export that may not be replaced, or with other files.

    Raises:
        InputError: names what it contains.
    """
    check_directory(directory)
    names = os.listdir(directory) if directory.exists() else []
    names = sorted(name for name in names if not name.startswith("."))
    ours = {STUDY, README, INITIAL, TRUTH, MANIFEST, RECORDS, SCORES}
    if MANIFEST not in names and not ours.issuperset(names):
        text = f"contains {', '.join(names[:3])}, no export (give another directory)"
        raise InputError(f"{directory}: {text}")
    if names and not overwrite:
        text = "already contains an export (give --overwrite to replace it)"
        raise InputError(f"{directory}: {text}")


def _remove_export(directory: Path) -> None:
    """Remove the files of an export, and no others."""
    records = directory.glob(f"{RECORDS}/*draw_[0-9][0-9][0-9][0-9][0-9].*")
    for path in (*records, *(directory / n for n in (STUDY, README, INITIAL, TRUTH, MANIFEST))):
        path.unlink(missing_ok=True)


def _file_entry(path: Path) -> dict[str, Any] | None:
    """Return size and SHA-256 of a file; None if it is missing."""
    try:
        content = read_regular_file(path)
    except FileNotFoundError:
        return None
    return {"bytes": len(content), "sha256": hashlib.sha256(content).hexdigest()}
