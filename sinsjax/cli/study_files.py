"""Commands about studies themselves: beginning one, and checking one before it runs."""

import os
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated, Any

import typer

from sinsjax.cli import options
from sinsjax.cli.options import Changes, Config
from sinsjax.errors import InputError
from sinsjax.messages import plain_console, print_line
from sinsjax.platform import runtime
from sinsjax.platform.files import write_file


def _list_names() -> list[str]:
    from sinsjax.study import files

    return [*files.template_files(), *files.shipped_studies()]


def _list_explained() -> list[str]:
    from sinsjax.methods.registry import METHODS
    from sinsjax.study.keys import TABLES

    return [*TABLES, *(key for model in TABLES.values() for key in model.model_fields), *METHODS]


def init(
    name: Annotated[
        str | None,
        typer.Argument(
            help="Template or shipped study.",
            show_default=False,
            metavar="NAME",
            autocompletion=options.completes(_list_names),
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", help="File to write; default: NAME.toml.", metavar="FILE"),
    ] = None,
    from_: Annotated[
        Path | None,
        typer.Option(
            "--from",
            help="With `init record`: the record to describe (delimited text or Parquet).",
            metavar="LOG",
        ),
    ] = None,
    changes: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            help="With --from: a known property of the record, as in record.gyro_unit=rad_per_s;"
            " the rest is examined. May be repeated.",
            metavar="SECTION.KEY=VALUE",
            autocompletion=options.complete_key,
        ),
    ] = None,
    list_: Annotated[
        bool, typer.Option("--list", help="List the templates and shipped studies, and exit.")
    ] = False,
) -> None:
    """Begin a study file: a copy of a template or a shipped study, with its comments.

    Example: sinsjax init sweep -o mine.toml; sinsjax init record --from log.csv
    """
    from sinsjax.study import files
    from sinsjax.study.changes import parse_changes

    console = plain_console()
    if list_:
        for line in _describe_templates_and_studies():
            print_line(console, line, wrap=True)
        return
    if name is None:
        raise InputError("NAME: required (`sinsjax init --list` shows the names)")
    if from_ is not None and name != "record":
        raise InputError(f"--from: requires `init record`, not `init {name}`")
    if changes and from_ is None:
        raise InputError("--set: requires `init record --from LOG` (or edit the study)")
    path = out or Path(f"{(from_ or Path(name)).stem}.toml")
    if from_ is None:
        text = files.shipped_text(name, path)
    else:
        from sinsjax.study.from_record import make_study_text

        text = make_study_text(from_, path, parse_changes(changes))
    if os.path.lexists(path):
        raise InputError(f"{path}: exists, and is not overwritten (give another file with --out)")
    write_file(path, text.encode())
    print_line(console, f"{path} written; `sinsjax validate {path}` checks it.")
    if from_ is not None:
        for line in _list_questions_and_next_command(text, path, from_):
            print_line(console, line)


def _list_questions_and_next_command(text: str, path: Path, log: Path) -> Iterator[str]:
    """Yield what the log of a new study does not determine, and how to align it."""
    from sinsjax.study import files

    if doubts := text.count(files.DOUBT):
        lines = "line" if doubts == 1 else "lines"
        yield f"{path} has {doubts} {lines} with # DOUBT to check."
    if keys := re.findall(r'^(\w+) = "\?"', text, re.MULTILINE):
        noun = "question" if len(keys) == 1 else "questions"
        yield f"{len(keys)} open {noun}: {', '.join(keys)}. Answer in {path}, or by --set; then"
    yield f"`sinsjax align {log} {path} -o out` runs it."


def _describe_templates_and_studies() -> Iterator[str]:
    """Yield the templates and shipped studies with their purposes."""
    from sinsjax.study import files

    for title, paths in (
        ("templates", files.template_files()),
        ("studies", files.shipped_studies()),
    ):
        yield f"{title}:"
        yield from (f"    {name}: {files.read_purpose(path)}" for name, path in paths.items())


