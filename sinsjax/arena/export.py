"""Writing the draws of a study for programs outside sinsjax: a record per draw, and the starts.

A directory of an export has

    initial.csv     one row per run: record, first attitude, place, start and end
    imu/            one record per draw, per environment if there are several
    truth.parquet   true attitudes at record times, unless the export is blind
    study.toml      the study, from which `sinsjax score` makes the truth again
    README.txt      units, signs, the order of Euler angles, and the columns to return
    export.json     the options, and size and SHA-256 of every file

An export whose export.json does not say "complete" is made again.
"""

import hashlib
import io
import os
import re
import shutil
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import jax
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
from sinsjax.execution.forecast import format_bytes
from sinsjax.messages import format_count
from sinsjax.platform import runtime
from sinsjax.platform.files import atomic_write, make_folder, read_regular_file
from sinsjax.records import write_csv, write_parquet
from sinsjax.records.layout import RecordLayout
from sinsjax.study.identity import fingerprint
from sinsjax.study.load import load_study, study_to_toml
from sinsjax.study.study import Study
from sinsjax.types import Quat
from sinsjax.units import DEG

INITIAL, TRUTH, README, MANIFEST = "initial.csv", "truth.parquet", "README.txt", "export.json"
SCORES = "scores"
"""Folder of the results that were scored."""

FORMATS = ("psins", "csv", "parquet")
QUANTITIES = ("increments", "rates")

_SCHEMA = 1
_SUFFIXES = {"psins": ".txt", "csv": ".csv", "parquet": ".parquet"}
_RECORD = r"(set_\d+_)?draw_\d+\.(txt|csv|parquet)"
_NUMBER_BYTES = {"psins": 22.0, "csv": 22.0, "parquet": 9.7}
"""Bytes of a number in a record."""


class Export(NamedTuple):
    """An export that is ready to be written.

    Attributes:
        runs: of the program.
        draws: the exported draws.
        format: "psins" (increments, blanks between columns, no names), "csv" or "parquet".
        quantity: "increments" (rad, m/s) or "rates" (rad/s, m/s^2, mean over each sample).
        frame: axes and signs, see `arena.frames`.
        blind: whether the truth is left out.
    """

    runs: ProgramRuns
    draws: range
    format: str
    quantity: str
    frame: str
    blind: bool

    @property
    def options(self) -> dict[str, Any]:
        """Options by name, but for the draws."""
        return {name: getattr(self, name) for name in ("format", "quantity", "frame", "blind")}

    @property
    def n_environments(self) -> int:
        """Number of environments."""
        return int(self.runs.environments.max()) + 1

    @property
    def n_records(self) -> int:
        """Number of records."""
        return self.n_environments * len(self.draws)

    @property
    def bytes(self) -> float:
        """Expected size of the records."""
        of_sample = 6 * _NUMBER_BYTES[self.format] + 8
        return self.n_records * self.runs.samples * of_sample

    @property
    def text(self) -> str:
        """Number of runs and records, and their size, in words."""
        count = format_count(len(self.runs.points) * len(self.draws), "run")
        records = format_count(self.n_records, "record")
        return (
            f"{self.runs.source.name}: {count} on {records} of {self.runs.samples:,} samples, about"
            f" {format_bytes(self.bytes)}"
        )

    def record_name(self, environment: int, draw: int) -> str:
        """Return the path of a record in the directory."""
        number = f"set_{environment:03d}_" if self.n_environments > 1 else ""
        return f"{RECORDS}/{number}draw_{draw:05d}{_SUFFIXES[self.format]}"


