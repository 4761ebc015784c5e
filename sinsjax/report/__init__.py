"""What is printed, drawn and written about directories of results, from Parquet alone.

Every study has the same report, `auto`, or `estimated` where it has no draws, and every tuning,
`tuned`; a folder of prose and a script makes a page of its own, `folder`.
"""

from collections.abc import Sequence
from pathlib import Path

from rich.console import Console

from sinsjax import console as screen
from sinsjax.errors import InputError
from sinsjax.execution.directory import register_figures
from sinsjax.execution.source import Source
from sinsjax.messages import shortened
from sinsjax.platform.files import require_writable
from sinsjax.report import auto, estimated, folder
from sinsjax.report.base import Chapter, Report, Text
from sinsjax.report.markup import template
from sinsjax.report.names import NO_NAMES
from sinsjax.report.output import FIGURES, Made, print_report, save_figures, write_html, write_page
from sinsjax.tuning.history import is_tuning


def summarise(
    directories: Sequence[Path],
    console: Console,
    page: Path | None = None,
    html: Path | None = None,
    *,
    full: bool = False,
    warned: bool = False,
) -> None:
    """Print the verdict on results or tunings, and draw their figures to ``figures/`` in each.

    Args:
        directories: of results or tunings.
        console: the console.
        page: a Markdown file to write, with figures beside it; or the folder of a page with prose
            and a script, of which nothing else is made unless ``html`` asks.
        html: an HTML file to write, which holds all.
        full: whether to print all tables.
        warned: whether the user has seen the studies' warnings.

    Raises:
        InputError: a directory holds no results that its layout can use, or cannot be written; or
            a report that fails otherwise. The results are as they were then.
    """
    try:
        _summarise(directories, console, page, html, full=full, warned=warned)
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
    full: bool,
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
        every = full or page is not None or html is not None
        if is_tuning(directory):
            from sinsjax.report import tuned  # late: it needs JAX

            report = tuned.report(source)
        else:
            kind = estimated if source.study.is_estimated else auto
            report = kind.report(source, full=every, warned=warned)
        made.append(_draw(report, source))
        print_report(made[-1], console, full=full)
    if page is None and html is None:
        return
    names = list(dict.fromkeys(one.source.study.name for one in made))
    *_, last = made
    words = template("words.md.j2").render().rstrip()
    sections = [*last.report.sections, Chapter("What the words mean", [Text(words)])]
    made[-1] = last._replace(report=last.report._replace(sections=sections))
    if page is not None:
        write_page(page, ", ".join(names), made)
    if html is not None:
        write_html(html, ", ".join(names), made)


def print_terms(console: Console) -> None:
    """Print what the words of a report mean."""
    for line in template("words.md.j2").render().splitlines():
        screen.say(console, NO_NAMES.plain(line.removeprefix("- ")), wrap=True)


def _read(directory: Path, *, unfinished: bool = False) -> Source:
    if is_tuning(directory):
        from sinsjax.tuning import results  # late, as above

        return results.read_evaluation(directory)
    return Source.read(directory, unfinished=unfinished)


def _draw(report: Report, source: Source) -> Made:
    """Draw a report's figures into the directory of its source."""
    made = Made.of(source, report)
    save_figures(made.images, source.directory / FIGURES)
    register_figures(
        {f"{name}.png": image for name, image in made.images.items()}, source.directory
    )
    return made
