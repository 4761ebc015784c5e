"""Reading the results of a program outside sinsjax: a row per run and time, with fixed columns.

README.txt of an export lists the columns; their names are in the first line, others are ignored.
Results may be in another convention than they should be: read again with the yaw mirrored or turned
by quarter turns, in radians, or with quaternions inverted or with their scalar last, they are then
much nearer to the truth.
"""

import io
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet as pq
from numpy.typing import NDArray

from sinsjax.arena.frames import from_angles, from_quaternion, to_angles, to_quaternion
from sinsjax.arena.runs import ProgramRuns
from sinsjax.errors import InputError
from sinsjax.maths.rotations import correct, misalignment
from sinsjax.messages import shorten, to_one_line
from sinsjax.platform.files import read_regular_file
from sinsjax.study.identity import fingerprint
from sinsjax.types import Quat, Vec3
from sinsjax.units import ARCMIN, DEG

_ANGLES = ["pitch_deg", "roll_deg", "yaw_deg"]
_SIGMAS = [f"sigma_{name}" for name in _ANGLES]
_QUATERNION = ["q_w", "q_x", "q_y", "q_z"]
_TYPES = {"study": pa.string()} | dict.fromkeys(
    ["run_id", "time_s", *_ANGLES, *_QUATERNION, *_SIGMAS], pa.float64()
)
_LENGTH_TOLERANCE = 0.01
_LARGEST_DEG = 1e6

_LEAST = 30 * ARCMIN
"""Median misalignment from which another reading is suspected, rad."""

_BETTER, _MUCH_BETTER = 0.25, 0.1
"""Largest share of it that a suspected reading has; the second where it is still bad."""

_YAWS = {
    "is yaw mirrored (positive the other way round)": (-1, 0.0),
    **{f"is yaw off by {turn} deg": (1, turn) for turn in (90, -90, 180)},
    "is yaw mirrored and from east": (-1, 90.0),
}
"""Signs of yaw, and turns, deg."""

_QUATERNIONS = {
    "is the scalar of the quaternions last": ([3, 0, 1, 2], 1),
    "are the quaternions from navigation to body axes": ([0, 1, 2, 3], -1),
    "is the scalar of the quaternions, from navigation to body axes, last": ([3, 0, 1, 2], -1),
}
"""Orders of quaternions, and the sign of their vectors."""


class GivenResults(NamedTuple):
    """Rows of a results file.

    Attributes:
        run: (rows,) place of the run in `ProgramRuns.run_id`, flat.
        time_s: (rows,).
        attitude: from b to n, leaves (rows,).
        sigma: (rows, 3) 1 sigma of pitch, roll and yaw, rad; NaN if not given.
        frame: of the file, see `arena.frames`.
        has_quaternions: whether the file has quaternions, not angles.
    """

    run: NDArray
    time_s: NDArray
    attitude: Quat
    sigma: NDArray
    frame: str
    has_quaternions: bool


