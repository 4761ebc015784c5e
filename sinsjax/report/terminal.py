"""Reports and tables on a terminal: no wider than it, and intervals are not broken.

In a pipe the same is printed without colour, at most `PIPE_WIDTH` columns wide.
"""

import os
import re
from collections.abc import Sequence

from rich import box
from rich.cells import cell_len
from rich.console import Console
from rich.padding import Padding
from rich.table import Table as RichTable
from rich.text import Text

from sinsjax import console as screen
from sinsjax.messages import escape_controls
from sinsjax.report.base import Report, Table

PIPE_WIDTH = 120
"""Columns of a table in a pipe, unless ``COLUMNS`` is set."""

_MAX_FACTS = 6  # that are no doubts
_MAX_ROWS = 8  # of the table of a verdict
_GAP, _EDGES = 3, 2  # blanks between two columns of a table, and at its sides
_INTERVAL = re.compile(r"\S+ \[\S+ \S+\]( \S+)?")
_RED = ("never", "failed")


def print_verdict(
    report: Report, console: Console, footer: Sequence[str] = (), *, full: bool = False
) -> None:
    """Print the title, the facts and the table per condition of a report.

    Args:
        report: the report.
        console: the console.
        footer: last lines: where the figures are, and the command for all tables.
        full: whether to print every fact and row; otherwise the first six facts, all doubts, and
            eight rows evenly over the conditions.
    """
    console.print(screen.literal_text(report.title, "bold"))
    answers = [fact for fact in report.facts if not fact.is_caution]
    first = answers if full else answers[:_MAX_FACTS]
    facts = [fact for fact in report.facts if fact.is_caution or fact in first]
    grid = RichTable.grid(padding=(0, 2, 0, 0))
    for number, fact in enumerate(facts):
        style = "yellow" if fact.is_caution else "bold" if number == 0 else ""
        grid.add_row(
            screen.literal_text(fact.label, style),
            _highlight(screen.literal_text(fact.text, "bold" if number == 0 else "")),
        )
    if left := len(report.facts) - len(facts):
        grid.add_row(Text("Also", "yellow"), Text(f"{left} more, see --full"))
    console.print(Padding(grid, (0, 0, 0, 2)))
    if table := report.table:
        console.print()
        rows, last = table.rows, len(table.rows) - 1
        if not full and last >= _MAX_ROWS:  # evenly over all of them
            rows = [rows[round(n * last / (_MAX_ROWS - 1))] for n in range(_MAX_ROWS)]
        console.print(Padding(_layout_table(table.header, rows, None), (0, 0, 0, 2)))
    for line in footer:
        screen.print_line(console, line, style="dim", wrap=True)


def print_table(table: Table, console: Console) -> None:
    """Print a table as wide as the terminal at most; a wider one continues below, first key first.

    Args:
        table: the table.
        console: the console.
    """
    width = console.width
    if not console.is_terminal and not os.environ.get("COLUMNS"):
        width = PIPE_WIDTH
    console.print(screen.literal_text(table.title, "bold"))
    header = [name.replace(" (", "\n(") for name in table.header]
    for columns in _split_columns([header, *table.rows], width - _EDGES):
        rows = [[row[column] for column in columns] for row in table.rows]
        layout = _layout_table([header[column] for column in columns], rows, box.SIMPLE_HEAD)
        console.print(layout, width=width)
    if table.note:
        console.print(screen.literal_text(table.note, "dim"))
    console.print()


def _layout_table(
    header: Sequence[str], rows: Sequence[Sequence[str]], frame: box.Box | None
) -> RichTable:
    """A table of literal text; rich wraps its columns, but no column of intervals."""
    table = RichTable(box=frame, pad_edge=False, padding=(0, 2, 0, 0) if frame is None else (0, 1))
    if frame is None:
        table.header_style = "dim"
    for name, *cells in zip(header, *rows, strict=True):
        lines = Text("\n").join(map(screen.literal_text, name.split("\n")))
        rigid = bool(cells) and all(" " not in c or _INTERVAL.fullmatch(c) for c in cells)
        table.add_column(lines, min_width=_least_width([name, *cells], rigid))
    for row in rows:
        table.add_row(*(_highlight(screen.literal_text(cell)) for cell in row))
    return table


def _highlight(text: Text) -> Text:
    text.highlight_words(_RED, "red")
    return text


def _least_width(cells: Sequence[str], rigid: bool = True) -> int:
    """The least width of a column: of its longest word, or of a number with its interval."""
    return max(
        cell_len(cell)
        if rigid and _INTERVAL.fullmatch(cell)
        else max(map(cell_len, escape_controls(cell, keep="\n").split()), default=1)
        for cell in cells
    )


def _split_columns(cells: Sequence[Sequence[str]], width: int) -> list[list[int]]:
    """Return the columns of each part of a table that is wider than the terminal."""
    least = [_least_width(column) for column in zip(*cells, strict=True)]
    parts: list[list[int]] = [[]]
    for column in range(len(least)):
        extended = [*parts[-1], column]
        if sum(least[index] + _GAP for index in extended) - _GAP > width and len(parts[-1]) > 1:
            parts.append([0, column])
        else:
            parts[-1] = extended
    return parts
