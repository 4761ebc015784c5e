"""Conversion of the engine's arrays to result tables; rows depend only on the study."""

from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from sinsjax import columns
from sinsjax.columns import Column
from sinsjax.engine.batch import Chunk
from sinsjax.engine.metrics import Observation, Outcome
from sinsjax.engine.scenario import start_samples
from sinsjax.execution import schemas
from sinsjax.execution.success import (
    FLOOR,
    TRUTH,
    RunSuccess,
    evaluate_success,
    has_floor,
    last_scheduled_reset_s,
)
from sinsjax.methods.filters.keys import last_triggered_sample
from sinsjax.methods.method import Method
from sinsjax.methods.registry import METHODS
from sinsjax.study import sampling
from sinsjax.study.keys import COARSE_KEYS
from sinsjax.study.study import Study
from sinsjax.study.success import settling_bands
from sinsjax.study.variants import Variants
from sinsjax.units import ARCMIN, DEG


class TableBuilder:
    """Conversion of a study's chunks to tables.

    Attributes:
        schemas: columns of the datasets in the order in which they are written: a row of the last
            one exists only if those of the others do.
    """

    def __init__(self, study: Study, *, has_truth: bool = True, curves: bool = False) -> None:
        """Prepare the columns that do not depend on the chunk.

        Args:
            study: checked study.
            has_truth: False for a record without a reference; columns that need one are null.
            curves: whether the chunks have curves.
        """
        self._study = study
        self._has_truth = has_truth
        self._bands = settling_bands(study)
        self._end_s, self._pass_s = study.spans_s.T
        self._last_reset_s = last_scheduled_reset_s(study)
        self.summary_columns = schemas.summary_columns(study)
        self.curve_columns = schemas.curve_columns(study)
        self.schemas = {"curves": self.curve_columns} if curves else {}
        self.schemas["summary"] = self.summary_columns
        self._has_data_columns = schemas.has_data_columns(study)
        self._data_before_start_s = _data_before_start_s(study)
        self._by_variant = schemas.variant_columns(study, self.summary_columns)
        self._keys = Variants.all_of(study)
        self._methods = study.coded("method")
        self._method_columns = schemas.method_columns(study)
        self._start_s = np.zeros(study.n_draws)
        if study.is_recorded:
            assert study.record is not None
            actual_s, given_s = (
                start_samples(study, study.rate_hz) / study.rate_hz,
                study.record.start_s,
            )
            # A rate of 99.9999999 Hz, from rounded stamps, must not move a start.
            self._start_s = np.where(np.abs(actual_s - given_s) < 1e-6, given_s, actual_s)

    def make_tables(self, chunk: Chunk, variant_ids: np.ndarray) -> dict[str, pa.Table]:
        """Return the tables of a chunk by dataset; the arguments are those of `summary_table`."""
        tables = {"summary": self.summary_table(chunk, variant_ids)}
        if "curves" in self.schemas:
            tables["curves"] = self.curve_table(chunk, variant_ids)
        return tables

    def summary_table(self, chunk: Chunk, variant_ids: np.ndarray) -> pa.Table:
        """Return the summary of a chunk, one row per run.

        Args:
            chunk: engine results.
            variant_ids: (variants of the part,) their numbers in the study.
        """
        variant = variant_ids[chunk.variant]
        outcome = chunk.outcome
        values: dict[str, Any] = {
            "run_id": chunk.draw * self._study.n_variants + variant,
            "draw_id": chunk.draw,
            "variant_id": variant,
            "start_s": self._start_s[chunk.draw],
        }
        values |= {name: column.take(variant) for name, column in self._by_variant.items()}
        first = int(chunk.draw.min())
        drawn = sampling.drawn_values(self._study, int(chunk.draw.max()) + 1 - first, first=first)
        for name, column in drawn.items():
            drawn_values = column[chunk.draw - first]
            values[name] = drawn_values if drawn_values.ndim == 1 else list(drawn_values)
        values |= self._angle_columns(outcome.last)
        verdict = evaluate_success(
            self._study,
            outcome,
            self._floor_flags(chunk, variant),
            self._end_s[variant],
            has_truth=self._has_truth,
            finds_heading=self._chunk_method(variant).finds_heading,
        )
        values |= self._settling_columns(
            verdict, self._pass_s[variant], self._data_before_start_s[variant]
        )
        values |= self._report_time_columns(outcome)
        for suffix, statistics in (("_mean", outcome.mean), ("_std", outcome.std)):
            for axis, value in zip("enu", statistics[:3], strict=True):
                values[f"phi_{axis}{suffix}_arcmin"] = self._truth_column(value / ARCMIN)
            for angle, value in zip(("pitch", "roll", "yaw"), statistics[3:], strict=True):
                values[f"{angle}{suffix}_deg"] = nullable_array(value / DEG)
        shares = ("error", "floor_error", "error_steady")
        for name, value in zip(shares, outcome.above_share, strict=True):
            values[f"p_above_{name}_share"] = self._truth_column(value)
        from_floor = {
            "p_above_floor_error_share": values["p_above_floor_error_share"],
            "floor_arcmin": self._truth_column(outcome.floor.phi.z / ARCMIN),
            "nis_u": self._truth_column(outcome.nis_u),
            "ok_floor": self._truth_flag_column(verdict.ok[FLOOR]),
        }
        no_floor = pa.array(~verdict.has_floor)
        values |= {k: pc.if_else(no_floor, None, column) for k, column in from_floor.items()}
        values["has_floor"] = self._truth_flag_column(verdict.has_floor)
        values["ok_truth"] = self._truth_flag_column(verdict.ok[TRUTH])
        values["nees"] = self._truth_column(outcome.nees)
        values["status"] = verdict.status
        values |= self._method_values(chunk, variant)
        return make_table(self.summary_columns, values)

    def curve_table(self, chunk: Chunk, variant_ids: np.ndarray) -> pa.Table:
        """Return the curves of a chunk that has them, one row per run and record time."""
        assert isinstance(chunk.curves, Observation)
        run_id = chunk.draw * self._study.n_variants + variant_ids[chunk.variant]
        codes, spans = self._study.lengths
        span = spans[codes[variant_ids[0]]]  # common to all variants of a part
        time_s = self._study.update_times(span)
        values = {"run_id": np.repeat(run_id, len(time_s)), "time_s": np.tile(time_s, len(run_id))}
        if self._study.passes:
            values["update_time_s"] = values["time_s"]
            values["stored_time_s"] = np.tile(self._study.stored_times(span), len(run_id))
            values["pass"] = np.tile(span.pass_numbers(), len(run_id))
        return make_table(self.curve_columns, values | self._angle_columns(chunk.curves))

    def _angle_columns(self, observation: Observation) -> dict[str, pa.Array]:
        values = {
            f"phi_{a}_arcmin": self._truth_column(v / ARCMIN) for a, v in _zip_axes(observation.phi)
        }
        values |= {
            f"sigma_{a}_arcmin": nullable_array(v / ARCMIN) for a, v in _zip_axes(observation.sigma)
        }
        angles = {"pitch": observation.pitch, "roll": observation.roll, "yaw": observation.yaw}
        values |= {f"{name}_deg": nullable_array(v / DEG) for name, v in angles.items()}
        # Twice, because a tiny negative angle is rounded to 360.
        heading = np.mod(np.mod(-np.asarray(observation.yaw) / DEG, 360.0), 360.0)
        return values | {"heading_deg": nullable_array(heading)}

    def _chunk_method(self, variant: np.ndarray) -> Method:
        """Return the method that all variants of a chunk share."""
        codes, names = self._methods
        return METHODS[names[codes[variant[0]]]]

    def _method_values(self, chunk: Chunk, variant: np.ndarray) -> dict[str, pa.Array]:
        """Return the columns specific to methods; all runs of a chunk have the same method."""
        method = self._chunk_method(variant)
        method_names = {column.column.name for column in method.own_columns(self._keys)}
        values = {}
        for name, (column, value, missing, _) in self._method_columns.items():
            column_values = (
                value(chunk.outcome.results, self._study.rate_hz)
                if name in method_names
                else missing
            )
            array = nullable_array(np.broadcast_to(column_values, len(variant)))
            values[name] = array.cast(column.dtype)
        return values

    def _truth_column(self, values: Any) -> pa.Array:
        """Return a column of values that need a truth: null without one, or if not finite."""
        return nullable_array(values if self._has_truth else np.full(np.shape(values), np.nan))

    def _truth_flag_column(self, flags: np.ndarray) -> pa.Array:
        """Return a column of flags that need a truth: null without one."""
        return pa.array(flags if self._has_truth else [None] * len(flags), pa.bool_())

    def _settling_columns(
        self, verdict: RunSuccess, pass_s: np.ndarray, before_s: np.ndarray
    ) -> dict[str, pa.Array]:
        """Return the settling times of all bands, about bias floor and truth, by column."""
        values = {}
        for truth, settled_by_band in (
            (False, verdict.settled_s[FLOOR]),
            (True, verdict.settled_s[TRUTH]),
        ):
            for band, settled in zip(self._bands, settled_by_band, strict=True):
                name = columns.settle_column(band, truth=truth).name
                values[name] = self._truth_column(settled)
                if self._has_data_columns:
                    data_column = columns.settle_data_column(band, truth=truth).name
                    values[data_column] = self._truth_column(before_s + np.minimum(settled, pass_s))
        return values

    def _report_time_columns(self, outcome: Outcome) -> dict[str, pa.Array]:
        """Return the heading error, its sigma and NEES at the report times, by column."""
        values: dict[str, pa.Array] = {}
        for number, time in enumerate(self._study.report_times_s):
            phi, sigma, nees = np.asarray(outcome.at_times)[:, number].T
            arrays = (
                self._truth_column(phi / ARCMIN),
                nullable_array(sigma / ARCMIN),
                self._truth_column(nees),
            )
            names = (column.name for column in columns.report_time_columns(time))
            values |= dict(zip(names, arrays, strict=True))
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


def _zip_axes(vector: Any) -> Any:
    return zip("enu", vector, strict=True)


def nullable_array(values: Any) -> pa.Array:
    """Return numbers of any shape as a column, null if they are not finite."""
    flat = np.asarray(values, dtype=float).ravel()
    return pa.array(flat, mask=~np.isfinite(flat))


def replace_column(table: pa.Table, name: str, values: pa.Array) -> pa.Table:
    """Return a table with new values in a column, cast to its type."""
    index, field = table.column_names.index(name), table.schema.field(name)
    return table.set_column(index, field, values.cast(field.type))


def make_table(table_columns: tuple[Column, ...], values: dict[str, Any]) -> pa.Table:
    """Return a table of some columns, from their values by name."""
    arrays = [pa.array(values[c.name]).cast(c.dtype) for c in table_columns]
    return pa.Table.from_arrays(arrays, schema=columns.arrow_schema(table_columns))
