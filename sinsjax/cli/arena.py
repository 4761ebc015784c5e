"""The commands that give a study's draws to a program outside sinsjax, and score its results."""

import re
import shlex
from pathlib import Path
from typing import Annotated, Any

import typer

from sinsjax.cli.options import Changes, Config, Out, Overwrite
from sinsjax.console import plain_console, print_line, print_warning
from sinsjax.errors import InputError

Frame = Annotated[
    str | None,
    typer.Option(
        help="enu: right-front-up, yaw counter-clockwise; ned: front-right-down, clockwise.",
        metavar="NAME",
    ),
]


def export(
    config: Config,
    out: Out,
    changes: Changes = None,
    draws: Annotated[
        str | None, typer.Option(help="Draws A to B - 1 only; default: all.", metavar="A:B")
    ] = None,
    format_: Annotated[
        str,
        typer.Option(
            "--format",
            help="csv; parquet; psins: text of increments wx wy wz vx vy vz t.",
            metavar="NAME",
        ),
    ] = "csv",
    quantity: Annotated[
        str,
        typer.Option(help="increments (rad, m/s) or rates (rad/s, m/s^2).", metavar="NAME"),
    ] = "increments",
    frame: Frame = "enu",
    blind: Annotated[bool, typer.Option("--blind", help="Leave out the truth.")] = False,
    overwrite: Overwrite = False,
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
    study, console = load_study(config, parse_changes(changes or ())), plain_console()
    kind, what, axes = (word.lower() for word in (format_, quantity, frame or "enu"))
    with show_progress(console, study.name) as show:
        directory = export_study(
            study,
            out,
            draws=_parse_draws(draws),
            format=kind,
            quantity=what,
            frame=axes,
            blind=blind,
            overwrite=overwrite,
            on_progress=show,
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
    against: Annotated[
        Path | None,
        typer.Option(
            help="Results of a sweep of the same study; without them it is run here.",
            metavar="DIR",
        ),
    ] = None,
    out: Annotated[
        str | None,
        typer.Option(
            "--out",
            "-o",
            help="Directory for the results; default: DIR/scores/NAME.",
            metavar="DIR",
        ),
    ] = None,
    frame: Frame = None,
    overwrite: Overwrite = False,
) -> None:
    """Compare the results of a program with those of sinsjax's methods on the same draws.

    Example: sinsjax score draws alignvn.csv --against out
    """
    from sinsjax.arena.score import score_results
    from sinsjax.execution.progress import show_progress
    from sinsjax.platform import runtime
    from sinsjax.report.terminal import print_table

    runtime.configure()
    console = plain_console()
    if against is None:
        print_line(console, "Without --against the study's own methods run first.")
    with show_progress(console, "own methods") as show:
        found = score_results(
            directory,
            results,
            name=name,
            against=against,
            out=out,
            frame=frame,
            overwrite=overwrite,
            on_progress=show,
        )
    for line in found.warnings:
        print_warning(line)
    print_line(console, f"{found.comparison.verdict}.", wrap=True)
    print_table(_result_table(found.comparison), console)
    print_line(console, f"Results: sinsjax report {shlex.quote(str(found.directory))}")


def _result_table(comparison: Any) -> Any:
    """Return the table of a comparison, one row per condition."""
    from sinsjax.analysis import format_estimate
    from sinsjax.report.base import Table
    from sinsjax.report.choices import condition_header, format_condition

    header = [condition_header(comparison.keys) or "conditions", comparison.name, "best"]
    rows = [
        [
            "all" if row.point is None else format_condition(comparison.keys, row.point),
            *map(format_estimate, (row.program, row.best, row.difference)),
        ]
        for row in (*comparison.conditions, comparison.overall)
    ]
    title = f"Mean heading error (arcmin); best: {comparison.best}"
    return Table(title, [*header, "difference"], rows)


def _parse_draws(text: str | None) -> tuple[int, int] | None:
    """Return the draws ``A:B``, from ``A:`` to the last, or ``N`` for the first N."""
    if text is None:
        return None
    match = re.fullmatch(r"(?:(\d{0,9}):)?(\d{0,9})", text.strip())
    if match is None or not any(match.groups()):
        raise InputError(f"--draws: {text!r} is not of the form A:B, as in 0:32")
    return int(match[1] or 0), int(match[2] or -1)


COMMANDS: tuple[Any, ...] = (export, score)
