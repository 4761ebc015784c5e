"""The page of all commands: ``python -m sinsjax.cli.commands_page > docs/commands.md``."""

from collections import Counter
from typing import Any

import typer

from sinsjax.cli import app


def render_commands_page() -> str:
    """Return usage, examples, arguments and options of every command, as Markdown."""
    group: Any = typer.main.get_command(app)
    panels = group.commands_by_panel(typer.Context(group))
    commands = {name: command for panel in panels.values() for name, command in panel.items()}
    records = {name: _help_records(command) for name, command in commands.items()}
    uses = Counter(record for records_ in records.values() for record in records_)
    common = [record for record, count in uses.items() if count > 1]
    lines = [
        "# Commands",
        "",
        "`sinsjax COMMAND -h` prints these, `sinsjax --version` the version;"
        " `sinsjax --install-completion` completes commands, studies and keys in the shell. A"
        " mistake is one line and exit code 2; an interrupted study ends"
        " with exit code 130, and `--resume` continues it.",
        "",
    ]
    for panel, names in panels.items():
        lines.append(f"- **{panel}**: {', '.join(f'[{name}](#{name})' for name in names)}")
    lines += ["", "## Common arguments and options", "", *map(_format_record, common)]
    for name, command in commands.items():
        summary, _, example = " ".join(command.help.split()).partition(" Example: ")
        usage = command.collect_usage_pieces(typer.Context(command))
        calls = " ".join(["sinsjax", name, *usage]), *filter(None, example.split("; "))
        shared = [f"`{_short_name(record)}`" for record in records[name] if record in common]
        listed = [f"- Common: {', '.join(shared)}"] if shared else []
        listed += [_format_record(record) for record in records[name] if record not in common]
        lines += ["", f"## {name}", "", summary, "", "```", *calls, "```"]
        lines += ["", *listed] if listed else []
    return "\n".join([*lines, ""])


def _help_records(command: Any) -> list[tuple[str, str]]:
    """Return the arguments and options of a command with their help."""
    records = command.help_records(typer.Context(command)).values()
    return [record for kind in records for record in kind if record[0] != "--help"]


def _short_name(record: tuple[str, str]) -> str:
    return record[0].split()[0].rstrip(",")


def _format_record(record: tuple[str, str]) -> str:
    return f"- `{record[0]}`: {' '.join(record[1].split())}"


if __name__ == "__main__":
    print(render_commands_page(), end="")
