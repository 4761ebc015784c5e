"""What a report is made of: where it reads from, and the blocks that a layout returns."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import pyarrow as pa
from matplotlib.figure import Figure

from sinsjax import plots, results
from sinsjax.analysis import Estimate, format_estimate
from sinsjax.config import load_study
from sinsjax.studies import Study


class Source(NamedTuple):
    """A directory of results, read.

    Attributes:
        directory: where they are.
        study: the resolved study.
        summary: one row a run, by run_id.
        config: file name of the study, as a page names it.
    """

    directory: Path
    study: Study
    summary: pa.Table
    config: str

    @classmethod
    def read(cls, directory: Path) -> "Source":
        """Reads a directory of results.

        Raises:
            InputError: it holds none, or its study cannot be read.
        """
        summary = results.read_summary(directory)
        study = load_study(directory / "study.toml")
        name = results.read_manifest(directory).get("config") or f"{study.study.name}.toml"
        return cls(directory, study, summary, name)

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
    """

    headline: Sequence[str]
    sections: Sequence[Section]


Layout = Callable[[Source], Report]


def shown_keys(study: Study) -> tuple[str, ...]:
    """The swept keys that tell variants apart: a case's label stands for the keys that it sets."""
    labelled = "case" in study.axis_keys
    return ("case", *study.axes) if labelled else study.axis_keys


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
