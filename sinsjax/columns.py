"""Every result column, with unit and type, and the version of their schema.

Two datasets come out of a study: ``summary`` with one row a run, and ``curves`` with one row a run
and record time. The keys that a study sweeps are columns of the summary too.
"""

from collections.abc import Iterable
from typing import Any, NamedTuple

import pyarrow as pa

from sinsjax.units import split_unit

SCHEMA_VERSION = "1"
"""Raised whenever a column changes its meaning or goes."""

STATUSES = ("ok", "not_settled", "diverged", "nonfinite")
"""How a run ended; the first that holds, and null without truth or reference.

nonfinite: the last attitude is no number (told without truth too). ok: it settled within
`ALWAYS_BAND_ARCMIN`, i.e. ``settle_10_s`` is not null. diverged: |phi_u - floor| >
`DIVERGED_DEG` at the end. not_settled: all others.
"""

ALWAYS_BAND_ARCMIN = 10.0
"""The band that decides a run's status; it is a column whatever the study's bands."""

DIVERGED_DEG = 10.0
"""A run that ends further than this from its floor in phi_u has diverged."""


class Column(NamedTuple):
    """A column: its name, type, unit and meaning."""

    name: str
    dtype: pa.DataType
    unit: str
    meaning: str


_F, _I, _S = pa.float64(), pa.int64(), pa.string()
_AXES = {"e": "east", "n": "north", "u": "up"}
_ANGLES = ("pitch", "roll", "yaw")


def _phi(prefix: str, meaning: str, suffix: str = "") -> tuple[Column, ...]:
    return tuple(
        Column(f"{prefix}_{a}{suffix}_arcmin", _F, "arcmin", f"{meaning} about {name}")
        for a, name in _AXES.items()
    )


def _euler(meaning: str, suffix: str = "") -> tuple[Column, ...]:
    return tuple(Column(f"{a}{suffix}_deg", _F, "deg", f"{meaning} {a}") for a in _ANGLES)


FIRED = (
    Column("triggered_count", _I, "", "resets that the trigger called for"),
    Column("triggered_first_s", _F, "s", "time of the first of them; null for none"),
    Column("triggered_last_s", _F, "s", "time of the last of them; null for none"),
)
"""Columns of what a trigger did, of a study that has one."""

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
    Column("phi_e0_deg", _F, "deg", "initial misalignment, as the study gives it, east"),
    Column("phi_n0_deg", _F, "deg", "initial misalignment, as the study gives it, north"),
    Column("phi_u0_deg", _F, "deg", "initial misalignment, as the study gives it, up"),
)
"""Columns that say which run a row is."""

OBSERVED = (
    *_phi("phi", "misalignment left in the corrected attitude"),
    *_phi("sigma", "the filter's own 1 sigma of that misalignment"),
    *_euler("corrected"),
)
"""Columns of one observation: the last one in the summary, all of them in the curves."""

JUDGED = (
    *_phi("phi", "window mean of the misalignment", "_mean"),
    *_phi("phi", "window standard deviation of the misalignment", "_std"),
    *_euler("window mean of", "_mean"),
    *_euler("window standard deviation of", "_std"),
    Column("floor_arcmin", _F, "arcmin", "limit of phi_u for the true constant biases"),
    Column("nees", _F, "", "phi' P^-1 phi at the end, 3 degrees of freedom"),
    Column("nis_u", _F, "", "(phi_u - floor)^2 / P_UU at the end"),
    Column("p_above_error_share", _F, "", "share of records with P_UU > phi_u^2"),
    Column("p_above_floor_error_share", _F, "", "share of records with P_UU > (phi_u - floor)^2"),
    Column("p_above_error_steady_share", _F, "", "share of steady records with P_UU > phi_u^2"),
    Column("status", _S, "", "ok, not_settled, diverged or nonfinite"),
)
"""Columns of a run's verdict; without truth or reference those that need it are null."""

CURVES = (RUN_ID, Column("time_s", _F, "s", "from the start of fine alignment"), *OBSERVED)
"""Columns of the curves dataset."""

PASSES = (
    Column("update_time_s", _F, "s", "updates so far times the sample time, passes and all"),
    Column("tape_time_s", _F, "s", "place on the tape, from its beginning"),
    Column("pass", _I, "", "number of the pass, from 1; odd ones are forward"),
)
"""Further columns of the curves where a tape is gone over more than once."""


def curves(*, passes: bool) -> tuple[Column, ...]:
    """Columns of the curves of a study with or without passes over a tape."""
    return (*CURVES, *(PASSES if passes else ()))


def settle_column(band_arcmin: float) -> Column:
    """The settling time of one band."""
    meaning = f"end of the last record interval with |phi_u - floor| > {band_arcmin:g} arcmin"
    return Column(f"settle_{band_arcmin:g}_s", _F, "s", f"{meaning}; null if never settled")


def settle_data_column(band_arcmin: float) -> Column:
    """The data that was there at the settling time of one band, where a tape is gone over again."""
    meaning = f"length of the tape that had been recorded by settle_{band_arcmin:g}_s"
    return Column(f"settle_{band_arcmin:g}_data_s", _F, "s", f"{meaning}; null if never settled")


def bands(study_bands: Iterable[float]) -> tuple[float, ...]:
    """A study's settle bands and the one that decides the status, arcmin."""
    return tuple(dict.fromkeys((*study_bands, ALWAYS_BAND_ARCMIN)))


def axis_column(key: str, values: Iterable[Any], meaning: str) -> Column:
    """The column of a swept key, typed by its values; its unit is in its name."""
    kinds = {type(value) for value in values if value is not None}
    if kinds == {bool}:
        dtype = pa.bool_()
    elif kinds <= {int, float}:
        dtype = _I if kinds == {int} else _F
    else:
        dtype = pa.list_(_F) if kinds & {tuple, list} else _S
    return Column(key, dtype, split_unit(key)[1], f"swept by the study: {meaning}")


def drawn_column(key: str, dimensions: int, meaning: str) -> Column:
    """The column of a key that has a value a draw: a number, or a list of them."""
    dtype = _F if dimensions == 1 else pa.list_(_F)
    return Column(key, dtype, split_unit(key)[1], f"drawn by the study: {meaning}")


def schema(columns: Iterable[Column]) -> pa.Schema:
    """Arrow schema with units and meanings as field metadata."""
    fields = [
        pa.field(c.name, c.dtype, metadata={"unit": c.unit, "meaning": c.meaning}) for c in columns
    ]
    return pa.schema(fields, metadata={"sinsjax.schema": SCHEMA_VERSION})
