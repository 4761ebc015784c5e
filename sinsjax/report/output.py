"""Output of a report: console, directory of figures, HTML page."""

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
from sinsjax.messages import escape_controls
from sinsjax.platform.files import atomic_write, make_folder
from sinsjax.report.base import Picture, Report, Table, Text, describe_success_criterion
from sinsjax.report.markup import load_template
from sinsjax.report.names import NO_NAMES, StudyNames
from sinsjax.report.terminal import print_table, print_verdict

FIGURES_FOLDER = "figures"
"""Directory of the figures, in that of the results or of a page."""


class DrawnReport(NamedTuple):
    """A report with its figures drawn.

    Attributes:
        source: the results.
        report: their report.
        images: PNG files by the name of the figure.
        names: names that occur in the report.
    """

    source: Source
    report: Report
    images: Mapping[str, bytes]
    names: StudyNames = NO_NAMES

    @classmethod
    def from_report(cls, source: Source, report: Report) -> "DrawnReport":
        """Draw the figures of a report."""
        blocks = (block for section in report.sections for block in section.blocks)
        pictures = (block for block in blocks if isinstance(block, Picture))
        footer = report.data_footer or source.sample_size_text
        images = {picture.name: plots.render_png(picture.figure, footer) for picture in pictures}
        return cls(
            source,
            report,
            images,
            StudyNames.from_study(source.study, source.config, *source.warnings),
        )


def print_report(drawn: DrawnReport, console: Console, *, full: bool = False) -> None:
    """Print the verdict, where the figures are, and all tables if wanted."""
    source, report, images, names = drawn
    console.print()
    footer = [f"Figures: {source.directory / FIGURES_FOLDER}"] if images else []
    if not full:
        footer.append(f"All tables: sinsjax report {source.directory} --full")
        print_verdict(report.verdict, console, names, footer)
        return
    print_verdict(report.verdict, console, names, footer, full=True)
    console.print()
    screen.print_line(console, describe_success_criterion(source.study), wrap=True)
    for section in report.sections:
        for block in section.blocks:
            if isinstance(block, Text):
                screen.print_line(console, names.to_plain_text(block.text), wrap=True)
            elif isinstance(block, Table) and block != report.verdict.table:
                print_table(block, console, names)
    if images:
        listed = ", ".join(f"{name}.png" for name in images)
        screen.print_line(console, f"Figures: {listed}.", wrap=True)


def save_figures(images: Mapping[str, bytes], directory: Path) -> None:
    """Write PNG files, by their names without extension, to a directory, created if missing.

    Raises:
        InputError: the directory cannot be written.
    """
    make_folder(directory)
    for name, content in images.items():
        with atomic_write(directory / f"{name}.png") as file:
            file.write(content)


def describe_origin(reports: Sequence[DrawnReport]) -> str:
    """Return the study files of a page and the versions that computed them, without repetition."""
    configs = ", ".join(dict.fromkeys(drawn.source.config for drawn in reports))
    versions = ", ".join(dict.fromkeys(drawn.source.version for drawn in reports))
    return f"{configs}; computed by sinsjax {versions}"


def write_html_page(path: Path, title: str, reports: Sequence[DrawnReport]) -> None:
    """Write a self-contained HTML page: no network, no other files, no script.

    Raises:
        InputError: the page cannot be written.
    """
    page = load_template("report.html.j2").render(
        title=title,
        all_names=merge_names(reports),
        success_definitions=success_definitions(reports),
        reports=reports,
        origin=describe_origin(reports),
        inline=_render_inline_html,
        paragraphs=_render_html_paragraphs,
        base64=lambda content: b64encode(content).decode(),
    )
    make_folder(path.parent)
    write_escaped_text(path, page)


def write_escaped_text(path: Path, text: str) -> None:
    """Write a page with control characters other than line breaks escaped.

    Raises:
        InputError: the page cannot be written.
    """
    with atomic_write(path) as file:
        file.write(escape_controls(text, keep="\n").encode())


def merge_names(reports: Sequence[DrawnReport]) -> StudyNames:
    """Return the names in all reports of a page."""
    return StudyNames(frozenset().union(*(drawn.names.texts for drawn in reports)))


def success_definitions(reports: Sequence[DrawnReport]) -> list[str]:
    """Return the definitions of *settled* and *ok* of a page, without repetition."""
    return list(dict.fromkeys(describe_success_criterion(drawn.source.study) for drawn in reports))


def _render_inline_html(text: str, names: StudyNames = NO_NAMES) -> Markup:
    return Markup(_markdown_parser().renderInline(names.to_markdown(text)))


def _render_html_paragraphs(text: str, names: StudyNames = NO_NAMES) -> Markup:
    return Markup(_markdown_parser().render(names.to_markdown(text)).rstrip())


@lru_cache(maxsize=1)
def _markdown_parser() -> Any:
    """Return a parser of Markdown without links and images, with HTML as text."""
    from markdown_it import MarkdownIt  # late: only HTML pages need it

    return MarkdownIt("commonmark", {"html": False}).disable(["link", "image", "autolink"])
