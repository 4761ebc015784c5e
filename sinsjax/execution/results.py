"""Results of studies: tables in memory, or in a directory whose parts are verified once."""

import json
from collections.abc import Iterable, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from sinsjax import columns
from sinsjax.errors import InputError
from sinsjax.execution.directory import STUDY, Manifest, is_intact, list_parts
from sinsjax.messages import first_error_line, format_count, format_facts, to_one_line
from sinsjax.platform.files import read_regular_file
from sinsjax.study.load import describe_differences, fingerprint, load_study
from sinsjax.study.study import Study
from sinsjax.study.success import SuccessMeasure, success_measures

STUDY_METADATA, CHUNK_METADATA = "sinsjax.study", "sinsjax.chunk"
"""Metadata of a part: identity of its job, and its chunk as JSON."""

_RESUME_HINT = "`--resume` computes damaged parts again"


class Results:
    """Results of a study: tables of its runs, in memory or read from a directory when needed.

    Attributes:
        study: the study, at the rate of its record if it has one.
        directory: directory of the results; None in memory.
        wall_s: time that the study took, s, with compilation.
        manifest: manifest of the directory.
        warnings: warnings from before the study ran, one line each.
        unfinished: whether runs are missing; only draws that every variant has are read then.

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
        wall_s: float | None,
        *,
        tables: Mapping[str, pa.Table] | None = None,
        directory: Path | None = None,
        manifest: Manifest | None = None,
    ) -> None:
        """Create results from tables by dataset, or from a directory and its manifest."""
        self.study, self.wall_s, self.directory = study, wall_s, directory
        self.manifest = manifest or Manifest(identity="")
        self.warnings, self.unfinished = tuple(map(to_one_line, self.manifest.warnings)), False
        no_curves = columns.arrow_schema(columns.CURVES).empty_table()
        self._tables = {"curves": no_curves, **(tables or {})}
        self._parts = StoredParts(directory, manifest) if directory and manifest else None
        self._whole: Any = None  # expression that selects the rows of whole draws

    @classmethod
    def read(cls, directory: str | Path) -> "Results":
        """Open a results directory; tables are read when needed.

        Of an unfinished study it has the draws that every variant has; a warning states how many.

        Raises:
            InputError: the directory contains no results or complete draws, its manifest or study
                cannot be read, or a part has changed.

        Examples:
            >>> changes = {"study.draws": 2, "study.rate_hz": 10.0}
            >>> _ = sinsjax.run_into(sinsjax.load_study("paper1_resets", changes), "out")
            >>> sinsjax.Results.read("out").summary.num_rows
            6
        """
        directory = Path(directory)
        manifest = Manifest.read(directory)
        study = load_study(directory / STUDY)
        if manifest.fingerprint != fingerprint(study):
            words = ("in the results", "in the file")
            differing = "; ".join(describe_differences(manifest.study, study, words))
            remedy = "(restore it, or delete it: `--resume` writes it again)"
            text = f"is not the study of the results: {differing} {remedy}"
            raise InputError(f"{directory / STUDY}: {text}")
        results = cls(study, manifest.wall_s, directory=directory, manifest=manifest)
        planned, runs = study.n_draws * study.n_variants, results.runs  # verifies the summary
        if runs < planned and manifest.state != "complete":
            results._select_whole_draws(f"unfinished: {runs:,} of {planned:,} runs are done")
        return results

    def _select_whole_draws(self, progress: str) -> None:
        """Restrict the results to draws that every variant has, for a fair comparison."""
        draws, counts = np.unique(self.rows(["draw_id"])["draw_id"], return_counts=True)
        whole = draws[counts == self.study.n_variants]
        if not len(whole):
            text = f"{progress}, and no draw that every variant has (continue with `--resume`)"
            raise InputError(f"{self.directory}: {text}")
        shown = f"shown are the {len(whole):,} draws that every variant has"
        remedy = "`sinsjax sweep --resume` adds the others"
        self.warnings = (f"{progress}; {shown}; {remedy}.", *self.warnings)
        draw = pc.divide(pc.field("run_id"), self.study.n_variants)
        self.unfinished, self._whole = True, draw.isin(whole.tolist())

    @property
    def runs(self) -> int:
        """Number of runs."""
        return self.rows(["run_id"]).num_rows

    @property
    def draws(self) -> int:
        """Number of draws per variant; fewer than the study's if it stopped early."""
        return self.runs // self.study.n_variants

    @cached_property
    def summary(self) -> pa.Table:
        """One row per run, ordered by run_id; the schema has units and meanings."""
        return self._read("summary")

    @cached_property
    def curves(self) -> pa.Table:
        """One row per run and record time; empty if curves were not kept."""
        return self._read("curves")

    def rows(self, names: Iterable[str]) -> pa.Table:
        """Return some columns of the summary, each once."""
        return self._read("summary", list(dict.fromkeys(names)))

    def read_curves(self, run_ids: Iterable[int]) -> pa.Table:
        """Return the curves of some runs; empty if none were stored."""
        return self._read("curves", rows=pc.field("run_id").isin(list(run_ids)))

    def _read(self, dataset: str, names: Sequence[str] | None = None, rows: Any = None) -> pa.Table:
        """Return columns of the rows of whole draws that an expression selects."""
        if self._parts is None:
            table = self._tables[dataset]
            table = table if rows is None else table.filter(rows)
            if missing := [name for name in names or () if name not in table.column_names]:
                raise InputError(f"{self.study.name}: {dataset}: column {missing[0]} is missing")
            return table if names is None else table.select(names)
        if self._whole is not None:
            rows = self._whole if rows is None else self._whole & rows
        return self._parts.read(dataset, names, rows)

    def rows_of_distinct_runs(self, names: Iterable[str]) -> pa.Table:
        """Return `rows` without duplicates: one variant of each set with the same runs.

        Keys without effect are null: without resets there is no cycle.
        """
        table, first_duplicate = self.rows(names), self.study.duplicate_of
        if (first_duplicate == np.arange(len(first_duplicate))).all():
            return table
        variant = np.tile(np.arange(len(first_duplicate)), self.draws)
        keep = first_duplicate[variant] == variant
        table, variant = table.filter(pa.array(keep)), variant[keep]
        for key in self.study.axis_keys:
            if key != "case" and key in table.column_names:
                no_effect = pa.array(self.study.without_effect(key)[variant])
                values = pc.if_else(no_effect, None, table[key])
                table = table.set_column(table.column_names.index(key), key, values)
        return table

    @cached_property
    def success_measures(self) -> tuple[SuccessMeasure, ...]:
        """Success criteria of the study that some run has, its own first."""
        criteria = success_measures(self.study)
        flags = self.rows([criterion.ok_column for criterion in criteria])
        return tuple(c for c in criteria if flags[c.ok_column].null_count < flags.num_rows)

    def __repr__(self) -> str:
        """Return five short lines: runs, axes, method, time and place."""
        facts, planned = self.study.facts, self.study.n_draws * self.study.n_variants
        facts.pop("length")
        if self.runs < planned:
            facts["runs"] = f"{self.runs:,} of {format_count(planned, 'run')}"
        failed = pc.is_in(self.rows(["status"])["status"], pa.array(columns.FAILED))
        facts["runs"] += f", {pc.sum(failed).as_py() or 0:,} diverged or not finite"
        time = "" if self.wall_s is None else f"in {self.wall_s:.3g} s, "
        facts["computed"] = f"{time}in {self.directory or 'memory'}"
        return format_facts(f"Results of {self.study.name}", facts)


