"""What version 1.0 had and this version does not have, each with what to use instead.

The texts end a line such as ``[filter] turning: is gone since 1.1 (...)``.
"""

LINE = "is gone since 1.1 ({})"
"""The message about something that is gone, with the text about it."""

KEYS: dict[str, str] = {}
"""Keys of studies, by ``section.key``."""

VALUES: dict[tuple[str, str], str] = {("tune.searches", "random"): "use 'sobol'"}
"""Values of keys, by ``section.key`` and value."""

COMMANDS: dict[str, str] = {}
"""Commands of the command line."""

OPTIONS: dict[tuple[str, str], str] = {
    ("report", "--page"): "use --html FILE",
}
"""Options, by command and option with its dashes."""
