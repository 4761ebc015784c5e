"""Building blocks of a report, and sentences that all reports use.

All text is plain: a writer escapes it for its medium.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure

from sinsjax import analysis, plots
from sinsjax.execution.results import Results
from sinsjax.plots.labels import format_value
from sinsjax.study.study import Study
from sinsjax.study.success import success_criteria

NO_INTERVAL = (
    "No intervals: the runs are on one record. They share its sensor biases, and most of its"
    " samples where their spans overlap, so their spread does not show how far another record"
    " would differ."
)
"""Note for results of runs on a record."""

MAX_ROWS = 20
"""Rows of a table; the note counts the rows left out."""

MIN_DRAWS_FOR_INTERVALS = 16
"""Draws from which on the coverage of all intervals is measured; below it, notes warn."""


class Table(NamedTuple):
    """A table of text.

    Attributes:
        title: its title.
        header: a name for each column.
        rows: cells.
        note: text below the table.
    """

    title: str
    header: Sequence[str]
    rows: Sequence[Sequence[str]]
    note: str = ""


def build_table(
    title: str,
    keys: Sequence[str],
    groups: Sequence[tuple[Mapping[str, Any], Any]],
    cells: Sequence[tuple[str, Callable[[Any], str]]],
    note: str = "",
    *,
    max_rows: int = MAX_ROWS,
) -> Table:
    """Return a table with one line per group: the values of its keys, then its formatted cells.

    If there are more than ``max_rows`` groups, the note ends with the number of the others.
    """
    lines = [
        [*(format_value(key[name]) for name in keys), *(format_cell(x) for _, format_cell in cells)]
        for key, x in groups[:max_rows]
    ]
    if hidden := len(groups) - len(lines):
        note = f"{note} {hidden} more rows are not shown.".lstrip()
    return Table(title, [*keys, *(header for header, _ in cells)], lines, note)


class Picture(NamedTuple):
    """A figure.

    Attributes:
        name: of its file, without extension.
        caption: text below the figure.
        figure: the figure.
    """

    name: str
    caption: str
    figure: Figure


Block = str | Table | Picture
"""A paragraph, a table or a figure."""


class Fact(NamedTuple):
    """A line of a verdict.

    Attributes:
        label: a word or two, such as ``Accuracy``.
        text: a sentence without its full stop.
        is_caution: whether it warns.
    """

    label: str
    text: str
    is_caution: bool = False


def caution(text: str, label: str = "Caution") -> Fact:
    """Return a line of a verdict that warns."""
    return Fact(label, text, True)


class Report(NamedTuple):
    """The report on one directory of results.

    Attributes:
        title: name of the study, number of runs, and failures.
        facts: the answer, then its basis, then doubts.
        table: the answer per condition, if there are several.
        blocks: all the rest, in the order in which it is read.
        footer: footer of the figures: the runs that they rest on.
        definition: definition of success.
        origin: the study's file and the version that computed it.
    """

    title: str
    facts: Sequence[Fact]
    table: Table | None = None
    blocks: Sequence[Block] = ()
    footer: str = ""
    definition: str = ""
    origin: str = ""

    @property
    def pictures(self) -> list[Picture]:
        """The figures of the report."""
        return [block for block in self.blocks if isinstance(block, Picture)]

    def draw(self) -> dict[str, bytes]:
        """Return the figures as PNG files, by their names."""
        return {one.name: plots.render_png(one.figure, self.footer) for one in self.pictures}


def describe_success_criterion(study: Study) -> str:
    """Describe *settled* and *ok* in a study, in one paragraph."""
    rule = success_criteria(study)
    ends_s = np.array([s.records for s in study.distinct_spans]) * study.study.record_interval_s
    dwell_s = rule.dwell(ends_s)
    last = " to ".join(f"{s:g}" for s in sorted({dwell_s.min(), dwell_s.max()}))
    aim = "true north" if rule.from_truth else "its bias floor (not of true north)"
    if study.is_recorded:
        aim = "the reference's heading, where there is one,"
    ends = f"has been there for {last} s at the end" if dwell_s.max() else "ends there"
    text = (
        f"Settled: the heading stays within {rule.band_arcmin:g} arcmin (or the band given) of"
        f" {aim} from then to the end of the run; ok: it {ends}, and the level errors end within"
        f" {rule.level_band_arcmin:g} arcmin."
    )
    if study.is_recorded:
        return text
    return f"{text} Bias floor: the heading error caused by a run's own constant sensor biases."


def describe_intervals(
    source: Results, sampled_units: str = "draws", quantity: str = "Number"
) -> str:
    """Describe the brackets of a table, or why there are none."""
    if source.study.is_recorded:
        return NO_INTERVAL
    note = f"{quantity} [95 % interval over the {sampled_units}]."
    if source.draws >= MIN_DRAWS_FOR_INTERVALS:
        return note
    return (
        f"{note} {analysis.FEW_DRAWS!r}, or no interval: so few do not bound the number. With fewer"
        f" than {MIN_DRAWS_FOR_INTERVALS} draws, intervals of the means of skewed values are too"
        " narrow."
    )
