"""Verdicts and tables on a terminal: nothing is wider than it, and no word is broken.

In a pipe the same is printed without colour, at most `PIPE_WIDTH` columns wide.
"""

import os
import re
from collections.abc import Iterable, Sequence
from itertools import zip_longest

from rich import box
from rich.cells import cell_len
from rich.console import Console, Group, RenderableType
from rich.padding import Padding
from rich.table import Table as Grid
from rich.text import Text as Line

from sinsjax import console as screen
from sinsjax.messages import escape_controls
from sinsjax.report.base import Fact, Table, Verdict
from sinsjax.report.names import NO_NAMES, StudyNames

MAX_VERDICT_LINES = 15
"""Lines of a verdict, its empty lines and its last line included."""

PIPE_WIDTH = 120
"""Columns of a table in a pipe, unless ``COLUMNS`` is set."""

_GAP, _EDGES = 3, 2  # blanks between two columns of a table, and at its sides
_INTERVAL = re.compile(r"\S+ \[\S+ \S+\]( \S+)?")
_MIN_VERDICT_ROWS = 2  # of a verdict's table
_RED = ("never", "failed")


def print_verdict(
    verdict: Verdict,
    console: Console,
    names: StudyNames = NO_NAMES,
    footer: Sequence[str] = (),
    *,
    full: bool = False,
) -> None:
    """Print a verdict in at most `MAX_VERDICT_LINES` lines on 80 columns or more.

    Rows of its table are left out evenly over the conditions; if that is not enough, the table,
    then facts, doubts last, and these are counted.

    Args:
        verdict: the verdict.
        console: the console.
        names: the names of the study, which are printed literally.
        footer: parts of its last line: figures, and the command for all tables.
        full: whether to print all of it instead.
    """
    facts = list(verdict.facts)
    n_rows = len(verdict.table.rows) if verdict.table else 0
    while True:
        layout = _layout_verdict(
            verdict, facts, n_rows, names, _pack_words(footer, console.width), console.width
        )
        if full or len(console.render_lines(layout, pad=False)) <= MAX_VERDICT_LINES:
            break
        droppable = [fact for fact in facts[1:] if not fact.is_caution] or facts[1:]
        if n_rows:
            n_rows = n_rows - 1 if n_rows > _MIN_VERDICT_ROWS else 0
        elif droppable:
            facts.remove(droppable[-1])
        else:
            break
    console.print(layout)


def _layout_verdict(
    verdict: Verdict,
    facts: Sequence[Fact],
    n_rows: int,
    names: StudyNames,
    footer: Sequence[str],
    width: int,
) -> Group:
    parts: list[RenderableType] = [screen.literal_text(names.to_plain_text(verdict.title), "bold")]
    grid = Grid.grid(padding=(0, 2, 0, 0))
    grid.add_column(no_wrap=True)
    grid.add_column()
    for number, fact in enumerate(facts):
        style = "yellow" if fact.is_caution else "bold" if number == 0 else ""
        text = screen.literal_text(names.to_plain_text(fact.text), "bold" if number == 0 else "")
        grid.add_row(screen.literal_text(fact.label, style), _highlight_failures(text))
    if left := len(verdict.facts) - len(facts):
        grid.add_row(Line("Also", "yellow"), Line(f"{left} more, see --full"))
    parts.append(Padding(grid, (0, 0, 0, 2)))
    if verdict.table is not None:
        parts += (
            [Line(), _layout_verdict_rows(verdict.table, n_rows, names, width)] if n_rows else []
        )
    return Group(*parts, *(screen.literal_text(line, "dim") for line in footer))


def _layout_verdict_rows(
    table: Table, n_rows: int, names: StudyNames, width: int
) -> RenderableType:
    """Return some rows of a verdict's table, evenly over all of them."""
    total = len(table.rows)
    places = sorted({round(n * (total - 1) / max(n_rows - 1, 1)) for n in range(n_rows)})
    header, *shown = (
        [escape_controls(names.to_plain_text(cell)) for cell in row]
        for row in (table.header, *(table.rows[place] for place in places))
    )
    grid = Grid(box=None, pad_edge=False, padding=(0, 2, 0, 0), header_style="dim")
    for name, size in zip(header, _fit_column_widths([header, *shown], width - 2, 2), strict=True):
        grid.add_column(screen.literal_text(name), width=size, overflow="fold")
    for row in shown:
        grid.add_row(*(_highlight_failures(screen.literal_text(cell)) for cell in row))
    return Padding(grid, (0, 0, 0, 2))


