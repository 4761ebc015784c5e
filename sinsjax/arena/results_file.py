"""Reading the results of a program outside sinsjax, one row per run and time.

| column | meaning |
| --- | --- |
| ``study`` | digest of the exported study; in text also as a first line ``# study = DIGEST`` |
| ``run_id`` | run of ``initial.csv``; or ``draw_id`` and ``variant_id`` |
| ``time_s`` | on the clock of the records |
| ``yaw_deg``, ``pitch_deg``, ``roll_deg`` | in the frame; ``_rad`` in radians; or ``heading_deg`` |
| ``q_w``, ``q_x``, ``q_y``, ``q_z`` | instead: from body to navigation frame |
| ``sigma_yaw_deg``, ... ``pitch``, ``roll`` | optional, 1 sigma; also ``_rad`` and ``_arcmin`` |

The frame is that of the export, unless ``# frame = ned`` or the caller gives another one.
"""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pyarrow.parquet as pq
from numpy.typing import NDArray

from sinsjax.arena.frames import FRAMES, from_angles, from_quaternion
from sinsjax.errors import InputError
from sinsjax.messages import shorten, to_one_line
from sinsjax.records.tables import ColumnTable, open_parquet
from sinsjax.records.text import open_csv
from sinsjax.types import Quat
from sinsjax.units import ARCMIN, DEG

ANGLES = ("pitch", "roll", "yaw")
_UNITS = {"deg": DEG, "rad": 1.0, "arcmin": ARCMIN}
_QUATERNION = ("q_w", "q_x", "q_y", "q_z")
_LENGTH_TOLERANCE = 0.01
_ANGLE = r"(pitch|roll|yaw|heading)_(deg|rad)"
_SIGMA = r"sigma_(pitch|roll|yaw|heading)_(deg|rad|arcmin)"


class GivenResults(NamedTuple):
    """Rows of a results file, by run and time.

    Attributes:
        run: (rows,) place of the run among those asked for.
        time_s: (rows,).
        angles: (rows, 3) pitch, roll and yaw in the frame, rad; None if quaternions are given.
        quaternions: (rows, 4) in the frame; None if angles are given.
        unit: unit of the angles in the file, "deg" or "rad"; "" for quaternions.
        sigma: (rows, 3) 1 sigma of pitch, roll and yaw, rad; NaN if not given.
        sigma_unit: unit of the sigma of the heading in the file; "" without one.
        frame: see `arena.frames`.
    """

    run: NDArray
    time_s: NDArray
    angles: NDArray | None
    quaternions: NDArray | None
    unit: str
    sigma: NDArray
    sigma_unit: str
    frame: str

    @property
    def attitude(self) -> Quat:
        """The attitudes from b to n, leaves (rows,)."""
        if self.angles is not None:
            return from_angles(self.angles, self.frame)
        assert self.quaternions is not None
        return from_quaternion(self.quaternions, self.frame)

    @property
    def has_sigma(self) -> bool:
        """Return whether a sigma of the heading is given."""
        return bool(np.isfinite(self.sigma[:, 2]).any())

    def select(self, rows: NDArray) -> "GivenResults":
        """Return some of the rows."""
        angles = None if self.angles is None else self.angles[rows]
        quaternions = None if self.quaternions is None else self.quaternions[rows]
        return self._replace(
            run=self.run[rows],
            time_s=self.time_s[rows],
            angles=angles,
            quaternions=quaternions,
            sigma=self.sigma[rows],
        )


class AskedRuns(NamedTuple):
    """The runs of an export.

    Attributes:
        digest: of its study.
        frame: of the export.
        run_id: (runs,).
        draw_id: (runs,).
        variant_id: (runs,).
        end_s: (runs,) end of each run, s.
        sample_s: sample time, s.
    """

    digest: str
    frame: str
    run_id: NDArray
    draw_id: NDArray
    variant_id: NDArray
    end_s: NDArray
    sample_s: float


