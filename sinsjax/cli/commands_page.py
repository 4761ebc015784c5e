"""The page of all commands: ``python -m sinsjax.cli.commands_page > docs/commands.md``."""

from typing import Any

import typer

from sinsjax.cli import app


def render_commands_page() -> str:
    """Return usage, arguments, options and an example of every command, as Markdown."""
    group: Any = typer.main.get_command(app)
    panels = group.commands_by_panel(typer.Context(group))
    commands = {name: command for panel in panels.values() for name, command in panel.items()}
    about = {name: _summary_and_example(command) for name, command in commands.items()}
    lines = [
        "# Commands",
        "",
        "`sinsjax COMMAND -h` prints these, `sinsjax --version` the version;"
        " `sinsjax --install-completion` has the shell complete commands, studies and keys. A"
        " mistake is one line ([messages](messages.md)) and exit code 2; an interrupted study ends"
        " with exit code 130, and `--resume` continues it.",
    ]
    for panel, commands_of_panel in panels.items():
        lines += ["", f"**{panel}**", "", "| command | |", "| --- | --- |"]
        lines += [f"| [`{name}`](#{name}) | {about[name][0]} |" for name in commands_of_panel]
    for name, command in commands.items():
        lines += ["", f"## {name}", "", *_command_help_section(name, command, *about[name])]
    return "\n".join([*lines, ""])


def _summary_and_example(command: Any) -> tuple[str, str]:
    """Return the summary of a command, and the example of its docstring."""
    text, _, example = " ".join(command.help.split()).partition(" Example: ")
    return text, example


def _command_help_section(name: str, command: Any, summary: str, example: str) -> list[str]:
    context = typer.Context(command, info_name=name)
    usage = " ".join(["sinsjax", name, *command.collect_usage_pieces(context)])
    lines = [summary, "", "```", usage, "```", ""]
    records = [
        record
        for records_of_kind in command.help_records(context).values()
        for record in records_of_kind
    ]
    lines += ["| | |", "| --- | --- |"]
    lines += [
        f"| `{_table_cell(name)}` | {_table_cell(meaning)} |"
        for name, meaning in records
        if name != "--help"
    ]
    if example:
        lines += ["", "For example:", "", "```", *example.split("; "), "```"]
    return lines


def _table_cell(text: str) -> str:
    return " ".join(text.split()).replace("|", "\\|")


if __name__ == "__main__":
    print(render_commands_page(), end="")
