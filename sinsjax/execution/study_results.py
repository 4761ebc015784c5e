"""Results of a study for Python: tables in memory, or those of a directory."""

from collections.abc import Iterator, Mapping
from functools import cached_property
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc

from sinsjax import columns
from sinsjax.execution import frames
from sinsjax.execution.directory import read_manifest, results_path
from sinsjax.execution.results import load_stored_study, read_curves, read_summary
from sinsjax.messages import format_count
from sinsjax.study import display
from sinsjax.study.study import Study


class Results:
    """Results of a study: tables of its runs, in memory or read from a directory when needed.

    ``summary, curves = results`` gives both tables.

    Attributes:
        study: the study, at the rate of its record if it has one.
        directory: directory of the results; None in memory.
        wall_s: time that the study took, s, with compilation.

    Examples:
        >>> study = sinsjax.load_study("paper1_resets", {"study.draws": 2, "study.rate_hz": 10.0})
        >>> results = sinsjax.run(study)
        >>> results.summary.num_rows, results.curves.num_rows
        (6, 5400)
        >>> results
        Results of paper1_resets
          runs      3 variants x 2 draws = 6 runs, 0 diverged or not finite
          axes      case (3)
          method    kalman5
          computed  in ... s, in memory
    """

    def __init__(
        self,
        study: Study,
        wall_s: float,
        *,
        tables: Mapping[str, pa.Table] | None = None,
        directory: Path | None = None,
    ) -> None:
        """Create results from tables by dataset, or from a directory."""
        self.study, self.wall_s, self.directory = study, wall_s, directory
        self._tables = tables

    @classmethod
    def read(cls, directory: str | Path) -> "Results":
        """Open a results directory; tables are read when needed.

        Args:
            directory: results directory.

        Raises:
            InputError: the directory contains no results, or its manifest or study cannot be read.

        Examples:
            >>> changes = {"study.draws": 2, "study.rate_hz": 10.0}
            >>> _ = sinsjax.run_into(sinsjax.load_study("paper1_resets", changes), "out")
            >>> sinsjax.Results.read("out").summary.num_rows
            6
        """
        directory = results_path(directory)
        wall_s = read_manifest(directory)["wall_s"]
        return cls(load_stored_study(directory), wall_s, directory=directory)

    @cached_property
    def summary(self) -> pa.Table:
        """One row per run, ordered by run_id; the schema has units and meanings.

        Raises:
            InputError: the directory cannot be read.

        Examples:
            >>> changes = {"study.draws": 2, "study.rate_hz": 10.0}
            >>> study = sinsjax.load_study("paper1_resets", changes)
            >>> sinsjax.run(study).summary["method"].unique().to_pylist()
            ['kalman5']
        """
        if self._tables is not None:
            return self._tables["summary"]
        assert self.directory is not None
        return read_summary(self.directory)

    @cached_property
    def curves(self) -> pa.Table:
        """One row per run and record time; empty if curves were not kept.

        Raises:
            InputError: the directory cannot be read.

        Examples:
            >>> changes = {"study.draws": 2, "study.rate_hz": 10.0}
            >>> study = sinsjax.load_study("paper1_resets", changes)
            >>> sinsjax.run(study, curves=False).curves.num_rows
            0
        """
        if self._tables is not None:
            return self._tables["curves"]
        assert self.directory is not None
        return read_curves(self.directory)

    def to_pandas(self, *, curves: bool = False) -> Any:
        """Return the summary as a pandas frame.

        Args:
            curves: whether to return the curves instead.

        Returns:
            A frame whose ``attrs`` have ``units`` and ``meanings`` by column.

        Raises:
            InputError: pandas is not installed, or the directory cannot be read.

        Examples:
            >>> changes = {"study.draws": 2, "study.rate_hz": 10.0}
            >>> study = sinsjax.load_study("paper1_resets", changes)
            >>> frame = sinsjax.run(study).to_pandas()
            >>> len(frame), frame.attrs["units"]["phi_u_arcmin"]
            (6, 'arcmin')
        """
        return frames.to_dataframe(self.curves if curves else self.summary)

    def to_xarray(self) -> Any:
        """Return the summary as an xarray dataset.

        Returns:
            A dataset with the dimension ``draw`` and one per axis of the study, or ``variant`` if
            the points of an axis have no key that identifies them. Variables have ``units`` and
            ``long_name``.

        Raises:
            InputError: xarray is not installed, or the directory is unfinished or cannot be read.

        Examples:
            >>> changes = {"study.draws": 2, "study.rate_hz": 10.0}
            >>> study = sinsjax.load_study("paper1_resets", changes)
            >>> dataset = sinsjax.run(study).to_xarray()
            >>> dict(dataset.sizes), dataset["settle_60_s"].attrs["units"]
            ({'draw': 2, 'case': 3}, 's')
        """
        return frames.to_dataset(self.study, self.summary)

    def __iter__(self) -> Iterator[pa.Table]:
        """Yield the summary and the curves."""
        yield from (self.summary, self.curves)

    def __repr__(self) -> str:
        """Return five short lines: runs, axes, method, time and place."""
        return display.format_text(f"Results of {self.study.name}", self._facts())

    def _repr_html_(self) -> str:
        """Return the lines of `__repr__` as a table, for notebooks."""
        return display.format_html(f"Results of {self.study.name}", self._facts())

    def __dir__(self) -> list[str]:
        """Return the names that a user needs, for the completion of interactive sessions."""
        return ["curves", "directory", "study", "summary", "to_pandas", "to_xarray", "wall_s"]

    def _facts(self) -> dict[str, str]:
        facts = self.study.facts
        facts.pop("length")
        failed = pc.sum(pc.is_in(self.summary["status"], pa.array(columns.FAILED))).as_py() or 0
        planned = self.study.n_draws * self.study.n_variants
        if (runs := self.summary.num_rows) < planned:
            facts["runs"] = f"{runs:,} of {format_count(planned, 'run')}"
        facts["runs"] += f", {failed:,} diverged or not finite"
        location = f"in {self.directory}" if self.directory else "in memory"
        return facts | {"computed": f"in {self.wall_s:.3g} s, {location}"}
