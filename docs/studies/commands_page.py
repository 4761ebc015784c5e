"""Render docs/commands.md: ``python -m docs.studies.commands_page > docs/commands.md``."""

from collections import Counter
from typing import Any

import typer

from sinsjax.cli import COMPARE, LOOK, RUN, SET_UP, app

_INTRODUCTION = (
    "`sinsjax COMMAND -h` prints these, `sinsjax --version` the version;"
    " `sinsjax --install-completion` completes commands, studies and keys in the shell. A mistake"
    " is one line and exit code 2; an interrupted study ends with exit"
    " code 130, and `--resume` continues it."
)


def render_commands_page() -> str:
    """Return usage, examples, arguments and options of every command, as Markdown."""
    group: Any = typer.main.get_command(app)
    entries = {name: _describe_parameters(command) for name, command in group.commands.items()}
    uses = Counter(line for lines in entries.values() for line in lines)
    lines = ["# Commands", "", _INTRODUCTION, ""]
    for panel in (RUN, LOOK, COMPARE, SET_UP):
        names = [k for k, command in group.commands.items() if command.rich_help_panel == panel]
        lines.append(f"- **{panel}**: {', '.join(f'[{name}](#{name})' for name in names)}")
    lines += ["", "## Common arguments and options", ""]
    lines += [line for line, count in uses.items() if count > 1]
    for name, command in group.commands.items():
        summary, _, example = " ".join(command.help.split()).partition(" Example: ")
        usage = " ".join(command.collect_usage_pieces(typer.Context(command)))
        usage = usage.replace("{", "").replace("}", "")
        calls = f"sinsjax {name} {usage}", *filter(None, example.split("; "))
        shared = [line.split()[1].rstrip(",:`") for line in entries[name] if uses[line] > 1]
        lines += ["", f"## {name}", "", summary, "", "```", *calls, "```"]
        lines += [""] if entries[name] else []
        lines += [f"- Common: {', '.join(f'{word}`' for word in shared)}"] if shared else []
        lines += [line for line in entries[name] if uses[line] == 1]
    return "\n".join([*lines, ""])


def _describe_parameters(command: Any) -> list[str]:
    """Return a line about each argument and option of a command but its help."""
    lines = []
    for parameter in command.params:
        name, text = parameter.get_help_record(typer.Context(command))
        if parameter.param_type_name == "argument":
            name = parameter.metavar + ("..." if parameter.nargs != 1 else "")
        lines.append(f"- `{name}`: {' '.join(text.split())}")
    return lines


if __name__ == "__main__":
    print(render_commands_page(), end="")
