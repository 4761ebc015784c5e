"""Writing the draws of a study for programs outside sinsjax: a record per draw, and the starts.

A directory of an export has

    initial.csv     one row per run: record, first attitude, place, start and end
    imu/            one record per draw, per environment if there are several
    truth.parquet   true attitudes at record times, unless the export is blind
    study.toml      the study, from which `sinsjax score` makes the truth again
    README.txt      units, signs, the order of Euler angles, and the columns to return
    export.json     the options, and size and SHA-256 of every file

Every file is written under a temporary name, synced and renamed. An interrupted export is made
again.
"""

import hashlib
import io
import os
import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from itertools import product
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
from sinsjax.errors import InputError, StudyInterrupted
from sinsjax.execution import sealed
from sinsjax.execution.directory import STUDY, check_directory, lock_directory, results_path
from sinsjax.execution.forecast import format_bytes
from sinsjax.execution.sealed import DamagedError
from sinsjax.messages import format_count
from sinsjax.platform import machine, runtime
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
_NUMBER_BYTES = {"psins": 22.0, "csv": 22.0, "parquet": 9.7}
"""Bytes of a number in a record."""


class ExportOptions(NamedTuple):
    """Options of an export.

    Attributes:
        draws: first draw and the one after the last, -1 for the study's last; None for all.
        format: "psins" (increments, blanks between columns, no names), "csv" or "parquet".
        quantity: "increments" (rad, m/s) or "rates" (rad/s, m/s^2, mean over each sample).
        frame: axes and signs, see `arena.frames`.
        blind: whether the truth is left out.
    """

    draws: tuple[int, int] | None = None
    format: str = "csv"
    quantity: str = "increments"
    frame: str = "enu"
    blind: bool = False


_DEFAULTS = ExportOptions()


class ExportPlan(NamedTuple):
    """An export that is ready to be written.

    Attributes:
        runs: of the program.
        options: with the draws.
        records: (environment, draw) of each record.
        bytes: expected size of the records.
    """

    runs: ProgramRuns
    options: ExportOptions
    records: list[tuple[int, int]]
    bytes: float

    @property
    def draws(self) -> range:
        """The exported draws."""
        assert self.options.draws is not None
        return range(*self.options.draws)

    @property
    def text(self) -> str:
        """Number of runs and records, and their size, in words."""
        count = format_count(len(self.runs.points) * len(self.draws), "run")
        records = format_count(len(self.records), "record")
        return (
            f"{self.runs.source.name}: {count} on {records} of {self.runs.samples:,} samples, about"
            f" {format_bytes(self.bytes)}"
        )

    def record_name(self, environment: int, draw: int) -> str:
        """Return the path of a record in the directory."""
        number = "" if self.runs.environments == 1 else f"set_{environment:03d}_"
        return f"{RECORDS}/{number}draw_{draw:05d}{_SUFFIXES[self.options.format]}"


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
    options = ExportOptions(draws, format, quantity, frame, blind)
    out = results_path(directory)
    write_export(plan_export(load_study(study), options), out, overwrite=overwrite)
    return out


def plan_export(study: Study, options: ExportOptions = _DEFAULTS) -> ExportPlan:
    """Check a study and the options of its export.

    Raises:
        InputError: see `export_study`.
    """
    runtime.ensure_configured()
    check_simulated(study)
    for name, known in (("format", FORMATS), ("quantity", QUANTITIES), ("frame", FRAMES)):
        value = getattr(options, name)
        if value not in known:
            raise InputError(f"{name}: {value!r} is not one of {', '.join(known)}")
    if options.format == "psins" and (options.quantity, options.frame) != ("increments", "enu"):
        other = "quantity" if options.quantity != "increments" else "frame"
        text = f"the psins format has increments of right-front-up axes (drop --{other}, or csv)"
        raise InputError(f"{other}: {getattr(options, other)!r}: {text}")
    first, end = options.draws or (0, study.n_draws)
    end = study.n_draws if end < 0 else end
    if not 0 <= first < end <= study.n_draws:
        text = f"must be A:B with 0 <= A < B <= {study.n_draws}, the draws of {study.name}"
        raise InputError(f"draws: {first}:{end}: {text}")
    runs = ProgramRuns(study)
    records = [(e, draw) for e in range(runs.environments) for draw in range(first, end)]
    size = len(records) * runs.samples * (6 * _NUMBER_BYTES[options.format] + 8)
    return ExportPlan(runs, options._replace(draws=(first, end)), records, size)


