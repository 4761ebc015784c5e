"""Conversion of the engine's arrays to result tables; rows depend only on the study."""

from functools import cached_property
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from sinsjax import columns
from sinsjax.columns import Column
from sinsjax.engine.batch import Chunk
from sinsjax.engine.metrics import Observation, Outcome
from sinsjax.engine.study_limits import has_floor, limited_variants, scheduled_last_s
from sinsjax.engine.truth import starts_of
from sinsjax.engine.verdicts import FLOOR, TRUTH, Judge, Verdict
from sinsjax.execution import layouts
from sinsjax.methods.description import Description
from sinsjax.methods.registry import METHODS
from sinsjax.study import sampling
from sinsjax.study.keys import COARSE_KEYS
from sinsjax.study.study import Study
from sinsjax.study.success import bands
from sinsjax.units import ARCMIN, DEG


class Tables:
    """Conversion of a study's chunks to tables."""

    def __init__(self, study: Study, *, has_truth: bool = True) -> None:
        """Prepare the columns that do not depend on the chunk.

        Args:
            study: checked study.
            has_truth: False for a record without a reference; columns that need one are null.
        """
        self._study = study
        self._has_truth = has_truth
        self._bands = bands(study)
        self._judge = Judge(study, has_truth=has_truth)
        self._end_s, self._pass_s = study.spans_s.T
        self._last_reset_s = scheduled_last_s(study)
        self.summary_columns = layouts.summary(study)
        self.curve_columns = layouts.curves(study)
        self._tells_data = layouts.tells_data(study)
        self._before_s = _before_s(study)
        self._by_variant = layouts.of_variants(study, self.summary_columns)
        self._methods = study.resolved.column("method")
        self._own_columns = layouts.of_methods(study)
        self._start_s = np.zeros(study.n_draws)
        if study.is_recorded:
            assert study.record is not None
            taken, given = starts_of(study, study.rate_hz) / study.rate_hz, study.record.start_s
            # A rate of 99.9999999 Hz, from stamps that are rounded, moves no start.
            self._start_s = np.where(np.abs(taken - given) < 1e-6, given, taken)

    def summary(self, chunk: Chunk, variant_ids: np.ndarray) -> pa.Table:
        """Summary of a chunk, one row per run.

        Args:
            chunk: engine results.
            variant_ids: (variants of the part,) their numbers in the study.
        """
        variant = variant_ids[chunk.variant]
        out = chunk.outcome
        values: dict[str, Any] = {
            "run_id": chunk.draw * self._study.n_variants + variant,
            "draw_id": chunk.draw,
            "variant_id": variant,
            "start_s": self._start_s[chunk.draw],
        }
        values |= {name: column.take(variant) for name, column in self._by_variant.items()}
        first = int(chunk.draw.min())
        drawn = sampling.values(self._study, int(chunk.draw.max()) + 1 - first, first=first)
        for name, column in drawn.items():
            own = column[chunk.draw - first]
            values[name] = own if own.ndim == 1 else list(own)
        values |= self._observed(out.last)
        verdict = self._judge(out, self._has_floor(chunk, variant), self._end_s[variant])
        values |= self._settled(verdict, self._pass_s[variant], self._before_s[variant])
        values |= self._at_times(out)
        for suffix, statistics in (("_mean", out.mean), ("_std", out.std)):
            for axis, value in zip("enu", statistics[:3], strict=True):
                values[f"phi_{axis}{suffix}_arcmin"] = self._known(value / ARCMIN)
            for angle, value in zip(("pitch", "roll", "yaw"), statistics[3:], strict=True):
                values[f"{angle}{suffix}_deg"] = nullable(value / DEG)
        shares = ("error", "floor_error", "error_steady")
        for name, value in zip(shares, out.above_share, strict=True):
            values[f"p_above_{name}_share"] = self._known(value)
        from_floor = {
            "p_above_floor_error_share": values["p_above_floor_error_share"],
            "floor_arcmin": self._known(out.limit.phi.z / ARCMIN),
            "nis_u": self._known(out.nis_u),
            "ok_floor": self._if_known(verdict.ok[FLOOR]),
        }
        nothing = pa.array(~verdict.has_floor)
        values |= {k: pc.if_else(nothing, None, column) for k, column in from_floor.items()}
        values["has_floor"] = self._if_known(verdict.has_floor)
        values["ok_truth"] = self._if_known(verdict.ok[TRUTH])
        values["nees"] = self._known(out.nees)
        values["status"] = verdict.status
        values |= self._of_method(chunk, variant)
        return table_of(self.summary_columns, values)

    def curves(self, chunk: Chunk, variant_ids: np.ndarray) -> pa.Table:
        """Curves of a chunk that has them, one row per run and record time."""
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
        return table_of(self.curve_columns, values | self._observed(chunk.curves))

    def _observed(self, seen: Observation) -> dict[str, pa.Array]:
        values = {f"phi_{a}_arcmin": self._known(v / ARCMIN) for a, v in _axes(seen.phi)}
        values |= {f"sigma_{a}_arcmin": nullable(v / ARCMIN) for a, v in _axes(seen.sigma)}
        angles = {"pitch": seen.pitch, "roll": seen.roll, "yaw": seen.yaw}
        values |= {f"{name}_deg": nullable(v / DEG) for name, v in angles.items()}
        # Twice, because a tiny negative angle is rounded to 360.
        heading = np.mod(np.mod(-np.asarray(seen.yaw) / DEG, 360.0), 360.0)
        return values | {"heading_deg": nullable(heading)}

    def _method(self, variant: np.ndarray) -> Description:
        """The method of a chunk's variants, common to all of them."""
        codes, names = self._methods
        return METHODS[names[codes[variant[0]]]]

    def _of_method(self, chunk: Chunk, variant: np.ndarray) -> dict[str, pa.Array]:
        """Columns specific to methods; all runs of a chunk have the same method."""
        method = self._method(variant)
        own = {column.column.name for column in method.columns_of(self._study)}
        values = {}
        for name, (column, value, missing, _) in self._own_columns.items():
            found = value(chunk.outcome.results, self._study.rate_hz) if name in own else missing
            array = nullable(np.broadcast_to(found, len(variant)))
            values[name] = array.cast(column.dtype)
        return values

    def _known(self, values: Any) -> pa.Array:
        """Values that need a truth: null without one, and where they are not finite."""
        return nullable(values if self._has_truth else np.full(np.shape(values), np.nan))

    def _if_known(self, flags: np.ndarray) -> pa.Array:
        """Flags that need a truth: null without one."""
        return pa.array(flags if self._has_truth else [None] * len(flags), pa.bool_())

    def _settled(
        self, verdict: Verdict, pass_s: np.ndarray, before_s: np.ndarray
    ) -> dict[str, pa.Array]:
        """Settling times of all bands, about the bias floor and the truth, by column."""
        values = {}
        for truth, of_bands in (
            (False, verdict.settled_s[FLOOR]),
            (True, verdict.settled_s[TRUTH]),
        ):
            for band, settled in zip(self._bands, of_bands, strict=True):
                name = columns.settle_column(band, truth=truth).name
                values[name] = self._known(settled)
                if self._tells_data:
                    data = columns.settle_data_column(band, truth=truth).name
                    values[data] = self._known(before_s + np.minimum(settled, pass_s))
        return values

    def _at_times(self, out: Outcome) -> dict[str, pa.Array]:
        """Heading error, its sigma and NEES at the report times, by column."""
        values: dict[str, pa.Array] = {}
        for number, time in enumerate(self._study.report_times_s):
            phi, sigma, nees = np.asarray(out.at_times)[:, number].T
            arrays = self._known(phi / ARCMIN), nullable(sigma / ARCMIN), self._known(nees)
            names = (column.name for column in columns.report_time_columns(time))
            values |= dict(zip(names, arrays, strict=True))
        return values

    def _has_floor(self, chunk: Chunk, variant: np.ndarray) -> np.ndarray:
        """Which runs have a bias floor, given the last reset of their schedule or trigger."""
        method = self._method(variant)
        called = method.last_called(chunk.outcome.results)
        if called is None and not self._study.drawn_keys:
            return self._limit_by_variant[variant]
        last_s = self._last_reset_s[variant]
        if called is not None:
            last_s = np.maximum(last_s, called / self._study.rate_hz)
        return has_floor(self._study, chunk.draw, variant, last_s)

    @cached_property
    def _limit_by_variant(self) -> np.ndarray:
        """Which variants have a bias floor, if that depends neither on draws nor on triggers."""
        return limited_variants(self._study)


def _before_s(study: Study) -> np.ndarray:
    """(variants,) data of a record before t = 0, where other variants begin with its first, s."""
    if not study.counts_before:
        return np.zeros(study.n_variants)
    column = study.resolved.column(*COARSE_KEYS)
    return column.each(lambda keys: study.samples_before(study.rate_hz, *keys)) / study.rate_hz


def _axes(vector: Any) -> Any:
    return zip("enu", vector, strict=True)


def nullable(values: Any) -> pa.Array:
    """Numbers of any shape as a column, null where they are not finite."""
    flat = np.asarray(values, dtype=float).ravel()
    return pa.array(flat, mask=~np.isfinite(flat))


def with_column(table: pa.Table, name: str, values: pa.Array) -> pa.Table:
    """A table with other values in a column, of its type."""
    place, field = table.column_names.index(name), table.schema.field(name)
    return table.set_column(place, field, values.cast(field.type))


def table_of(layout: tuple[Column, ...], values: dict[str, Any]) -> pa.Table:
    """A table of some columns, from their values by name."""
    arrays = [pa.array(values[c.name]).cast(c.dtype) for c in layout]
    return pa.Table.from_arrays(arrays, schema=columns.arrow_schema(layout))
