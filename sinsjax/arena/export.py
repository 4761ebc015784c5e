"""Writing the draws of a study for programs outside sinsjax: a record per draw, and the starts.

An export has `initial.csv`, one row per run; the records in `imu/`, one per draw and environment;
`truth.parquet`; `study.toml`, from which `sinsjax score` makes the truth again; `README.txt`; and
`export.json`, written last, with the SHA-256 of every file.
"""

import hashlib
import io
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet as pq
from numpy.typing import NDArray

from sinsjax.arena import given
from sinsjax.arena.frames import FRAMES, to_angles, to_body_axes, to_quaternion
from sinsjax.arena.runs import ProgramRuns, check_simulated
from sinsjax.arena.simulated_record import simulated_records
from sinsjax.errors import InputError
from sinsjax.execution.directory import STUDY, check_directory, read_sealed_json, to_sealed_json
from sinsjax.execution.progress import ProgressCallback, RunProgress
from sinsjax.platform import runtime
from sinsjax.platform.files import make_folder, read_regular_file, write_file
from sinsjax.records import Record
from sinsjax.study.load import fingerprint, load_study, study_to_toml
from sinsjax.study.study import Study
from sinsjax.types import Quat
from sinsjax.units import DEG

RECORDS, INITIAL, TRUTH, README = "imu", "initial.csv", "truth.parquet", "README.txt"
MANIFEST = "export.json"

FORMATS = {"psins": ".txt", "csv": ".csv", "parquet": ".parquet"}
"""Formats of records, and the suffixes of their files."""

_INCREMENTS = (
    *("gyro_x_rad", "gyro_y_rad", "gyro_z_rad"),
    *("accel_x_m_per_s", "accel_y_m_per_s", "accel_z_m_per_s"),
)
_QUATERNION = ("q_w", "q_x", "q_y", "q_z")
_SCHEMA = 1

_README = """\
sinsjax export of the study {study!r}: format {format}, frame {frame} (docs/arena.md of sinsjax)

initial.csv    one row per run to align: run_id (with gaps; do not renumber), draw_id, variant_id;
               the first attitude, misaligned on purpose (nan: find it without one), and velocity;
               latitude, height, gravity; rate; end of the run, s; its record; digest of the study
imu/           records: increments of gyros, rad, and of accelerometers, m/s, per sample (times
               rate_hz: mean rates); time at the end of each sample, s. No coning or sculling is
               corrected. Format psins: wx wy wz vx vy vz t, without names
truth.parquet  true attitude at record times; keep it from your program
study.toml     Earth, motion, and noise and biases of the sensors, for Q and P0

frame enu      body x right, y front, z up (at rest z reads +g) to east, north, up; yaw
               counter-clockwise from north, C_b^n = Rz(yaw) Rx(pitch) Ry(roll)
frame ned      body x front, y right, z down (at rest z reads -g) to north, east, down; yaw
               clockwise from north, C_b^n = Rz(yaw) Ry(pitch) Rx(roll)
angles         deg; pitch is positive with the front up, roll with the right side down
q_w q_x q_y q_z  from body to navigation frame, scalar first

Return one CSV or Parquet file, in the frame of the export, with a row for each run at `end_s` (to
half a sample) or a history. Columns: study and run_id, of initial.csv; time_s; yaw_deg, pitch_deg,
roll_deg, or q_w, q_x, q_y, q_z; and if you like sigma_yaw_deg, sigma_pitch_deg, sigma_roll_deg. A
run without a row at its end is a failure. Then: sinsjax score DIR results.csv --name my_filter
"""


