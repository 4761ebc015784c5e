"""What a report is made of: where it reads from, and the blocks that a report has."""

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from matplotlib.figure import Figure

from sinsjax import analysis, columns, plots
from sinsjax.analysis import Estimate, format_estimate
from sinsjax.errors import InputError
from sinsjax.execution import estimates, tables
from sinsjax.execution.parts import is_there
from sinsjax.study.acting import first_alike, silent
from sinsjax.study.load import load_study
from sinsjax.study.study import Study
from sinsjax.study.success import Yardstick, as_of_schema_1, success_of, yardsticks


@dataclass(frozen=True, eq=False)
class Source:
    """A directory of results; what is asked for is read, and no more.

    Attributes:
        directory: where they are.
        study: the resolved study.
        config: what a page names as the study's file.
        table: the summary by run_id, where it need not be read; the estimates by variant_id.
        schema: version of the results' columns.
        warnings: what was doubtful before the study ran, a line each.
        version: of the package that computed them.
    """

    directory: Path
    study: Study
    config: str
    table: pa.Table | None = None
    schema: str = columns.SCHEMA_VERSION
    warnings: tuple[str, ...] = ()
    version: str = "unknown"

    @classmethod
    def read(cls, directory: Path) -> "Source":
        """Opens a directory of results.

        Raises:
            InputError: it holds none, or its study cannot be read.
        """
        table = None
        if is_there(directory, estimates.DATASET):
            table = estimates.read_estimates(directory)
        else:
            tables.count_runs(directory)
        study = load_study(directory / "study.toml")
        manifest = tables.read_manifest(directory)
        schema = str(manifest.get("schema"))
        if schema == "1":
            study = as_of_schema_1(study)
        name = manifest.get("config") or f"study.toml of {study.name}"
        told = manifest.get("warnings")
        warnings = tuple(map(str, told if isinstance(told, list) else ()))
        versions = manifest.get("versions")
        version = str((versions if isinstance(versions, dict) else {}).get("sinsjax", "unknown"))
        return cls(directory, study, str(name), table, schema, warnings, version)

    @cached_property
    def runs(self) -> int:
        """Number of rows: of runs, or of variants where these are estimated."""
        return tables.count_runs(self.directory) if self.table is None else self.table.num_rows

    @property
    def draws(self) -> int:
        """Draws of every variant: fewer than the study's where it may stop before.

        Raises:
            InputError: runs are missing.
        """
        study = self.study
        draws = study.n_draws
        if study.stop_when and self.runs:
            draws = int(analysis.numbers(self.rows(["draw_id"]), "draw_id").max()) + 1
        if self.runs != draws * study.n_variants:
            raise InputError(
                f"{self.directory}: {self.runs} runs where the study has"
                f" {draws * study.n_variants}: are the results complete?"
            )
        return draws

    @cached_property
    def summary(self) -> pa.Table:
        """All columns, one row a run, by run_id; kept. A large study has no room for it."""
        return tables.read_summary(self.directory) if self.table is None else self.table

    def rows(self, names: Iterable[str]) -> pa.Table:
        """Some columns, one row a run, by run_id; read anew each time.

        Args:
            names: of the columns; repeated ones are there once.

        Raises:
            InputError: a column is missing.
        """
        wanted = list(dict.fromkeys(names))
        if self.table is None:
            return tables.read_summary(self.directory, wanted)
        if missing := [name for name in wanted if name not in self.table.column_names]:
            raise InputError(f"{self.directory}: summary: column {missing[0]} is missing")
        return self.table.select(wanted)

    def distinct(self, names: Iterable[str]) -> pa.Table:
        """As `rows`, of variants that differ: one of each kind that has the same runs.

        Keys are null where they do not act: without resets there is no cycle.
        """
        first = first_alike(self.study)
        if (first == np.arange(len(first))).all():
            return self.rows(names)
        table = self.rows(names)
        variant = np.tile(np.arange(len(first)), self.draws)
        keep = first[variant] == variant
        table, variant = table.filter(pa.array(keep)), variant[keep]
        for key in self.study.axis_keys:
            if key != "case" and key in table.column_names:
                place = table.column_names.index(key)
                nothing = pa.array(silent(self.study, key)[variant])
                values = pc.if_else(nothing, None, table[key])
                table = table.set_column(place, key, values)
        return table

    @cached_property
    def yardsticks(self) -> tuple[Yardstick, ...]:
        """What success can be counted from, what the study is judged from first.

        Not the truth where an earlier version did not record it, nor the limit where no run has
        one.
        """
        found = yardsticks(self.study)
        flags = self.rows([yard.ok for yard in found])
        return tuple(yard for yard in found if flags[yard.ok].null_count < flags.num_rows)

    @property
    def has_curves(self) -> bool:
        """Whether curves of any run were stored."""
        return (self.directory / "curves").is_dir()

    def curves(self, run_ids: Iterable[int] | None = None) -> pa.Table:
        """Curves of some runs, or of all; empty where none were stored."""
        return tables.read_curves(self.directory, None if run_ids is None else sorted(run_ids))


class Text(NamedTuple):
    """A paragraph, in Markdown without links."""

    text: str


class Table(NamedTuple):
    """A table of text.

    Attributes:
        title: what it shows.
        header: a name for each column.
        rows: cells.
        note: said below it.
        folded: on a page, hidden until a reader opens it; not printed on a console.
    """

    title: str
    header: Sequence[str]
    rows: Sequence[Sequence[str]]
    note: str = ""
    folded: bool = False


