"""The command that turns a data sheet into advice."""

import json
import textwrap
from pathlib import Path
from typing import Annotated, Any

import typer

from sinsjax.cli.options import Changes, completes
from sinsjax.cli.study_files import require_new
from sinsjax.messages import plain_console, print_line
from sinsjax.platform.files import write_file

_WIDEST = 100
_WRAPPED: Any = {"subsequent_indent": " " * 12, "drop_whitespace": True, "break_on_hyphens": False}


def _list_sheets() -> list[str]:
    from sinsjax.advice.sheet import shipped_sheets

    return list(shipped_sheets())


def advise(
    sheet: Annotated[
        Path | None,
        typer.Argument(
            help="Sheet of an IMU (TOML): a study without [alignment].",
            show_default=False,
            metavar="SHEET",
        ),
    ] = None,
    imu: Annotated[
        str | None,
        typer.Option(
            help="A shipped sheet instead; `list` shows them.",
            metavar="NAME",
            autocompletion=completes(_list_sheets),
        ),
    ] = None,
    latitude: Annotated[
        float | None, typer.Option(help="Latitude, deg.", metavar="DEG", show_default=False)
    ] = None,
    time: Annotated[
        float | None,
        typer.Option(help="Time to align, s; 300 unless the sheet has it.", metavar="S"),
    ] = None,
    motion: Annotated[
        str | None,
        typer.Option(
            help="Vehicle motion, in place of [motion]: still, rocking or surging.",
            metavar="NAME",
        ),
    ] = None,
    changes: Changes = None,
    study_file: Annotated[
        Path | None,
        typer.Option(
            "--study", help="Also write the Monte Carlo study that confirms it.", metavar="FILE"
        ),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the numbers as JSON.")] = False,
) -> None:
    """Predict from a data sheet how well an IMU finds north, its limits, and recommended settings.

    Example: sinsjax advise --imu kvh1775 --latitude 48 --time 300 --motion rocking
    """
    from sinsjax.advice.advise import advise as advise_on
    from sinsjax.advice.advise import describe_advice
    from sinsjax.advice.sheet import shipped_sheets
    from sinsjax.study.changes import parse_changes

    console = plain_console()
    if imu == "list":
        for name, path in shipped_sheets().items():
            comment = path.read_text(encoding="utf-8").partition("\n")[0]
            print_line(console, f"{name:<12} {comment.removeprefix('# ')}")
        return
    if study_file is not None:
        require_new(study_file)
    found = advise_on(
        sheet,
        imu=imu,
        latitude_deg=latitude,
        time_s=time,
        motion=motion,
        changes=parse_changes(changes),
    )
    if as_json:
        typer.echo(json.dumps(found.to_dict(), indent=1))
    else:
        width = min(console.width, _WIDEST)
        for line in describe_advice(found):
            for part in textwrap.wrap(line, width, **_WRAPPED) or [""]:
                print_line(console, part)
    if study_file is not None:
        write_file(study_file, found.study().encode())
        if not as_json:
            print_line(
                console, f"{study_file} written; `sinsjax sweep {study_file} -o out` confirms it."
            )