def export_study(
    study: Study | str | Path,
    directory: str | Path,
    *,
    draws: tuple[int, int] | None = None,
    format: str = "csv",
    quantity: str = "increments",
    frame: str = "enu",
    blind: bool = False,
    overwrite: bool = False,
) -> Path:
    """Write the draws of a simulated study for a program outside sinsjax.

    Args:
        study: study, its file, or the name of a shipped study.
        directory: directory of the export.
        draws: first draw and the one after the last; None for all.
        format: "csv", "parquet", or "psins": text of increments ``wx wy wz vx vy vz t``.
        quantity: "increments" (rad, m/s), or "rates" (rad/s, m/s^2) as means over each sample.
        frame: "enu" (right-front-up, yaw counter-clockwise) or "ned" (front-right-down, clockwise).
        blind: whether to leave out the truth.
        overwrite: whether to replace an export.

    Returns:
        The directory.

    Raises:
        InputError: the study has no draws to export, an option is wrong, the disk is too small, or
            the directory cannot be used.

    Examples:
        >>> study = sinsjax.load_study("paper1_resets", {"study.draws": 2, "study.rate_hz": 10.0})
        >>> exported = sinsjax.export_study(study, "draws")
        >>> sorted(path.name for path in exported.iterdir() if path.suffix)
        ['README.txt', 'export.json', 'initial.csv', 'study.toml', 'truth.parquet']
    """
    out = results_path(directory)
    plan = plan_export(study, draws, format, quantity, frame, blind)
    for _ in write_export(plan, out, overwrite=overwrite):
        pass
    return out


def plan_export(
    study: Study | str | Path,
    draws: tuple[int, int] | None = None,
    format: str = "csv",
    quantity: str = "increments",
    frame: str = "enu",
    blind: bool = False,
) -> Export:
    """Check a study and the options of its export.

    Args:
        study: see `export_study`, as the other arguments.
        draws: the one after the last may be -1 for the study's last.
        format: of the records.
        quantity: of the records.
        frame: of records and attitudes.
        blind: whether to leave out the truth.

    Raises:
        InputError: see `export_study`.
    """
    runtime.ensure_configured()
    study = load_study(study)
    check_simulated(study)
    for name, value, choices in (
        ("format", format, FORMATS),
        ("quantity", quantity, QUANTITIES),
        ("frame", frame, FRAMES),
    ):
        if value not in choices:
            raise InputError(f"{name}: {value!r} is not one of {', '.join(choices)}")
    if format == "psins" and (quantity, frame) != ("increments", "enu"):
        other, value = ("frame", frame) if quantity == "increments" else ("quantity", quantity)
        text = f"the psins format has increments of right-front-up axes (drop --{other}, or csv)"
        raise InputError(f"{other}: {value!r}: {text}")
    first, end = draws or (0, study.n_draws)
    end = study.n_draws if end < 0 else end
    if not 0 <= first < end <= study.n_draws:
        text = f"must be A:B with 0 <= A < B <= {study.n_draws}, the draws of {study.name}"
        raise InputError(f"draws: {first}:{end}: {text}")
    return Export(ProgramRuns(study), range(first, end), format, quantity, frame, blind)


def write_export(plan: Export, directory: Path, *, overwrite: bool = False) -> Iterator[int]:
    """Write a planned export, and yield the number of written records: first 0, once checked.

    An export that is not written to its end is unfinished.

    Raises:
        InputError: see `export_study`.
    """
    check_directory(directory)
    _check_target(directory, overwrite=overwrite)
    folder = next(path for path in (directory, *directory.absolute().parents) if path.exists())
    available = shutil.disk_usage(folder).free
    if plan.bytes > available:
        raise InputError(
            f"{directory}: the records need about {format_bytes(plan.bytes)}, but the disk has only"
            f" {format_bytes(available)} free (--format parquet is smaller, or --draws A:B)"
        )
    yield 0
    lock = lock_directory(directory)
    try:
        _remove_export(directory)
        _write_manifest(plan, directory, "running", {})  # to mark the files of a killed export
        make_folder(directory / RECORDS)
        study, files = plan.runs.source, dict[str, Any]()
        contents = {
            STUDY: study_to_toml(study).encode(),
            README: describe_export(study.name, fingerprint(study), **plan.options).encode(),
            INITIAL: _csv_bytes(pa.table(initial_rows(plan))),
            **({} if plan.blind else {TRUTH: _truth_parquet(plan)}),
        }
        for name, content in contents.items():
            with atomic_write(directory / name) as file:
                file.write(content)
            files[name] = _file_entry(directory / name)
        for name in _write_records(plan, directory):
            files[name] = _file_entry(directory / name)
            yield len(files) - len(contents)
        _write_manifest(plan, directory, "complete", files)
    finally:
        lock.release()


