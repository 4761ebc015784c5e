"""Help of commands that shows ``CONFIG`` and ``DIR...`` instead of ``{CONFIG}`` and types.

Also messages about a wrong command line, or one of version 1.0, and the command line that resumes
a study.
"""

import shlex
import sys
from typing import Any

import typer
from typer.core import TyperArgument, TyperCommand, TyperGroup

from sinsjax import gone
from sinsjax.errors import InputError
from sinsjax.messages import to_one_line

UsageError: Any = typer.BadParameter.__base__
"""Base class of typer's errors about a command line, which has no public name."""


def format_usage_error(error: Any) -> str:
    """Return one line about a `UsageError`, such as an unknown option or a missing argument."""
    text = to_one_line(error.format_message()).rstrip(".")
    help_ = "" if error.ctx is None else f" (see `{error.ctx.command_path} -h`)"
    return f"{text[:1].lower()}{text[1:]}{help_}"


RUN, LOOK, COMPARE, SET_UP = PANELS = ("Run", "Look", "Compare", "Set up")
"""Panels of the list of commands: the ``rich_help_panel`` of each command."""


class CommandGroup(TyperGroup):
    """The commands, listed by panel in the help.

    Typer draws panels only with markup, which would swallow the name of a section such as [tune].
    """

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """Return the command of some words; refuse one that is gone."""
        if args and args[0] in gone.COMMANDS and not ctx.resilient_parsing:
            raise InputError(f"{args[0]}: {gone.LINE.format(gone.COMMANDS[args[0]])}")
        return super().resolve_command(ctx, args)

    def commands_by_panel(self, ctx: Any) -> dict[str, dict[str, Any]]:
        """Return the commands by name in each panel."""
        names = self.list_commands(ctx)
        commands: dict[str, Any] = {name: self.get_command(ctx, name) for name in names}
        return {
            panel: {k: c for k, c in commands.items() if c.rich_help_panel == panel}
            for panel in PANELS
        }

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write each panel with its commands and their first sentences."""
        for panel, commands in self.commands_by_panel(ctx).items():
            with formatter.section(panel):
                formatter.write_dl([(k, c.get_short_help_str()) for k, c in commands.items()])


class Command(TyperCommand):
    """A command whose help names its arguments without their Python types."""

    def get_short_help_str(self, limit: int = 0) -> str:
        """Return its first sentence, wrapped but never cut in a list of commands."""
        return str(super().get_short_help_str(limit=sys.maxsize))

    def parse_args(self, ctx: Any, args: list[str]) -> Any:
        """Parse the words of the command; refuse an option that is gone."""
        try:
            return super().parse_args(ctx, args)
        except UsageError as error:
            option = getattr(error, "option_name", "")
            if instead := gone.OPTIONS.get((str(self.name), option)):
                text = gone.LINE.format(instead)
                raise InputError(f"{self.name} {option}: {text}") from None
            raise

    def collect_usage_pieces(self, ctx: Any) -> list[str]:
        """The words of the usage line: required arguments bare, others in brackets."""
        return [
            piece.replace("{", "").replace("}", "") for piece in super().collect_usage_pieces(ctx)
        ]

    def help_records(self, ctx: Any) -> dict[str, list[tuple[str, str]]]:
        """Return the arguments and the options with their help, by title."""
        records: dict[str, list[tuple[str, str]]] = {"Arguments": [], "Options": []}
        for param in self.get_params(ctx):
            if (record := param.get_help_record(ctx)) is None:
                continue
            if isinstance(param, TyperArgument):
                many = "..." if param.nargs != 1 else ""
                records["Arguments"].append((f"{param.display_name_raw}{many}", record[1]))
            else:
                records["Options"].append(record)
        return records

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Write the arguments, then the options, each with its help."""
        for title, records in self.help_records(ctx).items():
            if records:
                with formatter.section(title):
                    formatter.write_dl(records)


def resume_command_line() -> str:
    """Return the command line that resumes this one, or repeats an export."""
    words = [word for word in sys.argv[1:] if word not in ("--overwrite", "--resume")]
    option = "--overwrite" if words[:1] == ["export"] else "--resume"
    return shlex.join(["sinsjax", *words, option])
