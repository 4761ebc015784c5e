"""Running a study from the command line: checks, forecast, progress and report."""

import threading
from contextlib import ExitStack, nullcontext, suppress
from importlib import import_module
from pathlib import Path
from typing import Any

from sinsjax.console import plain_console, say, warn
from sinsjax.errors import InputError
from sinsjax.platform import runtime

MOST_RUNS = 1024
"""Most runs of which `run` and `align` keep every curve; `run` rejects more."""

_LOWERED = "/jax/core/compile/jaxpr_to_mlir_module_duration"
"""JAX's event that precedes compilation by XLA."""


def run_study(
    config: Path,
    given: str,
    *,
    changes: list[str] | None = None,
    overwrite: bool,
    devices: int | None,
    curves: bool | None,
    resume: bool = False,
    chunk_runs: int | None = None,
    cluster: tuple[int | None, str | None] = (None, None),
    files: tuple[Path, Path | None] | None = None,
) -> None:
    """Run a study into a directory and print its report.

    Args:
        config: study file.
        given: directory for the results.
        changes: of the study, ``section.key=value``.
        overwrite: whether to replace existing results.
        devices: threads that run the compiled program; None for all cores.
        curves: whether to keep curves; None follows the study.
        resume: whether to complete existing results.
        chunk_runs: runs per chunk; None for the default.
        cluster: workers to start, and the address of a Dask scheduler.
        files: record and reference of a recorded study.

    Raises:
        InputError: the study cannot be run with these options.
    """
    from sinsjax.execution import forecast, locking, progress
    from sinsjax.execution import resume as resuming
    from sinsjax.execution import run as study_run

    out = resuming.named(given)
    study = loaded(config, changes)
    if study.is_recorded and files is None:
        raise InputError(f"{config}: [record]: the study needs a record (use `sinsjax align`)")
    if files is not None and not study.is_recorded:
        raise InputError(f"{config}: has no [record] section to read {files[0]} with")
    check_options(overwrite=overwrite, resume=resume, devices=devices, workers=cluster[0])
    locking.check_unlocked(out)
    resuming.check_free(out, overwrite=overwrite or resume)
    if study.is_estimated:
        curves = None  # there are no runs to have any
    runs = study.n_draws * study.n_variants
    terminal = plain_console()
    if curves and runs > MOST_RUNS and files is None:
        raise InputError(
            f"{config}: {runs} runs are too many to keep every curve (at most {MOST_RUNS}; use"
            " `sinsjax sweep`)"
        )
    if curves and runs > MOST_RUNS:
        say(terminal, f"{runs} runs: curves are kept only where [study] curves = true.")
        curves = None
    configure(devices)
    stored = None if files is None else study_run.load_tape(study, *files)
    study = study_run.at_rate(study, stored)
    if resume:
        resuming.check_same_study(out, study)  # before anything is told of another study
    expected = forecast.of(study, curves=curves)
    forecast.require_room(study, expected, out, overwrite=overwrite, resume=resume)
    cores = devices or cluster[0] or runtime.usable_cores()
    done = forecast.runs_done(out) if resume else 0
    if resume and not out.exists():
        say(terminal, f"{out}: there is nothing to resume, all runs are new.")
    if cluster[1] is None:
        say(terminal, f"{expected.describe(cores, done)}.")
    study = made_ready(study, stored)
    if left := study.dropped_s:
        say(terminal, f"The last {left:g} s do not fill a record interval and are not run.")
    if study.run_s <= study.study.window_s[0]:
        say(terminal, f"Runs that end by {study.study.window_s[0]:g} s have no window statistics.")
    with (
        _executor(*cluster) as executor,
        progress.interruptible(terminal) as stop,
        ExitStack() as showing,
    ):
        if cluster[1] is not None:  # only now it is known how many there are
            say(terminal, f"{expected.describe(executor.facts['threads'], done, threads=True)}.")
        tell = showing.enter_context(progress.progress(terminal, study.name))
        study_run.run_into(
            study,
            out,
            stored,
            curves=curves,
            chunk_runs=chunk_runs,
            overwrite=overwrite,
            resume=resume,
            executor=executor,
            tell=tell,
            stop=stop,
            source=named(config, changes),
        )
    import_module("sinsjax.report").summarise([out], terminal, warned=True)