def read_summary(
    directory: str | Path, names: Sequence[str] | None = None, *, run_ids: list[int] | None = None
) -> pa.Table:
    """Read rows of the summary, ordered by run_id.

    Args:
        directory: results directory.
        names: columns to read, in this order; None for all.
        run_ids: runs to read; None for all.

    Raises:
        InputError: the directory contains no results, a part has changed, or a column is missing.

    Examples:
        >>> study = sinsjax.load_study("paper1_resets", {"study.draws": 2, "study.rate_hz": 10.0})
        >>> _ = sinsjax.run_into(study, "out")
        >>> sinsjax.read_summary("out", ["run_id", "status"], run_ids=[4]).to_pylist()
        [{'run_id': 4, 'status': 'ok'}]
    """
    runs = None if run_ids is None else pc.field("run_id").isin(run_ids)
    return _open_parts(directory).read("summary", names, runs)


def read_curves(directory: str | Path, run_ids: list[int] | None = None) -> pa.Table:
    """Read rows of the curves, ordered by run_id and time; empty if none were stored.

    Args:
        directory: results directory.
        run_ids: runs to read; None for all.

    Raises:
        InputError: a part has changed or cannot be read.

    Examples:
        >>> study = sinsjax.load_study("paper1_resets", {"study.draws": 2, "study.rate_hz": 10.0})
        >>> _ = sinsjax.run_into(study, "out")
        >>> sinsjax.read_curves("out", [4]).num_rows
        900
    """
    runs = None if run_ids is None else pc.field("run_id").isin(run_ids)
    return _open_parts(directory).read("curves", None, runs)


