"""What is printed, drawn and written about directories of results, from Parquet alone.

A study's ``[report] layout`` says which shape its report has; a layout is a function from a
`Source` to a `Report` and knows neither console nor page.
"""

from collections.abc import Sequence
from pathlib import Path

from rich.console import Console

from sinsjax.report import auto, car_test, paper1, pass_consistency, readings
from sinsjax.report.base import Layout, Source
from sinsjax.report.output import FIGURES, Made, print_report, save_figures, write_page

LAYOUTS: dict[str, Layout] = {
    "auto": auto.report,
    "paper1_conditions": paper1.report_conditions,
    "paper1_resets": paper1.report_resets,
    "paper1_readings": readings.report,
    "car_test": car_test.report,
    "pass_consistency": pass_consistency.report,
}
"""What each ``[report] layout`` is made by, in the order in which several share a page."""

PAPER1 = ("paper1_conditions", "paper1_resets", "paper1_readings")
"""The layouts of the page on paper 1."""


def summarise(directories: Sequence[Path], console: Console, page: Path | None = None) -> None:
    """Prints the tables of some results and draws their figures; writes a page on request.

    Args:
        directories: of results; the figures of each go to ``figures/`` in it.
        console: where the tables are printed.
        page: Markdown file to write, with figures beside it in ``figures/``.

    Raises:
        InputError: a directory holds no results that its layout can use, or cannot be written.
    """
    made = []
    for directory in directories:
        source = Source.read(directory)
        one = Made.of(source, LAYOUTS[source.study.report.layout](source))
        save_figures(one.images, directory / FIGURES)
        print_report(one, console)
        made.append(one)
    if page is not None:
        places = list(LAYOUTS)
        made.sort(key=lambda one: places.index(one.source.study.report.layout))
        write_page(page, _title(made), made, _missing(made))


def _title(made: Sequence[Made]) -> str:
    if any(one.source.study.report.layout in PAPER1 for one in made):
        return "Paper 1, reproduced"
    return ", ".join(one.source.study.study.name for one in made)


def _missing(made: Sequence[Made]) -> list[str]:
    """Says which part of paper 1's page has no results."""
    there = {one.source.study.report.layout for one in made}
    missing = [f"`configs/{name}.toml`" for name in PAPER1 if name not in there]
    if not missing or not there.intersection(PAPER1):
        return []
    return [f"Not on this page: {', '.join(missing)}."]
