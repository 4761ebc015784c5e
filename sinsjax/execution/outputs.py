"""The output of a study's tasks: tables of its runs, or estimates of its variants."""

from collections.abc import Mapping
from typing import Protocol, runtime_checkable

import pyarrow as pa
from numpy.typing import NDArray

from sinsjax.columns import FAILED, Column
from sinsjax.engine.batch import Calls, Chunk, Plan
from sinsjax.engine.build import Scenario
from sinsjax.engine.environment import Static
from sinsjax.engine.lanes import Group
from sinsjax.execution.estimates import EstimateOutput
from sinsjax.execution.tables import TableBuilder


@runtime_checkable
class Output(Protocol):
    """Conversion of the parts of a study to result tables.

    Attributes:
        schemas: columns of the datasets that every task writes, in the order in which they are
            written: the last one exists only if the others do.
    """

    schemas: Mapping[str, tuple[Column, ...]]

    def adapt_program(self, static: Static) -> Static:
        """Return the program of a part, from that of its runs."""
        ...

    def adapt_group(self, group: Group) -> Group:
        """Return the runs of a part for the engine, from all its runs."""
        ...

    def plan_calls(self, static: Static, draws: int, variants: int, tiles: int | None) -> Plan:
        """Return the division of a number of draws and variants into calls."""
        ...

    def make_calls(self, group: Group, tiles: int | None) -> Calls:
        """Return the calls of such a plan."""
        ...

    def make_tables(self, chunk: Chunk, variant_ids: NDArray) -> dict[str, pa.Table]:
        """Return the tables of a chunk by dataset."""
        ...

    def count_failures(self, tables: Mapping[str, pa.Table]) -> int:
        """Return the number of runs in these tables that diverged or became non-finite."""
        ...


class RunOutput:
    """Summary and curves of all runs, see `Output`.

    Attributes:
        schemas: columns by dataset.
    """

    def __init__(self, scenario: Scenario) -> None:
        self._builder = TableBuilder(scenario.study, has_truth=scenario.has_truth)
        curves = {"curves": self._builder.curve_columns} if scenario.curves else {}
        self.schemas: Mapping[str, tuple[Column, ...]] = {
            **curves,
            "summary": self._builder.summary_columns,
        }

    def adapt_program(self, static: Static) -> Static:
        """Return the program of the runs."""
        return static

    def adapt_group(self, group: Group) -> Group:
        """Return the runs."""
        return group

    def plan_calls(self, static: Static, draws: int, variants: int, tiles: int | None) -> Plan:
        """Return the division of a number of draws and variants into calls."""
        return Plan(static, draws, variants, tiles_per_chunk=tiles)

    def make_calls(self, group: Group, tiles: int | None) -> Calls:
        """Return the calls of such a plan."""
        return Calls(group, tiles_per_chunk=tiles)

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


def make_output(scenario: Scenario) -> Output:
    """Return the output that a study requests.

    Raises:
        InputError: curves are requested, but there are no runs.
    """
    return EstimateOutput(scenario) if scenario.study.is_estimated else RunOutput(scenario)
