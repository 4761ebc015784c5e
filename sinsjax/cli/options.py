"""Arguments and options shared by several commands, and their shell completion."""

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Annotated

import typer


def _find_study(path: Path) -> Path:
    from sinsjax.study import files

    return files.study_file_or_given_path(path)


def completes(list_names: Callable[[], Iterable[str]]) -> Callable[[str], list[str]]:
    """Return the shell completion of a word by the names that begin with it."""

    def complete(incomplete: str) -> list[str]:
        return [name for name in list_names() if name.startswith(incomplete)]

    return complete


def _list_studies() -> list[str]:
    from sinsjax.study import files

    return [*(path.name for path in Path().glob("*.toml")), *files.shipped_studies()]


def _list_keys() -> list[str]:
    from sinsjax.study.keys import SECTIONS

    return [f"{name}.{key}=" for name, model in SECTIONS.items() for key in model.model_fields]


complete_key = completes(_list_keys)

Config = Annotated[
    Path,
    typer.Argument(
        help="Study file (TOML), or the name of a shipped study (sinsjax init --list).",
        show_default=False,
        metavar="CONFIG",
        callback=_find_study,
        autocompletion=completes(_list_studies),
    ),
]
Changes = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        help="Change a key of the study, as in alignment.phi_u0_deg=12; SECTION={} drops a section,"
        " axes.KEY={} an axis; may be repeated.",
        metavar="SECTION.KEY=VALUE",
        autocompletion=complete_key,
    ),
]
Draws = Annotated[
    int | None,
    typer.Option(
        help="Draws, in place of the study's; with --resume more than before extend the results.",
        min=1,
        metavar="N",
    ),
]
Out = Annotated[
    Path,
    typer.Option(
        "--out", "-o", help="Directory for the results.", show_default=False, metavar="DIR"
    ),
]
Overwrite = Annotated[
    bool, typer.Option("--overwrite", help="Replace existing results in the directory.")
]
Devices = Annotated[
    int | None,
    typer.Option(
        help="Threads that run the compiled program, one per CPU core; default: all cores.",
        min=1,
        metavar="N",
    ),
]
Full = Annotated[bool, typer.Option("--full", help="Print all tables below the verdict.")]
Resume = Annotated[bool, typer.Option("--resume", help="Continue the results in the directory.")]
Record = Annotated[Path | None, typer.Option(help="Record of a recorded study.", metavar="FILE")]
Reference = Annotated[Path | None, typer.Option(help="Its reference attitude.", metavar="FILE")]
