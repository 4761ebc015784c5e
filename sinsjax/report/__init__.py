"""What is printed, drawn and written about directories of results, from Parquet alone.

Every study has the same report, `auto`, or `estimated` where it has no draws, and every tuning,
`tuned`; a folder of prose and a script makes a page of its own, `folder`.
"""

from collections.abc import Sequence
from pathlib import Path

from rich.console import Console

from sinsjax import console as screen
from sinsjax.errors import InputError
from sinsjax.execution.directory import list_figures
from sinsjax.execution.source import Source
from sinsjax.messages import shortened
from sinsjax.platform.files import require_writable
from sinsjax.report import auto, estimated, folder, tuned
from sinsjax.report.base import Chapter, Report, Text, at_the_end
from sinsjax.report.markup import template
from sinsjax.report.names import NO_NAMES
from sinsjax.report.output import FIGURES, Made, print_report, save_figures, write_html, write_page
from sinsjax.tuning import results
from sinsjax.tuning.run_tuning import is_tuning


def summarise(
    directories: Sequence[Path],
    console: Console,
    page: Path | None = None,
    html: Path | None = None,
    *,
    warned: bool = False,
) -> None:
    """Prints the tables of results or tunings, draws their figures to ``figures/`` in each of them.

    On request it writes a Markdown file, with figures beside it, and an HTML file that holds all.
    What was doubtful stands first, unless the user was ``warned`` before the study ran.
    Of a page that is a folder with prose and a script, nothing else is made, unless ``html`` asks.

    Raises:
        InputError: a directory holds no results that its layout can use, or cannot be written; or
            a report that fails otherwise. The results are as they were then.
    """
    try:
        _summarise(directories, console, page, html, warned=warned)
    except InputError:
        raise
    except Exception as error:
        where = ", ".join(map(str, directories))
        what = shortened(" ".join(f"{type(error).__name__}: {error}".split()))
        text = f"{where}: the report failed, the results are as they were ({what})"
        raise InputError(text) from error


def _summarise(
    directories: Sequence[Path],
    console: Console,
    page: Path | None,
    html: Path | None,
    *,
    warned: bool,
) -> None:
    if html is not None:
        require_writable(html, "--html")
    if page is not None and not page.is_dir():
        require_writable(page, "--page")
    elif page is not None:
        written, figures = folder.write(page, [_read(own) for own in directories])
        screen.say(console, f"{written} and {figures} figures beside it", wrap=True)
        if html is None:
            return
        page = None
    made = []
    for directory in directories:
        source = _read(directory, unfinished=True)
        if is_tuning(directory):
            told = tuned.report(source)
        else:
            told = (estimated if source.study.is_estimated else auto).report(source)
            doubtful = [] if warned else [f"Warning: {line}" for line in source.warnings]
            told = told._replace(headline=[*doubtful, *told.headline, *at_the_end(source)])
        made.append(_tell(told, source, console))
    names = list(dict.fromkeys(one.source.study.name for one in made))
    words = template("words.md.j2").render()
    console.print()
    for line in words.splitlines():
        screen.say(console, NO_NAMES.plain(line.removeprefix("- ")), wrap=True)
    *_, last = made
    sections = [*last.report.sections, Chapter("What the words mean", [Text(words.rstrip())])]
    made[-1] = last._replace(report=last.report._replace(sections=sections))
    if page is not None:
        write_page(page, ", ".join(names), made)
    if html is not None:
        write_html(html, ", ".join(names), made)


def _read(directory: Path, *, unfinished: bool = False) -> Source:
    if is_tuning(directory):
        return results.read(directory)
    return Source.read(directory, unfinished=unfinished)


def _tell(report: Report, source: Source, console: Console) -> Made:
    """Draws a report's figures into the directory of its source, and prints its tables."""
    made = Made.of(source, report)
    save_figures(made.images, source.directory / FIGURES)
    list_figures({f"{name}.png": image for name, image in made.images.items()}, source.directory)
    print_report(made, console)
    return made
