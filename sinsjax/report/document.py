"""The type `Report` and its writers: the terminal, and one HTML file from Markdown.

All text of a report is plain: a writer escapes it for its medium.
"""

import os
import re
from base64 import b64encode
from collections.abc import Iterator, Mapping, Sequence
from html import escape
from typing import NamedTuple

from markdown_it import MarkdownIt
from matplotlib.figure import Figure
from rich import box
from rich.console import Console
from rich.padding import Padding
from rich.table import Table as RichTable

from sinsjax.messages import escape_controls, literal_text, print_line

MAX_ROWS = 20  # of a table; the note counts the rows left out
MIN_DRAWS_FOR_INTERVALS = 16  # whose coverage is measured; below it, notes warn
_VERDICT_ROWS = 8  # of its table, evenly over the conditions
_PIPE_WIDTH = 120  # columns of a table in a pipe, unless ``COLUMNS`` is set
_MARKUP = re.compile(r"[\\`*_\[\]<>#|~$&!]|^[-+=]|(?<=\d)[.)](?= )")
"""What Markdown may interpret: marks anywhere, bullets, and the stop of a numbered item."""

_PAGE = """<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<title>{title}</title>
<meta name="viewport" content="width=device-width, initial-scale=1">
<style>
:root {{ color-scheme: light dark; }}
body {{ font: 16px/1.5 system-ui, sans-serif; max-width: 70rem; margin: 2rem auto; padding: 1rem; }}
img {{ max-width: 100%; background: #fff; display: block; }}
table {{ border-collapse: collapse; font-variant-numeric: tabular-nums; font-size: .9rem; }}
th, td {{ text-align: left; padding: .25rem .8rem .25rem 0; border-bottom: 1px solid #8888; }}
</style>
</head>
<body>
{body}</body>
</html>
"""


class Table(NamedTuple):
    """A table of text: a name for each column, and a note below it."""

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
    """A figure, with the name of its file without extension, and the text below it."""

    name: str
    caption: str
    figure: Figure


class Fact(NamedTuple):
    """A line of a verdict: a label such as ``Accuracy``, and a sentence without its full stop."""

    label: str
    text: str
    is_caution: bool = False


def caution(text: str, label: str = "Caution") -> Fact:
    """Return a line of a verdict that warns."""
    return Fact(label, text, True)


class Report(NamedTuple):
    """The report on one directory of results: facts, tables and figures.

    The facts are the answer, then its basis, then doubts; ``table`` is the answer per condition, if
    there are several. Notes are paragraphs on all of it. The footer of the figures states the runs
    that they rest on.
    """

    title: str
    facts: Sequence[Fact]
    table: Table | None = None
    tables: Sequence[Table] = ()
    pictures: Sequence[Picture] = ()
    notes: Sequence[str] = ()
    footer: str = ""


def print_report(
    report: Report, console: Console, footer: Sequence[str] = (), *, full: bool = False
) -> None:
    """Print the verdict of a report, then the footer; in full with all rows, notes and tables."""
    console.print()
    console.print(literal_text(report.title, "bold"))
    grid = RichTable.grid(padding=(0, 2, 0, 0))
    for number, fact in enumerate(report.facts):
        style = "yellow" if fact.is_caution else "bold" if number == 0 else ""
        text = literal_text(fact.text, "bold" if number == 0 else "")
        grid.add_row(literal_text(fact.label, style), text)
    console.print(Padding(grid, (0, 0, 0, 2)))
    if table := report.table:
        console.print()
        rows, last = table.rows, len(table.rows) - 1
        if not full and last >= _VERDICT_ROWS:  # evenly over all of them
            rows = [rows[round(n * last / (_VERDICT_ROWS - 1))] for n in range(_VERDICT_ROWS)]
        console.print(Padding(_layout_table(table.header, rows, None), (0, 0, 0, 2)))
    for line in footer:
        print_line(console, line, style="dim", wrap=True)
    if full:
        console.print()
        for note in report.notes:
            print_line(console, note, wrap=True)
        for table in report.tables:
            print_table(table, console)


def print_table(table: Table, console: Console) -> None:
    """Print a table as wide as the terminal at most; rich wraps its cells."""
    is_pipe = not console.is_terminal and not os.environ.get("COLUMNS")
    console.print(literal_text(table.title, "bold"))
    grid = _layout_table(table.header, table.rows, box.SIMPLE_HEAD)
    console.print(grid, width=_PIPE_WIDTH if is_pipe else console.width)
    if table.note:
        console.print(literal_text(table.note, "dim"))
    console.print()


def _layout_table(
    header: Sequence[str], rows: Sequence[Sequence[str]], frame: box.Box | None
) -> RichTable:
    """A table of literal text."""
    table = RichTable(box=frame, pad_edge=False, padding=(0, 2, 0, 0) if frame is None else (0, 1))
    for name in header:
        heading = literal_text(name, "dim" if frame is None else "")
        table.add_column(heading, overflow="fold")
    for row in rows:
        table.add_row(*map(literal_text, row))
    return table


def to_html(title: str, reports: Sequence[tuple[Report, Mapping[str, bytes]]]) -> str:
    """Return a self-contained HTML page of some reports, with their PNG files by name."""
    parser = MarkdownIt("commonmark", {"html": False, "xhtmlOut": False}).enable("table")
    parts = [f"# {escape_markdown(title)}"]
    parts += [part for report, images in reports for part in _markdown_parts(report, images)]
    body = parser.render("\n\n".join(parts) + "\n")
    return _PAGE.format(title=escape(escape_controls(title)), body=body)


def _markdown_parts(report: Report, images: Mapping[str, bytes]) -> Iterator[str]:
    """The paragraphs of a report in Markdown, with figures as data addresses."""
    mark = escape_markdown
    yield f"## {mark(report.title)}"
    yield "\n".join(f"- **{mark(label)}:** {mark(text)}." for label, text, _ in report.facts)
    if report.table:
        yield from _markdown_table(report.table)
    for name, caption, figure in report.pictures:
        text = mark(figure.get_suptitle().replace("\n", " "))
        yield f"![{text}](data:image/png;base64,{b64encode(images[name]).decode()})"
        yield mark(caption)
    yield from map(mark, report.notes)
    for table in report.tables:
        yield from _markdown_table(table)


def _markdown_table(table: Table) -> Iterator[str]:
    yield f"### {escape_markdown(table.title)}"
    header, *rows = (
        f"| {' | '.join(map(escape_markdown, row))} |" for row in (table.header, *table.rows)
    )
    yield "\n".join([header, "| --- " * len(table.header) + "|", *rows])
    if table.note:
        yield escape_markdown(table.note)


def escape_markdown(text: str) -> str:
    """Return plain text as Markdown that shows it literally, in one line."""
    return _MARKUP.sub(r"\\\g<0>", escape_controls(text))
