"""Columns of a study's result tables, and their rows from the engine's arrays.

Rows depend only on the study.
"""

from collections.abc import Iterable
from typing import Any

import numpy as np
import pyarrow as pa

from sinsjax import columns
from sinsjax.columns import Column
from sinsjax.engine.batch import Chunk
from sinsjax.engine.metrics import Observation
from sinsjax.engine.scenario import start_samples
from sinsjax.execution.success import (
    FLOOR,
    TRUTH,
    RunSuccess,
    evaluate_success,
    has_floor,
    last_scheduled_reset_s,
)
from sinsjax.methods.filters.keys import last_triggered_sample
from sinsjax.methods.method import Method, OwnColumn
from sinsjax.methods.registry import METHODS
from sinsjax.study.keys import COARSE_KEYS, key_meaning
from sinsjax.study.schema import NUMBERS_DRAWN
from sinsjax.study.study import Study
from sinsjax.study.success import settling_bands
from sinsjax.study.sweep import CodedColumn
from sinsjax.study.values import Variants, drawn_values
from sinsjax.units import ARCMIN, DEG

# --- columns --------------------------------------------------------------------------------------


def summary_columns(study: Study) -> tuple[Column, ...]:
    """Return the columns of the summary, in a time proportional to the total length of the axes."""
    kinds = [columns.settle_column]
    if study.passes or study.coarse_stages:
        kinds.append(columns.settle_data_column)
    return (
        *columns.IDENTITY,
        *_key_columns(study),
        *columns.OBSERVED,
        *(k(b, truth=t) for k in kinds for t in (False, True) for b in settling_bands(study)),
        *(column for t in study.report_times_s for column in columns.report_time_columns(t)),
        *columns.JUDGED,
        *(method_column.column for method_column in _method_columns(study).values()),
    )


def curve_columns(study: Study) -> tuple[Column, ...]:
    """Return the columns of the curves."""
    return columns.curve_columns(passes=study.passes is not None, coarse=bool(study.coarse_stages))


def _key_columns(study: Study) -> list[Column]:
    """Return the columns of swept and drawn keys, without those of every study."""
    swept = {key: values for dimension in study.dimensions for key, values in dimension.items()}
    found = [
        *(columns.axis_column(k, v, key_meaning(k)) for k, v in swept.items()),
        *(columns.drawn_column(k, NUMBERS_DRAWN[k], key_meaning(k)) for k in study.drawn_keys),
    ]
    known = {c.name for c in columns.IDENTITY}
    return [column for column in found if column.name not in known]


def _method_columns(study: Study) -> dict[str, OwnColumn]:
    """Return the columns specific to the study's methods, by name; methods may share a column."""
    methods, keys = [METHODS[n] for n in METHODS if n in study.methods], Variants.all_of(study)
    return {own.column.name: own for method in methods for own in method.own_columns(keys)}


def _variant_columns(study: Study, schema: Iterable[Column]) -> dict[str, pa.Array]:
    """Return the columns that the study determines, by name, (variants,), in the schema's types."""
    resets, cycle = study.schedules, study.coded().map(lambda _: None)
    if study.has("resets"):
        cycle = study.coded("reset_cycle_s")
    found = {
        **{key: study.coded(key) for key in study.axis_keys},
        "method": study.coded("method"),
        "reset_count": resets.map(len),
        "reset_cycle_s": cycle,
        "reset_times_s": resets.map(list),
        **{(key := f"phi_{a}0_deg"): study.coded(key) for a in "enu"},
    }
    types = {c.name: c.dtype for c in schema}
    names = found.keys() - {*study.drawn_keys}
    return {name: _expand_coded(found[name], types[name]) for name in names}


def _expand_coded(column: CodedColumn, dtype: pa.DataType) -> pa.Array:
    """Return the values of a key, one per variant; a number among lists applies to all axes."""
    codes, choices = column
    if pa.types.is_list(dtype):
        choices = tuple([v] if isinstance(v, int | float) else v for v in choices)
    return pa.array(choices, dtype).take(pa.array(codes))


# --- rows -----------------------------------------------------------------------------------------