def _write_records(plan: Export, directory: Path) -> Iterator[str]:
    """Write the records, and yield their paths in the directory."""
    layout, study = record_layout(plan), plan.runs.study
    delimiter = " " if plan.format == "psins" else ","
    for number in range(plan.n_environments):
        batch = plan.runs.batch(plan.runs.part_of(number), plan.draws)
        records = simulated_records(batch, study.rate_hz, study.name)
        for draw, record in zip(plan.draws, records, strict=True):
            name = plan.record_name(number, draw)
            if plan.format == "parquet":
                write_parquet(record, directory / name, layout)
            else:
                write_csv(record, directory / name, layout, delimiter=delimiter)
            yield name


def record_layout(plan: Export) -> RecordLayout:
    """Return the layout of an export's records, with which sinsjax reads them."""
    if plan.format == "psins":
        names = ("wx", "wy", "wz", "vx", "vy", "vz", "t")
        return RecordLayout(
            "csv", names, time_column="t", gyro_columns=names[:3], accel_columns=names[3:6]
        )
    rates = plan.quantity == "rates"
    gyro_unit, accel_unit = ("rad_per_s", "m_per_s2") if rates else ("rad", "m_per_s")
    return RecordLayout(
        plan.format,
        time_column="time_s",
        gyro_columns=tuple(f"gyro_{axis}_{gyro_unit}" for axis in "xyz"),
        accel_columns=tuple(f"accel_{axis}_{accel_unit}" for axis in "xyz"),
        gyro_unit=gyro_unit,
        accel_unit=accel_unit,
        axes_order=BODY_AXES[plan.frame],
    )


def read_export(directory: Path) -> tuple[Study, dict[str, Any]]:
    """Return the study and the manifest of an export.

    Raises:
        InputError: it is no complete export, or one of its files has changed.
    """
    check_directory(directory)
    manifest = _read_manifest(directory)
    if manifest is None:
        text = f"contains no export ({MANIFEST} is missing; `sinsjax export` writes one)"
        raise InputError(f"{directory}: {text}")
    again = "(`sinsjax export --overwrite` makes it again)"
    if manifest.get("state") != "complete":
        raise InputError(f"{directory}: the export is unfinished {again}")
    for name, entry in manifest["files"].items():
        if name == README:
            continue
        found = _file_entry(directory / name)
        if found != entry and (found or name in (STUDY, INITIAL)):  # records may be deleted
            raise InputError(f"{directory / name}: has changed since it was exported {again}")
    study = load_study(directory / STUDY)
    if fingerprint(study) != manifest["digest"]:
        text = "the attitude_file of its study has changed since (export the study again)"
        raise InputError(f"{directory}: {text}")
    return study, manifest


def initial_rows(plan: Export) -> dict[str, NDArray]:
    """Return the columns of the initial solutions by name, one row per run, by run_id."""
    runs, draws, frame = plan.runs, plan.draws, plan.frame
    count, n_points = len(draws) * len(runs.points), len(runs.points)
    starts = np.empty((count, 9))
    for part in runs.parts:
        found = jax.tree.leaves(given.find_starts(runs.batch(part, draws)))
        starts[runs.places(part, draws, draws.start)] = np.stack(found, axis=-1)
    *q, ve, vn, latitude, height, gravity = starts.T
    has_start = np.tile(runs.has_start, len(draws))

    def where_known(values: NDArray) -> NDArray:
        return np.where(has_start, values + 0.0, np.nan)  # no -0

    attitude = Quat(*q)
    pitch, roll, yaw = to_angles(attitude, frame).T / DEG
    quaternion = to_quaternion(attitude, frame)
    draw, variant = np.repeat(list(draws), n_points), np.tile(runs.variants, len(draws))
    environment = np.tile(runs.environments, len(draws))
    names = zip(environment.tolist(), draw.tolist(), strict=True)
    return {
        "run_id": draw * runs.source.n_variants + variant,
        "draw_id": draw,
        "variant_id": variant,
        "yaw_deg": where_known(yaw),
        "pitch_deg": where_known(pitch),
        "roll_deg": where_known(roll),
        **{f"q_{axis}": where_known(quaternion[:, i]) for i, axis in enumerate("wxyz")},
        "v_east_m_per_s": where_known(ve),
        "v_north_m_per_s": where_known(vn),
        "latitude_deg": latitude / DEG,
        "height_m": height,
        "gravity_m_per_s2": gravity,
        "rate_hz": np.full(count, float(runs.source.rate_hz)),
        "start_s": np.zeros(count),
        "end_s": np.full(count, runs.end_s),
        "file": np.array([plan.record_name(*name) for name in names]),
        "study": np.full(count, fingerprint(runs.source)),
    }