def read_results(path: str | Path, asked: AskedRuns, frame: str | None = None) -> GivenResults:
    """Read a file of results.

    Args:
        path: CSV or Parquet file.
        asked: the runs of the export.
        frame: of the attitudes; None for that of the file or the export.

    Returns:
        The rows, by run and time.

    Raises:
        InputError: the file cannot be read or is cut off; it is of another study; a column is
            missing; a run is unknown, repeated or ends too late; or a value is no number.
    """
    is_parquet = Path(path).suffix.lower() in (".parquet", ".pq")
    table = open_parquet(path) if is_parquet else open_csv(path)
    keys = _parquet_keys(path) if is_parquet else _comment_keys(table.comments)
    columns = _choose_columns(path, table)
    labels = {"study": {asked.digest: 0.0}} if "study" in table.names else {}
    try:
        values = table.read([*labels, *columns], labels=labels)
    except InputError as error:
        if "not finite" in str(error):
            hint = "leave the row out: a run without one at its end counts as a failure"
            raise InputError(f"{error} ({hint})") from None
        raise
    if cut := next((line for line in table.remarks if "cut off" in line), None):
        raise InputError(f"{path}: {cut.removesuffix(' and left out')} (write the file again)")
    _check_digest(path, asked, keys, [*labels.get("study", {})], has_column=bool(labels))
    by_name = dict(zip(columns, values[len(labels) :], strict=True))
    run = _find_runs(path, table, by_name, asked)
    order = np.lexsort((by_name["time_s"], run))
    _check_times(path, table, run, by_name["time_s"], asked, order)
    given = _build_results(path, table, by_name, run, _choose_frame(path, keys, asked, frame))
    return given.select(order)


def _comment_keys(comments: object) -> dict[str, str]:
    """Return the entries ``# key = value`` in the first lines of a text file."""
    lines = [str(line) for line in comments] if isinstance(comments, list | tuple) else []
    entries = (re.match(r"\s*[#%]\s*(study|frame)\s*[=:]\s*(\S+)", line) for line in lines)
    return {entry[1]: entry[2].strip("\"',") for entry in entries if entry}


def _parquet_keys(path: str | Path) -> dict[str, str]:
    metadata = pq.read_schema(path).metadata or {}
    known = ("study", "frame")
    found = {key: metadata[key.encode()] for key in known if key.encode() in metadata}
    return {key: value.decode(errors="replace") for key, value in found.items()}


def _choose_columns(path: str | Path, table: ColumnTable) -> list[str]:
    """Return the names of the columns to read."""
    names = table.names

    def find(*alternatives: str) -> str | None:
        return next((name for name in alternatives if name in names), None)

    run = [find("run_id")] if find("run_id") else [find("draw_id", "draw")]
    if run != ["run_id"]:
        run.append(find("variant_id", "variant"))
    if None in run:
        text = "needs 'run_id', or 'draw_id' and 'variant_id' (copy them from initial.csv)"
        raise InputError(f"{path}: {text}; the file has {_list_names(names)}")
    given = [name for name in names if name in _QUATERNION or re.fullmatch(_ANGLE, name)]
    unit = next((u for u in ("deg", "rad") if f"pitch_{u}" in names), "deg")
    attitude = [f"pitch_{unit}", f"roll_{unit}", f"yaw_{unit}"]
    if f"heading_{unit}" in names:
        attitude[2] = f"heading_{unit}"
    if any(name in names for name in _QUATERNION):
        attitude = list(_QUATERNION)
    if others := sorted(set(given) - set(attitude)):
        text = f"has both {attitude[-1]} and {others[0]}: one attitude a row (keep one)"
        raise InputError(f"{path}: {text}")
    sigmas: dict[str, str] = {}
    for name in (name for name in names if name.startswith("sigma_")):
        match = re.fullmatch(_SIGMA, name)
        if match is None:
            known = "sigma_yaw, sigma_pitch or sigma_roll with _deg, _rad or _arcmin"
            raise InputError(f"{path}: column {to_one_line(name)!r}: must be {known}")
        angle = match[1].replace("heading", "yaw")
        if sigmas.setdefault(angle, name) != name:
            raise InputError(f"{path}: has both {sigmas[angle]} and {name} (keep one)")
    return [str(name) for name in (*run, "time_s", *attitude, *sigmas.values())]


def _list_names(names: list[str]) -> str:
    return shorten(to_one_line(", ".join(map(repr, names))))


def _check_digest(
    path: str | Path,
    asked: AskedRuns,
    keys: Mapping[str, str],
    labels: list[str],
    *,
    has_column: bool,
) -> None:
    """Refuse results without the digest of the study, or with that of another one."""
    found = [text for text in labels if text.lower() != asked.digest]
    if "study" in keys and keys["study"].lower() != asked.digest:
        found.append(keys["study"])
    if found:
        raise InputError(
            f"{path}: is of another study: digest {shorten(to_one_line(found[0] or 'missing'), 40)}"
            f" there, {asked.digest} exported"
        )
    if not has_column and "study" not in keys:
        text = f"has no digest of its study (a column 'study' with {asked.digest}, as in"
        raise InputError(f"{path}: {text} initial.csv, or a first line `# study = {asked.digest}`)")


