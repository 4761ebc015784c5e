"""Reports on directories of results, from Parquet alone: printed, drawn and written.

A study is reported by `monte_carlo`, a tuning by `tuning`.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path

from rich.console import Console

from sinsjax.errors import InputError
from sinsjax.execution.directory import remove_other_figures
from sinsjax.execution.results import Results
from sinsjax.messages import print_line, shorten
from sinsjax.platform.files import make_folder, write_file
from sinsjax.report import monte_carlo
from sinsjax.report.base import Report, Table, describe_success_criterion
from sinsjax.report.markdown import to_html
from sinsjax.report.terminal import print_table, print_verdict
from sinsjax.tuning.history import is_tuning

FIGURES_FOLDER = "figures"
"""Folder of the figures, in the directory of the results."""


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
        drawn: list[tuple[Report, Mapping[str, bytes]]] = []
        names: dict[str, None] = {}
        for directory in directories:
            with_tables = full or html is not None
            source, report = _read(directory, with_tables=with_tables, quiet=warnings_shown)
            images = report.draw()
            make_folder(directory / FIGURES_FOLDER)
            for name, content in images.items():
                write_file(directory / FIGURES_FOLDER / f"{name}.png", content)
            remove_other_figures(directory, [f"{name}.png" for name in images])
            print_report(report, console, directory, full=full)
            drawn.append((report, images))
            names[source.study.name] = None
        if html is not None:
            make_folder(html.parent)
            write_file(html, to_html(", ".join(names), drawn).encode())
    except InputError:
        raise
    except Exception as error:
        paths = ", ".join(map(str, directories))
        reason = shorten(" ".join(f"{type(error).__name__}: {error}".split()))
        text = f"{paths}: the report failed, the results are unchanged ({reason})"
        raise InputError(text) from error


def _read(directory: Path, *, with_tables: bool, quiet: bool) -> tuple[Results, Report]:
    """The results in a directory, and their report."""
    source: Results
    if is_tuning(directory):
        from sinsjax.report import tuning  # late: it needs JAX
        from sinsjax.tuning.results import TuningResults

        tuned = TuningResults(directory)
        source, report = tuned.evaluation, tuning.build_report(tuned)
    else:
        source = Results.read(directory)
        report = monte_carlo.build_report(source, with_tables=with_tables, warnings_shown=quiet)
    study = source.study
    return source, report._replace(
        footer=report.footer or f"{study.name}: {study.n_variants:,} × {source.draws:,} runs",
        definition=describe_success_criterion(study),
        origin=f"{source.manifest.config or f'study.toml of {study.name}'}; computed by"
        f" sinsjax {source.manifest.versions.get('sinsjax', 'unknown')}",
    )


def print_report(report: Report, console: Console, directory: Path, *, full: bool = False) -> None:
    """Print the verdict, where the figures are, and all tables if wanted."""
    console.print()
    footer = [f"Figures: {directory}/{FIGURES_FOLDER}"] if report.pictures else []
    if not full:
        footer.append(f"All tables: sinsjax report {directory} --full")
    print_verdict(report, console, footer, full=full)
    if not full:
        return
    console.print()
    print_line(console, report.definition, wrap=True)
    for block in report.blocks:
        if isinstance(block, str):
            print_line(console, block, wrap=True)
        elif isinstance(block, Table):
            print_table(block, console)
