"""Reports on directories of results, from Parquet alone: printed, drawn and written.

A study is reported by `monte_carlo`, a tuning by `tuning`.
"""

from collections.abc import Sequence
from pathlib import Path

from rich.console import Console

from sinsjax.errors import InputError
from sinsjax.execution.directory import remove_other_figures
from sinsjax.execution.results import Results
from sinsjax.messages import shorten
from sinsjax.platform.files import require_writable
from sinsjax.report import monte_carlo
from sinsjax.report.output import (
    FIGURES_FOLDER,
    DrawnReport,
    print_report,
    save_figures,
    write_html_page,
)
from sinsjax.tuning.history import is_tuning


def print_reports(
    directories: Sequence[Path],
    console: Console,
    html: Path | None = None,
    *,
    full: bool = False,
    warnings_shown: bool = False,
) -> None:
    """Print the verdict on results or tunings, and draw their figures to ``figures/`` in each.

    Args:
        directories: of results or tunings.
        console: the console.
        html: a self-contained HTML file to write.
        full: whether to print all tables.
        warnings_shown: whether the user has seen the studies' warnings.

    Raises:
        InputError: a directory holds no usable results, or cannot be written; or
            a report that fails otherwise. The results are then unchanged.
    """
    try:
        _print_reports(directories, console, html, full=full, warnings_shown=warnings_shown)
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
    html: Path | None,
    *,
    full: bool,
    warnings_shown: bool,
) -> None:
    if html is not None:
        require_writable(html, "--html")
    reports = []
    source: Results
    for directory in directories:
        if is_tuning(directory):
            from sinsjax.report import tuning  # late: it needs JAX
            from sinsjax.tuning.results import Tuning

            source = found = Tuning.read(directory)
            report = tuning.build_report(found)
        else:
            source = Results.read(directory, whole_draws=True)
            report = monte_carlo.build_report(
                source, with_tables=full or html is not None, warnings_shown=warnings_shown
            )
        drawn = DrawnReport.from_report(source, report)
        save_figures(drawn.images, directory / FIGURES_FOLDER)
        remove_other_figures(directory, [f"{name}.png" for name in drawn.images])
        print_report(drawn, console, full=full)
        reports.append(drawn)
    if html is not None:
        names = dict.fromkeys(drawn.source.study.name for drawn in reports)
        write_html_page(html, ", ".join(names), reports)
