"""A directory of results as reports and pages read it."""

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from sinsjax import analysis
from sinsjax.errors import InputError
from sinsjax.execution import directory as places
from sinsjax.execution import results
from sinsjax.messages import format_count, to_one_line
from sinsjax.study.study import Study
from sinsjax.study.success import Yardstick, yardsticks

_KEPT = 2**20  # runs; of more, columns are read anew each time, to bound the memory


@dataclass(frozen=True, eq=False)
class Source:
    """A directory of results; what is asked for is read, and no more.

    Attributes:
        directory: where they are.
        study: the resolved study.
        config: what a page names as the study's file.
        table: the summary by run_id, where it need not be read; the estimates by variant_id.
        warnings: what was doubtful before the study ran, a line each.
        version: of the package that computed them.
        wall_s: how long the study took, s; None if unknown.
        record_latitude_deg: that of the header of the record, deg; None if there is none.
        whole_draws: of an unfinished study, the draws that all variants have; no others are read.
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
    _kept: dict[str, pa.Table] = field(default_factory=dict, init=False, repr=False)

    @classmethod
    def read(cls, directory: Path, *, unfinished: bool = False) -> "Source":
        """Opens a directory of results.

        Args:
            directory: where they are.
            unfinished: whether the draws that are whole stand for a study that is not finished; a
                warning then says how many there are.

        Raises:
            InputError: it holds none, or its study cannot be read, or no draw is whole yet.
        """
        table = None
        places.check_entries(directory)
        manifest = places.read_manifest(directory)
        has_estimates = results.has_dataset(directory, "estimates")
        if has_estimates and not results.has_dataset(directory, "summary"):
            table = results.read_estimates(directory)
        else:
            results.count_runs(directory)
        study = results.load_stored_study(directory)
        name = manifest.get("config") or f"study.toml of {study.name}"
        told = manifest.get("warnings")
        warnings = tuple(
            to_one_line(str(line)) for line in (told if isinstance(told, list) else ())
        )
        versions = manifest.get("versions")
        version = (versions if isinstance(versions, dict) else {}).get("sinsjax", "unknown")
        version, config = to_one_line(str(version)), to_one_line(str(name))
        numbers = (manifest.get(name) for name in ("wall_s", "record_latitude_deg"))
        wall_s, latitude_deg = (float(x) if isinstance(x, int | float) else None for x in numbers)
        source = cls(directory, study, config, table, warnings, version, wall_s, latitude_deg)
        is_going_on = unfinished and manifest.get("state") in ("running", "interrupted")
        return source._of_what_is_there() if is_going_on else source

    def _of_what_is_there(self) -> "Source":
        """The same of the draws that are whole: variants are compared on the same draws."""
        study, runs = self.study, self.runs
        whole, shown = None, ""
        if self.table is None:
            draws = analysis.numeric_column(
                results.read_summary(self.directory, ["draw_id"]), "draw_id"
            )
            number, count = np.unique(draws.astype(int), return_counts=True)
            whole = number[count == study.n_variants]
            shown = f"; shown are the {len(whole):,} draws that every variant has"
        most = study.n_draws * study.n_variants
        if runs >= most:
            return self
        kind = "runs" if self.table is None else "variants"
        there = f"unfinished: {runs:,} of {most:,} {kind} are there ({100 * runs / most:.2g} %)"
        if whole is not None and not len(whole):
            raise InputError(
                f"{self.directory}: {there}, and no draw that every variant has (continue with"
                " `--resume`)"
            )
        told = f"{there}{shown}; `sinsjax sweep --resume` adds the others."
        return replace(self, whole_draws=whole, warnings=(told, *self.warnings))

    @cached_property
    def runs(self) -> int:
        """Number of rows: of runs, or of variants where these are estimated."""
        if self.whole_draws is not None:
            return len(self.whole_draws) * self.study.n_variants
        return results.count_runs(self.directory) if self.table is None else self.table.num_rows

    @property
    def counted(self) -> str:
        """What a figure rests on, for its footer: the study's name and how many runs it has."""
        study = self.study
        unit = "start time" if study.is_recorded else "Monte Carlo run"
        if study.n_variants == 1:
            return f"{study.name}: {format_count(self.runs, unit)}"
        each = self.runs / study.n_variants
        rows = format_count(int(each), unit) if each.is_integer() else f"{each:,g} {unit}s"
        return f"{study.name}: {study.n_variants:,} variants × {rows} = {self.runs:,} runs"

    @property
    def draws(self) -> int:
        """Draws of every variant: fewer than the study's where it stopped or is unfinished.

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
                f"{self.directory}: {self.runs} runs where the study has"
                f" {draws * study.n_variants}: are the results complete?"
            )
        return draws

    @cached_property
    def summary(self) -> pa.Table:
        """All columns, one row a run, by run_id; kept. A large study has no room for it."""
        return self._whole(None) if self.table is None else self.table

    def _whole(self, names: list[str] | None) -> pa.Table:
        """Columns of the runs that are read; None for all columns."""
        if self.whole_draws is None:
            return results.read_summary(self.directory, names)
        more = None if names is None else [*names, *({"draw_id"} - {*names})]
        rows = results.read_summary(self.directory, more)
        rows = rows.filter(pc.is_in(rows["draw_id"], pa.array(self.whole_draws)))
        return rows if names is None else rows.select(names)

    def rows(self, names: Iterable[str]) -> pa.Table:
        """Some columns, one row a run, by run_id; each is read once, unless there are many runs.

        Args:
            names: of the columns; repeated ones are there once.

        Raises:
            InputError: a column is missing.
        """
        wanted = list(dict.fromkeys(names))
        if self.table is None:
            if self.runs > _KEPT or not wanted:
                return self._whole(wanted)
            if missing := [name for name in wanted if name not in self._kept]:
                read = self._whole(missing)
                self._kept.update((name, read.select([name])) for name in missing)
            columns = [self._kept[name] for name in wanted]
            fields = [one.schema.field(0) for one in columns]
            schema = pa.schema(fields, columns[0].schema.metadata)
            return pa.Table.from_arrays([one.column(0) for one in columns], schema=schema)
        if missing := [name for name in wanted if name not in self.table.column_names]:
            raise InputError(f"{self.directory}: summary: column {missing[0]} is missing")
        return self.table.select(wanted)

    def largest(self, key: str) -> float:
        """The largest magnitude of a number or vector of the study, given or drawn, to 3 digits."""
        drawn = key in self.study.drawn_keys
        values = self.rows([key])[key].to_pylist() if drawn else self.study.values(key)
        return float(f"{max(float(np.max(np.abs(value or 0.0))) for value in values):.3g}")

    def distinct(self, names: Iterable[str]) -> pa.Table:
        """As `rows`, of variants that differ: one of each kind that has the same runs.

        Keys are null where they do not act: without resets there is no cycle.
        """
        first = self.study.duplicate_of
        if (first == np.arange(len(first))).all():
            return self.rows(names)
        table = self.rows(names)
        variant = np.tile(np.arange(len(first)), self.draws)
        keep = first[variant] == variant
        table, variant = table.filter(pa.array(keep)), variant[keep]
        for key in self.study.axis_keys:
            if key != "case" and key in table.column_names:
                place = table.column_names.index(key)
                nothing = pa.array(self.study.without_effect(key)[variant])
                values = pc.if_else(nothing, None, table[key])
                table = table.set_column(place, key, values)
        return table

    @cached_property
    def yardsticks(self) -> tuple[Yardstick, ...]:
        """What success can be counted from, what the study is judged from first.

        Neither the truth nor the bias floor where no run has one.
        """
        found = yardsticks(self.study)
        flags = self.rows([yard.ok for yard in found])
        return tuple(yard for yard in found if flags[yard.ok].null_count < flags.num_rows)

    @property
    def has_curves(self) -> bool:
        """Whether curves of any run were stored."""
        return (self.directory / "curves").is_dir()

    def curves(self, run_ids: Iterable[int] | None = None) -> pa.Table:
        """Curves of some runs, or of all that are read; empty where none were stored."""
        if run_ids is None and self.whole_draws is not None:
            run_ids = self.rows(["run_id"])["run_id"].to_pylist()
        return results.read_curves(self.directory, None if run_ids is None else sorted(run_ids))
