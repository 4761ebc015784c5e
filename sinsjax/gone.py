"""What version 1.0 had and this version does not have, each with what to use instead.

The texts end a line such as ``[filter] turning: is gone since 1.1 (...)``.
"""

KEYS: dict[str, str] = {}
"""Keys of studies, by ``section.key``."""

VALUES: dict[tuple[str, str], str] = {}
"""Values of keys, by ``section.key`` and value."""

COMMANDS: dict[str, str] = {
    "bench": "python benchmarks/bench.py, in the repository",
    "terms": "docs/glossary.md",
}
"""Commands of the command line."""

OPTIONS: dict[tuple[str, str], str] = {
    ("export", "--resume"): "export again, with --overwrite",
    ("sweep", "--workers"): "start `dask scheduler` and `dask worker`, give --scheduler URL",
}
"""Options, by command and option with its dashes."""