class Picture(NamedTuple):
    """A figure.

    Attributes:
        name: of its file, without extension.
        caption: what is seen.
        figure: the figure.
        rests_on: said below it, where it rests on other runs than those of the source.
    """

    name: str
    caption: str
    figure: Figure
    rests_on: str = ""


Block = Text | Table | Picture


class Chapter(NamedTuple):
    """A heading and what stands under it."""

    heading: str
    blocks: Sequence[Block]


class Report(NamedTuple):
    """What is made of a directory of results.

    Attributes:
        headline: what was found, a sentence or two each.
        sections: in the order in which they are read.
        rests_on: said below the figures, where they rest on other runs than those of the source.
    """

    headline: Sequence[str]
    sections: Sequence[Chapter]
    rests_on: str = ""

    def followed_by(self, section: Chapter) -> "Report":
        """The report with one more section at its end."""
        return self._replace(sections=[*self.sections, section])


def aim_of(study: Study) -> str:
    """What a study's headings are judged against, after *within 10 arcmin of*."""
    if study.is_recorded:
        return "the reference's heading"
    if success_of(study).from_truth:
        return "true north"
    return "what the run's own constant sensor biases allow (not of true north)"


def yardstick(study: Study) -> str:
    """What *settled* and *ok* mean in a study, in one sentence for pages and captions."""
    rule = success_of(study)
    ends_s = np.array([s.records for s in study.distinct_spans]) * study.study.record_interval_s
    dwell_s = rule.dwell(ends_s)
    last = " to ".join(f"{s:g}" for s in sorted({dwell_s.min(), dwell_s.max()}))
    how = f"has been there for {last} s at the end" if dwell_s.max() else "ends there"
    return (
        f"Settled: the heading stays within {rule.band_arcmin:g} arcmin (or the band that is"
        f" named) of {aim_of(study)} from then to the end of the run; ok: it {how}, and the level"
        f" errors end within {rule.level_band_arcmin:g} arcmin."
    )


def swept(study: Study) -> dict[tuple[str, ...], tuple[Any, ...]]:
    """What a study sweeps as a reader counts it: the values of each axis by the keys that tell it.

    Keys that go together, in cases or in axes, are one axis. It is told by the label or the first
    of its keys if no two of its points share that value, else by all of them, and by tuples then.
    """
    axes: dict[tuple[str, ...], tuple[Any, ...]] = {}
    for dimension in study.dimensions:
        first, values = next(iter(dimension.items()))
        if len(set(values)) == len(values):
            axes[(first,)] = tuple(values)
        else:
            axes[tuple(dimension)] = tuple(zip(*dimension.values(), strict=True))
    return axes


def shown_keys(study: Study) -> tuple[str, ...]:
    """The swept keys that tell variants apart, see `swept`."""
    return tuple(key for keys in swept(study) for key in keys)


def only(study: Study, key: str) -> Any:
    """The one value of a key.

    Raises:
        InputError: the study sweeps it.
    """
    first, *rest = study.combinations(key)
    if rest:
        raise InputError(f"{study.name}: one {key} is needed, not a sweep of it")
    return first[key]


def name_of(key: Mapping[str, Any]) -> str:
    """A variant in words: ``reset_count 3, phi_u0 30 deg``; a case by its label alone."""
    words = (str(v) if k == "case" else plots.setting(k, value_text(v)) for k, v in key.items())
    return ", ".join(words) or "all runs"


def value_text(value: Any) -> str:
    """A key's value as a reader wants it: 50 for 50.0, ``none`` for an empty list."""
    if isinstance(value, list | tuple):
        return ", ".join(map(value_text, value)) or "none"
    if isinstance(value, float):
        return f"{value:g}"
    return "-" if value is None else str(value)


NEEDED = (
    "draw_id",
    "start_s",
    "status",
    "phi_u_arcmin",
    "has_limit",
    "phi_u_mean_arcmin",
    "floor_arcmin",
)
"""Columns that `analysis.summarise` needs besides keys and yardsticks."""


def estimate_of(row: Mapping[str, Any], name: str) -> Estimate:
    """A statistic in a row of `analysis.summarise`; NaN where it is unknown."""
    ends = (row[f"{name}{end}"] for end in ("", "_low", "_high"))
    value, low, high = (math.nan if end is None else end for end in ends)
    return Estimate(value, low, high, row["n"])


def at_the_end(source: Source) -> Iterator[str]:
    """How many headings are right at the end, where there is a truth: of all runs of a study."""
    try:
        rows = source.rows(["draw_id", "start_s", "phi_u_arcmin", "status"])
    except InputError:
        return  # some columns of a summary alone tell nothing of it
    if not analysis.has_truth(rows):
        return
    band = success_of(source.study).band_arcmin
    right = np.abs(analysis.numbers(rows, "phi_u_arcmin")) <= band
    about = "the reference" if source.study.is_recorded else "true north"
    found = percent(analysis.share(right, analysis.clusters_of(rows)))
    yield f"Within {band:g}' of {about} at the end: {found} % of the runs."


def intervals(source: Source, over: str = "draws", what: str = "Number") -> str:
    """What the brackets of a table are, or why there are none, in words."""
    if source.study.is_recorded and source.study.n_draws > 1:
        return analysis.NO_INTERVAL
    return f"{what} [95 % interval over the {over}]."


def percent(share: Estimate) -> str:
    """A share with its interval as a number of percent."""
    low, value, high = (100 * x for x in (share.low, share.value, share.high))
    return format_estimate(Estimate(value, low, high, share.n), digits=0)