def loaded(config: Path, changes: list[str] | None = None) -> Any:
    """Load a study with ``--set`` applied, and warn about sections that are no longer used."""
    from sinsjax.study.changes import parsed
    from sinsjax.study.load import load_study, unread_sections

    study = load_study(config, parsed(changes or ()))
    if line := unread_sections(config):
        warn(f"{line}.")
    return study


def named(config: Path, changes: list[str] | None) -> Path | str:
    """How results name their study: its file, and what ``--set`` changed."""
    file = config.name if config.is_absolute() else config.as_posix()
    return f"{file} with {', '.join(changes)}" if changes else config


def foreseen(config: Path, changes: list[str] | None) -> list[str]:
    """What a study would run, without running it: runs, steps, time, memory and disk."""
    from sinsjax.alignment.methods import PACKAGES
    from sinsjax.execution import forecast, preflight

    study = loaded(config, changes)
    if study.tune:
        what = f"tunes {', '.join(study.tune.variables)}"
    else:
        draws = "start times" if study.is_recorded else "draws"
        what = f"variants: {study.n_variants:,}, {draws}: {study.n_draws:,}"
    lines = [f"{config}: valid; {what}."]
    if not study.study.rate_hz:
        return [*lines, "The record tells the rate, and so how long this takes."]
    if study.tune:
        from sinsjax.tuning.carry_out import check_searches

        runtime.configure()  # methods of other packages are evaluated
        check_searches(study)
    expected = (forecast.of_tuning if study.tune else forecast.of)(study)
    steps = expected.length_s * study.rate_hz
    lines.append(f"{expected.describe(runtime.usable_cores())}.")
    lines.append(f"Up to {steps:,.0f} steps a run, {steps * expected.runs:,.0f} in all.")
    if not study.is_recorded and (told := preflight.process_noise(study)):
        lines.append(f"{told}.")
    warnings = [] if study.is_recorded else preflight.warnings_of(study)
    if not study.is_recorded and not PACKAGES.keys().isdisjoint(study.methods):
        runtime.configure()
        warnings = [*preflight.check_methods(study), *warnings]
    return [*lines, *(f"Warning: {line}" for line in warnings)]


def made_ready(study: Any, stored: Any) -> Any:
    """The study at the rate of its record, after printing its warnings.

    The report's modules will be imported while its first program compiles.
    """
    from sinsjax.execution import run as study_run

    study, warnings = study_run.made_ready(study, stored)
    for line in warnings:
        warn(line)
    # Only now: a study that is refused ends at once, with nothing left to wait for.
    _import_while_compiling("sinsjax.report")
    return study


def check_options(
    *, overwrite: bool, resume: bool, devices: int | None, workers: int | None = None
) -> None:
    """Reject conflicting options, and more devices or workers than cores."""
    if overwrite and resume:
        raise InputError("--resume: conflicts with --overwrite (give one of them)")
    cores = runtime.usable_cores()
    for option, count in (("--devices", devices), ("--workers", workers)):
        if count is not None and count > cores:
            raise InputError(f"{option}: {count} exceeds the {cores} available cores")


def configure(devices: int | None) -> None:
    """Configure JAX and start it."""
    runtime.configure(devices)
    runtime.require_backend()


def _import_while_compiling(name: str) -> None:
    """Import a module while XLA compiles its first program and Python is idle.

    The process waits for the thread before it ends: one that Python stops within an extension
    module takes the whole process down with "terminate called".
    """
    import jax.monitoring

    def load() -> None:
        with suppress(Exception):  # the import by the main thread tells it
            import_module(name)

    thread = threading.Thread(target=load, daemon=False)

    def listen(event: str, seconds: float, **about: Any) -> None:
        if event == _LOWERED and thread.ident is None:
            with suppress(RuntimeError):  # another thread has started it at the same time
                thread.start()

    jax.monitoring.register_event_duration_secs_listener(listen)


def _executor(workers: int | None, scheduler: str | None) -> Any:
    """A context with the executor of the tasks: Dask workers, or None for this process."""
    if workers is None and scheduler is None:
        return nullcontext()
    from sinsjax.execution import dask_pool

    return dask_pool.executor(workers=workers, scheduler=scheduler)
