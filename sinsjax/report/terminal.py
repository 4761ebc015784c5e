"""Reports and tables on a terminal; in a pipe the same without colour."""

import os
from collections.abc import Sequence

from rich import box
from rich.console import Console
from rich.padding import Padding
from rich.table import Table as RichTable

from sinsjax import messages as screen
from sinsjax.report.base import Report, Table

PIPE_WIDTH = 120
"""Columns of a table in a pipe, unless ``COLUMNS`` is set."""

_MAX_ROWS = 8  # of the table of a verdict


def print_verdict(
    report: Report, console: Console, footer: Sequence[str] = (), *, full: bool = False
) -> None:
    """Print the title, the facts and the table per condition of a report.

    Args:
        report: the report.
        console: the console.
        footer: last lines: where the figures are, and the command for all tables.
        full: whether to print every row; otherwise eight, evenly over the conditions.
    """
    console.print(screen.literal_text(report.title, "bold"))
    grid = RichTable.grid(padding=(0, 2, 0, 0))
    for number, fact in enumerate(report.facts):
        style = "yellow" if fact.is_caution else "bold" if number == 0 else ""
        text = screen.literal_text(fact.text, "bold" if number == 0 else "")
        grid.add_row(screen.literal_text(fact.label, style), text)
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
    """Print a table as wide as the terminal at most; rich wraps its cells."""
    width = console.width
    if not console.is_terminal and not os.environ.get("COLUMNS"):
        width = PIPE_WIDTH
    console.print(screen.literal_text(table.title, "bold"))
    console.print(_layout_table(table.header, table.rows, box.SIMPLE_HEAD), width=width)
    if table.note:
        console.print(screen.literal_text(table.note, "dim"))
    console.print()


def _layout_table(
    header: Sequence[str], rows: Sequence[Sequence[str]], frame: box.Box | None
) -> RichTable:
    """A table of literal text."""
    table = RichTable(box=frame, pad_edge=False, padding=(0, 2, 0, 0) if frame is None else (0, 1))
    for name in header:
        heading = screen.literal_text(name, "dim" if frame is None else "")
        table.add_column(heading, overflow="fold")
    for row in rows:
        table.add_row(*map(screen.literal_text, row))
    return table
