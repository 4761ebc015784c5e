"""How far covariance analysis holds for a variant, by a few draws; where it does not, many of them.

The index of nonlinearity is the rms over a few draws of what a run has beyond its companion, in
standard deviations of the true error.
"""

import threading
from functools import lru_cache
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from sinsjax import columns
from sinsjax.engine import companions
from sinsjax.engine.batch import Calls
from sinsjax.engine.build import Scenario
from sinsjax.engine.lanes import Group
from sinsjax.engine.verdicts import FLOOR, TRUTH
from sinsjax.execution.estimates import settled_of, told_records
from sinsjax.execution.tables import nullable, with_column
from sinsjax.study.success import bands
from sinsjax.units import ARCMIN

CHECKED = 8
"""Draws that the index is made of."""

MOST = 0.5
"""Of the index; beyond it covariance analysis does not hold."""

_PARTS_READY = 2
_VARIANTS_CHECKED = 64  # per call: the errors of a lane's draws stay in the first-level cache
_VARIANTS_FILLED = 8  # per call of many draws


class Linearity:
    """The index of a study's variants, and the draws of those for which it is large."""

    def __init__(self, scenario: Scenario) -> None:
        study = scenario.study
        self._scenario, self._study = scenario, study
        self._records, self._end_s = told_records(study), study.spans_s[:, 0]
        self._ends = [f"_at_{time_s:g}" for time_s in study.report_times_s] + [""]
        self._lock = threading.Lock()
        self._runs = lru_cache(_PARTS_READY)(self._group)

    def checked(self, number: int, table: pa.Table) -> pa.Table:
        """Estimates of some variants of a part with their index, those beyond `MOST` from draws.

        Args:
            number: of the part.
            table: estimates.
        """
        ids = self._scenario.variant_ids[number]
        places = np.searchsorted(ids, table["variant_id"].to_numpy())
        cuts = range(0, len(places), _VARIANTS_CHECKED)
        blocks = [slice(first, first + _VARIANTS_CHECKED) for first in cuts]
        width = len(places[blocks[0]])
        with self._lock:  # otherwise every thread would make the part and compile
            group = self._runs(number)
            runs, wide = (_few(group, places[blocks[0]], n) for n in (width, _VARIANTS_CHECKED))
            Calls(runs).compile()
            companions.program(wide, self._records).compiled()
        index = np.concatenate(
            [self._index(table[some], group, places[some], width) for some in blocks], axis=1
        )
        for end, values in zip(self._ends, index, strict=True):
            table = with_column(table, f"nonlinearity{end}", nullable(values))
        beyond = ~(index.max(axis=0) <= MOST) & ~np.isnan(index).all(axis=0)
        table = with_column(table, "filled_by_draws", pa.array(beyond))
        for first in range(0, int(beyond.sum()), _VARIANTS_FILLED):
            rows = np.flatnonzero(beyond)[first : first + _VARIANTS_FILLED]
            table = self._filled(table, group, rows, places[rows])
        return table

    def _group(self, number: int) -> Group:
        draws = self._study.study.draws or CHECKED
        return self._scenario.part(number, range(max(draws, CHECKED))).group

    def _index(self, table: pa.Table, group: Group, places: NDArray, width: int) -> NDArray:
        """Return the index of a few variants, (times, variants).

        Args:
            table: their rows.
            group: all variants of the part.
            places: their places in it.
            width: variants per call of the runs, so that all calls share a program.
        """
        out = Calls(_few(group, places, width)).whole().outcome
        beside = companions.of_group(_few(group, places, _VARIANTS_CHECKED), self._records)
        at_times = () if out.at_times is None else np.asarray(out.at_times)[..., 0].T
        phi = np.stack([*at_times, out.last.phi.z]).reshape(len(self._ends), CHECKED, width)
        count = len(places)
        beyond = (phi[..., :count] - beside[2, :, :count].swapaxes(1, 2)) / ARCMIN
        names = (f"true_sigma_u{end}_arcmin" for end in self._ends)
        sigma = np.stack([table[name].to_numpy(zero_copy_only=False) for name in names])
        with np.errstate(divide="ignore", invalid="ignore"):  # without noise there is none
            return np.sqrt(np.mean(beyond**2, axis=1)) / sigma

    def _filled(self, table: pa.Table, group: Group, rows: NDArray, places: NDArray) -> pa.Table:
        """The table with what the draws of some rows give of the heading."""
        width = _VARIANTS_FILLED
        made = Calls(_few(group, places, width, draws=group.sizes[0])).whole()

        def of(leaf: Any) -> NDArray:
            """(variants, draws, ...)."""
            leaf = np.asarray(leaf)
            return leaf.reshape(-1, width, *leaf.shape[1:]).swapaxes(0, 1)[: len(rows)]

        out = made.outcome
        told = {"": (of(out.last.phi.z), of(out.last.sigma.z))}
        if out.at_times is not None:
            phi, sigma, _ = np.moveaxis(of(out.at_times), 3, 0)
            times = zip(np.moveaxis(phi, 2, 0), np.moveaxis(sigma, 2, 0), strict=True)
            told |= zip(self._ends, times, strict=False)
        limited = table["has_floor"].to_numpy(zero_copy_only=False)[rows]
        floor = np.where(limited[:, None], of(out.limit.phi.z), np.nan)
        values: dict[str, NDArray] = {}
        for end, (phi, sigma) in told.items():
            values |= {
                f"phi_u{end}_arcmin": phi.mean(1) / ARCMIN,
                f"true_sigma_u{end}_arcmin": phi.std(1, ddof=1) / ARCMIN,
                f"sigma_u{end}_arcmin": np.sqrt(np.mean(sigma**2, axis=1)) / ARCMIN,
            }
            for band in bands(self._study):
                for side, error in (("", phi - floor), ("_truth", phi)):
                    inside = np.where(np.isnan(error), np.nan, np.abs(error) <= band * ARCMIN)
                    values[f"within_{band:g}{side}{end}_share"] = inside.mean(1)
        until, end_s = of(out.outside_until), self._end_s[table["variant_id"].to_numpy()[rows]]
        for truth, about in ((False, FLOOR), (True, TRUTH)):
            for number, band in enumerate(bands(self._study)):
                names = (c.name for c in columns.settle_estimate_columns(band, truth=truth))
                settled = settled_of(until[:, :, about, number], end_s, opposite=False)
                known = np.ones_like(limited) if truth else limited
                values |= zip(names, (np.where(known, s, np.nan) for s in settled), strict=True)
        for name, own in values.items():
            whole = table[name].to_numpy(zero_copy_only=False).copy()
            whole[rows] = own
            table = with_column(table, name, nullable(whole))
        return table


def _few(group: Group, places: NDArray, width: int, draws: int = CHECKED) -> Group:
    """The first draws of a few variants, the last one repeated up to so many."""
    filled = np.pad(places, (0, width - len(places)), mode="edge")
    return group.some(np.arange(draws), filled)
