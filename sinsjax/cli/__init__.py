"""The command line: thin commands over the package's functions.

It takes arguments and options, and gives lines on a terminal and directories of results. A user's
mistake is one line, and exit code 2.
"""

import gc
import shlex
import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from sinsjax.cli import advice, arena, loop_gains, study_files
from sinsjax.cli.options import (
    Changes,
    Config,
    Devices,
    Draws,
    Full,
    Out,
    Overwrite,
    Record,
    Reference,
    Resume,
)
from sinsjax.cli.running import run_study
from sinsjax.errors import InputError, StudyInterrupted
from sinsjax.messages import escape_controls, plain_console, print_line, to_one_line
from sinsjax.platform import runtime

RUN, LOOK, COMPARE, SET_UP = "Run", "Look", "Compare", "Set up"
"""Panels of the list of commands."""

app = typer.Typer(
    no_args_is_help=True,
    context_settings={"help_option_names": ["-h", "--help"]},
    rich_markup_mode="markdown",  # rich's own would swallow the name of a section such as [tune]
    pretty_exceptions_enable=False,
)
_UsageError: Any = typer.BadParameter.__base__
"""Base class of typer's errors about a command line, which has no public name."""


def _print_version(requested: bool) -> bool:
    if requested:
        typer.echo(f"sinsjax {runtime.package_version()}")
        raise typer.Exit
    return requested


@app.callback()
def _common_options(
    version: Annotated[
        bool,
        typer.Option(
            "--version", help="Show the version and exit.", callback=_print_version, is_eager=True
        ),
    ] = False,
) -> None:
    """Initial alignment of strapdown inertial navigators, thousands of runs at a time."""


@app.command(rich_help_panel=RUN)
def run(
    config: Config,
    out: Out,
    changes: Changes = None,
    overwrite: Overwrite = False,
    resume: Resume = False,
    devices: Devices = None,
    full: Full = False,
) -> None:
    """Simulate a few runs: curves, figures and a table.

    Example: sinsjax run paper1_resets -o out
    """
    run_study(
        config,
        changes,
        devices=devices,
        full=full,
        directory=out,
        keeps_few_curves=True,
        overwrite=overwrite,
        resume=resume,
    )


@app.command(rich_help_panel=RUN)
def sweep(
    config: Config,
    out: Out,
    changes: Changes = None,
    draws: Draws = None,
    overwrite: Overwrite = False,
    resume: Resume = False,
    devices: Devices = None,
    full: Full = False,
    scheduler: Annotated[
        str | None,
        typer.Option(
            help="Dask scheduler to use, tcp://host:port (extra `cluster`).", metavar="URL"
        ),
    ] = None,
    chunk_runs: Annotated[
        int | None,
        typer.Option(
            help="Runs per chunk; does not affect results, and may not change with --resume.",
            min=1,
            metavar="N",
        ),
    ] = None,
) -> None:
    """Simulate all draws and variants of a study to Parquet, with a figure and a table.

    Example: sinsjax sweep reset_sweep -o out
    """
    if devices is not None and scheduler is not None:
        raise InputError("--devices: conflicts with --scheduler (one device per worker)")
    run_study(
        config,
        changes if draws is None else [*(changes or ()), f"study.draws={draws}"],
        devices=devices,
        full=full,
        scheduler=scheduler,
        directory=out,
        chunk_runs=chunk_runs,
        overwrite=overwrite,
        resume=resume,
    )


@app.command(rich_help_panel=RUN)
def align(
    record: Annotated[
        Path, typer.Argument(help="Inertial record.", show_default=False, metavar="RECORD")
    ],
    config: Config,
    out: Out,
    reference: Annotated[
        Path | None,
        typer.Option(help="Reference attitude to compare with (CSV or Parquet).", metavar="FILE"),
    ] = None,
    changes: Changes = None,
    overwrite: Overwrite = False,
    resume: Resume = False,
    devices: Devices = None,
    full: Full = False,
) -> None:
    """Align recorded data: attitude and 1 sigma from every start time of the study.

    Example: sinsjax align drive.imu car_test -o out
    """
    run_study(
        config,
        changes,
        (record, reference),
        devices=devices,
        full=full,
        directory=out,
        keeps_few_curves=True,
        overwrite=overwrite,
        resume=resume,
    )


@app.command(rich_help_panel=RUN)
def tune(
    config: Config,
    out: Out,
    record: Record = None,
    reference: Reference = None,
    changes: Changes = None,
    overwrite: Overwrite = False,
    resume: Resume = False,
    devices: Devices = None,
    full: Full = False,
) -> None:
    """Search the variables of a study's [tune] for the best, and evaluate it on other draws.

    Example: sinsjax tune tune_condition5 -o out
    """
    run_study(
        config,
        changes,
        (record, reference),
        devices=devices,
        full=full,
        tunes=True,
        directory=out,
        overwrite=overwrite,
        resume=resume,
    )


