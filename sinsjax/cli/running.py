"""Running a study from the command line: checks, forecast, progress, stopping and report."""

import os
import signal
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from types import FrameType
from typing import Any

from rich.console import Console

from sinsjax.errors import InputError
from sinsjax.messages import plain_console, print_line, print_warning
from sinsjax.platform import runtime

_STOPPING = "Stopping after the running chunks (repeat to abandon them)."
_SIGNALS = (signal.SIGINT, signal.SIGTERM)  # batch systems send the second


def run_study(
    config: Path,
    changes: list[str] | None,
    record_and_reference: tuple[Path | None, Path | None] = (None, None),
    *,
    devices: int | None,
    full: bool,
    tunes: bool = False,
    scheduler: str | None = None,
    **options: Any,
) -> None:
    """Run or tune a study into a directory and print its report.

    The arguments are options of commands: the changes ``section.key=value``, the files of a record
    and its reference, and the others those of `prepare.load_job`.
    """
    from sinsjax.execution.prepare import prepare_job
    from sinsjax.execution.progress import show_progress
    from sinsjax.execution.run import run_job
    from sinsjax.study.changes import parse_changes
    from sinsjax.tuning.run_tuning import prepare_tuning, run_tuning

    if options["overwrite"] and options["resume"]:
        raise InputError("--resume: conflicts with --overwrite (give one of them)")
    cores = runtime.usable_cores()
    if devices is not None and devices > cores:
        raise InputError(f"--devices: {devices} exceeds the {cores} available cores")
    runtime.configure(devices)
    runtime.start_jax_on_chosen_platform()
    if changes:
        file = config.name if config.is_absolute() else config.as_posix()
        options["source"] = f"{file} with {', '.join(changes)}"
    prepare, terminal = prepare_tuning if tunes else prepare_job, plain_console()
    job = prepare(config, parse_changes(changes), *record_and_reference, **options)
    assert job.directory is not None and job.forecast is not None
    with ExitStack() as stack:
        executor, cores = None, devices or cores
        if scheduler is not None:
            from sinsjax.execution import cluster

            executor = stack.enter_context(cluster.executor(scheduler=scheduler))
            cores = executor.facts["threads"]  # known only now
        print_line(terminal, job.forecast.describe(cores))
        for line in job.warnings:
            print_warning(line)
        for line in job.notes:
            print_line(terminal, line)
        stop, name = stack.enter_context(stop_on_signal(terminal)), job.study.name
        if tunes:
            run_tuning(job, lambda search: show_progress(terminal, f"{name}: {search}"), stop)
        else:
            on_progress = stack.enter_context(show_progress(terminal, name))
            run_job(job, executor=executor, on_progress=on_progress, stop=stop)
    from sinsjax import report  # late: it takes a second to import

    report.print_reports([job.directory], terminal, full=full, warnings_shown=True)


@contextmanager
def stop_on_signal(console: Console) -> Iterator[threading.Event]:
    """An event set by Ctrl-C or a termination signal; a second signal ends the process at once.

    Ending at once loses only the running chunks: files are written atomically.
    """
    stop = threading.Event()

    def handle(number: int, frame: FrameType | None) -> None:
        if stop.is_set():
            os._exit(128 + number)
        stop.set()
        # In a thread, because the signal may have interrupted this one while printing.
        threading.Thread(target=print_line, args=(console, _STOPPING)).start()

    before = {number: signal.signal(number, handle) for number in _SIGNALS}
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