def _choose_frame(
    path: str | Path, keys: Mapping[str, str], asked: AskedRuns, frame: str | None
) -> str:
    chosen = (frame or keys.get("frame") or asked.frame).lower()
    if chosen not in FRAMES:
        place = "frame" if frame else f"{path}: frame"
        raise InputError(f"{place}: {to_one_line(chosen)!r} is not one of {', '.join(FRAMES)}")
    return chosen


def _find_runs(
    path: str | Path, table: ColumnTable, columns: Mapping[str, NDArray], asked: AskedRuns
) -> NDArray:
    """Return the place of each row's run among those asked for."""
    if "run_id" in columns:
        numbers, known, what = columns["run_id"], asked.run_id, "run_id"
        shown = [numbers]
    else:
        draw, variant = list(columns.values())[:2]
        width = float(asked.variant_id.max() + 2)
        numbers = draw * width + np.where((variant >= 0) & (variant < width), variant, width - 1)
        known, what = asked.draw_id * width + asked.variant_id, "draw_id and variant_id"
        shown = [draw, variant]
    order = np.argsort(known)
    place = np.minimum(np.searchsorted(known[order], numbers), len(known) - 1)
    run = order[place]
    unknown = known[run] != numbers
    if unknown.any():
        row = int(unknown.argmax())
        values = ", ".join(f"{column[row]:.12g}" for column in shown)
        text = f"no run of the export has this {what} ({values}; see initial.csv)"
        raise InputError(f"{path}: row {table.row_number(row)}: {text}")
    return np.asarray(run)


def _check_times(
    path: str | Path,
    table: ColumnTable,
    run: NDArray,
    time_s: NDArray,
    asked: AskedRuns,
    order: NDArray,
) -> None:
    late = time_s > asked.end_s[run] + asked.sample_s / 2
    if late.any() or (time_s < 0).any():
        row = int((late | (time_s < 0)).argmax())
        text = f"is beyond its run, 0 to {asked.end_s[run[row]]:.12g} s"
        raise InputError(f"{path}: row {table.row_number(row)}: time_s = {time_s[row]:.12g} {text}")
    same = (np.diff(run[order]) == 0) & (np.diff(time_s[order]) < asked.sample_s / 2)
    if same.any():
        at = int(same.argmax())
        rows = sorted(table.row_number(int(row)) for row in order[at : at + 2])
        text = f"repeats run_id {asked.run_id[run[order[at]]]} at {time_s[order[at]]:.12g} s"
        raise InputError(f"{path}: row {rows[1]}: {text} (row {rows[0]} has it already)")


def _build_results(
    path: str | Path,
    table: ColumnTable,
    columns: Mapping[str, NDArray],
    run: NDArray,
    frame: str,
) -> GivenResults:
    sigma, sigma_unit = np.full((len(run), 3), np.nan), ""
    for name, values in columns.items():
        if name.startswith("sigma_"):
            _, angle, unit = name.split("_")
            sigma[:, ANGLES.index(angle.replace("heading", "yaw"))] = values * _UNITS[unit]
            if angle in ("heading", "yaw"):
                sigma_unit = unit
            if (bad := values <= 0).any():
                row = table.row_number(int(bad.argmax()))
                raise InputError(f"{path}: row {row}: {name} must be above 0")
    angles = quaternions = None
    unit = ""
    if "q_w" in columns:
        quaternions = np.stack([columns[name] for name in _QUATERNION], axis=-1)
        off = np.abs(np.linalg.norm(quaternions, axis=-1) - 1) > _LENGTH_TOLERANCE
        if off.any():
            row = table.row_number(int(off.argmax()))
            raise InputError(f"{path}: row {row}: q_w, q_x, q_y, q_z is no unit quaternion")
    else:
        unit = "rad" if "pitch_rad" in columns else "deg"
        heading = f"heading_{unit}"
        if heading in columns:  # clockwise in every frame
            yaw = columns[heading] * (1 if frame == "ned" else -1)
        else:
            yaw = columns[f"yaw_{unit}"]
        angles = np.stack([columns[f"pitch_{unit}"], columns[f"roll_{unit}"], yaw], axis=-1)
        angles = angles * _UNITS[unit]
    return GivenResults(run, columns["time_s"], angles, quaternions, unit, sigma, sigma_unit, frame)