def _open_parts(directory: str | Path) -> "StoredParts":
    return StoredParts(Path(directory), Manifest.read(Path(directory)))


class StoredParts:
    """The parts of a results directory, verified with its manifest before their rows are read."""

    def __init__(self, directory: Path, manifest: Manifest) -> None:
        self._directory, self._manifest = directory, manifest
        self._datasets: dict[str, Any] = {}  # None without parts

    def read(self, dataset: str, names: Sequence[str] | None = None, rows: Any = None) -> pa.Table:
        """Read columns of the rows that an expression selects, sorted; all by default."""
        order = ["run_id"] if dataset == "summary" else ["run_id", "time_s"]
        try:
            if dataset not in self._datasets:
                self._datasets[dataset] = self._open_dataset(dataset)
            if (stored := self._datasets[dataset]) is None:
                return columns.arrow_schema(columns.CURVES).empty_table()
            selected = stored.schema.names if names is None else list(names)
            if missing := [name for name in selected if name not in stored.schema.names]:
                raise InputError(f"{self._directory}: {dataset}: column {missing[0]} is missing")
            table = stored.to_table(columns=sorted({*order, *selected}), filter=rows)
        except (OSError, pa.ArrowException) as error:
            text = f"cannot be read: {first_error_line(error)} ({_RESUME_HINT})"
            raise InputError(f"{self._directory / dataset}: {text}") from error
        table = table.sort_by([(name, "ascending") for name in order]).select(selected)
        # The metadata of the first part does not apply to the others.
        return table.replace_schema_metadata({"sinsjax.schema": columns.SCHEMA_VERSION})

    def _open_dataset(self, dataset: str) -> Any:
        """Verify the parts of a dataset and return it; None without curves."""
        import pyarrow.dataset as ds  # late: it imports pandas where that is installed

        complete = list_parts(self._directory, "summary")  # first: their curves are there
        parts, manifest = list_parts(self._directory, dataset), self._manifest
        rows = sum(map(self._verify_part, parts))
        missing = {path.name for path in complete} - {path.name for path in parts}
        if dataset == "summary" and rows < manifest.runs_done:
            text = f"parts are missing: {rows:,} of {manifest.runs_done:,} runs are there"
            raise InputError(f"{self._directory / dataset}: {text} ({_RESUME_HINT})")
        if dataset == "curves" and manifest.curves and missing:
            path = self._directory / dataset / min(missing)
            raise InputError(f"{path}: is missing ({_RESUME_HINT})")
        if not parts and dataset == "summary":
            raise InputError(f"{self._directory}: contains no results (no part in {dataset}/)")
        return ds.dataset(parts, format="parquet") if parts else None

    def _verify_part(self, path: Path) -> int:
        """Verify a part and return its number of rows."""
        metadata = read_part_metadata(read_regular_file(path))
        if metadata is None:
            raise InputError(f"{path}: has changed since it was written ({_RESUME_HINT})")
        identity, chunk = metadata[STUDY_METADATA], json.loads(metadata[CHUNK_METADATA])
        place = (path.parent.name, path.stem, self._manifest.identity)
        if (chunk["dataset"], chunk["name"], identity) != place:
            text = "is a part of another study's results, or under another name"
            raise InputError(f"{path}: {text} ({_RESUME_HINT})")
        return chunk["rows"]


def read_part_metadata(content: bytes) -> dict[str, str] | None:
    """Return the metadata of a part's content, see `tasks.part_metadata`; None if it is damaged."""
    if not is_intact(content):
        return None
    entries = pq.read_metadata(pa.BufferReader(content)).metadata or {}
    names = (STUDY_METADATA, CHUNK_METADATA)
    if not entries.keys() >= {name.encode() for name in names}:
        return None  # another program's
    return {name: entries[name.encode()].decode() for name in names}
