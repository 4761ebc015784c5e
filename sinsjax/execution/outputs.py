"""The output of a study's tasks: tables of its runs."""

from collections.abc import Mapping

import pyarrow as pa
from numpy.typing import NDArray

from sinsjax.columns import FAILED, Column
from sinsjax.engine.batch import Chunk
from sinsjax.engine.scenario import Scenario
from sinsjax.execution.tables import TableBuilder


class RunOutput:
    """Summary and curves of all runs.

    Attributes:
        schemas: columns of the datasets that every task writes, in the order in which they are
            written: the last one exists only if the others do.
    """

    def __init__(self, scenario: Scenario) -> None:
        self._builder = TableBuilder(scenario.study, has_truth=scenario.has_truth)
        curves = {"curves": self._builder.curve_columns} if scenario.curves else {}
        self.schemas: Mapping[str, tuple[Column, ...]] = {
            **curves,
            "summary": self._builder.summary_columns,
        }

    def make_tables(self, chunk: Chunk, variant_ids: NDArray) -> dict[str, pa.Table]:
        """Return one row per run, and one per run and record time if curves are stored."""
        tables = {"summary": self._builder.summary_table(chunk, variant_ids)}
        if "curves" in self.schemas:
            tables["curves"] = self._builder.curve_table(chunk, variant_ids)
        return tables

    def count_failures(self, tables: Mapping[str, pa.Table]) -> int:
        """Return the number of runs that diverged or became non-finite, by their status."""
        status = tables["summary"]["status"].to_pylist()
        return sum(map(status.count, FAILED))