@app.command(rich_help_panel=LOOK)
def rerun(
    directory: Annotated[
        Path, typer.Argument(help="Directory of results.", show_default=False, metavar="DIR")
    ],
    run_id: Annotated[
        int, typer.Option(help="Number of the run.", min=0, show_default=False, metavar="N")
    ],
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            "-o",
            help="Directory for the run; default: DIRECTORY/reruns/RUN_ID.",
            metavar="DIR",
        ),
    ] = None,
    record: Record = None,
    reference: Reference = None,
) -> None:
    """Repeat a single run with its full curve, and compare its row with the results.

    Example: sinsjax rerun out --run-id 17
    """
    from sinsjax.execution.run import rerun_stored_run
    from sinsjax.tuning import history

    runtime.configure()
    if history.is_tuning(directory):
        evaluation = directory / history.EVALUATION
        raise InputError(
            f"{directory}: holds a tuning run (give a folder of its runs: {evaluation})"
        )
    runtime.start_jax_on_chosen_platform()
    terminal, files = plain_console(), (record, reference)
    if not rerun_stored_run(directory, run_id, terminal, out=out, files=files):
        raise typer.Exit(1)


@app.command(rich_help_panel=LOOK)
def report(
    directories: Annotated[
        list[Path],
        typer.Argument(help="Directories of results.", show_default=False, metavar="DIR"),
    ],
    html: Annotated[
        Path | None,
        typer.Option(help="Also write a self-contained HTML file there.", metavar="FILE"),
    ] = None,
    full: Full = False,
) -> None:
    """Print the verdict on results again, and draw their figures, from the Parquet files.

    Example: sinsjax report out --html my_sweep.html
    """
    from sinsjax import report as reports

    reports.print_reports(directories, plain_console(), html, full=full)


def info() -> None:
    """Show versions, devices, compiler options and the folder of compiled programs."""
    from sinsjax.study.keys import (  # without plug-ins that clash with keys of a study
        BROKEN,
        PACKAGES,
    )

    runtime.configure()
    runtime.start_jax_on_chosen_platform()
    entries = runtime.info()
    methods = (f"{name} ({' '.join(package)})" for name, package in PACKAGES.items())
    more = {
        "plug-in methods": ", ".join(methods),
        "not usable": "; ".join(BROKEN.values()),
    }
    for key, value in (entries | {key: value for key, value in more.items() if value}).items():
        print_line(plain_console(), f"{key:>20}  {value}")


for _panel, _commands in {
    COMPARE: arena.COMMANDS,
    SET_UP: (advice.advise, *study_files.COMMANDS, info, loop_gains.gains),
}.items():
    for _command in _commands:
        app.command(rich_help_panel=_panel)(_command)


def main() -> None:
    """The command line within a process: see `sinsjax.__main__` for its end."""
    # Imported objects stay alive; scanning them repeatedly takes a fifth of the tracing time.
    gc.freeze()
    gc.set_threshold(100_000)
    try:
        code = app(standalone_mode=False)  # typer itself would print the usage before an error
    except Exception as error:
        if len(sys.argv) == 1 and isinstance(error, _UsageError):
            error.show()  # the help
            raise SystemExit(2) from None
        code, lines = _exit_code_and_lines(error)
        for line in lines:
            print(line, file=sys.stderr)
        raise SystemExit(code) from None
    if code == 130:  # Ctrl-C outside of a study's chunks, which typer turns into this code
        print("interrupted: stored results are kept", file=sys.stderr)
    raise SystemExit(code)


def _exit_code_and_lines(error: Any) -> tuple[int, list[str]]:
    """Return the exit code of a command that an error ends, and its lines.

    Raises:
        Exception: the error itself, if it is one of sinsjax.
    """
    if isinstance(error, StudyInterrupted):
        words = [word for word in sys.argv[1:] if word not in ("--overwrite", "--resume")]
        option = "--overwrite" if words[:1] == ["export"] else "--resume"
        again = shlex.join(["sinsjax", *words, option])
        return 130, [escape_controls(f"interrupted: {error} (continue: {again})")]
    if isinstance(error, InputError):
        return 2, [f"error: {line}" for line in error.lines]
    if isinstance(error, OSError):  # such as a full disk behind the standard output
        return 2, [f"error: {error}"]
    if isinstance(error, _UsageError):
        text = to_one_line(error.format_message()).rstrip(".")
        help_ = "" if error.ctx is None else f" (see `{error.ctx.command_path} -h`)"
        return 2, [f"error: {text[:1].lower()}{text[1:]}{help_}"]
    raise error