def write_export(
    plan: ExportPlan,
    directory: Path,
    *,
    overwrite: bool = False,
    on_begin: Callable[[], None] = lambda: None,
    on_record: Callable[[int, int], None] | None = None,
    is_stopped: Callable[[], bool] = lambda: False,
) -> None:
    """Write a planned export.

    Args:
        plan: the export.
        directory: where to.
        overwrite: whether to replace an export.
        on_begin: called once everything is checked, before anything is written.
        on_record: called with the numbers of written and of all records after every record.
        is_stopped: whether to end after the running record.

    Raises:
        InputError: see `export_study`.
        StudyInterrupted: ``is_stopped`` returned True.
    """
    check_directory(directory)
    earlier = _check_target(directory, overwrite=overwrite)
    available = machine.free_disk_bytes(directory)
    if plan.bytes > available:
        raise InputError(
            f"{directory}: the records need about {format_bytes(plan.bytes)}, but the disk has only"
            f" {format_bytes(available)} free (--format parquet is smaller, or --draws A:B)"
        )
    on_begin()
    lock = lock_directory(directory)
    try:
        if earlier:
            _remove_export(directory, earlier)
        _Writer(plan, directory).write(on_record, is_stopped)
    finally:
        lock.release()


class _Writer:
    """Writer of an export.

    Attributes:
        files: size and SHA-256 of each complete file, by path in the directory.
    """

    def __init__(self, plan: ExportPlan, directory: Path) -> None:
        self._plan, self._directory, self.files = plan, directory, dict[str, Any]()

    def write(
        self, on_record: Callable[[int, int], None] | None, is_stopped: Callable[[], bool]
    ) -> None:
        """Write all files, the manifest first, to mark those of a killed export."""
        plan, total = self._plan, len(self._plan.records)
        self._write_manifest("running")
        make_folder(self._directory / RECORDS)
        study = plan.runs.source
        self._write(STUDY, study_to_toml(study).encode())
        self._write(README, _readme(plan).encode())
        self._write(INITIAL, _initial_csv(plan))
        if not plan.options.blind:
            self._write(TRUTH, _truth_parquet(plan))
        for done, (name, write) in enumerate(self._records()):
            if is_stopped():
                self._write_manifest("interrupted")
                text = f"{done:,} of {total:,} records are in {self._directory}"
                raise StudyInterrupted(text)
            write(self._directory / name)
            self._register(name)
            if on_record:
                on_record(done + 1, total)
        self._write_manifest("complete")

    def _records(self) -> Iterator[tuple[str, Callable[[Path], None]]]:
        """Yield the paths of the records, and functions that write them."""
        plan, layout = self._plan, record_layout(self._plan.options)
        for number in range(plan.runs.environments):
            batch = plan.runs.batch(plan.runs.part_of(number), plan.draws)
            study = plan.runs.study
            records = simulated_records(batch, study.rate_hz, study.name)
            for draw, record in zip(plan.draws, records, strict=True):

                def write(path: Path, record: Any = record) -> None:
                    match plan.options.format:
                        case "parquet":
                            write_parquet(record, path, layout)
                        case "psins":
                            write_csv(record, path, layout, delimiter=" ")
                        case _:
                            write_csv(record, path, layout)

                yield plan.record_name(number, draw), write

    def _write(self, name: str, content: bytes) -> None:
        with atomic_write(self._directory / name) as file:
            file.write(content)
        self._register(name)

    def _register(self, name: str) -> None:
        self.files[name] = _file_entry(self._directory / name)

    def _write_manifest(self, state: str) -> None:
        content = _manifest_options(self._plan) | {"state": state, "files": self.files}
        with atomic_write(self._directory / MANIFEST) as file:
            file.write(sealed.to_sealed_json(content))


