"""What a report is made of, and words that all of them use."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure

from sinsjax import analysis, plots
from sinsjax.analysis.words import percent
from sinsjax.errors import InputError
from sinsjax.execution.source import Source
from sinsjax.study.study import Study
from sinsjax.study.success import success_of


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
