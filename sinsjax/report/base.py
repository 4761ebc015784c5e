"""What a report is made of, and words that all of them use."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure

from sinsjax import analysis
from sinsjax.analysis.words import percent
from sinsjax.errors import InputError
from sinsjax.execution.source import Source
from sinsjax.plots.words import value_text
from sinsjax.report.markup import said
from sinsjax.study.study import Study
from sinsjax.study.success import success_of

MOST_ROWS = 20
"""Rows of a table; what is left out is said."""


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

    @classmethod
    def of(
        cls, headline: Sequence[str], parts: Mapping[str, Sequence[Block]], rests_on: str = ""
    ) -> "Report":
        """A report of those parts, by their headings, that hold something."""
        sections = [Chapter(heading, blocks) for heading, blocks in parts.items() if blocks]
        return cls(headline, sections, rests_on)


def yardstick(study: Study) -> str:
    """What *settled* and *ok* mean in a study, in one sentence for pages and captions."""
    rule = success_of(study)
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
    if source.study.is_recorded:
        return analysis.NO_INTERVAL
    return f"{what} [95 % interval over the {over}]."
