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
Lines of a Parquet file are entries of its metadata. Other columns are ignored.
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
from sinsjax.arena.runs import ProgramRuns
from sinsjax.errors import InputError
from sinsjax.messages import shorten, to_one_line
from sinsjax.platform.files import read_regular_file
from sinsjax.study.identity import fingerprint
from sinsjax.types import Quat
from sinsjax.units import DEG

_ANGLES = ["pitch_deg", "roll_deg", "yaw_deg"]
_SIGMAS = [f"sigma_{name}" for name in _ANGLES]
_QUATERNION = ["q_w", "q_x", "q_y", "q_z"]
_IDS = ["run_id", "draw_id", "variant_id"]
_NUMBERS = [*_IDS, "time_s", *_ANGLES, *_QUATERNION, *_SIGMAS]
_TYPES = dict.fromkeys(_NUMBERS, pa.float64()) | {"study": pa.string()}
_HEADER_LINE = r"\s*[#%]\s*(study|frame)\s*[=:]\s*[\"']?([^\s\"',]+)"
_LENGTH_TOLERANCE = 0.01
_LARGEST_DEG = 1e6
_HEADER_BYTES = 2**16


class GivenResults(NamedTuple):
    """Rows of a results file, by run and time.

    Attributes:
        run: (rows,) place of the run among those of the program.
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


def read_results(
    path: Path, runs: ProgramRuns, export_frame: str, frame: str | None = None
) -> GivenResults:
    """Read a file of results.

    Args:
        path: CSV or Parquet file.
        runs: the exported runs.
        export_frame: frame of the export.
        frame: of the attitudes; None for that of the file or the export.

    Returns:
        The rows, by run and time.

    Raises:
        InputError: the file cannot be read or is cut off; it is of another study; a column is
            missing; a run is unknown, repeated or ends too late; or a value is no number.
    """
    table, first_row = _read_table(path)
    names, lines = table.column_names, table.schema.metadata or {}

    def refuse(rows: NDArray, text: str) -> None:
        if rows.any():
            raise InputError(f"{path}: row {first_row + int(rows.argmax())}: {text}")

    def read(*columns: str) -> NDArray:
        numbers = np.stack([table[name].to_numpy() for name in columns], axis=-1)
        text = "is not finite (leave the row out: a run without one at its end counts as a failure)"
        for column, name in zip(numbers.T, columns, strict=True):
            refuse(~np.isfinite(column), f"column '{name}': {text}")
        return numbers

    digest = fingerprint(runs.source)
    found = {lines[b"study"].decode()} if b"study" in lines else set()
    found |= {*map(str, table["study"].unique().to_pylist())} if "study" in names else set()
    if {text.lower() for text in found} != {digest}:
        shown = shorten(to_one_line(", ".join(sorted(found)) or "none"), 40)
        text = f"is of another study: digest {shown} there, {digest} exported"
        raise InputError(f"{path}: {text} (column 'study', or a first line '# study = {digest}')")
    frames = {f.lower() for f in (frame, lines.get(b"frame", b"").decode()) if f} or {export_frame}
    if len(frames) > 1 or not frames <= {*FRAMES}:
        text = f"give one of {', '.join(FRAMES)}, in a line '# frame = ...' or by --frame"
        raise InputError(f"{path}: frame: {to_one_line(' and '.join(sorted(frames)))!r} ({text})")
    attitude = _QUATERNION if "q_w" in names else _ANGLES
    ids = _IDS[:1] if "run_id" in names else _IDS[1:]
    if missing := [name for name in (*ids, "time_s", *attitude) if name not in names]:
        text = f"lacks {', '.join(missing)} (README.txt in the export lists the columns)"
        raise InputError(f"{path}: {text}")
    if attitude == _QUATERNION and {*_ANGLES} & {*names}:
        raise InputError(f"{path}: has both angles and quaternions (keep one)")

    known = [runs.run_id] if len(ids) == 1 else np.divmod(runs.run_id, runs.source.n_variants)
    place = {key: i for i, key in enumerate(zip(*(a.tolist() for a in known), strict=True))}
    run = np.array([place.get(tuple(key), -1) for key in read(*ids).tolist()], int)
    which = " and ".join(ids)
    refuse(run < 0, f"no run of the export has this {which} (see initial.csv)")
    time_s, end_s, half = read("time_s")[:, 0], runs.end_s, 0.5 / runs.source.rate_hz
    refuse((time_s < 0) | (time_s > end_s + half), f"time_s is beyond its run, 0 to {end_s:.12g} s")
    order = np.lexsort((time_s, run))
    repeated = np.zeros(len(run), bool)
    repeated[order[1:]] = (np.diff(run[order]) == 0) & (np.diff(time_s[order]) < half)
    refuse(repeated, f"repeats its {which} and time_s")
    sigma = np.full((len(run), 3), np.nan)
    for i, name in enumerate(_SIGMAS):
        if name in names:
            sigma[:, i] = read(name)[:, 0] * DEG
            refuse(sigma[:, i] <= 0, f"{name} must be above 0")
    values = read(*attitude)
    if attitude == _QUATERNION:
        off = np.abs(np.linalg.norm(values, axis=-1) - 1) > _LENGTH_TOLERANCE
        refuse(off, f"{', '.join(_QUATERNION)} is no unit quaternion")
    else:
        large = (np.abs(values) > _LARGEST_DEG).any(axis=-1)
        refuse(large, f"an angle is beyond {_LARGEST_DEG:g} deg")
        values = values * DEG
    return GivenResults(run, time_s, values, sigma, frames.pop()).select(order)


def _read_table(path: Path) -> tuple[pa.Table, int]:
    """Read the known columns of a file, and the number of their first row.

    The lines of its header are metadata of the table.

    Raises:
        InputError: it is no regular file, no table, or repeats a line or column of its header.
    """
    try:
        content = read_regular_file(path.resolve())
    except FileNotFoundError:
        raise InputError(f"{path}: there is no such file") from None
    try:
        if content.startswith(b"PAR1"):
            table, first_row = pq.read_table(pa.BufferReader(content)), 1
            header = table.schema.metadata
        else:
            lines = content[:_HEADER_BYTES].decode("utf-8-sig", errors="replace").splitlines()
            comments = next((n for n, line in enumerate(lines) if line.strip()[:1] not in "#%"), 0)
            matches = [re.match(_HEADER_LINE, line) for line in lines[:comments]]
            entries = [(match[1], match[2]) for match in matches if match]
            names = [name.strip() for name in next(csv.reader(lines[comments : comments + 1]), [])]
            listed = [*(f"# {key} =" for key, _ in entries), *names]
            if repeated := [name for name in listed if listed.count(name) > 1]:
                text = f"repeats {to_one_line(repeated[0])!r} in its header (keep one)"
                raise InputError(f"{path}: {text}")
            options = pa.csv.ReadOptions(
                use_threads=False,  # for messages with the number of the row
                column_names=names,
                skip_rows=comments + 1,
            )
            convert = pa.csv.ConvertOptions(
                column_types=_TYPES, include_columns=[name for name in names if name in _TYPES]
            )
            table = pa.csv.read_csv(io.BytesIO(content), options, convert_options=convert)
            first_row, header = comments + 2, dict(entries)
        schema = pa.schema([(n, _TYPES[n]) for n in table.column_names if n in _TYPES], header)
        return table.select(schema.names).cast(schema), first_row
    except (pa.ArrowException, UnicodeDecodeError) as error:
        raise InputError(f"{path}: {shorten(to_one_line(str(error)), 200)}") from None
