"""Check of covariance analysis by a few draws per variant; many draws replace it if it fails.

The index of nonlinearity is the rms difference, over a few draws, between the heading error of a
run and that of its linear companion, in standard deviations of the true error.
"""

import threading
from functools import lru_cache
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from sinsjax import columns
from sinsjax.covariance import linear_draws
from sinsjax.engine.batch import Calls
from sinsjax.engine.build import Scenario
from sinsjax.engine.lanes import Group
from sinsjax.engine.success import FLOOR, TRUTH
from sinsjax.execution.estimates import report_record_indices, settling_statistics
from sinsjax.execution.tables import nullable_array, replace_column
from sinsjax.study.success import settling_bands
from sinsjax.units import ARCMIN

CHECKED_DRAWS = 8
"""Number of draws for the index."""

MAX_INDEX = 0.5
"""Largest index for which covariance analysis holds."""

_PARTS_READY = 2
_VARIANTS_PER_CHECK = 64  # per call: the errors of a lane's draws stay in the first-level cache
_VARIANTS_PER_FILL = 8  # per call of many draws


class LinearityCheck:
    """Index of nonlinearity of a study's variants, and draws of those for which it is large."""

    def __init__(self, scenario: Scenario) -> None:
        study = scenario.study
        self._scenario, self._study = scenario, study
        self._records, self._end_s = report_record_indices(study), study.spans_s[:, 0]
        self._ends = [f"_at_{time_s:g}" for time_s in study.report_times_s] + [""]
        self._lock = threading.Lock()
        self._cached_group = lru_cache(_PARTS_READY)(self._part_group)

    def add_nonlinearity_index(self, part: int, table: pa.Table) -> pa.Table:
        """Add the index to estimates of a part; estimate variants beyond `MAX_INDEX` from draws.

        Args:
            part: number of the part.
            table: estimates.
        """
        ids = self._scenario.variant_ids[part]
        positions = np.searchsorted(ids, table["variant_id"].to_numpy())
        cuts = range(0, len(positions), _VARIANTS_PER_CHECK)
        blocks = [slice(first, first + _VARIANTS_PER_CHECK) for first in cuts]
        width = len(positions[blocks[0]])
        with self._lock:  # otherwise every thread would build the part and compile
            group = self._cached_group(part)
            runs, wide = (
                _select_variants(group, positions[blocks[0]], n)
                for n in (width, _VARIANTS_PER_CHECK)
            )
            Calls(runs).compile()
            linear_draws.linear_program(wide, self._records).compiled()
        index = np.concatenate(
            [
                self._nonlinearity_index(table[block], group, positions[block], width)
                for block in blocks
            ],
            axis=1,
        )
        for end, values in zip(self._ends, index, strict=True):
            table = replace_column(table, f"nonlinearity{end}", nullable_array(values))
        beyond = ~(index.max(axis=0) <= MAX_INDEX) & ~np.isnan(index).all(axis=0)
        table = replace_column(table, "filled_by_draws", pa.array(beyond))
        for first in range(0, int(beyond.sum()), _VARIANTS_PER_FILL):
            rows = np.flatnonzero(beyond)[first : first + _VARIANTS_PER_FILL]
            table = self._fill_from_draws(table, group, rows, positions[rows])
        return table

    def _part_group(self, part: int) -> Group:
        draws = self._study.study.draws or CHECKED_DRAWS
        return self._scenario.part(part, range(max(draws, CHECKED_DRAWS))).group

    def _nonlinearity_index(
        self, table: pa.Table, group: Group, positions: NDArray, width: int
    ) -> NDArray:
        """Return the index of a few variants, (times, variants).

        Args:
            table: their rows.
            group: all variants of the part.
            positions: their positions in it.
            width: variants per call of the runs, so that all calls share a program.
        """
        outcome = Calls(_select_variants(group, positions, width)).all_chunks().outcome
        companion_phi = linear_draws.linear_misalignments(
            _select_variants(group, positions, _VARIANTS_PER_CHECK), self._records
        )
        at_times = () if outcome.at_times is None else np.asarray(outcome.at_times)[..., 0].T
        phi = np.stack([*at_times, outcome.last.phi.z]).reshape(
            len(self._ends), CHECKED_DRAWS, width
        )
        count = len(positions)
        difference = (phi[..., :count] - companion_phi[2, :, :count].swapaxes(1, 2)) / ARCMIN
        names = (f"true_sigma_u{end}_arcmin" for end in self._ends)
        sigma = np.stack([table[name].to_numpy(zero_copy_only=False) for name in names])
        with np.errstate(divide="ignore", invalid="ignore"):  # zero without noise
            return np.sqrt(np.mean(difference**2, axis=1)) / sigma

    def _fill_from_draws(
        self, table: pa.Table, group: Group, rows: NDArray, positions: NDArray
    ) -> pa.Table:
        """Replace the heading columns of some rows by statistics of their draws."""
        width = _VARIANTS_PER_FILL
        chunk = Calls(_select_variants(group, positions, width, draws=group.sizes[0])).all_chunks()

        def by_variant(leaf: Any) -> NDArray:
            """Reshape a leaf to (variants, draws, ...)."""
            leaf = np.asarray(leaf)
            return leaf.reshape(-1, width, *leaf.shape[1:]).swapaxes(0, 1)[: len(rows)]

        outcome = chunk.outcome
        heading_by_time = {"": (by_variant(outcome.last.phi.z), by_variant(outcome.last.sigma.z))}
        if outcome.at_times is not None:
            phi, sigma, _ = np.moveaxis(by_variant(outcome.at_times), 3, 0)
            times = zip(np.moveaxis(phi, 2, 0), np.moveaxis(sigma, 2, 0), strict=True)
            heading_by_time |= zip(self._ends, times, strict=False)
        has_floor = table["has_floor"].to_numpy(zero_copy_only=False)[rows]
        floor = np.where(has_floor[:, None], by_variant(outcome.floor.phi.z), np.nan)
        values: dict[str, NDArray] = {}
        for end, (phi, sigma) in heading_by_time.items():
            values |= {
                f"phi_u{end}_arcmin": phi.mean(1) / ARCMIN,
                f"true_sigma_u{end}_arcmin": phi.std(1, ddof=1) / ARCMIN,
                f"sigma_u{end}_arcmin": np.sqrt(np.mean(sigma**2, axis=1)) / ARCMIN,
            }
            for band in settling_bands(self._study):
                for side, error in (("", phi - floor), ("_truth", phi)):
                    inside = np.where(np.isnan(error), np.nan, np.abs(error) <= band * ARCMIN)
                    values[f"within_{band:g}{side}{end}_share"] = inside.mean(1)
        outside_until, end_s = (
            by_variant(outcome.outside_until),
            self._end_s[table["variant_id"].to_numpy()[rows]],
        )
        for truth, centre in ((False, FLOOR), (True, TRUTH)):
            for number, band in enumerate(settling_bands(self._study)):
                names = (c.name for c in columns.settle_estimate_columns(band, truth=truth))
                settled = settling_statistics(
                    outside_until[:, :, centre, number], end_s, antithetic=False
                )
                known = np.ones_like(has_floor) if truth else has_floor
                values |= zip(names, (np.where(known, s, np.nan) for s in settled), strict=True)
        for name, column_values in values.items():
            column = table[name].to_numpy(zero_copy_only=False).copy()
            column[rows] = column_values
            table = replace_column(table, name, nullable_array(column))
        return table


def _select_variants(
    group: Group, positions: NDArray, width: int, draws: int = CHECKED_DRAWS
) -> Group:
    """Return the first draws of a few variants, padded to ``width`` with the last variant."""
    padded = np.pad(positions, (0, width - len(positions)), mode="edge")
    return group.select(np.arange(draws), padded)
