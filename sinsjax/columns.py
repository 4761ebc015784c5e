"""The result columns, with units and types, and the version of their schema.

A study writes two datasets: ``summary`` with one row per run, and ``curves`` with one row
per run and record time. The keys that a study sweeps are also columns of the summary.
"""

from collections.abc import Iterable
from functools import lru_cache
from typing import Any, NamedTuple

import pyarrow as pa

from sinsjax.units import split_unit

SCHEMA_VERSION = "4"
"""Incremented whenever a column is removed or changes its meaning."""

STATUSES = ("ok", "not_settled", "diverged", "nonfinite", "no_north")
"""Outcomes of a run: the first that applies; null if there is no truth or bias floor.

nonfinite: the last attitude is not finite (detected even without truth). no_north: the run's level
gyro bias exceeds the level component of Earth rate, which shows north, or its method finds no
heading. ok: ``ok_truth`` or ``ok_floor``, according to the study's `judged_from`. diverged: the
last phi_u is further than the study's `diverged_deg` from its bias floor (from the truth if there
is none). not_settled: the rest.
"""

FAILED = ("diverged", "nonfinite")
"""The statuses that progress and verdicts count as failed."""


class Column(NamedTuple):
    """Name, type, unit and meaning of a column."""

    name: str
    dtype: pa.DataType
    unit: str
    meaning: str


_F, _I, _S = pa.float64(), pa.int64(), pa.string()


def column(name: str, meaning: str, dtype: pa.DataType = _F) -> Column:
    """Return a column, whose name ends in its unit."""
    return Column(name, dtype, split_unit(name)[1], meaning)


_ANGLES = ("pitch", "roll", "yaw")
_NO_HEADING = "; null for a method that finds no heading"
_AXES = {"e": "east", "n": "north", "u": f"up{_NO_HEADING}"}


def _misalignment_columns(prefix: str, meaning: str, suffix: str = "") -> tuple[Column, ...]:
    return tuple(
        column(f"{prefix}_{a}{suffix}_arcmin", f"{meaning} about {name}")
        for a, name in _AXES.items()
    )


def _euler_angle_columns(meaning: str, suffix: str = "") -> tuple[Column, ...]:
    return tuple(
        column(f"{a}{suffix}_deg", f"{meaning} {a}{_NO_HEADING if a == 'yaw' else ''}")
        for a in _ANGLES
    )


RUN_ID = column("run_id", "draw_id * variants + variant_id", _I)

IDENTITY = (
    RUN_ID,
    column("draw_id", "sensor realisation, or start time of a record", _I),
    column("variant_id", "point of the study's axes", _I),
    column("method", "alignment method", _S),
    column("reset_count", "number of resets", _I),
    column("reset_cycle_s", "time between resets; null for explicit times"),
    column("reset_times_s", "reset times", pa.list_(_F)),
    column("start_s", "start in the record, where coarse alignment begins"),
    column("phi_e0_deg", "initial misalignment about east, as given by the study"),
    column("phi_n0_deg", "initial misalignment about north, as given by the study"),
    column("phi_u0_deg", "initial misalignment about up, as given by the study"),
)
"""Columns that identify the run of a row."""

OBSERVED = (
    *_misalignment_columns("phi", "misalignment of the corrected attitude"),
    *_misalignment_columns("sigma", "the filter's own 1 sigma of the misalignment"),
    *_euler_angle_columns("corrected"),
    column("heading_deg", f"corrected heading, clockwise from north, 0 to 360: -yaw{_NO_HEADING}"),
)
"""Columns of one observation: the summary has the last observation, the curves have all of them."""

FLOOR = (
    column("has_floor", "whether phi_u has a bias floor under the run's biases", pa.bool_()),
    column(
        "floor_arcmin",
        "bias floor of phi_u under the run's constant biases, without its drift by the up gyro",
    ),
)
"""Columns of the bias floor, from which a heading may be judged."""

