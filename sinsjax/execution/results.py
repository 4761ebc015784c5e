"""Results of studies: tables in memory, or in a directory whose parts are verified once."""

import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from sinsjax import columns, gone
from sinsjax.errors import InputError
from sinsjax.execution import frames, sealed
from sinsjax.execution.directory import (
    STUDY,
    Manifest,
    check_directory,
    list_parts,
    results_path,
)
from sinsjax.messages import first_error_line, format_count, to_one_line
from sinsjax.platform.files import read_regular_file
from sinsjax.study import display
from sinsjax.study.attitude_file import attitude_file
from sinsjax.study.identity import describe_differences, fingerprint, sections_to_json
from sinsjax.study.load import load_study
from sinsjax.study.study import Study
from sinsjax.study.success import SuccessMeasure, success_measures
from sinsjax.study.sweep import without_gone_settings

STUDY_METADATA, CHUNK_METADATA = "sinsjax.study", "sinsjax.chunk"
"""Metadata of a part: identity of its job, and its chunk as JSON."""

_RESUME_HINT = "`--resume` computes damaged parts again"
_READERS = 4  # threads; hashing releases Python's lock
_MAX_KEPT_RUNS = 2**18  # larger studies read columns anew each time, to limit the memory


class Results:
    """Results of a study: tables of its runs, in memory or read from a directory when needed.

    ``summary, curves = results`` gives both tables.

    Attributes:
        study: the study, at the rate of its record if it has one.
        directory: directory of the results; None in memory.
        wall_s: time that the study took, s, with compilation.
        manifest: entries of the manifest in the directory.
        config: label of the study.
        version: version of sinsjax that computed the results.
        warnings: warnings from before the study ran, one line each.
        whole_draws: in an unfinished study, the draws that every variant has, if it is restricted
            to them; else None.

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
        self._tables = dict(tables or {})  # those of a directory are added when they are read
        self._parts = StoredParts(directory, manifest) if directory and tables is None else None
        self.config = to_one_line(self.manifest.config or f"study.toml of {study.name}")
        self.version = to_one_line(self.manifest.versions.get("sinsjax", "unknown"))
        self.warnings = tuple(map(to_one_line, self.manifest.warnings))
        self.whole_draws: np.ndarray | None = None

    @classmethod
    def read(cls, directory: str | Path, *, whole_draws: bool = False) -> "Results":
        """Open a results directory; tables are read when needed.

        Args:
            directory: results directory.
            whole_draws: whether to restrict an unfinished study to the draws that every variant
                has; a warning then states how many there are.

        Raises:
            InputError: the directory contains no results or complete draws, its manifest or study
                cannot be read, or a part has changed.

        Examples:
            >>> changes = {"study.draws": 2, "study.rate_hz": 10.0}
            >>> _ = sinsjax.run_into(sinsjax.load_study("paper1_resets", changes), "out")
            >>> sinsjax.Results.read("out").summary.num_rows
            6
        """
        directory = results_path(directory)
        check_directory(directory)
        manifest = Manifest.read(directory)
        study = _load_study(directory, manifest)
        results = cls(study, manifest.wall_s, directory=directory, manifest=manifest)
        assert results.runs >= 0  # verifies the summary
        if whole_draws and manifest.state in ("running", "interrupted"):
            results._restrict_to_whole_draws()
        return results

    def _restrict_to_whole_draws(self) -> None:
        """Restrict the results to draws that every variant has, for a fair comparison."""
        planned, runs = self.study.n_draws * self.study.n_variants, self.runs
        if runs >= planned:
            return
        draws, counts = np.unique(self._read_rows(["draw_id"])["draw_id"], return_counts=True)
        whole = draws[counts == self.study.n_variants]
        progress = (
            f"unfinished: {runs:,} of {planned:,} runs are done ({100 * runs / planned:.2g} %)"
        )
        if not len(whole):
            text = f"{progress}, and no draw that every variant has (continue with `--resume`)"
            raise InputError(f"{self.directory}: {text}")
        remedy = "`sinsjax sweep --resume` adds the others"
        if self.study.study.external:
            remedy = "the others were not exported"
        shown = f"shown are the {len(whole):,} draws that every variant has"
        self.warnings = (f"{progress}; {shown}; {remedy}.", *self.warnings)
        self.whole_draws = whole

    def _stored(self) -> "StoredParts":
        assert self._parts is not None
        return self._parts

    @cached_property
    def _stored_runs(self) -> int:
        return self._stored().query("summary", lambda dataset: dataset.count_rows())

    @property
    def runs(self) -> int:
        """Number of runs."""
        if self.whole_draws is not None:
            return len(self.whole_draws) * self.study.n_variants
        if "summary" in self._tables:
            return self._tables["summary"].num_rows
        return self._stored_runs

    @property
    def draws(self) -> int:
        """Number of draws per variant; fewer than the study's if it stopped early or is unfinished.

        Raises:
            InputError: runs are missing.
        """
        if self.whole_draws is not None:
            return len(self.whole_draws)
        study, draws = self.study, self.study.n_draws
        if study.stop_when and self.runs:
            draws = pc.max(self.rows(["draw_id"])["draw_id"]).as_py() + 1
        if self.runs != draws * study.n_variants:
            raise InputError(
                f"{self.directory}: has {self.runs} runs, but the study has"
                f" {draws * study.n_variants} (continue with `--resume`)"
            )
        return draws

    @property
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
        if "summary" not in self._tables:
            self._tables["summary"] = self._read_rows(None)
        return self._tables["summary"]

    @property
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
        if "curves" not in self._tables:
            self._tables["curves"] = self.read_curves()
        return self._tables["curves"]

    def rows(self, names: Iterable[str]) -> pa.Table:
        """Return some columns, one row per run, by run_id.

        Args:
            names: names of the columns; repeated ones appear once.

        Raises:
            InputError: a column is missing.
        """
        selected = list(dict.fromkeys(names))
        if "summary" not in self._tables and self.runs > _MAX_KEPT_RUNS:
            return self._read_rows(selected)
        if missing := [name for name in selected if name not in self.summary.column_names]:
            raise InputError(f"{self.directory}: summary: column {missing[0]} is missing")
        return self.summary.select(selected)

    def _read_rows(self, names: list[str] | None) -> pa.Table:
        """Read columns of the summary, restricted to `whole_draws`; None for all columns."""
        draws = None
        if self.whole_draws is not None:
            draws = pc.field("draw_id").isin(self.whole_draws.tolist())
        return self._stored().read("summary", names, draws)

    def read_curves(self, run_ids: Iterable[int] | None = None) -> pa.Table:
        """Return the curves of some runs, or of all; empty if none were stored."""
        if run_ids is None and self.whole_draws is not None:
            run_ids = self.rows(["run_id"])["run_id"].to_pylist()
        runs = None if run_ids is None else pc.field("run_id").isin(list(run_ids))
        if "curves" not in self._tables:
            return self._stored().read("curves", None, runs)
        return self._tables["curves"] if runs is None else self._tables["curves"].filter(runs)

    @property
    def has_curves(self) -> bool:
        """Return whether curves of any run were stored."""
        if self._parts is not None:
            return bool(self._parts.paths("curves"))
        return len(self._tables.get("curves", ())) > 0

    # --- for reports ----------------------------------------------------------------------------

    @property
    def sample_size_text(self) -> str:
        """Sample size for the footer of a figure: the study's name and its number of runs."""
        study = self.study
        unit = "start time" if study.is_recorded else "Monte Carlo run"
        if study.n_variants == 1:
            return f"{study.name}: {format_count(self.runs, unit)}"
        each = self.runs / study.n_variants
        rows = format_count(int(each), unit) if each.is_integer() else f"{each:,g} {unit}s"
        return f"{study.name}: {study.n_variants:,} variants × {rows} = {self.runs:,} runs"

    def largest_magnitude(self, key: str) -> float:
        """Return the largest magnitude of a key's numbers, fixed or drawn, to 3 digits."""
        drawn = key in self.study.drawn_keys
        values = self.rows([key])[key].to_pylist() if drawn else self.study.values(key)
        return float(f"{max(float(np.max(np.abs(value or 0.0))) for value in values):.3g}")

    def distinct_rows(self, names: Iterable[str]) -> pa.Table:
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
        """Success criteria of the study, its own first.

        Truth and bias floor are left out if no run has one.
        """
        criteria = success_measures(self.study)
        flags = self.rows([criterion.ok_column for criterion in criteria])
        return tuple(c for c in criteria if flags[c.ok_column].null_count < flags.num_rows)

    # --- in Python ------------------------------------------------------------------------------

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

    def __dir__(self) -> list[str]:
        """Return the names that a user needs, for the completion of interactive sessions."""
        return ["curves", "directory", "study", "summary", "to_pandas", "to_xarray", "wall_s"]

    def _facts(self) -> dict[str, str]:
        facts = self.study.facts
        facts.pop("length")
        status = self.rows(["status"])["status"]
        failed = pc.sum(pc.is_in(status, pa.array(columns.FAILED))).as_py() or 0
        planned = self.study.n_draws * self.study.n_variants
        if self.runs < planned:
            facts["runs"] = f"{self.runs:,} of {format_count(planned, 'run')}"
        facts["runs"] += f", {failed:,} diverged or not finite"
        time = "" if self.wall_s is None else f"in {self.wall_s:.3g} s, "
        return facts | {"computed": f"{time}in {self.directory or 'memory'}"}


