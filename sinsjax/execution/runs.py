"""The runs of a study as the output of its tasks."""

from collections.abc import Mapping

import pyarrow as pa
from numpy.typing import NDArray

from sinsjax.columns import Column
from sinsjax.engine.batch import Calls, Chunk, Plan
from sinsjax.engine.build import Scenario
from sinsjax.engine.lanes import Group
from sinsjax.engine.realisations import Static
from sinsjax.execution.tables import Tables


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
            "summary": self._made.summary_columns,
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
        status = tables["summary"]["status"].to_pylist()
        return status.count("diverged") + status.count("nonfinite")
