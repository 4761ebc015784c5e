"""The commands that give a study's draws to a program outside sinsjax, and score its results."""

import shlex
from pathlib import Path
from typing import Annotated, Any

import typer

from sinsjax.cli.options import Changes, Config, Out
from sinsjax.messages import plain_console, print_line, print_warning


def export(
    config: Config,
    out: Out,
    changes: Changes = None,
    format_: Annotated[
        str,
        typer.Option(
            "--format",
            help="csv; parquet; psins: text without names, wx wy wz vx vy vz t.",
            metavar="NAME",
        ),
    ] = "csv",
    frame: Annotated[
        str,
        typer.Option(
            help="enu: right-front-up, yaw counter-clockwise; ned: front-right-down, clockwise.",
            metavar="NAME",
        ),
    ] = "enu",
) -> None:
    """Write the draws of a study as files for a program outside sinsjax (MATLAB, C, C++, Python).

    Example: sinsjax export paper1_resets -o draws --format psins
    """
    from sinsjax.arena.export import export_study
    from sinsjax.execution.progress import show_progress
    from sinsjax.platform import runtime
    from sinsjax.study.changes import parse_changes
    from sinsjax.study.load import load_study

    runtime.configure()
    study, console = load_study(config, parse_changes(changes)), plain_console()
    with show_progress(console, study.name) as show:
        directory = export_study(
            study, out, format=format_.lower(), frame=frame.lower(), on_progress=show
        )
    print_line(console, f"{directory}: read README.txt; then")
    print_line(console, f"sinsjax score {shlex.quote(str(directory))} RESULTS --name PROGRAM")


def score(
    directory: Annotated[
        Path, typer.Argument(help="Directory of the export.", show_default=False, metavar="DIR")
    ],
    results: Annotated[
        Path,
        typer.Argument(
            help="Results of the program (CSV or Parquet).", show_default=False, metavar="RESULTS"
        ),
    ],
    name: Annotated[
        str | None,
        typer.Option(help="Name of the program; default: the stem of RESULTS.", metavar="NAME"),
    ] = None,
) -> None:
    """Compare the results of a program with those of sinsjax's methods on the same draws.

    The study's own methods run once, into DIR/own; the results of all are in DIR/scores/NAME.

    Example: sinsjax score draws alignvn.csv
    """
    from sinsjax.arena.score import score_results
    from sinsjax.execution.progress import show_progress
    from sinsjax.platform import runtime
    from sinsjax.report import print_reports

    runtime.configure()
    console = plain_console()
    with show_progress(console, "own methods") as show:
        found = score_results(directory, results, name=name, on_progress=show)
    for line in found.warnings:
        print_warning(line)
    print_reports([found.directory or directory], console, warnings_shown=True)


COMMANDS: tuple[Any, ...] = (export, score)
