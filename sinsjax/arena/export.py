"""Writing the draws of a study for programs outside sinsjax: a record per draw, and the starts.

An export has `initial.csv`, one row per run; the records in `imu/`, one per draw and environment;
`study.toml`; `README.txt`; and `export.json`, written last, with the SHA-256 of every file.
"""

import hashlib
import io
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet as pq
from numpy.typing import NDArray

from sinsjax.arena.runs import ProgramRuns, find_starts
from sinsjax.engine.batch import Batch
from sinsjax.engine.inputs import Draw, Environment, ProgramSpec, derive_inputs, true_increments
from sinsjax.engine.samples import TileSensors
from sinsjax.engine.scenario import Scenario, StudySource
from sinsjax.errors import InputError
from sinsjax.execution.directory import STUDY, read_sealed_json, refuse_links, to_sealed_json
from sinsjax.execution.progress import ProgressCallback, RunProgress
from sinsjax.maths.rotations import from_euler, to_euler
from sinsjax.methods.method import Site
from sinsjax.platform import runtime
from sinsjax.platform.files import make_folder, read_regular_file, write_file
from sinsjax.records import Record
from sinsjax.study.load import fingerprint, load_study, study_to_toml
from sinsjax.study.study import Study
from sinsjax.types import Array, Quat
from sinsjax.units import DEG

FRAMES = ("enu", "ned")  # see `_README`; of angles, only the sign of yaw differs
RECORDS, INITIAL, README, MANIFEST = "imu", "initial.csv", "README.txt", "export.json"
FORMATS = {"psins": ".txt", "csv": ".csv", "parquet": ".parquet"}  # suffixes of records
_INCREMENTS = [f"gyro_{a}_rad" for a in "xyz"] + [f"accel_{a}_m_per_s" for a in "xyz"]
_SCHEMA = 1

_README = """\
sinsjax export of the study {study!r}: format {format}, frame {frame} (docs/arena.md of sinsjax)

initial.csv    one row per run to align: run_id (with gaps; do not renumber), draw_id, variant_id;
               the first attitude, misaligned on purpose (nan: find it without one), and velocity;
               latitude, height, gravity; rate; end of the run, s; its record; digest of the study
imu/           records: increments of gyros, rad, and of accelerometers, m/s, per sample (times
               rate_hz: mean rates); time at the end of each sample, s. No coning or sculling is
               corrected. Format psins: wx wy wz vx vy vz t, without names
study.toml     Earth, motion, and noise and biases of the sensors, for Q and P0

frame enu      body x right, y front, z up (at rest z reads +g) to east, north, up; yaw
               counter-clockwise from north, C_b^n = Rz(yaw) Rx(pitch) Ry(roll)
frame ned      body x front, y right, z down (at rest z reads -g) to north, east, down; yaw
               clockwise from north, C_b^n = Rz(yaw) Ry(pitch) Rx(roll)
angles         deg; pitch is positive with the front up, roll with the right side down
q_w q_x q_y q_z  from body to navigation frame, scalar first

Return one CSV or Parquet file, in the frame of the export, with a row for each run at `end_s` (to
half a sample) or a history. Columns: study and run_id, of initial.csv; time_s; yaw_deg, pitch_deg,
roll_deg, or q_w, q_x, q_y, q_z; and if you like sigma_yaw_deg. A run without a row at its end is a
failure. Then: sinsjax score DIR results.csv --name my_filter
"""


def export_study(
    study: StudySource,
    directory: str | Path,
    *,
    format: str = "csv",
    frame: str = "enu",
    on_progress: ProgressCallback | None = None,
) -> Path:
    """Write the draws of a simulated study for a program outside sinsjax; return the directory.

    Args:
        study: study, its file, or the name of a shipped study.
        directory: directory of the export, new or empty.
        format: "csv", "parquet", or "psins": text without names, ``wx wy wz vx vy vz t``.
        frame: "enu" (right-front-up, yaw counter-clockwise) or "ned" (front-right-down, clockwise).
        on_progress: called with the number of written records.

    Raises:
        InputError: the study has no draws to export, an option is wrong, or the directory cannot be
            used.

    Examples:
        >>> study = sinsjax.load_study("paper1_resets", {"study.draws": 2, "study.rate_hz": 10.0})
        >>> exported = sinsjax.export_study(study, "draws")
        >>> sorted(path.name for path in exported.iterdir() if path.suffix)
        ['README.txt', 'export.json', 'initial.csv', 'study.toml']
    """
    runtime.ensure_configured()
    for option, value, choices in (("format", format, FORMATS), ("frame", frame, FRAMES)):
        if value not in choices:
            raise InputError(f"{option}: {value!r} is not one of {', '.join(choices)}")
    study = load_study(study)
    runs = ProgramRuns(study.model_copy(update={"stop_when": None, "tune": None}))
    out = Path(directory)
    digests: dict[str, str] = {}
    refuse_links(out)
    if out.exists() and any(out.iterdir()):
        raise InputError(f"{out}: is not empty (give another directory, or delete it)")
    make_folder(out / RECORDS)

    def write(name: str, content: bytes) -> None:
        write_file(out / name, content)
        digests[name] = hashlib.sha256(content).hexdigest()

    write(STUDY, study_to_toml(runs.source).encode())
    write(README, _README.format(study=study.name, format=format, frame=frame).encode())
    starts = np.empty((9, *runs.run_id.shape))
    names: dict[int, list[str]] = {}
    for batch, condition in runs.batches_and_variant_conditions():
        starts[:6, :, condition] = np.reshape(find_starts(batch), (6, study.n_draws, -1))
        number = int(runs.environments[condition[0]])
        if number in names:
            continue
        folder = f"{RECORDS}/set_{number:03d}_" if runs.environments.any() else f"{RECORDS}/"
        draws = range(study.n_draws)
        names[number] = [f"{folder}draw_{draw:05d}{FORMATS[format]}" for draw in draws]
        records = simulated_records(batch, study.rate_hz, study.name)
        for draw, (name, record) in enumerate(zip(names[number], records, strict=True)):
            write(name, _record_content(record, format, frame))
            place = record.latitude_deg, record.height_m, record.gravity_m_per_s2
            starts[6:, draw, runs.environments == number] = np.array(place, float)[:, None]
            if on_progress is not None:
                total = study.n_draws * (int(runs.environments.max()) + 1)
                on_progress(RunProgress(len(digests) - 2, total, None, 0, "records"))
    files = np.stack([names[number] for number in runs.environments], axis=1)
    write(INITIAL, _to_csv(_initial_table(runs, starts, files, frame)))
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


