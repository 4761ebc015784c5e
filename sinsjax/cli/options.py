"""Arguments and options shared by several commands, and their shell completion."""

from pathlib import Path
from typing import Annotated

import typer


def _find_study(path: Path) -> Path:
    from sinsjax.study import files

    return files.find_study_file(path)


def complete_study(incomplete: str) -> list[str]:
    """The shipped studies and the study files of this folder that a word may be completed to."""
    from sinsjax.study import files

    local = (path.name for path in Path().glob("*.toml"))
    return [name for name in (*local, *files.shipped_studies()) if name.startswith(incomplete)]


def complete_section_or_key(incomplete: str) -> list[str]:
    """The sections, keys and methods that `sinsjax keys` explains."""
    from sinsjax.methods.registry import METHODS
    from sinsjax.study.keys import TABLES

    known = [*TABLES, *(key for model in TABLES.values() for key in model.model_fields), *METHODS]
    return [name for name in known if name.startswith(incomplete)]


def add_draws_override(changes: list[str] | None, draws: int | None) -> list[str] | None:
    """Return the changes of a study, with its number of draws if given."""
    return changes if draws is None else [*(changes or ()), f"study.draws={draws}"]


def complete_override_key(incomplete: str) -> list[str]:
    """The keys that may be set, as ``section.key=``."""
    from sinsjax.study.keys import SECTIONS

    known = (f"{name}.{key}=" for name, model in SECTIONS.items() for key in model.model_fields)
    return [place for place in known if place.startswith(incomplete)]


Config = Annotated[
    Path,
    typer.Argument(
        help="Study file (TOML), or the name of a shipped study (sinsjax init --list).",
        show_default=False,
        metavar="CONFIG",
        callback=_find_study,
        autocompletion=complete_study,
    ),
]
Changes = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        help="Change a key of the study, as in alignment.phi_u0_deg=12; SECTION={} drops a section,"
        " axes.KEY={} an axis; may be repeated.",
        metavar="SECTION.KEY=VALUE",
        autocompletion=complete_override_key,
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
    str,  # because an empty path would become "."
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
