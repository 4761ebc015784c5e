"""The runs of a study as the output of its tasks, and their companions beside them."""

from collections.abc import Mapping

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from sinsjax import columns
from sinsjax.columns import Column
from sinsjax.engine.batch import Calls, Chunk, Plan
from sinsjax.engine.build import Scenario
from sinsjax.engine.lanes import Group
from sinsjax.engine.paired import Blocks, PairedCalls, PairedChunk
from sinsjax.engine.realisations import Static
from sinsjax.engine.verdicts import LIMIT, TRUTH
from sinsjax.execution import layouts
from sinsjax.execution.estimates import told_records
from sinsjax.execution.tables import Tables, nullable
from sinsjax.study.times import spans_s
from sinsjax.units import ARCMIN


class Runs:
    """Summary and curves of all runs, see `outputs.Output`.

    Attributes:
        layouts: columns by dataset.
    """

    def __init__(self, scenario: Scenario) -> None:
        self._made = Tables(scenario.study, has_truth=scenario.has_truth)
        curves = {"curves": self._made.curve_columns} if scenario.curves else {}
        self.layouts: Mapping[str, tuple[Column, ...]] = {
            **curves,
            "summary": layouts.summary(scenario.study),
        }

    def program(self, static: Static) -> Static:
        """As it is."""
        return static

    def group(self, group: Group) -> Group:
        """As it is."""
        return group

    def plan(self, static: Static, draws: int, count: int, tiles: int | None) -> Plan:
        """See `Output`."""
        return Plan(static, draws, count, tiles_a_chunk=tiles)

    def calls(self, group: Group, tiles: int | None) -> Calls:
        """See `Output`."""
        return Calls(group, tiles_a_chunk=tiles)

    def tables(self, chunk: Chunk, variant_ids: NDArray) -> dict[str, pa.Table]:
        """One row per run, and one per run and record time."""
        made = {"summary": self._made.summary(chunk, variant_ids)}
        if "curves" in self.layouts:
            made["curves"] = self._made.curves(chunk, variant_ids)
        return made

    def failures(self, tables: Mapping[str, pa.Table]) -> int:
        """By their status."""
        return failures(tables["summary"])


class PairedRuns:
    """The same with the companion of each run in its row of the summary.

    Attributes:
        layouts: columns by dataset.
    """

    def __init__(self, scenario: Scenario) -> None:
        study = scenario.study
        self._runs = Runs(scenario)
        self.layouts = self._runs.layouts
        self._records, self._end_s = told_records(study), spans_s(study)[:, 0]
        self._names = [column.name for column in layouts.of_companions(study)]

    def program(self, static: Static) -> Static:
        """As it is."""
        return static

    def group(self, group: Group) -> Group:
        """As it is."""
        return group

    def plan(self, static: Static, draws: int, count: int, tiles: int | None) -> Blocks:
        """Blocks, which no number of tiles changes."""
        return Blocks(draws, count)

    def calls(self, group: Group, tiles: int | None) -> PairedCalls:
        """Of blocks."""
        return PairedCalls(group, self._records)

    def tables(self, chunk: PairedChunk, variant_ids: NDArray) -> dict[str, pa.Table]:
        """As those of runs, with their companions."""
        made = self._runs.tables(chunk.runs, variant_ids)
        summary, schema = made["summary"], columns.schema(self.layouts["summary"])
        limited = summary["has_limit"].to_numpy(zero_copy_only=False)
        phi, until = chunk.companions
        never = until >= self._end_s[variant_ids[chunk.runs.variant]] * (1 - 1e-12)
        settled = np.where(never, np.nan, until)
        settled[LIMIT] = np.where(limited, settled[LIMIT], np.nan)
        values = [*(phi[2] / ARCMIN), *settled[LIMIT], *settled[TRUTH]]
        for name, value in zip(self._names, values, strict=True):
            summary = summary.append_column(schema.field(name), nullable(value))
        return made | {"summary": summary}

    def failures(self, tables: Mapping[str, pa.Table]) -> int:
        """By their status."""
        return failures(tables["summary"])


def failures(summary: pa.Table) -> int:
    """Number of runs of a summary that diverged or became non-finite."""
    status = summary["status"].to_pylist()
    return status.count("diverged") + status.count("nonfinite")