def export_study(
    study: Study | str | Path,
    directory: str | Path,
    *,
    format: str = "csv",
    frame: str = "enu",
    on_progress: ProgressCallback | None = None,
) -> Path:
    """Write the draws of a simulated study for a program outside sinsjax.

    Args:
        study: study, its file, or the name of a shipped study.
        directory: directory of the export, new or empty.
        format: "csv", "parquet", or "psins": text without names, ``wx wy wz vx vy vz t``.
        frame: "enu" (right-front-up, yaw counter-clockwise) or "ned" (front-right-down, clockwise).
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
    study = load_study(study)
    check_simulated(study)
    for option, value, choices in (("format", format, FORMATS), ("frame", frame, FRAMES)):
        if value not in choices:
            raise InputError(f"{option}: {value!r} is not one of {', '.join(choices)}")
    runs = ProgramRuns(study.model_copy(update={"stop_when": None, "tune": None}))
    out = Path(directory)
    check_directory(out)
    if out.exists() and any(out.iterdir()):
        raise InputError(f"{out}: is not empty (give another directory, or delete it)")
    make_folder(out / RECORDS)
    digests: dict[str, str] = {}

    def write(name: str, content: bytes) -> None:
        write_file(out / name, content)
        digests[name] = hashlib.sha256(content).hexdigest()

    write(STUDY, study_to_toml(runs.source).encode())
    write(README, _README.format(study=study.name, format=format, frame=frame).encode())
    starts, places = np.empty((6, *runs.run_id.shape)), np.empty((3, *runs.run_id.shape))
    truths: dict[int, pa.Table] = {}
    for batch, condition in runs.batches():
        found = given.find_starts(batch)
        columns = jax.tree.leaves(found[:-1])
        starts[:, :, condition] = np.reshape(columns, (len(starts), study.n_draws, -1))
        environment = int(runs.environments[condition[0]])
        if environment in truths:
            continue
        names = [record_name(runs, format, environment, draw) for draw in range(study.n_draws)]
        truths[environment] = _truth_table(found.truth, names, frame, study)
        records = simulated_records(batch, study.rate_hz, study.name)
        for draw, (name, record) in enumerate(zip(names, records, strict=True)):
            write(name, _record_content(record, format, frame))
            place = record.latitude_deg, record.height_m, record.gravity_m_per_s2
            places[:, draw, runs.environments == environment] = np.array(place, float)[:, None]
            if on_progress is not None:
                total = study.n_draws * (int(runs.environments.max()) + 1)
                on_progress(RunProgress(len(digests) - 2, total, None, 0, "records"))
    initial = initial_table(runs, [*starts, *places], format, frame)
    write(INITIAL, _to_csv(initial))
    truth = pa.concat_tables([truths[number] for number in sorted(truths)])
    write(TRUTH, _to_parquet(truth))
    manifest = {
        "schema": _SCHEMA,
        "sinsjax": runtime.package_version(),
        "study": study.name,
        "digest": fingerprint(runs.source),
        "draws": [0, study.n_draws],
        "format": format,
        "frame": frame,
        "files": {name: {"sha256": digest} for name, digest in digests.items()},
    }
    write_file(out / MANIFEST, to_sealed_json(manifest))
    return out


def read_export(directory: Path) -> tuple[Study, str]:
    """Return the study and the frame of an export.

    Raises:
        InputError: it is no complete export, or one of its files has changed.
    """
    check_directory(directory)
    again = "(`sinsjax export` writes one to another directory)"
    try:
        manifest = read_sealed_json(directory / MANIFEST)
    except FileNotFoundError:
        raise InputError(f"{directory}: contains no export, or an unfinished one {again}") from None
    if manifest.get("schema") != _SCHEMA:
        raise InputError(f"{directory}: is an export of another version {again}")
    for name, entry in manifest["files"].items():
        found = _digest(directory / name)
        is_missed = found is not None or name in (STUDY, INITIAL)  # others may be deleted
        if found != entry["sha256"] and name != README and is_missed:
            raise InputError(f"{directory / name}: has changed since it was exported {again}")
    study = load_study(directory / STUDY)
    if fingerprint(study) != manifest["digest"] or manifest["draws"] != [0, study.n_draws]:
        text = "has some draws alone, or the attitude_file of its study has changed since"
        raise InputError(f"{directory}: {text} {again}")
    return study, manifest["frame"]


def record_name(runs: ProgramRuns, format: str, environment: int, draw: int) -> str:
    """Return the path of a record in the directory."""
    number = f"set_{environment:03d}_" if runs.environments.any() else ""
    return f"{RECORDS}/{number}draw_{draw:05d}{FORMATS[format]}"


def initial_table(runs: ProgramRuns, starts: list[NDArray], format: str, frame: str) -> pa.Table:
    """Return the initial solutions, one row per run, by run_id.

    Starts are quaternion and velocity, m/s, then latitude, deg, height and gravity, each of shape
    (draws, conditions).
    """
    *quaternion, east, north, latitude_deg, height, gravity = (part.ravel() for part in starts)
    attitude = Quat(*quaternion)
    pitch, roll, yaw = to_angles(attitude, frame).T / DEG
    first = {"yaw_deg": yaw, "pitch_deg": pitch, "roll_deg": roll}
    first |= dict(zip(_QUATERNION, to_quaternion(attitude, frame).T, strict=True))
    first |= {"v_east_m_per_s": east, "v_north_m_per_s": north}
    n_draws, source = len(runs.run_id), runs.source
    draw, variant = np.divmod(runs.run_id.ravel(), source.n_variants)
    known = np.tile(runs.has_start, n_draws)
    environments = np.tile(runs.environments, n_draws).tolist()
    places = zip(environments, draw.tolist(), strict=True)
    return pa.table(
        {
            "run_id": runs.run_id.ravel(),
            "draw_id": draw,
            "variant_id": variant,
            **{name: np.where(known, v + 0.0, np.nan) for name, v in first.items()},  # no -0
            "latitude_deg": latitude_deg,
            "height_m": height,
            "gravity_m_per_s2": gravity,
            "rate_hz": np.full(len(draw), float(source.rate_hz)),
            "start_s": np.zeros(len(draw)),
            "end_s": np.full(len(draw), runs.end_s),
            "file": [record_name(runs, format, *place) for place in places],
            "study": [fingerprint(source)] * len(draw),
        }
    )


def _record_content(record: Record, format: str, frame: str) -> bytes:
    """Return a file with the increments of a record."""
    increments = [to_body_axes(values, frame) for values in (record.dtheta, record.dv)]
    columns = dict(zip(_INCREMENTS, np.hstack(increments).T, strict=True))
    time = {"time_s": np.arange(1, len(record.dv) + 1) / record.rate_hz}
    if format == "psins":
        return _to_csv(pa.table(columns | time), delimiter=" ", names=False)
    table = pa.table(time | columns)
    return _to_parquet(table) if format == "parquet" else _to_csv(table)


def _truth_table(truth: Quat, names: list[str], frame: str, study: Study) -> pa.Table:
    """Return the true attitudes at record times, one row per record and time."""
    angles = to_angles(Quat(*(part.T.ravel() for part in truth)), frame).T / DEG
    time_s = study.update_times(next(iter(study.distinct_spans)))
    columns: dict[str, Any] = {
        "file": np.repeat(names, len(time_s)),
        "draw_id": np.repeat(np.arange(len(names)), len(time_s)),
        "time_s": np.tile(time_s, len(names)),
    }
    return pa.table(columns | dict(zip(("pitch_deg", "roll_deg", "yaw_deg"), angles, strict=True)))


def _to_csv(table: pa.Table, delimiter: str = ",", *, names: bool = True) -> bytes:
    sink = io.BytesIO()
    if names:
        sink.write((delimiter.join(table.column_names) + "\n").encode())
    options = pa.csv.WriteOptions(include_header=False, delimiter=delimiter, quoting_style="none")
    pa.csv.write_csv(table, sink, options)
    return sink.getvalue()


def _to_parquet(table: pa.Table) -> bytes:
    sink = pa.BufferOutputStream()
    pq.write_table(table, sink, compression="zstd")
    return sink.getvalue().to_pybytes()


def _digest(path: Path) -> str | None:
    """Return the SHA-256 of a file; None if it is missing."""
    try:
        return hashlib.sha256(read_regular_file(path)).hexdigest()
    except FileNotFoundError:
        return None