JUDGED = (
    *_misalignment_columns("phi", "window mean of the misalignment", "_mean"),
    *_misalignment_columns("phi", "window standard deviation of the misalignment", "_std"),
    *_euler_angle_columns("window mean of", "_mean"),
    *_euler_angle_columns("window standard deviation of", "_std"),
    *FLOOR,
    column("nees", "phi' P^-1 phi at the end, phi from the truth; 3 degrees of freedom"),
    column("nis_u", "(phi_u - floor)^2 / P_UU at the end"),
    column("p_above_error_share", "share of records with P_UU > phi_u^2"),
    column("p_above_floor_error_share", "share of records with P_UU > (phi_u - floor)^2"),
    column("p_above_error_steady_share", "share of steady records with P_UU > phi_u^2"),
    column(
        "ok_floor",
        "phi_u within the success band of its bias floor for the dwell time, final level errors"
        " small",
        pa.bool_(),
    ),
    column(
        "ok_truth",
        "phi_u within the success band of the truth for the dwell time, final level errors small",
        pa.bool_(),
    ),
    column("status", "ok (see judged_from), not_settled, diverged, no_north or nonfinite", _S),
)
"""Columns that judge a run; those that need a truth or reference are null without it."""

CURVES = (RUN_ID, column("time_s", "from the start of fine alignment"), *OBSERVED)
"""Columns of the curves dataset."""

PASSES = (
    column("update_time_s", "number of updates over all passes times the sample time"),
    column("stored_time_s", "position in the stored record, from its beginning"),
    column("pass", "number of the pass, from 1; odd passes run forward", _I),
)
"""Additional columns of the curves of repeated passes over a stored record."""


def curve_columns(*, passes: bool, coarse: bool = False) -> tuple[Column, ...]:
    """Return the columns of the curves, of runs with repeated passes or coarse alignment."""
    run_id, time_s, *observed = CURVES
    if coarse:
        time_s = time_s._replace(meaning="from the first sample of data")
    return (run_id, time_s, *observed, *(PASSES if passes else ()))


def settle_column(band_arcmin: float, *, truth: bool = False) -> Column:
    """The settling time into one band about a run's bias floor or about the truth."""
    error = "|phi_u|" if truth else "|phi_u - floor|"
    meaning = f"end of the last record interval with {error} > {band_arcmin:g} arcmin"
    name = f"settle_{band_arcmin:g}{'_truth' if truth else ''}_s"
    return column(name, f"{meaning}; null if never settled")


def settle_data_column(band_arcmin: float, *, truth: bool = False) -> Column:
    """The length of data recorded by the settling time of one band, which passes repeat."""
    settled = settle_column(band_arcmin, truth=truth).name
    meaning = f"length of data recorded by {settled}; null if never settled"
    return column(f"{settled.removesuffix('_s')}_data_s", meaning)


def report_time_columns(time_s: float) -> tuple[Column, Column, Column]:
    """Return heading error, its sigma and NEES at one of a study's report times."""
    at = f"{time_s:g}"
    return (
        column(f"phi_u_at_{at}_arcmin", f"phi_u_arcmin at {at} s of data"),
        column(f"sigma_u_at_{at}_arcmin", f"sigma_u_arcmin at {at} s of data"),
        column(f"nees_at_{at}", f"nees at {at} s of data; 3 degrees of freedom"),
    )


def axis_column(key: str, values: Iterable[Any], meaning: str) -> Column:
    """The column of a swept key, typed by its values; the key's name ends in its unit."""
    kinds = {type(value) for value in values if value is not None}
    if kinds == {bool}:
        dtype = pa.bool_()
    elif kinds <= {int, float}:
        dtype = _I if kinds == {int} else _F
    else:
        dtype = pa.list_(_F) if kinds & {tuple, list} else _S
    return column(key, f"swept by the study: {meaning}", dtype)


def drawn_column(key: str, dimensions: int, meaning: str) -> Column:
    """The column of a key drawn for each draw: a number, or a list of numbers."""
    dtype = _F if dimensions == 1 else pa.list_(_F)
    return column(key, f"drawn by the study: {meaning}", dtype)


@lru_cache(maxsize=8)  # needed for every chunk
def arrow_schema(columns: tuple[Column, ...]) -> pa.Schema:
    """Return the Arrow schema with units and meanings as field metadata."""
    fields = [
        pa.field(c.name, c.dtype, metadata={"unit": c.unit, "meaning": c.meaning}) for c in columns
    ]
    return pa.schema(fields, metadata={"sinsjax.schema": SCHEMA_VERSION})