class TableBuilder:
    """Conversion of a study's chunks to tables.

    Attributes:
        schemas: columns of the datasets in the order in which they are written: a row of the last
            one exists only if those of the others do.
    """

    def __init__(self, study: Study, *, has_truth: bool = True, curves: bool = False) -> None:
        """Prepare the columns that do not depend on the chunk.

        A record without a reference has no truth; columns that need one are null.
        """
        self._study, self._has_truth = study, has_truth
        self.schemas = {"curves": curve_columns(study)} if curves else {}
        self.schemas["summary"] = summary_columns(study)
        self._end_s, self._pass_s = study.spans_s.T
        self._last_reset_s = last_scheduled_reset_s(study)
        self._before_s = _data_before_start_s(study)
        self._by_variant = _variant_columns(study, self.schemas["summary"])
        self._keys, self._methods = Variants.all_of(study), study.coded("method")
        self._method_columns = _method_columns(study)
        self._start_s = np.zeros(study.n_draws)
        if study.record is not None:
            actual_s = start_samples(study, study.rate_hz) / study.rate_hz
            given_s = study.record.start_s
            # A rate of 99.9999999 Hz, from rounded stamps, must not move a start.
            self._start_s = np.where(np.abs(actual_s - given_s) < 1e-6, given_s, actual_s)

    def make_tables(self, chunk: Chunk, variant_ids: np.ndarray) -> dict[str, pa.Table]:
        """Return the tables of a chunk by dataset, see `summary_table`."""
        tables = {"summary": self.summary_table(chunk, variant_ids)}
        if "curves" in self.schemas:
            tables["curves"] = self._curve_table(chunk, variant_ids)
        return tables

    def summary_table(self, chunk: Chunk, variant_ids: np.ndarray) -> pa.Table:
        """Return the summary of a chunk, one row per run.

        ``variant_ids``, (variants of the program,), are their numbers in the study.
        """
        study, outcome, draw = self._study, chunk.outcome, chunk.draw
        variant = variant_ids[chunk.variant]
        codes, names = self._methods
        method = METHODS[names[codes[variant[0]]]]  # that of all runs of a chunk
        verdict = evaluate_success(
            study,
            outcome,
            self._floor_flags(chunk, variant),
            self._end_s[variant],
            has_truth=self._has_truth,
            finds_heading=method.finds_heading,
        )
        values = {
            "run_id": draw * study.n_variants + variant,
            "draw_id": draw,
            "variant_id": variant,
            "start_s": self._start_s[draw],
            "status": verdict.status,
            **{name: column.take(variant) for name, column in self._by_variant.items()},
            **self._drawn_values(draw),
            **self._method_values(chunk, method),
            **_attitude_values(outcome.last),
        }
        share, floor_share, steady_share = outcome.above_share
        errors = {
            **_error_values(outcome.last),
            **self._settling_times(verdict, variant),
            "p_above_error_share": share,
            "p_above_floor_error_share": np.where(verdict.has_floor, floor_share, np.nan),
            "p_above_error_steady_share": steady_share,
            "floor_arcmin": np.where(verdict.has_floor, outcome.floor.phi.z / ARCMIN, np.nan),
            "nis_u": np.where(verdict.has_floor, outcome.nis_u, np.nan),
            "nees": outcome.nees,
            "has_floor": verdict.has_floor,
            "ok_floor": pa.array(verdict.ok[FLOOR], mask=~verdict.has_floor),
            "ok_truth": verdict.ok[TRUTH],
        }
        for suffix, statistics in (("_mean", outcome.mean), ("_std", outcome.std)):
            for axis, value in zip("enu", statistics[:3], strict=True):
                errors[f"phi_{axis}{suffix}_arcmin"] = value / ARCMIN
            for angle, value in zip(("pitch", "roll", "yaw"), statistics[3:], strict=True):
                values[f"{angle}{suffix}_deg"] = value / DEG
        for number, time_s in enumerate(study.report_times_s):
            phi, sigma, nees = np.asarray(outcome.at_times)[:, number].T
            names_at = (column.name for column in columns.report_time_columns(time_s))
            phi_name, sigma_name, nees_name = names_at
            values[sigma_name] = sigma / ARCMIN
            errors |= {phi_name: phi / ARCMIN, nees_name: nees}
        return self._make_table("summary", values, errors)

    def _curve_table(self, chunk: Chunk, variant_ids: np.ndarray) -> pa.Table:
        """Return the curves of a chunk that has them, one row per run and record time."""
        study, curves = self._study, chunk.curves
        assert isinstance(curves, Observation)
        run_id = chunk.draw * study.n_variants + variant_ids[chunk.variant]
        codes, spans = study.lengths
        span = spans[codes[variant_ids[0]]]  # common to all variants of a program
        time_s = study.update_times(span)
        values = {"run_id": np.repeat(run_id, len(time_s)), "time_s": np.tile(time_s, len(run_id))}
        if study.passes:
            values["update_time_s"] = values["time_s"]
            values["stored_time_s"] = np.tile(study.stored_times(span), len(run_id))
            values["pass"] = np.tile(span.pass_numbers(), len(run_id))
        return self._make_table("curves", values | _attitude_values(curves), _error_values(curves))

    def _make_table(self, dataset: str, values: dict[str, Any], errors: dict[str, Any]) -> pa.Table:
        """Return a table of values, and of errors, which are null without a truth."""
        if not self._has_truth:
            errors = dict.fromkeys(errors, pa.nulls(len(values["run_id"])))
        arrays = {name: _to_column(value) for name, value in (values | errors).items()}
        return make_table(self.schemas[dataset], arrays)

    def _drawn_values(self, draw: np.ndarray) -> dict[str, Any]:
        """Return the drawn values of runs, by their draws."""
        first = int(draw.min())
        drawn = drawn_values(self._study, int(draw.max()) + 1 - first, first=first)
        rows = {name: values[draw - first] for name, values in drawn.items()}
        return {name: row if row.ndim == 1 else list(row) for name, row in rows.items()}

    def _method_values(self, chunk: Chunk, method: Method) -> dict[str, pa.Array]:
        """Return the columns specific to methods; those of other methods have no values."""
        own = {column.column.name for column in method.own_columns(self._keys)}
        values = {}
        for name, (column, value, missing, _) in self._method_columns.items():
            found = value(chunk.outcome.results, self._study.rate_hz) if name in own else missing
            array = np.broadcast_to(np.asarray(found, float), len(chunk.draw))
            values[name] = _to_column(array).cast(column.dtype)
        return values

    def _settling_times(self, verdict: RunSuccess, variant: np.ndarray) -> dict[str, np.ndarray]:
        """Return the settling times of all bands, about bias floor and truth, by column."""
        values = {}
        for criterion, truth in ((FLOOR, False), (TRUTH, True)):
            settled_by_band = verdict.settled_s[criterion]
            for band, settled in zip(settling_bands(self._study), settled_by_band, strict=True):
                values[columns.settle_column(band, truth=truth).name] = settled
                data_s = self._before_s[variant] + np.minimum(settled, self._pass_s[variant])
                values[columns.settle_data_column(band, truth=truth).name] = data_s
        return values

    def _floor_flags(self, chunk: Chunk, variant: np.ndarray) -> np.ndarray:
        """Return whether each run has a bias floor, given its last scheduled or triggered reset."""
        last_s = self._last_reset_s[variant]
        if (last_event := last_triggered_sample(chunk.outcome.results)) is not None:
            last_s = np.maximum(last_s, last_event / self._study.rate_hz)
        return has_floor(self._study, chunk.draw, variant, last_s)