def read_export_study_and_frame(directory: Path) -> tuple[Study, str]:
    """Return the study and the frame of a complete export whose files have not changed."""
    refuse_links(directory)
    again = "(`sinsjax export` writes one to another directory)"
    try:
        manifest = read_sealed_json(directory / MANIFEST)
    except FileNotFoundError:
        raise InputError(f"{directory}: contains no export, or an unfinished one {again}") from None
    if manifest.get("schema") != _SCHEMA:
        raise InputError(f"{directory}: is an export of another version {again}")
    for name, entry in manifest["files"].items():
        try:
            digest = hashlib.sha256(read_regular_file(directory / name)).hexdigest()
        except FileNotFoundError:  # others may be deleted
            digest = "" if name in (STUDY, INITIAL) else entry["sha256"]
        if digest != entry["sha256"] and name != README:
            raise InputError(f"{directory / name}: has changed since it was exported {again}")
    study = load_study(directory / STUDY)
    if fingerprint(study) != manifest["digest"] or manifest["draws"] != [0, study.n_draws]:
        text = "has some draws alone, or the attitude_file of its study has changed since"
        raise InputError(f"{directory}: {text} {again}")
    return study, manifest["frame"]


def _initial_table(runs: ProgramRuns, starts: NDArray, files: NDArray, frame: str) -> pa.Table:
    """Return one row per run of attitude, velocity, latitude, deg, height and gravity, (9, ...)."""
    *quaternion, east, north, latitude_deg, height, gravity = starts.reshape(9, -1)
    attitude, run_id, source = Quat(*quaternion), runs.run_id.ravel(), runs.source
    pitch, roll, yaw = to_angles(attitude, frame).T / DEG
    first = {"yaw_deg": yaw, "pitch_deg": pitch, "roll_deg": roll}
    first |= dict(zip(("q_w", "q_x", "q_y", "q_z"), to_quaternion(attitude, frame).T, strict=True))
    first |= {"v_east_m_per_s": east, "v_north_m_per_s": north}
    known = np.tile(runs.has_start, source.n_draws)
    columns = {
        "run_id": run_id,
        "draw_id": run_id // source.n_variants,
        "variant_id": run_id % source.n_variants,
        **{name: np.where(known, v + 0.0, np.nan) for name, v in first.items()},  # no -0
        "latitude_deg": latitude_deg,
        "height_m": height,
        "gravity_m_per_s2": gravity,
        "rate_hz": np.full(len(run_id), float(source.rate_hz)),
        "start_s": np.zeros(len(run_id)),
        "end_s": np.full(len(run_id), runs.end_s),
        "file": files.ravel(),
        "study": [fingerprint(source)] * len(run_id),
    }
    return pa.table(columns)


def _record_content(record: Record, format: str, frame: str) -> bytes:
    """Return a file with the increments of a record."""
    increments = [to_body_axes(values, frame) for values in (record.dtheta, record.dv)]
    columns = dict(zip(_INCREMENTS, np.hstack(increments).T, strict=True))
    time = {"time_s": np.arange(1, len(record.dv) + 1) / record.rate_hz}
    if format == "psins":
        return _to_csv(pa.table(columns | time), " ", names=False)
    if format == "csv":
        return _to_csv(pa.table(time | columns))
    sink = pa.BufferOutputStream()
    pq.write_table(pa.table(time | columns), sink, compression="zstd")
    return sink.getvalue().to_pybytes()


