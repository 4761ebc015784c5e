"""What a report is made of: where it reads from, and the blocks that a layout returns."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import pyarrow as pa
from matplotlib.figure import Figure

from sinsjax import analysis, plots, results
from sinsjax.analysis import Estimate, format_estimate
from sinsjax.config import load_study
from sinsjax.studies import Study
from sinsjax.types import InputError


@dataclass(frozen=True, eq=False)
class Source:
    """A directory of results; what is asked for is read, and no more.

    Attributes:
        directory: where they are.
        study: the resolved study.
        config: what a page names as the study's file.
        table: the summary by run_id, where it need not be read.
    """

    directory: Path
    study: Study
    config: str
    table: pa.Table | None = None

    @classmethod
    def read(cls, directory: Path) -> "Source":
        """Opens a directory of results.

        Raises:
            InputError: it holds none, or its study cannot be read.
        """
        results.count_runs(directory)
        study = load_study(directory / "study.toml")
        given = results.read_manifest(directory).get("config")
        return cls(directory, study, given or f"study.toml of {study.study.name}")

    @cached_property
    def runs(self) -> int:
        """Number of runs, which is that of the rows of the summary."""
        return results.count_runs(self.directory) if self.table is None else self.table.num_rows

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
        return results.read_summary(self.directory) if self.table is None else self.table

    def rows(self, names: Iterable[str]) -> pa.Table:
        """Some columns, one row a run, by run_id; read anew each time.

        Args:
            names: of the columns; repeated ones are there once.

        Raises:
            InputError: a column is missing.
        """
        wanted = list(dict.fromkeys(names))
        if self.table is None:
            return results.read_summary(self.directory, wanted)
        if missing := [name for name in wanted if name not in self.table.column_names]:
            raise InputError(f"{self.directory}: summary: column {missing[0]} is missing")
        return self.table.select(wanted)

    @property
    def has_curves(self) -> bool:
        """Whether curves of any run were stored."""
        return (self.directory / "curves").is_dir()

    def curves(self, run_ids: Iterable[int] | None = None) -> pa.Table:
        """Curves of some runs, or of all; empty where none were stored."""
        return results.read_curves(self.directory, None if run_ids is None else sorted(run_ids))


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
    """

    name: str
    caption: str
    figure: Figure


Block = Text | Table | Picture


class Section(NamedTuple):
    """A heading and what stands under it."""

    heading: str
    blocks: Sequence[Block]


class Report(NamedTuple):
    """What a layout makes of a directory of results.

    Attributes:
        headline: what was found, a sentence or two each.
        sections: in the order in which they are read.
        rests_on: said below the figures, where they rest on other runs than those of the source.
    """

    headline: Sequence[str]
    sections: Sequence[Section]
    rests_on: str = ""


Layout = Callable[[Source], Report]


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


def percent(share: Estimate) -> str:
    """A share with its interval as a number of percent."""
    low, value, high = (100 * x for x in (share.low, share.value, share.high))
    return format_estimate(Estimate(value, low, high, share.n), digits=0)
