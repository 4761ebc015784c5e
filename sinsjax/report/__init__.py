"""Reports on directories of results, from Parquet alone: printed, drawn and written.

A study is reported by `monte_carlo`, a tuning by `tuning`; a folder of prose and a script is
written as a page by `study_page`.
"""

from collections.abc import Sequence
from pathlib import Path

from rich.console import Console

from sinsjax import console as screen
from sinsjax.errors import InputError
from sinsjax.execution.directory import register_figures
from sinsjax.execution.source import Source
from sinsjax.messages import shorten
from sinsjax.platform.files import require_writable
from sinsjax.report import monte_carlo, study_page
from sinsjax.report.base import Chapter, Report, Text
from sinsjax.report.markup import load_template
from sinsjax.report.names import NO_NAMES
from sinsjax.report.output import (
    FIGURES_FOLDER,
    DrawnReport,
    print_report,
    save_figures,
    write_html_page,
    write_markdown_page,
)
from sinsjax.tuning.history import is_tuning


def print_reports(
    directories: Sequence[Path],
    console: Console,
    page: Path | None = None,
    html: Path | None = None,
    *,
    full: bool = False,
    warnings_shown: bool = False,
) -> None:
    """Print the verdict on results or tunings, and draw their figures to ``figures/`` in each.

    Args:
        directories: of results or tunings.
        console: the console.
        page: a Markdown file to write, with figures in ``figures/`` next to it; or the folder of
            a study page (prose and script), which alone is written unless ``html`` is given.
        html: a self-contained HTML file to write.
        full: whether to print all tables.
        warnings_shown: whether the user has seen the studies' warnings.

    Raises:
        InputError: a directory holds no usable results, or cannot be written; or
            a report that fails otherwise. The results are then unchanged.
    """
    try:
        _print_reports(directories, console, page, html, full=full, warnings_shown=warnings_shown)
    except InputError:
        raise
    except Exception as error:
        paths = ", ".join(map(str, directories))
        reason = shorten(" ".join(f"{type(error).__name__}: {error}".split()))
        text = f"{paths}: the report failed, the results are unchanged ({reason})"
        raise InputError(text) from error


def _print_reports(
    directories: Sequence[Path],
    console: Console,
    page: Path | None,
    html: Path | None,
    *,
    full: bool,
    warnings_shown: bool,
) -> None:
    if html is not None:
        require_writable(html, "--html")
    if page is not None and not page.is_dir():
        require_writable(page, "--page")
    elif page is not None:
        written, figures = study_page.write_study_page(
            page, [_read_source(directory) for directory in directories]
        )
        screen.print_line(console, f"{written} and {figures} figures beside it", wrap=True)
        if html is None:
            return
        page = None
    reports = []
    for directory in directories:
        source = _read_source(directory, allow_unfinished=True)
        with_tables = full or page is not None or html is not None
        if is_tuning(directory):
            from sinsjax.report import tuning  # late: it needs JAX

            report = tuning.build_report(source)
        else:
            report = monte_carlo.build_report(
                source, with_tables=with_tables, warnings_shown=warnings_shown
            )
        reports.append(_draw_and_save_figures(report, source))
        print_report(reports[-1], console, full=full)
    if page is None and html is None:
        return
    names = list(dict.fromkeys(drawn.source.study.name for drawn in reports))
    *_, last = reports
    words = load_template("terms.md.j2").render().rstrip()
    sections = [*last.report.sections, Chapter("Terms", [Text(words)])]
    reports[-1] = last._replace(report=last.report._replace(sections=sections))
    if page is not None:
        write_markdown_page(page, ", ".join(names), reports)
    if html is not None:
        write_html_page(html, ", ".join(names), reports)


def print_terms(console: Console) -> None:
    """Print the glossary of a report."""
    for line in load_template("terms.md.j2").render().splitlines():
        screen.print_line(console, NO_NAMES.to_plain_text(line.removeprefix("- ")), wrap=True)


def _read_source(directory: Path, *, allow_unfinished: bool = False) -> Source:
    if is_tuning(directory):
        from sinsjax.tuning import results  # late, as above

        return results.read_evaluation(directory)
    return Source.read(directory, unfinished=allow_unfinished)


def _draw_and_save_figures(report: Report, source: Source) -> DrawnReport:
    """Draw a report's figures into the directory of its source."""
    drawn = DrawnReport.from_report(source, report)
    save_figures(drawn.images, source.directory / FIGURES_FOLDER)
    register_figures(
        {f"{name}.png": image for name, image in drawn.images.items()}, source.directory
    )
    return drawn
