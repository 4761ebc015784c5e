"""Output of a report: the console, a folder of figures, an HTML page."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from rich.console import Console

from sinsjax.console import print_line
from sinsjax.platform.files import atomic_write, make_folder
from sinsjax.report.base import DrawnReport, Table
from sinsjax.report.markdown import to_html
from sinsjax.report.terminal import print_table, print_verdict

FIGURES_FOLDER = "figures"
"""Folder of the figures, in the directory of the results."""


def print_report(drawn: DrawnReport, console: Console, *, full: bool = False) -> None:
    """Print the verdict, where the figures are, and all tables if wanted."""
    source, report, _ = drawn
    console.print()
    footer = [f"Figures: {source.directory}/{FIGURES_FOLDER}"] if report.pictures else []
    if not full:
        footer.append(f"All tables: sinsjax report {source.directory} --full")
    print_verdict(report, console, footer, full=full)
    if not full:
        return
    console.print()
    print_line(console, drawn.definition, wrap=True)
    for block in report.blocks:
        if isinstance(block, str):
            print_line(console, block, wrap=True)
        elif isinstance(block, Table):
            print_table(block, console)
    if report.pictures:
        listed = ", ".join(f"{picture.name}.png" for picture in report.pictures)
        print_line(console, f"Figures: {listed}.", wrap=True)


def save_figures(images: Mapping[str, bytes], directory: Path) -> None:
    """Write PNG files, by their names without extension, to a directory, created if missing.

    Raises:
        InputError: the directory cannot be written.
    """
    make_folder(directory)
    for name, content in images.items():
        with atomic_write(directory / f"{name}.png") as file:
            file.write(content)


def write_html_page(path: Path, title: str, reports: Sequence[DrawnReport]) -> None:
    """Write a self-contained HTML page: no network, no other files, no script.

    Raises:
        InputError: the page cannot be written.
    """
    make_folder(path.parent)
    with atomic_write(path) as file:
        file.write(to_html(title, reports).encode())