def read_results(path: Path, runs: ProgramRuns, frame: str) -> GivenResults:
    """Read a file of results in the frame of their export.

    Raises:
        InputError: the file cannot be read or is cut off; it is of another study; a column is
            missing or repeated; a run is unknown, repeated or ends too late; or a value is no
            number.
    """
    table, first_row = _read_table(path)
    names, digest = table.column_names, fingerprint(runs.source)

    def refuse(rows: NDArray, text: str) -> None:
        if rows.any():
            raise InputError(f"{path}: row {first_row + int(rows.argmax())}: {text}")

    def read(name: str) -> NDArray:
        column = table[name].to_numpy()
        text = "is not finite (leave the row out: a run without one at its end counts as a failure)"
        refuse(~np.isfinite(column), f"column '{name}': {text}")
        return column

    has_quaternions = "q_w" in names
    attitude = _QUATERNION if has_quaternions else _ANGLES
    if missing := [n for n in ("study", "run_id", "time_s", *attitude) if n not in names]:
        text = f"lacks {', '.join(missing)} in its first line (as in initial.csv; see README.txt)"
        raise InputError(f"{path}: {text}")
    found = [str(text) for text in table["study"].unique().to_pylist()]
    if found != [digest]:
        shown = shorten(to_one_line(", ".join(found) or "none"), 40)
        text = f"is of another study: digest {shown} there, {digest} exported"
        raise InputError(f"{path}: {text} (column 'study')")
    place = {run_id: i for i, run_id in enumerate(runs.run_id.ravel().tolist())}
    run = np.array([place.get(run_id, -1) for run_id in read("run_id").tolist()])
    refuse(run < 0, "no run of the export has this run_id (see initial.csv)")
    time_s, end_s, half = read("time_s"), runs.end_s, 0.5 / runs.source.rate_hz
    refuse((time_s < 0) | (time_s > end_s + half), f"time_s is beyond its run, 0 to {end_s:.12g} s")
    order, repeated = np.lexsort((time_s, run)), np.zeros(len(run), bool)
    repeated[order[1:]] = (np.diff(run[order]) == 0) & (np.diff(time_s[order]) < half)
    refuse(repeated, "repeats its run_id and time_s")
    sigma = np.full((len(run), 3), np.nan)
    for i, name in enumerate(_SIGMAS):
        if name in names:
            sigma[:, i] = read(name) * DEG
            refuse(sigma[:, i] <= 0, f"{name} must be above 0")
    values = np.stack([*map(read, attitude)], axis=-1)
    if has_quaternions:
        off = np.abs(np.linalg.norm(values, axis=-1) - 1) > _LENGTH_TOLERANCE
        refuse(off, f"{', '.join(_QUATERNION)} is no unit quaternion")
        q = from_quaternion(values, frame)
    else:
        large = (np.abs(values) > _LARGEST_DEG).any(axis=-1)
        refuse(large, f"an angle is beyond {_LARGEST_DEG:g} deg")
        q = from_angles(values * DEG, frame)
    return GivenResults(run, time_s, q, sigma, frame, has_quaternions)


def _read_table(path: Path) -> tuple[pa.Table, int]:
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
        known = [name for name in table.column_names if name in _TYPES]
        if repeated := [name for name in known if known.count(name) > 1]:
            raise InputError(f"{path}: repeats column '{repeated[0]}' (keep one)")
        return table.select(known).cast(pa.schema([(n, _TYPES[n]) for n in known])), first_row
    except FileNotFoundError:
        raise InputError(f"{path}: there is no such file") from None
    except (pa.ArrowException, UnicodeDecodeError) as error:
        raise InputError(f"{path}: {shorten(to_one_line(str(error)), 200)}") from None


def suspect(given: GivenResults, rows: NDArray, phi: NDArray) -> str | None:
    """Return the convention that results seem to have, in a sentence; None without a suspicion.

    Args:
        given: results.
        rows: last row of each run.
        phi: (rows, 3) misalignment there, rad.
    """
    as_given, found = Quat(*(part[rows] for part in given.attitude)), []
    q_true, error = jax.vmap(correct)(Vec3(*phi.T), as_given), _median_length(phi)
    for words, attitude in _iter_readings(as_given, given.frame, given.has_quaternions):
        now = _median_length(np.stack(jax.vmap(misalignment)(q_true, attitude), axis=-1))
        if error > _LEAST and now <= min(_BETTER * error, max(DEG, _MUCH_BETTER * error)):
            found.append((now, words))
    if not found:
        return None
    now, words = min(found)
    text = f"the median error is {now / ARCMIN:.3g} arcmin instead of {error / ARCMIN:.3g}"
    return f"{words}? Read so, {text}"


def _median_length(phi: NDArray) -> float:
    return float(np.median(np.linalg.norm(phi, axis=-1)))


def _iter_readings(as_given: Quat, frame: str, has_quaternions: bool) -> Iterator[tuple[str, Quat]]:
    """Yield other readings of attitudes: what they suppose, in words, and attitudes."""
    angles = to_angles(as_given, frame)
    if has_quaternions:
        for words, (order, sign) in _QUATERNIONS.items():
            values = to_quaternion(as_given, frame)[:, order] * [1, sign, sign, sign]
            yield words, from_quaternion(values, frame)
    else:
        yield "are the angles in radians", from_angles(angles / DEG, frame)
    for words, (sign, turn) in _YAWS.items():
        pitch, roll, yaw = angles.T
        yaw = sign * (yaw - turn * DEG)
        yield words, from_angles(np.stack([pitch, roll, yaw], axis=-1), frame)
