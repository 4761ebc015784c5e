"""Reading the results of a program outside sinsjax, one row per run and time.

| column | meaning |
| --- | --- |
| ``study`` | digest of the exported study; or a first line ``# study = DIGEST`` |
| ``run_id`` | run of ``initial.csv``; or ``draw_id`` and ``variant_id`` |
| ``time_s`` | on the clock of the records |
| ``yaw_deg``, ``pitch_deg``, ``roll_deg`` | in the frame |
| ``q_w``, ``q_x``, ``q_y``, ``q_z`` | instead: from body to navigation frame |
| ``sigma_yaw_deg``, ``sigma_pitch_deg``, ``sigma_roll_deg`` | optional, 1 sigma |

The frame is that of the export, unless a line ``# frame = ned`` or the caller gives another one.
Lines of a Parquet file are entries of its metadata.
"""

import csv
import io
import re
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet as pq
from numpy.typing import NDArray

from sinsjax.arena.frames import FRAMES, from_angles, from_quaternion
from sinsjax.errors import InputError
from sinsjax.messages import shorten, to_one_line
from sinsjax.platform.files import read_regular_file
from sinsjax.types import Quat
from sinsjax.units import DEG

ANGLES = ("pitch_deg", "roll_deg", "yaw_deg")
_SIGMAS = tuple(f"sigma_{name}" for name in ANGLES)
_QUATERNION = ("q_w", "q_x", "q_y", "q_z")
_NUMBERS = ("run_id", "draw_id", "variant_id", "time_s", *ANGLES, *_QUATERNION, *_SIGMAS)
_LENGTH_TOLERANCE = 0.01
_LARGEST_DEG = 1e6
_HEADER_BYTES = 2**16
_LIKE_ATTITUDE = r"(sigma|pitch|roll|yaw|heading)_|q_[wxyz]"


class GivenResults(NamedTuple):
    """Rows of a results file, by run and time.

    Attributes:
        run: (rows,) place of the run among those asked for.
        time_s: (rows,).
        values: (rows, 3) pitch, roll and yaw, rad, or (rows, 4) quaternions; in the frame.
        sigma: (rows, 3) 1 sigma of pitch, roll and yaw, rad; NaN if not given.
        frame: see `arena.frames`.
    """

    run: NDArray
    time_s: NDArray
    values: NDArray
    sigma: NDArray
    frame: str

    @property
    def has_quaternions(self) -> bool:
        """Return whether attitudes are quaternions."""
        return self.values.shape[1] == len(_QUATERNION)

    @property
    def attitude(self) -> Quat:
        """The attitudes from b to n, leaves (rows,)."""
        return (from_quaternion if self.has_quaternions else from_angles)(self.values, self.frame)

    def select(self, rows: NDArray) -> "GivenResults":
        """Return some of the rows."""
        run, time_s, values, sigma = (column[rows] for column in self[:4])
        return GivenResults(run, time_s, values, sigma, self.frame)


class AskedRuns(NamedTuple):
    """The runs of an export, by draw, then by variant.

    Attributes:
        digest: of its study.
        frame: of the export.
        draws: the draws.
        variants: (variants,) ascending, those of its study that a program runs.
        n_variants: number of all variants.
        end_s: end of a run, s.
        sample_s: sample time, s.
    """

    digest: str
    frame: str
    draws: range
    variants: NDArray
    n_variants: int
    end_s: float
    sample_s: float

    @property
    def run_id(self) -> NDArray:
        """(runs,) Their numbers in the exported study."""
        return np.add.outer(np.array(self.draws) * self.n_variants, self.variants).ravel()


