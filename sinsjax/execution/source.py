"""A results directory as the source of reports and pages."""

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from sinsjax import analysis
from sinsjax.errors import InputError
from sinsjax.execution import directory as results_directory
from sinsjax.execution import results
from sinsjax.messages import format_count, to_one_line
from sinsjax.study.study import Study
from sinsjax.study.success import SuccessMeasure, success_measures

_MAX_CACHED_RUNS = 2**20  # larger studies read columns anew each time, to limit the memory


@dataclass(frozen=True, eq=False)
class Source:
    """A results directory, of which only the requested columns are read.

    Attributes:
        directory: results directory.
        study: the resolved study.
        config: name of the study's file on pages.
        table: the summary, if it has been read as a whole; else None.
        warnings: warnings from before the study ran, one line each.
        version: version of sinsjax that computed the results.
        wall_s: duration of the study, s; None if unknown.
        record_latitude_deg: latitude in the record's header, deg; None if there is none.
        whole_draws: in an unfinished study, the draws that every variant has; others are ignored.
    """

    directory: Path
    study: Study
    config: str
    table: pa.Table | None = None
    warnings: tuple[str, ...] = ()
    version: str = "unknown"
    wall_s: float | None = None
    record_latitude_deg: float | None = None
    whole_draws: np.ndarray | None = None
    _cached_columns: dict[str, pa.Table] = field(default_factory=dict, init=False, repr=False)

    @classmethod
    def read(cls, directory: Path, *, unfinished: bool = False) -> "Source":
        """Open a results directory.

        Args:
            directory: results directory.
            unfinished: whether to accept an unfinished study, restricted to the draws that every
                variant has; a warning then states how many there are.

        Raises:
            InputError: it contains no results or complete draws, or its study cannot be read.
        """
        results_directory.check_directory(directory)
        manifest = results_directory.read_manifest(directory)
        results.count_runs(directory)
        study = results.load_stored_study(directory)
        name = manifest.get("config") or f"study.toml of {study.name}"
        manifest_warnings = manifest.get("warnings")
        warnings = tuple(
            to_one_line(str(line))
            for line in (manifest_warnings if isinstance(manifest_warnings, list) else ())
        )
        versions = manifest.get("versions")
        version = (versions if isinstance(versions, dict) else {}).get("sinsjax", "unknown")
        version, config = to_one_line(str(version)), to_one_line(str(name))
        numbers = (manifest.get(name) for name in ("wall_s", "record_latitude_deg"))
        wall_s, latitude_deg = (float(x) if isinstance(x, int | float) else None for x in numbers)
        source = cls(directory, study, config, None, warnings, version, wall_s, latitude_deg)
        restrict = unfinished and manifest.get("state") in ("running", "interrupted")
        return source._restrict_to_whole_draws() if restrict else source

    def _restrict_to_whole_draws(self) -> "Source":
        """Return the source restricted to draws that every variant has, for a fair comparison."""
        study, runs = self.study, self.runs
        draws = analysis.numeric_column(
            results.read_summary(self.directory, ["draw_id"]), "draw_id"
        )
        draw_ids, variant_counts = np.unique(draws.astype(int), return_counts=True)
        whole_draws = draw_ids[variant_counts == study.n_variants]
        suffix = f"; shown are the {len(whole_draws):,} draws that every variant has"
        planned_runs = study.n_draws * study.n_variants
        if runs >= planned_runs:
            return self
        share = 100 * runs / planned_runs
        progress = f"unfinished: {runs:,} of {planned_runs:,} runs are done ({share:.2g} %)"
        if not len(whole_draws):
            raise InputError(
                f"{self.directory}: {progress}, and no draw that every variant has (continue with"
                " `--resume`)"
            )
        remedy = "`sinsjax sweep --resume` adds the others"
        if self.study.study.external:
            remedy = "the others were not exported"
        warning = f"{progress}{suffix}; {remedy}."
        return replace(self, whole_draws=whole_draws, warnings=(warning, *self.warnings))

    @cached_property
    def runs(self) -> int:
        """Number of runs."""
        if self.whole_draws is not None:
            return len(self.whole_draws) * self.study.n_variants
        return results.count_runs(self.directory) if self.table is None else self.table.num_rows

    @property
    def sample_size_text(self) -> str:
        """Sample size for the footer of a figure: the study's name and its number of runs."""
        study = self.study
        unit = "start time" if study.is_recorded else "Monte Carlo run"
        if study.n_variants == 1:
            return f"{study.name}: {format_count(self.runs, unit)}"
        runs_per_variant = self.runs / study.n_variants
        rows = (
            format_count(int(runs_per_variant), unit)
            if runs_per_variant.is_integer()
            else f"{runs_per_variant:,g} {unit}s"
        )
        return f"{study.name}: {study.n_variants:,} variants × {rows} = {self.runs:,} runs"

    @property
    def draws(self) -> int:
        """Number of draws per variant; fewer than the study's if it stopped early or is unfinished.

        Raises:
            InputError: runs are missing.
        """
        study = self.study
        if self.whole_draws is not None:
            return len(self.whole_draws)
        draws = study.n_draws
        if study.stop_when and self.runs:
            draws = int(analysis.numeric_column(self.rows(["draw_id"]), "draw_id").max()) + 1
        if self.runs != draws * study.n_variants:
            raise InputError(
                f"{self.directory}: has {self.runs} runs, but the study has"
                f" {draws * study.n_variants} (continue with `--resume`)"
            )
        return draws

    @cached_property
    def summary(self) -> pa.Table:
        """All columns, one row per run, by run_id, cached; too large in large studies."""
        return self._read_columns(None) if self.table is None else self.table

    def _read_columns(self, names: list[str] | None) -> pa.Table:
        """Read columns of the summary, restricted to `whole_draws`; None for all columns."""
        if self.whole_draws is None:
            return results.read_summary(self.directory, names)
        needed = None if names is None else [*names, *({"draw_id"} - {*names})]
        rows = results.read_summary(self.directory, needed)
        rows = rows.filter(pc.is_in(rows["draw_id"], pa.array(self.whole_draws)))
        return rows if names is None else rows.select(names)

    def rows(self, names: Iterable[str]) -> pa.Table:
        """Return some columns, one row per run, by run_id; each is read once, unless runs are many.

        Args:
            names: names of the columns; repeated ones appear once.

        Raises:
            InputError: a column is missing.
        """
        selected = list(dict.fromkeys(names))
        if self.table is None:
            if self.runs > _MAX_CACHED_RUNS or not selected:
                return self._read_columns(selected)
            if missing := [name for name in selected if name not in self._cached_columns]:
                table = self._read_columns(missing)
                self._cached_columns.update((name, table.select([name])) for name in missing)
            columns = [self._cached_columns[name] for name in selected]
            fields = [column.schema.field(0) for column in columns]
            schema = pa.schema(fields, columns[0].schema.metadata)
            return pa.Table.from_arrays([column.column(0) for column in columns], schema=schema)
        if missing := [name for name in selected if name not in self.table.column_names]:
            raise InputError(f"{self.directory}: summary: column {missing[0]} is missing")
        return self.table.select(selected)

    def largest_magnitude(self, key: str) -> float:
        """Return the largest magnitude of a key's numbers, fixed or drawn, to 3 digits."""
        drawn = key in self.study.drawn_keys
        values = self.rows([key])[key].to_pylist() if drawn else self.study.values(key)
        return float(f"{max(float(np.max(np.abs(value or 0.0))) for value in values):.3g}")

    def distinct_rows(self, names: Iterable[str]) -> pa.Table:
        """Return `rows` without duplicates: one variant of each set with the same runs.

        Keys without effect are null: without resets there is no cycle.
        """
        first_duplicate = self.study.duplicate_of
        if (first_duplicate == np.arange(len(first_duplicate))).all():
            return self.rows(names)
        table = self.rows(names)
        variant = np.tile(np.arange(len(first_duplicate)), self.draws)
        keep = first_duplicate[variant] == variant
        table, variant = table.filter(pa.array(keep)), variant[keep]
        for key in self.study.axis_keys:
            if key != "case" and key in table.column_names:
                index = table.column_names.index(key)
                no_effect = pa.array(self.study.without_effect(key)[variant])
                values = pc.if_else(no_effect, None, table[key])
                table = table.set_column(index, key, values)
        return table

    @cached_property
    def success_measures(self) -> tuple[SuccessMeasure, ...]:
        """Success criteria of the study, its own first.

        Truth and bias floor are left out if no run has one.
        """
        criteria = success_measures(self.study)
        flags = self.rows([criterion.ok_column for criterion in criteria])
        return tuple(
            criterion
            for criterion in criteria
            if flags[criterion.ok_column].null_count < flags.num_rows
        )

    @property
    def has_curves(self) -> bool:
        """Return whether curves of any run were stored."""
        return (self.directory / "curves").is_dir()

    def curves(self, run_ids: Iterable[int] | None = None) -> pa.Table:
        """Return the curves of some runs, or of all; empty if none were stored."""
        if run_ids is None and self.whole_draws is not None:
            run_ids = self.rows(["run_id"])["run_id"].to_pylist()
        return results.read_curves(self.directory, None if run_ids is None else sorted(run_ids))