def read_summary(
    directory: str | Path,
    names: Sequence[str] | None = None,
    *,
    run_ids: list[int] | None = None,
    verify: bool = True,
) -> pa.Table:
    """Read rows of the summary, ordered by run_id.

    Args:
        directory: results directory.
        names: columns to read, in this order; None for all.
        run_ids: runs to read; None for all.
        verify: whether to verify the checksum of every part.

    Raises:
        InputError: the directory contains no results, a part has changed, or a column is missing.

    Examples:
        >>> study = sinsjax.load_study("paper1_resets", {"study.draws": 2, "study.rate_hz": 10.0})
        >>> _ = sinsjax.run_into(study, "out")
        >>> sinsjax.read_summary("out", ["run_id", "status"], run_ids=[4]).to_pylist()
        [{'run_id': 4, 'status': 'ok'}]
    """
    runs = None if run_ids is None else pc.field("run_id").isin(run_ids)
    return StoredParts.open(directory, verify=verify).read("summary", names, runs)


def read_curves(
    directory: str | Path, run_ids: list[int] | None = None, *, verify: bool = True
) -> pa.Table:
    """Read rows of the curves, ordered by run_id and time; empty if none were stored.

    Args:
        directory: results directory.
        run_ids: runs to read; None for all.
        verify: whether to verify the checksum of every part.

    Raises:
        InputError: a part has changed or cannot be read.

    Examples:
        >>> study = sinsjax.load_study("paper1_resets", {"study.draws": 2, "study.rate_hz": 10.0})
        >>> _ = sinsjax.run_into(study, "out")
        >>> sinsjax.read_curves("out", [4]).num_rows
        900
    """
    runs = None if run_ids is None else pc.field("run_id").isin(run_ids)
    return StoredParts.open(directory, verify=verify).read("curves", None, runs)


