"""The command line: thin commands over `campaign`, `report` and `bench`.

A user's mistake prints one line and exits with code 2; nothing else of Python is shown.
"""

import atexit
import gc
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from sinsjax import runtime
from sinsjax.types import InputError

app = typer.Typer(
    help="Initial alignment of strapdown inertial navigators, thousands of runs at a time.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)

MOST_RUNS = 1024
"""Runs up to which `run` and `align` keep every curve; `run` takes no more."""

Config = Annotated[Path, typer.Argument(help="Study file (TOML).", show_default=False)]
Out = Annotated[
    Path, typer.Option("--out", "-o", help="Directory for the results.", show_default=False)
]
Overwrite = Annotated[bool, typer.Option(help="Replace results that the directory holds.")]
Devices = Annotated[
    int | None,
    typer.Option(help="CPU devices to spread the runs over; all cores if left out.", min=1),
]


@app.command()
def run(config: Config, out: Out, overwrite: Overwrite = False, devices: Devices = None) -> None:
    """Simulate a few runs: curves, figures and a table.

    Example: sinsjax run configs/paper1_resets.toml -o out
    """
    _run_study(config, out, overwrite=overwrite, devices=devices, curves=True)


@app.command()
def sweep(config: Config, out: Out, overwrite: Overwrite = False, devices: Devices = None) -> None:
    """Simulate all draws and variants of a study into Parquet, with a figure and a table.

    Example: sinsjax sweep configs/reset_sweep.toml -o out
    """
    _run_study(config, out, overwrite=overwrite, devices=devices, curves=None)


@app.command()
def align(
    record: Annotated[Path, typer.Argument(help="Inertial record.", show_default=False)],
    config: Config,
    out: Out,
    reference: Annotated[
        Path | None, typer.Option(help="Reference attitude to compare with (CSV or Parquet).")
    ] = None,
    overwrite: Overwrite = False,
    devices: Devices = None,
) -> None:
    """Align a recorded file: attitude with its 1 sigma, from every start time of the study.

    Example: sinsjax align drive.imu configs/car_test.toml -o out
    """
    _run_study(
        config,
        out,
        overwrite=overwrite,
        devices=devices,
        curves=True,
        files=(record, reference),
    )


@app.command()
def report(
    directories: Annotated[
        list[Path], typer.Argument(help="Directories of results.", show_default=False)
    ],
    page: Annotated[
        Path | None, typer.Option(help="Also write a documentation page (Markdown) there.")
    ] = None,
) -> None:
    """Draw the figures and print the tables again, from the Parquet files alone.

    Example: sinsjax report out --page docs/my_sweep.md
    """
    from sinsjax import report as reports

    reports.summarise(directories, Console(), page)


@app.command()
def gains() -> None:
    """Compare the gains that paper 2 prints with its formulas, and show the roots of its loops.

    Example: sinsjax gains
    """
    from sinsjax.report.gains import print_gains

    print_gains(Console())


@app.command()
def info() -> None:
    """Show versions, devices and the compiler options in force."""
    runtime.configure()
    console = Console(highlight=False)
    for key, value in runtime.info().items():
        shown = ", ".join(f"{k} = {v}" for k, v in value.items()) if key == "options" else value
        console.print(f"{key:>20}  {shown}", soft_wrap=True)


@app.command()
def bench(
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object a line.")] = False,
    limit: Annotated[
        bool, typer.Option("--limit", help="Also build and run the limit kernel (needs gcc).")
    ] = False,
    repeats: Annotated[int, typer.Option(help="Timings a row; the median is told.", min=1)] = 7,
) -> None:
    """Time the engine's step on one core: the short benchmark set.

    Example: sinsjax bench --limit
    """
    from sinsjax import bench as benchmarks

    benchmarks.run(Console(), as_json=as_json, limit=limit, repeats=repeats)


def _run_study(
    config: Path,
    out: Path,
    *,
    overwrite: bool,
    devices: int | None,
    curves: bool | None,
    files: tuple[Path, Path | None] | None = None,
) -> None:
    from sinsjax import campaign
    from sinsjax.config import load_study
    from sinsjax.results import check_free

    study = load_study(config)
    if study.is_recorded and files is None:
        raise InputError(f"{config}: [record]: the study reads a record: use `sinsjax align`")
    if files is not None and not study.is_recorded:
        raise InputError(f"{config}: has no [record] section to read {files[0]} with")
    check_free(out, overwrite=overwrite)
    runs = study.n_draws * study.n_variants
    console = Console()
    if curves and runs > MOST_RUNS and files is None:
        raise InputError(
            f"{config}: {runs} runs are too many to keep every curve (at most {MOST_RUNS}):"
            " use `sinsjax sweep`"
        )
    if curves and runs > MOST_RUNS:
        console.print(f"{runs} runs: curves are kept only where [study] curves = true.")
        curves = None
    if devices is not None and devices > runtime.usable_cores():
        raise InputError(f"--devices: {devices} are more than the {runtime.usable_cores()} cores")
    runtime.configure(devices)
    # What the report needs takes a third of a second to import, which XLA's compiling leaves idle.
    threading.Thread(target=import_module, args=("sinsjax.report",), daemon=True).start()
    tape = None if files is None else campaign.load_tape(study, *files)
    if left := study.dropped_s:
        console.print(f"The last {left:g} s are no whole record interval and are not run.")
    if study.run_s <= study.study.window_s[0]:
        console.print(f"Runs that end by {study.study.window_s[0]:g} s have no window statistics.")
    with _progress(console, study.study.name) as tell:
        campaign.run_into(
            study, out, tape, curves=curves, overwrite=overwrite, progress=tell, source=config
        )
    import_module("sinsjax.report").summarise([out], console)


@contextmanager
def _progress(console: Console, name: str) -> Iterator[Any]:
    """A bar on a terminal, a plain line every tenth of the way elsewhere."""
    if not console.is_terminal:
        told = -1

        def tell_plainly(done: int, total: int) -> None:
            nonlocal told
            if done * 10 // total > told:
                told = done * 10 // total
                console.print(f"{name}: {done} of {total} runs", highlight=False)

        yield tell_plainly
        return
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("runs"),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=console) as progress:
        task = progress.add_task(f"{name} (compiling)", total=None)

        def tell(done: int, total: int) -> None:
            progress.update(task, description=name, completed=done, total=total)

        yield tell


def main() -> None:
    """Entry point of the ``sinsjax`` command."""
    # A last collection of what ends with the process anyway takes a third of a second.
    atexit.register(gc.freeze)
    try:
        app()
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(2) from None