class _File(NamedTuple):
    """A file of results.

    Attributes:
        path: of the file.
        table: its rows, of known columns.
        names: of all columns.
        header: entries ``study`` and ``frame`` outside the table.
        first_row: number of the first row, for messages.
    """

    path: Path
    table: pa.Table
    names: list[str]
    header: dict[str, str]
    first_row: int

    def refuse(self, rows: NDArray, text: str) -> None:
        """Raise an error about the first of some rows, if there is any."""
        if rows.any():
            raise InputError(f"{self.path}: row {self.first_row + int(rows.argmax())}: {text}")

    def read(self, name: str) -> NDArray:
        """Return the numbers of a column."""
        try:
            numbers = self.table[name].cast(pa.float64()).to_numpy()
        except pa.ArrowException as error:
            raise InputError(f"{self.path}: {name}: {to_one_line(str(error))}") from None
        hint = "leave the row out: a run without one at its end counts as a failure"
        self.refuse(~np.isfinite(numbers), f"column '{name}': is not finite ({hint})")
        return np.asarray(numbers)


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
    file = _open(Path(path))
    _check_digest(file, asked)
    given, frame = file.header.get("frame"), frame and frame.lower()
    if given and frame and given.lower() != frame:
        raise InputError(f"{path}: has a line '# frame = {given}', --frame is {frame} (drop one)")
    frame = (frame or given or asked.frame).lower()
    if frame not in FRAMES:
        raise InputError(f"{path}: frame: {to_one_line(frame)!r} is not one of {', '.join(FRAMES)}")
    attitude, sigmas = _choose_columns(file)
    run, time_s = _find_runs(file, asked), file.read("time_s")
    late = (time_s < 0) | (time_s > asked.end_s + asked.sample_s / 2)
    text = f"time_s = {time_s[late.argmax()]:.12g}" if late.any() else ""
    file.refuse(late, f"{text} is beyond its run, 0 to {asked.end_s:.12g} s")
    order = np.lexsort((time_s, run))
    same = (np.diff(run[order]) == 0) & (np.diff(time_s[order]) < asked.sample_s / 2)
    if same.any():
        first, again = np.sort(order[same.argmax() :][:2]) + file.first_row
        which = f"run_id {asked.run_id[run[again - file.first_row]]} at"
        text = f"repeats {which} {time_s[again - file.first_row]:.12g} s (row {first} has it)"
        raise InputError(f"{path}: row {again}: {text}")
    sigma = np.full((len(run), 3), np.nan)
    for name in sigmas:
        sigma[:, _SIGMAS.index(name)] = file.read(name) * DEG
        file.refuse(sigma[:, _SIGMAS.index(name)] <= 0, f"{name} must be above 0")
    values = np.stack([file.read(name) for name in attitude], axis=-1)
    if attitude == _QUATERNION:
        off = np.abs(np.linalg.norm(values, axis=-1) - 1) > _LENGTH_TOLERANCE
        file.refuse(off, f"{', '.join(_QUATERNION)} is no unit quaternion")
    else:
        large = (np.abs(values) > _LARGEST_DEG).any(axis=-1)
        file.refuse(large, f"an angle is beyond {_LARGEST_DEG:g} deg")
        values = values * DEG
    return GivenResults(run, time_s, values, sigma, frame).select(order)


def _open(path: Path) -> _File:
    """Read all columns of a file as numbers, but for the digest.

    Raises:
        InputError: it is no regular file, no table, or repeats a line or column of its header.
    """
    try:
        content = read_regular_file(path.resolve())
    except FileNotFoundError:
        raise InputError(f"{path}: there is no such file") from None
    try:
        if content.startswith(b"PAR1"):
            table = pq.read_table(pa.BufferReader(content))
            metadata = table.schema.metadata or {}
            entries = [(key.decode(), value.decode()) for key, value in metadata.items()]
            header = {key: value for key, value in entries if key in ("study", "frame")}
            return _File(path, table, table.column_names, header, 1)
        lines = content[:_HEADER_BYTES].decode("utf-8-sig", errors="replace").splitlines()
        comments = next((n for n, line in enumerate(lines) if line.strip()[:1] not in "#%"), 0)
        header = _parse_header(path, lines[:comments])
        names = [name.strip() for name in next(csv.reader(lines[comments : comments + 1]), [])]
        if repeated := [name for name in names if names.count(name) > 1]:
            raise InputError(f"{path}: has two columns {to_one_line(repeated[0])!r} (keep one)")
        options = pa.csv.ReadOptions(use_threads=False, column_names=names, skip_rows=comments + 1)
        convert = pa.csv.ConvertOptions(
            column_types=dict.fromkeys(_NUMBERS, pa.float64()) | {"study": pa.string()},
            include_columns=[name for name in names if name in (*_NUMBERS, "study")],
            strings_can_be_null=True,
        )
        table = pa.csv.read_csv(io.BytesIO(content), options, convert_options=convert)
        return _File(path, table, names, header, comments + 2)
    except (pa.ArrowException, UnicodeDecodeError) as error:
        raise InputError(f"{path}: {shorten(to_one_line(str(error)), 200)}") from None