class StoredParts:
    """The parts of a results directory, each verified once before its rows are read."""

    def __init__(self, directory: Path, manifest: Manifest | None, *, verify: bool = True) -> None:
        """Prepare to read parts, which the manifest, if there is one, must not contradict."""
        self._directory, self._manifest, self._verify = directory, manifest, verify
        self._verified: dict[str, list[Path]] = {}

    @classmethod
    def open(cls, directory: str | Path, *, verify: bool = True) -> "StoredParts":
        """Return the parts of a directory, whose manifest may be missing or damaged."""
        directory = Path(directory)
        check_directory(directory)
        return cls(directory, Manifest.find(directory) if verify else None, verify=verify)

    def paths(self, dataset: str) -> list[Path]:
        """Return the parts of a dataset, verified; empty if none were stored.

        Raises:
            InputError: a part has changed, is missing or belongs elsewhere.
        """
        if dataset not in self._verified:
            others = list_parts(self._directory, "summary")  # first: their curves are complete
            parts = list_parts(self._directory, dataset)
            if self._verify:
                self._verify_all(dataset, parts, others)
            self._verified[dataset] = parts
        return self._verified[dataset]

    def _verify_all(self, dataset: str, parts: list[Path], summary: list[Path]) -> None:
        with ThreadPoolExecutor(_READERS) as pool:
            rows = sum(pool.map(self._verify_part, parts))
        if self._manifest is None:
            return
        if dataset == "summary" and rows < self._manifest.runs_done:
            raise InputError(
                f"{self._directory / dataset}: parts are missing: {rows:,} of"
                f" {self._manifest.runs_done:,} runs are there ({_RESUME_HINT})"
            )
        missing = {path.name for path in summary} - {path.name for path in parts}
        if dataset == "curves" and self._manifest.curves and missing:
            path = self._directory / dataset / min(missing)
            raise InputError(f"{path}: is missing ({_RESUME_HINT})")

    def _verify_part(self, path: Path) -> int:
        """Verify a part and return its number of rows."""
        metadata = read_part_metadata(read_regular_file(path))
        if metadata is None:
            raise InputError(f"{path}: has changed since it was written ({_RESUME_HINT})")
        chunk = json.loads(metadata[CHUNK_METADATA])
        if (chunk["dataset"], chunk["name"]) != (path.parent.name, path.stem):
            text = f"is part {chunk['dataset']}/{chunk['name']} under another name"
            raise InputError(f"{path}: {text} ({_RESUME_HINT})")
        if self._manifest is not None and metadata[STUDY_METADATA] != self._manifest.identity:
            raise InputError(f"{path}: is a part of another study's results ({_RESUME_HINT})")
        return chunk["rows"]

    def query(self, dataset: str, function: Callable[[Any], Any]) -> Any:
        """Return the result of a function of a dataset, a `pyarrow.dataset.Dataset`.

        Raises:
            InputError: there are no parts, or a part has changed or cannot be read.
        """
        import pyarrow.dataset as ds  # late: it imports pandas where that is installed

        try:
            if parts := self.paths(dataset):
                return function(ds.dataset(parts, format="parquet"))
        except (OSError, pa.ArrowException) as error:
            text = f"cannot be read: {first_error_line(error)} ({_RESUME_HINT})"
            raise InputError(f"{self._directory / dataset}: {text}") from error
        raise InputError(f"{self._directory}: contains no results (no part in {dataset}/)")

    def read(self, dataset: str, names: Sequence[str] | None = None, rows: Any = None) -> pa.Table:
        """Read rows of a dataset, sorted; without curves those are an empty table.

        Args:
            dataset: "summary" or "curves".
            names: columns to read, in this order; None for all.
            rows: expression that selects rows; None for all.
        """
        order = {"summary": ["run_id"], "curves": ["run_id", "time_s"]}[dataset]
        if dataset == "curves" and not self.paths(dataset):
            return columns.arrow_schema(columns.CURVES).empty_table()

        def select_rows(stored: Any) -> pa.Table:
            selected = stored.schema.names if names is None else list(names)
            if missing := [name for name in selected if name not in stored.schema.names]:
                path = self._directory
                raise InputError(f"{path}: {dataset}: column {missing[0]} is missing")
            table = stored.to_table(columns=sorted({*order, *selected}), filter=rows)
            return table.sort_by([(name, "ascending") for name in order]).select(selected)

        # The metadata of the first part does not apply to the others.
        return self.query(dataset, select_rows).replace_schema_metadata(
            {"sinsjax.schema": columns.SCHEMA_VERSION}
        )


