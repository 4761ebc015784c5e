"""A reference attitude, against which a recorded study can be judged."""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from sinsjax.records.layout import FloatArray
from sinsjax.records.tables import open_csv, open_parquet
from sinsjax.types import InputError

_SIGMAS = ("sigma_e_deg", "sigma_n_deg", "sigma_u_deg")


class Reference(NamedTuple):
    """A reference attitude at M times.

    Attributes:
        time_s: (M,) increasing, from the record's beginning, s.
        attitude_deg: (M, 3) pitch, roll and yaw (counter-clockwise from north), deg.
        sigma_deg: (M, 3) standard deviations about east, north and up, deg; None if not given.
        source: the file's name, for messages.
    """

    time_s: FloatArray
    attitude_deg: FloatArray
    sigma_deg: FloatArray | None
    source: str = "reference"


def read_reference(path: str | Path) -> Reference:
    """Reads a reference attitude from Parquet (a name that ends so) or comma-separated text.

    Columns: time_s, pitch_deg, roll_deg, yaw_deg or yaw_ccw_deg (one of the two; both mean
    counter-clockwise from north), and sigma_e_deg, sigma_n_deg, sigma_u_deg (all three or none).

    Args:
        path: the file.

    Returns:
        The reference.

    Raises:
        InputError: the file cannot be read, a column is missing or a value is wrong; the line names
            the column and the row.
    """
    table = open_parquet(path) if Path(path).suffix.lower() == ".parquet" else open_csv(path)
    yaws = [name for name in ("yaw_deg", "yaw_ccw_deg") if name in table.names]
    if len(yaws) == 2:
        raise InputError(f"{path}: yaw_deg and yaw_ccw_deg are both there; leave one out")
    sigmas = _SIGMAS if any(name in table.names for name in _SIGMAS) else ()
    values = table.read(["time_s", "pitch_deg", "roll_deg", *(yaws or ["yaw_deg"]), *sigmas])
    time_s, attitude, sigma = values[:, 0], values[:, 1:4], values[:, 4:]
    faults = (
        (np.diff(time_s, prepend=-np.inf) <= 0, "time_s does not increase"),
        (np.abs(attitude[:, 0]) > 90, "pitch_deg is beyond 90"),
        ((sigma < 0).any(axis=1), "a sigma is negative"),
    )
    for bad, text in faults:
        if bad.any():
            raise InputError(f"{path}: row {table.row(int(bad.argmax()))}: {text}")
    if len(time_s) < 2:
        raise InputError(f"{path}: a reference needs at least two rows")
    return Reference(time_s, attitude, sigma if sigmas else None, str(path))