def _data_before_start_s(study: Study) -> np.ndarray:
    """Return the length of record before t = 0, s, (variants,); zero if no variant counts it."""
    if not study.counts_before:
        return np.zeros(study.n_variants)
    column = study.coded(*COARSE_KEYS)
    return column.compute(lambda keys: study.samples_before(study.rate_hz, *keys)) / study.rate_hz


def _attitude_values(observation: Observation) -> dict[str, np.ndarray]:
    """Return attitude, heading and the filter's 1 sigma of an observation by column."""
    angles = {"pitch": observation.pitch, "roll": observation.roll, "yaw": observation.yaw}
    values = {f"{name}_deg": np.asarray(value) / DEG for name, value in angles.items()}
    # Twice, because a tiny negative angle is rounded to 360.
    values["heading_deg"] = np.mod(np.mod(-values["yaw_deg"], 360.0), 360.0)
    sigmas = zip("enu", observation.sigma, strict=True)
    return values | {f"sigma_{axis}_arcmin": sigma / ARCMIN for axis, sigma in sigmas}


def _error_values(observation: Observation) -> dict[str, Any]:
    """Return the misalignment of an observation by column."""
    phi = zip("enu", observation.phi, strict=True)
    return {f"phi_{axis}_arcmin": value / ARCMIN for axis, value in phi}


def _to_column(values: Any) -> Any:
    """Return values of any shape as a column; numbers that are not finite are null."""
    if isinstance(values, list | pa.Array):
        return values
    flat = np.asarray(values).ravel()
    return pa.array(flat, mask=~np.isfinite(flat)) if flat.dtype.kind == "f" else pa.array(flat)


def replace_column(table: pa.Table, name: str, values: pa.Array) -> pa.Table:
    """Return a table with new values in a column, cast to its type."""
    index, field = table.column_names.index(name), table.schema.field(name)
    return table.set_column(index, field, values.cast(field.type))


def make_table(table_columns: tuple[Column, ...], values: dict[str, Any]) -> pa.Table:
    """Return a table of some columns, from their values by name."""
    arrays = [pa.array(values[c.name]).cast(c.dtype) for c in table_columns]
    return pa.Table.from_arrays(arrays, schema=columns.arrow_schema(table_columns))
