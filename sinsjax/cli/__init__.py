"""The command line: thin commands. A user's mistake is one line, and exit code 2."""

import gc
import math
import sys
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Annotated

import typer

from sinsjax.cli import advice, arena, machine, study_files
from sinsjax.cli.help import (
    COMPARE,
    LOOK,
    RUN,
    SET_UP,
    Command,
    CommandGroup,
    UsageError,
    format_usage_error,
    resume_command_line,
)
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
    add_draws_override,
)
from sinsjax.cli.running import (
    configure_jax,
    print_plan_and_warnings,
    reject_conflicting_options,
    run_study,
    source_label,
)
from sinsjax.console import plain_console, tolerate_broken_pipe
from sinsjax.errors import InputError, StudyInterrupted
from sinsjax.messages import escape_controls
from sinsjax.platform import runtime

app = typer.Typer(
    cls=CommandGroup,
    no_args_is_help=True,
    context_settings={"help_option_names": ["-h", "--help"]},
    rich_markup_mode=None,  # markup would swallow the name of a section such as [tune]
    pretty_exceptions_enable=False,
)
command = partial(app.command, cls=Command)


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


@command(rich_help_panel=RUN)
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
        out,
        changes=changes,
        overwrite=overwrite,
        resume=resume,
        devices=devices,
        full=full,
        keep_curves=True,
    )


@command(rich_help_panel=RUN)
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
        out,
        changes=add_draws_override(changes, draws),
        overwrite=overwrite,
        resume=resume,
        devices=devices,
        full=full,
        keep_curves=False,
        chunk_runs=chunk_runs,
        scheduler=scheduler,
    )


@command(rich_help_panel=RUN)
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
        out,
        changes=changes,
        overwrite=overwrite,
        resume=resume,
        devices=devices,
        full=full,
        keep_curves=True,
        record_and_reference=(record, reference),
    )


@command(rich_help_panel=RUN)
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
    from sinsjax.cli.progress import stop_on_signal
    from sinsjax.execution.prepare import RunOptions
    from sinsjax.execution.progress import show_progress
    from sinsjax.study.changes import parse_changes
    from sinsjax.tuning import run_tuning

    reject_conflicting_options(overwrite=overwrite, resume=resume, devices=devices)
    configure_jax(devices)
    options = RunOptions(
        out, overwrite=overwrite, resume=resume, source=source_label(config, changes)
    )
    job = run_tuning.prepare_tuning(
        config, parse_changes(changes or ()), record, reference, options
    )
    assert job.directory is not None and job.forecast is not None
    terminal = plain_console()
    cores = runtime.usable_cores() if devices is None else devices
    print_plan_and_warnings(terminal, job, job.forecast.describe(cores))
    with stop_on_signal(terminal) as stop:
        run_tuning.run_tuning(
            job, watch=lambda name: show_progress(terminal, f"{job.study.name}: {name}"), stop=stop
        )
    import_module("sinsjax.report").print_reports(
        [job.directory], terminal, full=full, warnings_shown=True
    )


@command(rich_help_panel=LOOK)
def rerun(
    directory: Annotated[
        Path, typer.Argument(help="Directory of results.", show_default=False, metavar="DIR")
    ],
    run_id: Annotated[
        int, typer.Option(help="Number of the run.", min=0, show_default=False, metavar="N")
    ],
    given: Annotated[
        str | None,
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
    from sinsjax.execution import rerun as rerunning
    from sinsjax.execution.directory import results_path
    from sinsjax.tuning import history, run_tuning

    runtime.configure()
    if history.is_tuning(directory):
        evaluation = directory / run_tuning.EVALUATION
        raise InputError(
            f"{directory}: holds a tuning run (give a folder of its runs: {evaluation})"
        )
    runtime.start_backend()
    out_path = None if given is None else results_path(given)
    terminal, files = plain_console(), (record, reference)
    if not rerunning.rerun_stored_run(directory, run_id, terminal, out=out_path, files=files):
        raise typer.Exit(1)


@command(rich_help_panel=LOOK)
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


for _command in arena.COMMANDS:
    command(rich_help_panel=COMPARE)(_command)

for _command in (advice.advise, *study_files.COMMANDS, *machine.COMMANDS):
    command(rich_help_panel=SET_UP)(_command)


@command(rich_help_panel=SET_UP)
def gains(
    level_sigma: Annotated[
        float, typer.Option(help="Decay rate of levelling, 1/s.", metavar="X")
    ] = 0.02,
    azimuth_sigma: Annotated[
        float, typer.Option(help="Decay rate in azimuth, 1/s.", metavar="X")
    ] = 0.01,
    damping: Annotated[
        float, typer.Option(help="Damping ratio of both, above 0, below 1.", metavar="X")
    ] = 0.5**0.5,
    gravity: Annotated[float, typer.Option(help="Gravity, m/s^2.", metavar="X")] = 9.8,
    radius: Annotated[float, typer.Option(help="Earth radius, m.", metavar="X")] = 6378137.0,
) -> None:
    """Design the compass loops: gains from decay rates, the resulting roots and settling times.

    Example: sinsjax gains --azimuth-sigma 0.025
    """
    from sinsjax.cli.loop_gains import print_gains

    numbers = {
        "--level-sigma": level_sigma,
        "--azimuth-sigma": azimuth_sigma,
        "--damping": damping,
        "--gravity": gravity,
        "--radius": radius,
    }
    for option, value in numbers.items():
        if not 0 < value < (1 if option == "--damping" else math.inf):
            below = " and below 1" if option == "--damping" else ""
            raise InputError(f"{option}: must be above 0{below}, not {value:g}")
    rates = (level_sigma, azimuth_sigma, damping)
    print_gains(plain_console(), *rates, gravity=gravity, radius=radius)


def main() -> None:
    """The command line within a process: see `sinsjax.__main__` for its end."""
    # Imported objects stay alive; scanning them repeatedly takes a fifth of the tracing time.
    gc.freeze()
    gc.set_threshold(100_000)
    with tolerate_broken_pipe():
        try:
            code = app(standalone_mode=False)  # typer itself would print the usage before an error
        except UsageError as error:
            if len(sys.argv) == 1:  # without a command, its help is shown
                error.show()
            else:
                print(f"error: {format_usage_error(error)}", file=sys.stderr)
            raise SystemExit(2) from None
        except InputError as error:
            for line in error.lines:
                print(f"error: {line}", file=sys.stderr)
            raise SystemExit(2) from None
        except StudyInterrupted as interrupted:
            line = f"interrupted: {interrupted} (continue: {resume_command_line()})"
            print(escape_controls(line), file=sys.stderr)
            raise SystemExit(130) from None
        except Exception as error:
            from sinsjax.methods.plugins import describe_plugin_error

            described = describe_plugin_error(error)
            if described is None:
                raise
            print(f"error: {described}", file=sys.stderr)
            raise SystemExit(2) from None
        if code == 130:  # Ctrl-C outside of a study's chunks, which typer turns into this code
            print("interrupted: stored results are kept", file=sys.stderr)
        raise SystemExit(code)
