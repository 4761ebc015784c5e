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

SUCCESS_BAND_ARCMIN = 10.0
"""Default band within which the heading and level errors of a successful run end."""

DIVERGED_DEG = 10.0
"""Default final distance of phi_u from its bias floor beyond which a run has diverged."""


class Column(NamedTuple):
    """Name, type, unit and meaning of a column."""

    name: str
    dtype: pa.DataType
    unit: str
    meaning: str


_F, _I, _S = pa.float64(), pa.int64(), pa.string()
_AXES = {"e": "east", "n": "north", "u": "up"}
_ANGLES = ("pitch", "roll", "yaw")
_NO_HEADING = "; null for a method that finds no heading"


def _misalignment_columns(
    prefix: str, meaning: str, suffix: str = "", *, up: str = ""
) -> tuple[Column, ...]:
    return tuple(
        Column(
            f"{prefix}_{a}{suffix}_arcmin",
            _F,
            "arcmin",
            f"{meaning} about {name}{up if a == 'u' else ''}",
        )
        for a, name in _AXES.items()
    )


def _euler_angle_columns(meaning: str, suffix: str = "") -> tuple[Column, ...]:
    return tuple(
        Column(f"{a}{suffix}_deg", _F, "deg", f"{meaning} {a}{_NO_HEADING if a == 'yaw' else ''}")
        for a in _ANGLES
    )


RUN_ID = Column("run_id", _I, "", "draw_id * variants + variant_id")

IDENTITY = (
    RUN_ID,
    Column("draw_id", _I, "", "sensor realisation, or start time of a record"),
    Column("variant_id", _I, "", "point of the study's axes"),
    Column("method", _S, "", "alignment method"),
    Column("reset_count", _I, "", "number of resets"),
    Column("reset_cycle_s", _F, "s", "time between resets; null for explicit times"),
    Column("reset_times_s", pa.list_(_F), "s", "reset times"),
    Column("start_s", _F, "s", "start in the record, where coarse alignment begins"),
    Column("phi_e0_deg", _F, "deg", "initial misalignment about east, as given by the study"),
    Column("phi_n0_deg", _F, "deg", "initial misalignment about north, as given by the study"),
    Column("phi_u0_deg", _F, "deg", "initial misalignment about up, as given by the study"),
)
"""Columns that identify the run of a row."""

PREDICTED = Column(
    "predicted_settle_s",
    _F,
    "s",
    "settling time that the law of resets predicts for a median run from this misalignment; null"
    " where it says nothing",
)
"""Column of a study whose resets have a schedule by name."""

OBSERVED = (
    *_misalignment_columns("phi", "misalignment of the corrected attitude", up=_NO_HEADING),
    *_misalignment_columns("sigma", "the filter's own 1 sigma of the misalignment", up=_NO_HEADING),
    *_euler_angle_columns("corrected"),
    Column(
        "heading_deg",
        _F,
        "deg",
        f"corrected heading, clockwise from north, 0 to 360: -yaw{_NO_HEADING}",
    ),
)
"""Columns of one observation: the summary has the last observation, the curves have all of them."""

FLOOR = (
    Column("has_floor", pa.bool_(), "", "whether phi_u has a bias floor under the run's biases"),
    Column(
        "floor_arcmin",
        _F,
        "arcmin",
        "bias floor of phi_u under the run's constant biases, without its drift by the up gyro",
    ),
)
"""Columns of the bias floor, from which a heading may be judged."""

JUDGED = (
    *_misalignment_columns("phi", "window mean of the misalignment", "_mean", up=_NO_HEADING),
    *_misalignment_columns(
        "phi", "window standard deviation of the misalignment", "_std", up=_NO_HEADING
    ),
    *_euler_angle_columns("window mean of", "_mean"),
    *_euler_angle_columns("window standard deviation of", "_std"),
    *FLOOR,
    Column("nees", _F, "", "phi' P^-1 phi at the end, phi from the truth; 3 degrees of freedom"),
    Column("nis_u", _F, "", "(phi_u - floor)^2 / P_UU at the end"),
    Column("p_above_error_share", _F, "", "share of records with P_UU > phi_u^2"),
    Column("p_above_floor_error_share", _F, "", "share of records with P_UU > (phi_u - floor)^2"),
    Column("p_above_error_steady_share", _F, "", "share of steady records with P_UU > phi_u^2"),
    Column(
        "ok_floor",
        pa.bool_(),
        "",
        "phi_u within the success band of its bias floor for the dwell time, final level errors"
        " small",
    ),
    Column(
        "ok_truth",
        pa.bool_(),
        "",
        "phi_u within the success band of the truth for the dwell time, final level errors small",
    ),
    Column("status", _S, "", "ok (see judged_from), not_settled, diverged, no_north or nonfinite"),
)
"""Columns that judge a run; those that need a truth or reference are null without it."""

