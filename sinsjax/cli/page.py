"""The help of every command as a page: ``python -m sinsjax.cli.page > docs/commands.md``."""

from typing import Any

import typer

from sinsjax.cli import app


def page() -> str:
    """Usage, arguments, options and an example of every command, as Markdown."""
    group: Any = typer.main.get_command(app)
    panels = group.panels(typer.Context(group))
    commands = {name: command for panel in panels.values() for name, command in panel.items()}
    about = {name: _about(command) for name, command in commands.items()}
    lines = [
        "# Commands",
        "",
        "`sinsjax COMMAND -h` prints these, `sinsjax --version` the version;"
        " `sinsjax --install-completion` has the shell complete commands, studies and keys. A"
        " mistake is one line ([messages](messages.md)) and exit code 2; an interrupted study ends"
        " with exit code 130, and `--resume` continues it.",
    ]
    for panel, here in panels.items():
        lines += ["", f"**{panel}**", "", "| command | |", "| --- | --- |"]
        lines += [f"| [`{name}`](#{name}) | {about[name][0]} |" for name in here]
    for name, command in commands.items():
        lines += ["", f"## {name}", "", *_described(name, command, *about[name])]
    return "\n".join([*lines, ""])


def _about(command: Any) -> tuple[str, str]:
    """What the command does, and the example of its docstring."""
    text, _, example = " ".join(command.help.split()).partition(" Example: ")
    return text, example


def _described(name: str, command: Any, text: str, example: str) -> list[str]:
    context = typer.Context(command, info_name=name)
    usage = " ".join(["sinsjax", name, *command.collect_usage_pieces(context)])
    lines = [text, "", "```", usage, "```", ""]
    records = [record for some in command.help_records(context).values() for record in some]
    lines += ["| | |", "| --- | --- |"]
    lines += [f"| `{_cell(name)}` | {_cell(told)} |" for name, told in records if name != "--help"]
    if example:
        lines += ["", "For example:", "", "```", *example.split("; "), "```"]
    return lines


def _cell(text: str) -> str:
    return " ".join(text.split()).replace("|", "\\|")


if __name__ == "__main__":
    print(page(), end="")
