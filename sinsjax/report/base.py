"""What a report is made of, and words that all of them use."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure

from sinsjax import analysis
from sinsjax.execution.source import Source
from sinsjax.plots.words import value_text
from sinsjax.report.markup import said
from sinsjax.study.study import Study
from sinsjax.study.success import success_criteria

MOST_ROWS = 20
"""Rows of a table; what is left out is said."""

ENOUGH_DRAWS = 16
"""Draws from which on the coverage of all intervals is measured; below it, notes warn."""


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


def table_of(
    title: str,
    keys: Sequence[str],
    rows: Sequence[Mapping[str, Any]],
    cells: Sequence[tuple[str, Callable[[Any], str]]],
    note: str = "",
    *,
    most: int = MOST_ROWS,
    left: str = "rows are not shown",
) -> Table:
    """A table with a line for each row: its keys, then what each cell with its header tells of it.

    Of more than ``most`` rows the note says how many there are, and in the words of ``left`` where.
    """
    lines = [
        [*(value_text(row[key]) for key in keys), *(tell(row) for _, tell in cells)]
        for row in rows[:most]
    ]
    if hidden := len(rows) - len(lines):
        note = f"{note} {hidden} more {left}.".lstrip()
    return Table(title, [*keys, *(header for header, _ in cells)], lines, note)


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


class Fact(NamedTuple):
    """A line of a verdict.

    Attributes:
        label: a word or two, such as ``Accuracy``.
        text: a sentence, in Markdown without links.
        is_doubt: whether it warns.
    """

    label: str
    text: str
    is_doubt: bool = False


class Verdict(NamedTuple):
    """What a reader wants to know first.

    Attributes:
        title: name of the study, number of runs, and failures.
        facts: the answer, then its basis, then doubts.
        table: the answer per condition, if there are several.
    """

    title: str
    facts: Sequence[Fact]
    table: Table | None = None


class Report(NamedTuple):
    """What is made of a directory of results.

    Attributes:
        verdict: the answer.
        sections: all the rest, in the order in which it is read.
        rests_on: footer of the figures, if they rest on other runs than those of the source.
    """

    verdict: Verdict
    sections: Sequence[Chapter]
    rests_on: str = ""

    @classmethod
    def of(
        cls, verdict: Verdict, parts: Mapping[str, Sequence[Block]], rests_on: str = ""
    ) -> "Report":
        """A report of the parts, by their headings, that have blocks; the verdict's table first."""
        first = [] if verdict.table is None else [verdict.table]
        every = {"Verdict": first, **parts}
        sections = [Chapter(heading, blocks) for heading, blocks in every.items() if blocks]
        return cls(verdict, sections, rests_on)

    @property
    def headline(self) -> list[str]:
        """The verdict without its table as lines of Markdown."""
        facts = self.verdict.facts
        return [f"{self.verdict.title}.", *(f"**{one.label}:** {one.text}." for one in facts)]


def yardstick(study: Study) -> str:
    """What *settled* and *ok* mean in a study, in one sentence for pages and captions."""
    rule = success_criteria(study)
    ends_s = np.array([s.records for s in study.distinct_spans]) * study.study.record_interval_s
    dwell_s = rule.dwell(ends_s)
    last = " to ".join(f"{s:g}" for s in sorted({dwell_s.min(), dwell_s.max()}))
    aim = "true north" if rule.from_truth else "its bias floor (not of true north)"
    if study.is_recorded:
        aim = "the reference's heading, where there is one,"
    return said(
        "yardstick",
        band=rule.band_arcmin,
        aim=aim,
        dwell=last if dwell_s.max() else "",
        level_band=rule.level_band_arcmin,
        has_floor=not study.is_recorded,
    )


def intervals(source: Source, over: str = "draws", what: str = "Number") -> str:
    """What the brackets of a table are, or why there are none, in words."""
    if source.study.is_recorded:
        return analysis.NO_INTERVAL
    note = f"{what} [95 % interval over the {over}]."
    if source.draws >= ENOUGH_DRAWS:
        return note
    return (
        f"{note} *{analysis.FEW_DRAWS}*, or no interval: so few do not bound the number. With fewer"
        f" than {ENOUGH_DRAWS} draws, intervals of the means of skewed values are too narrow."
    )