def _fit_column_widths(rows: Sequence[Sequence[str]], width: int, gap: int) -> list[int]:
    """Widths of columns that break no word, as long as the words of a row have room.

    Args:
        rows: cells.
        width: columns of the terminal.
        gap: blanks between two columns.
    """
    whole = [max(map(cell_len, cells)) for cells in zip(*rows, strict=True)]
    least = [max(map(_min_cell_width, cells)) for cells in zip(*rows, strict=True)]
    room = width - gap * (len(whole) - 1)
    if sum(least) > room:  # a word has to break, the longest first
        while sum(least) > max(room, len(least)):
            least[least.index(max(least))] -= 1
        return least
    while sum(whole) > room:
        wide = max(range(len(whole)), key=lambda place: (whole[place] - least[place], place))
        whole[wide] -= 1
    return whole


def _highlight_failures(text: Line) -> Line:
    text.highlight_words(_RED, "red")
    return text


def _pack_words(words: Iterable[str], width: int) -> list[str]:
    """Return words in as few lines as possible, separated by three blanks."""
    lines: list[str] = []
    for word in words:
        if lines and len(lines[-1]) + 3 + len(word) <= width:
            lines[-1] += f"   {word}"
        else:
            lines.append(word)
    return lines


def print_table(table: Table, console: Console, names: StudyNames = NO_NAMES) -> None:
    """Print a table as wide as the terminal at most; a wider one continues below, first key first.

    Args:
        table: the table.
        console: the console.
        names: the names of the study, which are printed literally.
    """
    previous_width = console.width
    if not console.is_terminal and not os.environ.get("COLUMNS"):
        console.width = PIPE_WIDTH
    width = console.width - _EDGES
    console.print(screen.literal_text(names.to_plain_text(table.title), "bold"))
    header = [escape_controls(name).replace(" (", "\n(") for name in table.header]
    cells = [header, *([escape_controls(cell) for cell in row] for row in table.rows)]
    for columns in _split_columns(cells, width):
        console.print(_layout_table([[row[column] for column in columns] for row in cells], width))
    if table.note:
        console.print(screen.literal_text(names.to_plain_text(table.note), "dim"))
    console.print()
    console.width = previous_width


def _min_cell_width(cell: str) -> int:
    """The least width of a cell: of its longest word, or of a number with its interval."""
    if _INTERVAL.fullmatch(cell):
        return cell_len(cell)
    return max(map(cell_len, cell.split()), default=1)


def _split_columns(cells: Sequence[Sequence[str]], width: int) -> list[list[int]]:
    """Return the columns of each part of a table, so that no word is broken."""
    least = [max(map(_min_cell_width, column)) for column in zip(*cells, strict=True)]
    parts: list[list[int]] = [[]]
    for column in range(len(least)):
        extended = [*parts[-1], column]
        if sum(least[index] + _GAP for index in extended) - _GAP > width and len(parts[-1]) > 1:
            parts.append([0, column])
        else:
            parts[-1] = extended
    return parts


def _layout_table(cells: Sequence[Sequence[str]], width: int) -> Grid:
    """The first row is the header."""
    table = Grid(box=box.SIMPLE_HEAD, pad_edge=False)
    header, *rows = cells
    lines = [name.split("\n") for name in header]
    heads = zip_longest(*lines, fillvalue="")
    for line, size in zip(lines, _fit_column_widths([*heads, *rows], width, _GAP), strict=True):
        text = Line("\n").join(map(screen.literal_text, line))
        table.add_column(text, width=size, overflow="fold")
    for row in rows:
        table.add_row(*(_highlight_failures(screen.literal_text(cell)) for cell in row))
    return table