def record_layout(options: ExportOptions) -> RecordLayout:
    """Return the layout of an export's records, with which sinsjax reads them."""
    if options.format == "psins":
        names = ("wx", "wy", "wz", "vx", "vy", "vz", "t")
        return RecordLayout(
            "csv", names, time_column="t", gyro_columns=names[:3], accel_columns=names[3:6]
        )
    rates = options.quantity == "rates"
    gyro_unit, accel_unit = ("rad_per_s", "m_per_s2") if rates else ("rad", "m_per_s")
    return RecordLayout(
        options.format,
        time_column="time_s",
        gyro_columns=tuple(f"gyro_{axis}_{gyro_unit}" for axis in "xyz"),
        accel_columns=tuple(f"accel_{axis}_{accel_unit}" for axis in "xyz"),
        gyro_unit=gyro_unit,
        accel_unit=accel_unit,
        axes_order=BODY_AXES[options.frame],
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
    if manifest.get("state") != "complete":
        raise InputError(
            f"{directory}: the export is unfinished (`sinsjax export --overwrite` makes it again)"
        )
    for name in (STUDY, INITIAL):
        if manifest["files"].get(name) != _file_entry(directory / name):
            text = "has changed since it was exported (`sinsjax export --overwrite` makes it again)"
            raise InputError(f"{directory / name}: {text}")
    return load_study(directory / STUDY), manifest


def initial_rows(plan: ExportPlan) -> dict[str, NDArray]:
    """Return the columns of the initial solutions by name, one row per run, by run_id."""
    runs, frame = plan.runs, plan.options.frame
    tasks = runs.tasks(plan.draws)
    starts: dict[tuple[int, int], Any] = {}
    for part in runs.parts:
        found = np.stack(jax.tree.leaves(given.find_starts(runs.batch(part, plan.draws))), axis=-1)
        keys = product(plan.draws, (runs.points[point].number for point in part.points))
        starts |= {(point, draw): row for (draw, point), row in zip(keys, found, strict=True)}
    keys_of_tasks = zip(tasks.point.tolist(), tasks.draw.tolist(), strict=True)
    *q, ve, vn, latitude, height, gravity = np.array([starts[key] for key in keys_of_tasks]).T
    has_start = np.array([point.has_start for point in runs.points.values()])[tasks.point]

    def where_known(values: NDArray) -> NDArray:
        return np.where(has_start, values + 0.0, np.nan)  # no -0

    attitude = Quat(*q)
    pitch, roll, yaw = to_angles(attitude, frame).T / DEG
    quaternion = to_quaternion(attitude, frame)
    names = zip(tasks.environment.tolist(), tasks.draw.tolist(), strict=True)
    count = len(tasks.run_id)
    return {
        "run_id": tasks.run_id,
        "draw_id": tasks.draw,
        "variant_id": tasks.variant,
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


def _initial_csv(plan: ExportPlan) -> bytes:
    return _csv_bytes(pa.table(initial_rows(plan)))


def _readme(plan: ExportPlan) -> str:
    study, options = plan.runs.source, plan.options._asdict()
    options.pop("draws")
    return describe_export(study.name, fingerprint(study), **options)


def _csv_bytes(table: pa.Table) -> bytes:
    sink = io.BytesIO()
    sink.write((",".join(table.column_names) + "\n").encode())
    options = pa.csv.WriteOptions(include_header=False, quoting_style="none")
    pa.csv.write_csv(table, sink, options)
    return sink.getvalue()


def _truth_parquet(plan: ExportPlan) -> bytes:
    """Return the true attitudes at record times, one row per record and time."""
    runs, sink = plan.runs, pa.BufferOutputStream()
    writer = None
    for number in range(runs.environments):
        part = runs.part_of(number)
        truth = given.true_attitudes_at_records(runs.batch(part, plan.draws))
        time_s = runs.study.update_times(runs.study.spans[part.ids[0]])
        for place, draw in enumerate(plan.draws):
            attitude = Quat(*(np.ascontiguousarray(a[:, place]) for a in truth))
            pitch, roll, yaw = to_angles(attitude, plan.options.frame).T / DEG
            table = pa.table(
                {
                    "file": pa.array([plan.record_name(number, draw)] * len(time_s)),
                    "draw_id": np.full(len(time_s), draw),
                    "time_s": time_s,
                    "yaw_deg": yaw,
                    "pitch_deg": pitch,
                    "roll_deg": roll,
                }
            )
            writer = writer or pq.ParquetWriter(sink, table.schema, compression="zstd")
            writer.write_table(table)
    assert writer is not None
    writer.close()
    return sink.getvalue().to_pybytes()


def _manifest_options(plan: ExportPlan) -> dict[str, Any]:
    options = plan.options._asdict() | {"draws": list(plan.options.draws or ())}
    return {
        "schema": _SCHEMA,
        "sinsjax": runtime.package_version(),
        "study": plan.runs.source.name,
        "digest": fingerprint(plan.runs.source),
        **options,
    }


def _read_manifest(directory: Path) -> dict[str, Any] | None:
    try:
        manifest = sealed.read_sealed_json(directory / MANIFEST)
    except FileNotFoundError:
        return None
    if manifest.get("schema") != _SCHEMA or not isinstance(manifest.get("files"), dict):
        raise InputError(f"{directory / MANIFEST}: is of another version (export the study again)")
    return manifest


def _check_target(directory: Path, *, overwrite: bool) -> Mapping[str, Any] | None:
    """Return the manifest of an earlier export in a directory, if it may be replaced.

    Raises:
        InputError: it may not, or the directory contains other files.
    """
    names = _visible(directory) if directory.exists() else []
    if not names:
        return None
    try:
        earlier = _read_manifest(directory)
    except DamagedError:
        earlier = None
    own = {STUDY, README, INITIAL, TRUTH, MANIFEST, RECORDS, SCORES}
    if earlier is None and overwrite and own.issuperset(names):
        return {"files": {}}  # an export whose manifest is lost
    if earlier is None:
        others = ", ".join(sorted(names)[:3])
        raise InputError(f"{directory}: contains {others}, no export (give another directory)")
    if not overwrite:
        text = "already contains an export (give --overwrite to replace it)"
        raise InputError(f"{directory}: {text}")
    return earlier


def _visible(directory: Path) -> list[str]:
    return [name for name in os.listdir(directory) if not name.startswith(".")]


def _remove_export(directory: Path, manifest: Mapping[str, Any]) -> None:
    """Remove the files of an export, and records that a killed one did not list."""
    listed = (directory / name for name in manifest["files"] if _is_own(name))
    unlisted = (p for p in directory.glob(f"{RECORDS}/*") if _is_own(f"{RECORDS}/{p.name}"))
    for path in {*listed, *unlisted, directory / MANIFEST}:
        with suppress(FileNotFoundError):
            path.unlink()


def _is_own(name: str) -> bool:
    suffixes = "|".join(re.escape(suffix) for suffix in _SUFFIXES.values())
    is_record = re.fullmatch(rf"{RECORDS}/(set_\d+_)?draw_\d+({suffixes})", name)
    return is_record is not None or name in (STUDY, README, INITIAL, TRUTH)


def _file_entry(path: Path) -> dict[str, Any] | None:
    """Return size and SHA-256 of a file; None if it is missing."""
    try:
        content = read_regular_file(path)
    except FileNotFoundError:
        return None
    return {"bytes": len(content), "sha256": hashlib.sha256(content).hexdigest()}
