"""Running a study from the command line: checks, forecast, progress and report."""

import threading
from contextlib import ExitStack, suppress
from importlib import import_module
from pathlib import Path
from typing import Any

from sinsjax.console import plain_console, print_line, print_warning
from sinsjax.errors import InputError
from sinsjax.platform import runtime

_LOWERED = "/jax/core/compile/jaxpr_to_mlir_module_duration"
"""JAX's event that precedes compilation by XLA."""


def run_study(
    config: Path,
    directory: str,
    *,
    changes: list[str] | None = None,
    overwrite: bool,
    devices: int | None,
    keep_curves: bool,
    full: bool = False,
    resume: bool = False,
    chunk_runs: int | None = None,
    scheduler: str | None = None,
    record_and_reference: tuple[Path | None, Path | None] = (None, None),
) -> None:
    """Run a study into a directory and print its report.

    Args:
        config: study file.
        directory: directory for the results.
        changes: of the study, ``section.key=value``.
        overwrite: whether to replace existing results.
        devices: threads that run the compiled program; None for all cores.
        keep_curves: whether to keep the curves of all runs, if they are few.
        full: whether to print all tables.
        resume: whether to complete existing results.
        chunk_runs: runs per chunk; None for the default.
        scheduler: address of a Dask scheduler; None for this process alone.
        record_and_reference: record and reference of a recorded study.

    Raises:
        InputError: the study cannot be run with these options.
    """
    from sinsjax.cli.progress import stop_on_signal
    from sinsjax.execution import forecast
    from sinsjax.execution.prepare import RunOptions, prepare_job
    from sinsjax.execution.progress import show_progress
    from sinsjax.execution.run import MAX_CURVE_RUNS, run_job
    from sinsjax.study.changes import parse_changes

    reject_conflicting_options(overwrite=overwrite, resume=resume, devices=devices)
    configure_jax(devices)
    options = RunOptions(
        directory,
        max_curve_runs=MAX_CURVE_RUNS if keep_curves else None,
        chunk_runs=chunk_runs,
        overwrite=overwrite,
        resume=resume,
        source=source_label(config, changes),
    )
    job = prepare_job(config, parse_changes(changes or ()), *record_and_reference, options)
    assert job.directory is not None and job.forecast is not None
    terminal = plain_console()
    done = forecast.count_stored_runs(job.directory) if resume else 0
    with ExitStack() as stack:
        executor = None
        if scheduler is None:
            cores = devices or runtime.usable_cores()
            print_plan_and_warnings(terminal, job, job.forecast.describe(cores, done))
        else:
            from sinsjax.execution import cluster

            executor = stack.enter_context(cluster.executor(scheduler=scheduler))
            threads = executor.facts["threads"]  # known only now
            print_plan_and_warnings(
                terminal, job, job.forecast.describe(threads, done, threads=True)
            )
        stop = stack.enter_context(stop_on_signal(terminal))
        on_progress = stack.enter_context(show_progress(terminal, job.study.name))
        run_job(job, executor=executor, on_progress=on_progress, stop=stop)
    import_module("sinsjax.report").print_reports(
        [job.directory], terminal, full=full, warnings_shown=True
    )


def print_plan_and_warnings(terminal: Any, job: Any, plan: str) -> None:
    """Print the plan of a prepared job, its warnings and notes.

    The report's modules will be imported while its first program compiles.
    """
    print_line(terminal, f"{plan}.")
    for line in job.warnings:
        print_warning(line)
    for line in job.notes:
        print_line(terminal, line)
    _import_while_compiling("sinsjax.report")


def source_label(config: Path, changes: list[str] | None) -> Path | str:
    """Return the label of a study in its results: its file, and its changes by ``--set``."""
    file = config.name if config.is_absolute() else config.as_posix()
    return f"{file} with {', '.join(changes)}" if changes else config


def describe_plan(config: Path, changes: list[str] | None) -> list[str]:
    """Return the planned runs of a study and their cost: steps, time, memory and disk."""
    from sinsjax.execution import checks
    from sinsjax.execution.prepare import RunOptions, prepare_job
    from sinsjax.study.changes import parse_changes
    from sinsjax.study.files import source_name
    from sinsjax.study.load import load_study
    from sinsjax.study.unused_keys import list_idle_keys
    from sinsjax.tuning.run_tuning import prepare_tuning

    runtime.configure()  # plug-in methods are traced
    overrides = parse_changes(changes or ())
    study = load_study(config, overrides)
    if study.tune:
        summary = f"tunes {', '.join(study.tune.variables)}"
    else:
        draws = "start times" if study.is_recorded else "draws"
        summary = f"variants: {study.n_variants:,}, {draws}: {study.n_draws:,}"
    lines = [f"{source_name(config)}: valid; {summary}.", *list_idle_keys(study)]
    if study.is_recorded:
        return [*lines, "The record determines the rate and the duration."]
    if study.tune:
        job = prepare_tuning(config, overrides, None, None, RunOptions())
    else:
        job = prepare_job(config, overrides, options=RunOptions())
    expected = job.forecast
    assert expected is not None
    steps = expected.length_s * study.rate_hz
    lines.append(f"{expected.describe(runtime.usable_cores())}.")
    lines.append(f"Up to {steps:,.0f} steps per run, {steps * expected.runs:,.0f} in total.")
    describe = (
        checks.describe_process_noise,
        checks.describe_measurement_noise,
        checks.describe_feedback_interval,
    )
    lines += [f"{line}." for line in (text(study) for text in describe) if line]
    return [*lines, *(f"Warning: {line}" for line in job.warnings)]


def reject_conflicting_options(*, overwrite: bool, resume: bool, devices: int | None) -> None:
    """Reject conflicting options, and more devices than cores."""
    if overwrite and resume:
        raise InputError("--resume: conflicts with --overwrite (give one of them)")
    cores = runtime.usable_cores()
    if devices is not None and devices > cores:
        raise InputError(f"--devices: {devices} exceeds the {cores} available cores")


def configure_jax(devices: int | None) -> None:
    """Configure JAX and start it."""
    runtime.configure(devices)
    runtime.start_backend()


def _import_while_compiling(module_name: str) -> None:
    """Import a module while XLA compiles its first program and Python is idle.

    The process waits for the thread before it ends: one that Python stops within an extension
    module aborts the whole process with "terminate called".
    """
    import jax.monitoring

    def load() -> None:
        with suppress(Exception):  # the import by the main thread reports it
            import_module(module_name)

    thread = threading.Thread(target=load, daemon=False)

    def listen(event: str, seconds: float, **about: Any) -> None:
        if event == _LOWERED and thread.ident is None:
            with suppress(RuntimeError):  # another thread has started it at the same time
                thread.start()

    jax.monitoring.register_event_duration_secs_listener(listen)