CURVES = (RUN_ID, Column("time_s", _F, "s", "from the start of fine alignment"), *OBSERVED)
"""Columns of the curves dataset."""

PASSES = (
    Column("update_time_s", _F, "s", "number of updates over all passes times the sample time"),
    Column("stored_time_s", _F, "s", "position in the stored record, from its beginning"),
    Column(
        "pass",
        _I,
        "",
        "number of the pass, from 1; odd passes run forward",
    ),
)
"""Additional columns of the curves of repeated passes over a stored record."""


def curve_columns(*, passes: bool, coarse: bool = False) -> tuple[Column, ...]:
    """Return the columns of the curves.

    Args:
        passes: whether to include those of repeated passes.
        coarse: whether runs begin with coarse alignment.
    """
    run_id, time_s, *observed = CURVES
    if coarse:
        time_s = time_s._replace(meaning="from the first sample of data")
    return (run_id, time_s, *observed, *(PASSES if passes else ()))


def settle_column(band_arcmin: float, *, truth: bool = False) -> Column:
    """The settling time into one band about a run's bias floor or about the truth."""
    error = "|phi_u|" if truth else "|phi_u - floor|"
    meaning = f"end of the last record interval with {error} > {band_arcmin:g} arcmin"
    name = f"settle_{band_arcmin:g}{'_truth' if truth else ''}_s"
    return Column(name, _F, "s", f"{meaning}; null if never settled")


def settle_data_column(band_arcmin: float, *, truth: bool = False) -> Column:
    """The length of data recorded by the settling time of one band.

    It differs from the settling time with repeated passes and with coarse alignment.
    """
    settled = settle_column(band_arcmin, truth=truth).name
    meaning = f"length of data recorded by {settled}; null if never settled"
    return Column(f"{settled.removesuffix('_s')}_data_s", _F, "s", meaning)


def report_time_columns(time_s: float) -> tuple[Column, Column, Column]:
    """Return heading error, its sigma and NEES at one of a study's report times."""
    at = f"{time_s:g}"
    return (
        Column(f"phi_u_at_{at}_arcmin", _F, "arcmin", f"phi_u_arcmin at {at} s of data"),
        Column(f"sigma_u_at_{at}_arcmin", _F, "arcmin", f"sigma_u_arcmin at {at} s of data"),
        Column(f"nees_at_{at}", _F, "", f"nees at {at} s of data; 3 degrees of freedom"),
    )


INFORMATION_BOUND = (
    Column("variant_id", _I, "", "point of the study's axes"),
    CURVES[1],
    Column("bound_u_arcmin", _F, "arcmin", "least 1 sigma of phi_u of any unbiased estimator"),
)
"""Columns of `sinsjax.information_bound`."""


def settling_bands(
    study_bands: Iterable[float], success_band: float | None = None
) -> tuple[float, ...]:
    """A study's settling bands, including its success band, arcmin."""
    decisive = SUCCESS_BAND_ARCMIN if success_band is None else success_band
    return tuple(dict.fromkeys((*study_bands, decisive)))


def axis_column(key: str, values: Iterable[Any], meaning: str) -> Column:
    """The column of a swept key, typed by its values; the key's name ends in its unit."""
    kinds = {type(value) for value in values if value is not None}
    if kinds == {bool}:
        dtype = pa.bool_()
    elif kinds <= {int, float}:
        dtype = _I if kinds == {int} else _F
    else:
        dtype = pa.list_(_F) if kinds & {tuple, list} else _S
    return Column(key, dtype, split_unit(key)[1], f"swept by the study: {meaning}")


def drawn_column(key: str, dimensions: int, meaning: str) -> Column:
    """The column of a key drawn for each draw: a number, or a list of numbers."""
    dtype = _F if dimensions == 1 else pa.list_(_F)
    return Column(key, dtype, split_unit(key)[1], f"drawn by the study: {meaning}")


@lru_cache(maxsize=8)  # needed for every chunk
def arrow_schema(columns: tuple[Column, ...]) -> pa.Schema:
    """Return the Arrow schema with units and meanings as field metadata."""
    fields = [
        pa.field(c.name, c.dtype, metadata={"unit": c.unit, "meaning": c.meaning}) for c in columns
    ]
    return pa.schema(fields, metadata={"sinsjax.schema": SCHEMA_VERSION})
