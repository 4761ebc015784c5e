"""Building blocks of a report, and sentences that several reports use.

All text is plain: a writer escapes it for its medium.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure

from sinsjax import plots
from sinsjax.analysis import FEW_DRAWS
from sinsjax.execution.results import Results
from sinsjax.study.study import Study
from sinsjax.study.success import success_criteria

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

    def shortened(self, max_rows: int = MAX_ROWS) -> "Table":
        """Return the first rows, with the number of the others at the end of the note."""
        hidden = len(self.rows) - max_rows
        if hidden <= 0:
            return self
        note = f"{self.note} {hidden} more rows are not shown.".lstrip()
        return self._replace(rows=self.rows[:max_rows], note=note)


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
    aim = "the reference's heading" if study.is_recorded else aim
    return (
        f"Settled: the heading stays within {rule.band_arcmin:g} arcmin (or the band given) of"
        f" {aim} from then to the end of the run; ok: it has been there for {last} s at the end,"
        f" and the level errors end within {rule.level_band_arcmin:g} arcmin. Bias floor: the"
        " heading error caused by a run's own constant sensor biases."
    )


def describe_intervals(source: Results, quantity: str = "Number", of: str = "draws") -> str:
    """Describe the brackets of a table, or why there are none."""
    if source.study.is_recorded:
        return "No intervals: all runs are on one record and share its sensor biases."
    note = f"{quantity} [95 % interval over the {of}]; {FEW_DRAWS!r}: too few to bound it."
    if source.draws < MIN_DRAWS_FOR_INTERVALS:
        note += f" With fewer than {MIN_DRAWS_FOR_INTERVALS} draws, intervals of the means of"
        note += " skewed values are too narrow."
    return note
