"""Where a report goes: a console, a directory of figures, a page in Markdown or in HTML."""

import os
from base64 import b64encode
from collections.abc import Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

from markupsafe import Markup
from rich import box
from rich import table as rich_table
from rich.console import Console
from rich.measure import Measurement

from sinsjax import console as screen
from sinsjax import plots
from sinsjax.execution.source import Source
from sinsjax.messages import escape_controls, one_line
from sinsjax.platform.files import file_stem, make_folder, replacing
from sinsjax.report.base import Block, Picture, Report, Table, Text, yardstick
from sinsjax.report.markup import template
from sinsjax.report.names import NO_NAMES, Names

FIGURES = "figures"
"""Directory of the figures, in that of the results or of a page."""


class Made(NamedTuple):
    """A report with its figures drawn.

    Attributes:
        source: what it reports.
        report: what it says.
        images: PNG files by the name of the figure.
        names: in what it says.
    """

    source: Source
    report: Report
    images: Mapping[str, bytes]
    names: Names = NO_NAMES

    @classmethod
    def of(cls, source: Source, report: Report) -> "Made":
        """Draws the figures of a report."""
        blocks = (block for section in report.sections for block in section.blocks)
        pictures = (block for block in blocks if isinstance(block, Picture))
        footer = report.rests_on or source.counted
        images = {one.name: plots.png(one.figure, one.rests_on or footer) for one in pictures}
        return cls(source, report, images, Names.of(source.study, source.config, *source.warnings))


def print_report(made: Made, console: Console) -> None:
    """Prints what was found and every table that is not folded, and names the figures."""
    source, report, images, names = made
    console.print()
    screen.say(console, source.study.name, style="bold")
    lines = (yardstick(source.study), *report.headline)
    for line in sorted(lines, key=lambda line: not line.startswith("Warning: ")):
        screen.say(console, names.plain(line), wrap=True)
    for section in report.sections:
        for block in section.blocks:
            if isinstance(block, Text):
                screen.say(console, names.plain(block.text), wrap=True)
            elif isinstance(block, Table) and not block.folded:
                print_table(block, console, names)
    if images:
        listed = ", ".join(f"{name}.png" for name in images)
        screen.say(console, f"Figures in {source.directory / FIGURES}: {listed}", wrap=True)


def save_figures(images: Mapping[str, bytes], directory: Path) -> None:
    """Writes PNG files, by their names without extension, to a directory that is made if missing.

    Raises:
        InputError: the directory cannot be written.
    """
    make_folder(directory)
    for name, content in images.items():
        with replacing(directory / f"{name}.png") as file:
            file.write(content)


def origin(made: Sequence[Made]) -> str:
    """What a page was made from: the files of its studies and what computed them, each once."""
    configs = ", ".join(dict.fromkeys(one.source.config for one in made))
    versions = ", ".join(dict.fromkeys(one.source.version for one in made))
    return f"{configs}; computed by sinsjax {versions}"


def write_page(page: Path, title: str, made: Sequence[Made]) -> None:
    """Writes a documentation page in Markdown, and its figures to ``figures/`` beside it.

    Raises:
        InputError: the page cannot be written.
    """
    begun = one_line(f"sinsjax report --page {page.name} ({origin(made)})")
    sections = []
    for source, report, images, names in made:
        prefix = f"{file_stem(source.study.name)}_"
        named = {f"{prefix}{name}": image for name, image in images.items()}
        save_figures(named, page.parent / FIGURES)
        for heading, blocks in report.sections:
            told = [markdown(block, prefix, names) for block in blocks]
            sections.append((names.markdown(heading), told))
    text = template("report.md.j2").render(
        begun=begun.replace("<", "&lt;").replace(">", "&gt;"),
        title=names_of(made).markdown(title),
        meanings=meanings(made),
        headline=[one.names.markdown(line) for one in made for line in one.report.headline],
        sections=sections,
    )
    write_text(page, text)


def write_html(path: Path, title: str, made: Sequence[Made]) -> None:
    """Writes an HTML page that needs nothing else: no network, no file beside it, no script.

    Raises:
        InputError: the page cannot be written.
    """
    page = template("report.html.j2").render(
        title=title,
        all_names=names_of(made),
        meanings=meanings(made),
        made=made,
        origin=origin(made),
        inline=_inline,
        paragraphs=_paragraphs,
        base64=lambda content: b64encode(content).decode(),
    )
    make_folder(path.parent)
    write_text(path, page)


def write_text(path: Path, text: str) -> None:
    """Write a page, in Markdown or HTML, with control characters other than line breaks escaped.

    Raises:
        InputError: the page cannot be written.
    """
    with replacing(path) as file:
        file.write(escape_controls(text, keep="\n").encode())


def names_of(made: Sequence[Made]) -> Names:
    """The names in all that stands on a page."""
    return Names(frozenset().union(*(one.names.texts for one in made)))


def meanings(made: Sequence[Made]) -> list[str]:
    """What *settled* and *ok* mean on a page, each meaning once."""
    return list(dict.fromkeys(yardstick(one.source.study) for one in made))


def markdown(block: Block, prefix: str = "", names: Names = NO_NAMES) -> str:
    """A block with its names as Markdown; the file name of a figure may have a prefix."""
    text = template("block.md.j2").render(
        block=block,
        md=names.markdown,
        file=f"{FIGURES}/{prefix}{block.name}.png" if isinstance(block, Picture) else "",
        rule=["---"] * len(block.header) if isinstance(block, Table) else [],
    )
    return text.rstrip()


def print_table(block: Table, console: Console, names: Names = NO_NAMES) -> None:
    """Prints one table; into a file or a pipe each row on a line, unless COLUMNS has a width."""
    free = not console.is_terminal and not os.environ.get("COLUMNS")
    table = rich_table.Table(
        title=screen.literal(block.title, "bold"),
        caption=screen.literal(names.plain(block.note)) if block.note else None,
        title_justify="left",
        caption_justify="left",
        box=box.SIMPLE_HEAD,
        pad_edge=False,
    )
    for name in map(screen.literal, block.header):
        table.add_column(name, overflow="fold")  # a cut name would be another key's too
    for row in block.rows:
        table.add_row(*map(screen.literal, row))
    width = console.width
    if free:
        wide = console.options.update(max_width=10_000)
        console.width = Measurement.get(console, wide, table).maximum
    console.print(table)
    console.width = width


def _inline(text: str, names: Names = NO_NAMES) -> Markup:
    return Markup(_markdown().renderInline(names.markdown(text)))


def _paragraphs(text: str, names: Names = NO_NAMES) -> Markup:
    return Markup(_markdown().render(names.markdown(text)).rstrip())


@lru_cache(maxsize=1)
def _markdown() -> Any:
    """What a report says is Markdown without links or images; anything else in it is text."""
    from markdown_it import MarkdownIt  # late, for reports without such a page

    return MarkdownIt("commonmark", {"html": False}).disable(["link", "image", "autolink"])