def validate(config: Config, changes: Changes = None) -> None:
    """Check a study without running it: report its errors, or the planned runs and their cost.

    Example: sinsjax validate reset_sweep --set study.draws=64
    """
    for line in describe_plan(config, changes):
        print_line(plain_console(), line)


def describe_plan(config: Path, changes: list[str] | None) -> list[str]:
    """Return the planned runs of a study and their cost: steps, time, memory and disk."""
    from sinsjax.execution.prepare import prepare_job
    from sinsjax.study.changes import parse_changes
    from sinsjax.study.files import source_name
    from sinsjax.study.load import load_study
    from sinsjax.study.rules import describe_idle_keys

    runtime.configure()  # plug-in methods are traced
    overrides = parse_changes(changes)
    study = load_study(config, overrides)
    if study.tune:
        summary = f"tunes {', '.join(study.tune.variables)}"
    else:
        draws = "start times" if study.is_recorded else "draws"
        summary = f"variants: {study.n_variants:,}, {draws}: {study.n_draws:,}"
    lines = [f"{source_name(config)}: valid; {summary}.", *describe_idle_keys(study)]
    if study.is_recorded:
        return [*lines, "The record determines the rate and the duration."]
    prepare: Callable[..., Any] = prepare_job
    if study.tune:
        from sinsjax.tuning.run_tuning import prepare_tuning as prepare
    job = prepare(config, overrides)
    expected = job.forecast
    assert expected is not None
    steps = expected.length_s * study.rate_hz
    lines.append(expected.describe(runtime.usable_cores()))
    lines.append(f"Up to {steps:,.0f} steps per run, {steps * expected.runs:,.0f} in total.")
    return [*lines, *(f"Warning: {line}" for line in job.warnings)]


def keys(
    name: Annotated[
        str | None,
        typer.Argument(
            help="Section, key or method; all keys without one.",
            show_default=False,
            metavar="SECTION|KEY|METHOD",
            autocompletion=options.completes(_list_explained),
        ),
    ] = None,
) -> None:
    """Explain the keys of a study: name, unit, default, meaning, and the methods that read them.

    For a method: its source, the package that provides it, and its own keys.

    Example: sinsjax keys reset_cycle_s
    """
    from sinsjax.study import keys

    console = plain_console()
    for line in keys.describe_method_if_known(name) if name else ():
        print_line(console, line, wrap=True)
    for key in keys.find_keys(name):
        is_fixed = key.default and not key.default.startswith("required")
        default = f"default {key.default}" if is_fixed else key.default
        about = filter(None, (key.unit, default, f"methods: {key.readers_text}"))
        print_line(console, f"[{key.section}] {key.name}: {'; '.join(about)}")
        if key.meaning:
            print_line(console, f"    {key.meaning}", wrap=True)


def schedule(config: Config, changes: Changes = None) -> None:
    """Compute by the law when to reset a study's filter, and predict its settling time.

    Example: sinsjax schedule paper1_resets
    """
    from sinsjax.study import reset_plan
    from sinsjax.study.changes import parse_changes
    from sinsjax.study.load import load_study

    study, console = load_study(config, parse_changes(changes)), plain_console()
    for line in reset_plan.describe_plans(study):
        print_line(console, line, wrap=True)


def require_new(study_file: Path) -> None:
    """Refuse a file of ``--study`` that exists, or whose folder cannot be written."""
    if os.path.lexists(study_file):
        raise InputError(f"{study_file}: exists, and is not overwritten (give another file)")
    folder = study_file.parent
    if not folder.is_dir():
        raise InputError(f"{study_file}: cannot be written: there is no folder {folder}")
    if not os.access(folder, os.W_OK):
        raise InputError(f"{study_file}: cannot be written: no right to write in {folder}")


COMMANDS = (init, validate, keys, schedule)