def read_part_metadata(content: bytes) -> dict[str, str] | None:
    """Return the metadata of a part, see `tasks.part_metadata`; None if it is not intact.

    Args:
        content: content of the file.
    """
    if not sealed.is_intact(content):
        return None
    try:
        about = pq.read_metadata(pa.BufferReader(content))
        entries = about.metadata or {}
        metadata = {key: entries[key.encode()].decode() for key in (STUDY_METADATA, CHUNK_METADATA)}
        rows = json.loads(metadata[CHUNK_METADATA])["rows"]
        return metadata if rows == about.num_rows else None
    except (KeyError, ValueError, TypeError, pa.ArrowException):
        return None


def _load_study(directory: Path, manifest: Manifest) -> Study:
    """Load the study of a results directory.

    Raises:
        InputError: it cannot be read, or is not the study of the results.
    """
    try:
        study = load_study(directory / STUDY)
    except InputError as error:
        if any(gone.MARK in line for line in error.lines):
            text = to_one_line("; ".join(error.lines))
            raise InputError(f"{text}; `sinsjax.read_summary` still reads the rows") from None
        raise
    if not _is_study_of(manifest, study):
        differing = describe_differences(manifest.study, study, ("in the results", "in the file"))
        text = f"is not the study of the results: {to_one_line('; '.join(differing))}"
        remedy = "(restore it, or delete it: `--resume` writes it again)"
        raise InputError(f"{directory / STUDY}: {text} {remedy}")
    return study


def _is_study_of(manifest: Manifest, study: Study) -> bool:
    """Return whether a manifest is of a study, whose attitude_file may be gone."""
    if attitude_file(study) is not None:
        return without_gone_settings(manifest.study) == sections_to_json(study)
    return manifest.fingerprint == fingerprint(study)