def _to_csv(table: pa.Table, delimiter: str = ",", *, names: bool = True) -> bytes:
    sink = io.BytesIO()
    if names:
        sink.write((delimiter.join(table.column_names) + "\n").encode())
    options = pa.csv.WriteOptions(include_header=False, delimiter=delimiter, quoting_style="none")
    pa.csv.write_csv(table, sink, options)
    return sink.getvalue()


def simulated_record(study: StudySource, draw_id: int = 0, variant_id: int = 0) -> Record:
    """Return the output of a simulated study's sensors as a record that can be written to a file.

    Args:
        study: simulated study, its file, or the name of a shipped study.
        draw_id: draw of the noise.
        variant_id: variant of Earth, motion and sensors, if these are swept.

    Raises:
        InputError: the study has no such variant or draw, or reads a record itself.

    Examples:
        >>> record = sinsjax.simulated_record("paper1_resets")
        >>> record.rate_hz, record.dtheta.shape  # rad per sample
        (100.0, (90000, 3))
    """
    scenario = Scenario(study, curves=False)
    if draw_id < 0:
        raise InputError(f"{scenario.study.name}: has no draw {draw_id}")
    number, _ = scenario.find(variant_id)
    batch = scenario.batch(number, range(draw_id, draw_id + 1))
    return next(simulated_records(batch, scenario.study.rate_hz, scenario.study.name))


def simulated_records(batch: Batch, rate_hz: float, source: str) -> Iterator[Record]:
    """Yield the record of each draw of a simulation, of a rate in Hz; one program serves all."""
    spec, environment = batch.spec, batch.environment
    samples = min(spec.intervals, int(environment.pass_intervals)) * spec.interval_samples
    if environment.increments is None and environment.motion is not None:
        motion, place = environment.motion, environment.site.place
        rows = true_increments(motion, place, rate_hz, samples, with_axes=True)
        environment = environment._replace(increments=rows[:, :6], axes=rows[:, 6:])
    for number in range(batch.n_draws):
        draws = batch.select_draws(np.array([number])).draws
        rows, site = jax.tree.map(np.array, _measure_single_draw(spec, samples, environment, draws))
        yield Record(
            dtheta=rows[:, :3],
            dv=rows[:, 3:],
            rate_hz=rate_hz,
            latitude_deg=float(site.latitude / DEG),
            height_m=float(site.earth.height),
            gravity_m_per_s2=float(site.place.gravity),
            source=source,
        )


@partial(jax.jit, static_argnums=(0, 1))
def _measure_single_draw(
    spec: ProgramSpec, samples: int, environment: Environment, draws: Draw
) -> tuple[Array, Site]:
    """Return the measured increments (samples, 6) of a single draw, and its site."""
    draws = derive_inputs(spec, environment, draws)
    tile, all_ = TileSensors(spec, environment, draws), jnp.arange(samples)
    now, _ = tile.make_block_sampler(all_)(tile.start(), all_)
    site = environment.site
    if draws.site is not None:
        site = jax.tree.map(lambda a: a[0], draws.site)
    return jnp.stack([axis[:, 0] for axis in jax.tree.leaves(now)], axis=1), site


_to_euler = jax.jit(jax.vmap(to_euler))
_from_euler = jax.jit(jax.vmap(from_euler))


def to_body_axes(vectors: NDArray, frame: str) -> NDArray:
    """Return vectors in the body axes of a frame, (..., 3), from right, front, up."""
    right, front, up = np.moveaxis(vectors, -1, 0)
    return np.stack([front, right, -up] if frame == "ned" else [right, front, up], axis=-1)


def to_angles(attitude: Quat, frame: str) -> NDArray:
    """Return pitch, roll and yaw in a frame, rad, (runs, 3)."""
    pitch, roll, yaw = (np.asarray(angle) for angle in _to_euler(attitude))
    return np.stack([pitch, roll, -yaw if frame == "ned" else yaw], axis=-1)


def from_angles(angles: NDArray, frame: str) -> Quat:
    """Return attitudes, leaves (runs,), from pitch, roll and yaw in a frame, rad, (runs, 3)."""
    pitch, roll, yaw = np.moveaxis(angles, -1, 0)
    attitude = _from_euler(pitch, roll, -yaw if frame == "ned" else yaw)
    return Quat(*(np.asarray(part) for part in attitude))


def to_quaternion(attitude: Quat, frame: str) -> NDArray:
    """Return quaternions in a frame, (runs, 4)."""
    w, x, y, z = attitude
    return np.stack([w, y, x, -z] if frame == "ned" else [w, x, y, z], axis=-1)


def from_quaternion(quaternion: NDArray, frame: str) -> Quat:
    """Return attitudes, leaves (runs,), from quaternions in a frame, (runs, 4), of any length."""
    unit = quaternion / np.linalg.norm(quaternion, axis=-1, keepdims=True)
    w, x, y, z = np.moveaxis(unit, -1, 0)
    return Quat(w, y, x, -z) if frame == "ned" else Quat(w, x, y, z)
