"""Where a report goes: a console, a directory of figures, a page in Markdown or in HTML."""

from base64 import b64encode
from collections.abc import Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

from markupsafe import Markup
from rich.console import Console

from sinsjax import console as screen
from sinsjax import plots
from sinsjax.execution.source import Source
from sinsjax.messages import escape_controls, one_line
from sinsjax.platform.files import file_stem, make_folder, replacing
from sinsjax.report.base import Block, Picture, Report, Table, Text, yardstick
from sinsjax.report.markup import template
from sinsjax.report.names import NO_NAMES, Names
from sinsjax.report.terminal import print_table, print_verdict

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
        footer = report.rests_on or source.sample_size_text
        images = {one.name: plots.png(one.figure, one.rests_on or footer) for one in pictures}
        return cls(source, report, images, Names.of(source.study, source.config, *source.warnings))


def print_report(made: Made, console: Console, *, full: bool = False) -> None:
    """Print the verdict, where the figures are, and all tables that are not folded if wanted."""
    source, report, images, names = made
    console.print()
    last = [f"Figures: {source.directory / FIGURES}"] if images else []
    if not full:
        last.append(f"All tables: sinsjax report {source.directory} --full")
        print_verdict(report.verdict, console, names, last)
        return
    print_verdict(report.verdict, console, names, last, full=True)
    console.print()
    screen.say(console, yardstick(source.study), wrap=True)
    for section in report.sections:
        for block in section.blocks:
            if isinstance(block, Text):
                screen.say(console, names.plain(block.text), wrap=True)
            elif isinstance(block, Table) and not block.folded and block != report.verdict.table:
                print_table(block, console, names)
    if images:
        listed = ", ".join(f"{name}.png" for name in images)
        screen.say(console, f"Figures: {listed}. Words: sinsjax terms.", wrap=True)


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


def _inline(text: str, names: Names = NO_NAMES) -> Markup:
    return Markup(_markdown().renderInline(names.markdown(text)))


def _paragraphs(text: str, names: Names = NO_NAMES) -> Markup:
    return Markup(_markdown().render(names.markdown(text)).rstrip())


@lru_cache(maxsize=1)
def _markdown() -> Any:
    """What a report says is Markdown without links or images; anything else in it is text."""
    from markdown_it import MarkdownIt  # late, for reports without such a page

    return MarkdownIt("commonmark", {"html": False}).disable(["link", "image", "autolink"])