def _csv_bytes(table: pa.Table) -> bytes:
    sink = io.BytesIO()
    sink.write((",".join(table.column_names) + "\n").encode())
    options = pa.csv.WriteOptions(include_header=False, quoting_style="none")
    pa.csv.write_csv(table, sink, options)
    return sink.getvalue()


def _truth_parquet(plan: Export) -> bytes:
    """Return the true attitudes at record times, one row per record and time."""
    runs, sink, tables = plan.runs, pa.BufferOutputStream(), []
    for number in range(runs.environments.max() + 1):
        part = runs.part_of(number)
        truth = given.true_attitudes_at_records(runs.batch(part, plan.draws))
        time_s = runs.study.update_times(runs.study.lengths.to_list()[part.ids[0]])
        for place, draw in enumerate(plan.draws):
            attitude = Quat(*(np.ascontiguousarray(a[:, place]) for a in truth))
            pitch, roll, yaw = to_angles(attitude, plan.frame).T / DEG
            columns = {
                "file": [plan.record_name(number, draw)] * len(time_s),
                "draw_id": np.full(len(time_s), draw),
                "time_s": time_s,
            }
            angles = {"yaw_deg": yaw, "pitch_deg": pitch, "roll_deg": roll}
            tables.append(pa.table(columns | angles))
    pq.write_table(pa.concat_tables(tables), sink, compression="zstd")
    return sink.getvalue().to_pybytes()


def _write_manifest(plan: Export, directory: Path, state: str, files: dict[str, Any]) -> None:
    content = {
        "schema": _SCHEMA,
        "sinsjax": runtime.package_version(),
        "study": plan.runs.source.name,
        "digest": fingerprint(plan.runs.source),
        **plan.options,
        "draws": [plan.draws.start, plan.draws.stop],
        "state": state,
        "files": files,
    }
    with atomic_write(directory / MANIFEST) as file:
        file.write(sealed.to_sealed_json(content))


def _read_manifest(directory: Path) -> dict[str, Any] | None:
    try:
        manifest = sealed.read_sealed_json(directory / MANIFEST)
    except FileNotFoundError:
        return None
    if manifest.get("schema") != _SCHEMA or not isinstance(manifest.get("files"), dict):
        raise InputError(f"{directory / MANIFEST}: is of another version (export the study again)")
    return manifest


def _check_target(directory: Path, *, overwrite: bool) -> None:
    """Refuse a directory with an export that may not be replaced, or with other files.

    Raises:
        InputError: names what it contains.
    """
    names = sorted(os.listdir(directory)) if directory.exists() else []
    if not (names := [name for name in names if not name.startswith(".")]):
        return
    is_export = {STUDY, README, INITIAL, TRUTH, MANIFEST, RECORDS, SCORES}.issuperset(names)
    with suppress(InputError):
        is_export = is_export or _read_manifest(directory) is not None
    if not is_export:
        text = f"contains {', '.join(names[:3])}, no export (give another directory)"
        raise InputError(f"{directory}: {text}")
    if not overwrite:
        text = "already contains an export (give --overwrite to replace it)"
        raise InputError(f"{directory}: {text}")


def _remove_export(directory: Path) -> None:
    """Remove the files of an export, and no others."""
    records = (p for p in directory.glob(f"{RECORDS}/*") if re.fullmatch(_RECORD, p.name))
    others = (directory / name for name in (STUDY, README, INITIAL, TRUTH, MANIFEST))
    for path in (*records, *others):
        path.unlink(missing_ok=True)


def _file_entry(path: Path) -> dict[str, Any] | None:
    """Return size and SHA-256 of a file; None if it is missing."""
    try:
        content = read_regular_file(path)
    except FileNotFoundError:
        return None
    return {"bytes": len(content), "sha256": hashlib.sha256(content).hexdigest()}