def _parse_header(path: Path, lines: list[str]) -> dict[str, str]:
    """Return the entries ``# key = value`` of the first lines."""
    header: dict[str, str] = {}
    for line in lines:
        if entry := re.match(r"\s*[#%]\s*(study|frame)\s*[=:]\s*(\S+)", line):
            if entry[1] in header:
                raise InputError(f"{path}: has two lines '# {entry[1]} = ...' (keep one)")
            header[entry[1]] = entry[2].strip("\"',")
    return header


def _check_digest(file: _File, asked: AskedRuns) -> None:
    """Refuse results without the digest of the study, or with that of another one."""
    found = [file.header["study"]] if "study" in file.header else []
    if "study" in file.names:
        found += [str(text or "missing") for text in file.table["study"].unique().to_pylist()]
    for text in found:
        if text.lower() != asked.digest:
            shown = shorten(to_one_line(text), 40)
            text = f"is of another study: digest {shown} there, {asked.digest} exported"
            raise InputError(f"{file.path}: {text}")
    if not found and "study" not in file.names:
        text = f"has no digest of its study (a column 'study' with {asked.digest}, as in"
        raise InputError(
            f"{file.path}: {text} initial.csv, or a first line `# study = {asked.digest}`)"
        )


def _choose_columns(file: _File) -> tuple[tuple[str, ...], list[str]]:
    """Return the names of the columns of attitudes and of sigmas."""
    names = file.names
    other = (n for n in names if re.match(_LIKE_ATTITUDE, n) and n not in _NUMBERS)
    if name := next(other, None):
        text = f"must be one of {', '.join((*ANGLES, *_QUATERNION, *_SIGMAS))}"
        raise InputError(f"{file.path}: column {to_one_line(name)!r}: {text}")
    has_angles, has_quaternion = (any(n in names for n in of) for of in (ANGLES, _QUATERNION))
    if has_angles and has_quaternion:
        raise InputError(f"{file.path}: has both angles and quaternions (keep one)")
    attitude = _QUATERNION if has_quaternion else ANGLES
    if missing := [name for name in ("time_s", *attitude) if name not in names]:
        listed = shorten(to_one_line(", ".join(map(repr, names))))
        text = f"lacks {', '.join(missing)} (README.txt lists the columns); the file has {listed}"
        raise InputError(f"{file.path}: {text}")
    return attitude, [name for name in _SIGMAS if name in names]


def _find_runs(file: _File, asked: AskedRuns) -> NDArray:
    """Return the place of each row's run among those asked for."""
    names = file.names
    by = ["run_id"] if "run_id" in names else ["draw_id", "variant_id"]
    if not {*by} <= {*names}:
        text = "needs 'run_id', or 'draw_id' and 'variant_id' (copy them from initial.csv)"
        raise InputError(f"{file.path}: {text}")
    columns = [file.read(name) for name in by]
    draw, variant = columns if len(by) == 2 else np.divmod(columns[0], asked.n_variants)
    place = np.minimum(np.searchsorted(asked.variants, variant), len(asked.variants) - 1)
    known = (asked.variants[place] == variant) & np.isin(draw, np.array(asked.draws))
    row = int(known.argmin())
    values = ", ".join(f"{column[row]:.12g}" for column in columns) if len(known) else ""
    text = f"no run of the export has this {' and '.join(by)} ({values}; see initial.csv)"
    file.refuse(~known, text)
    return np.asarray((draw - asked.draws.start) * len(asked.variants) + place, int)
