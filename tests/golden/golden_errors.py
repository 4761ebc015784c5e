"""Faulty studies, and the file, section and key of each error that the command line reports."""

import io
import json
import re
import sys
import tomllib
from contextlib import redirect_stderr, redirect_stdout, suppress
from pathlib import Path
from typing import Any
from unittest import mock

import tomli_w

from sinsjax import cli

HERE = Path(__file__).parent
EXPECTED = HERE / "expected" / "errors.json"

# A section and perhaps a key, or several that repeat together; a key that stands in no section.
_KEY = r"\w[\w.\[\]]*"
_PLACE = re.compile(rf"(?:\[([^\]]+)\](?: ({_KEY}(?:, {_KEY})*))?|(\w+)): ")

Place = list[str]
"""File, section and key at the beginning of an error's line; empty if it names none."""


def bad_studies() -> dict[str, str]:
    """Return the text of every faulty study, by name."""
    tables = tomllib.loads((HERE / "bad_studies.toml").read_text("utf-8"))
    return {name: _text(tables["bases"], **bad) for name, bad in tables["bad"].items()}


def _text(bases: dict[str, Any], **bad: Any) -> str:
    if "text" in bad:
        return bad["text"]
    study = _merged(bases[bad.get("base", "simulated")], bad.get("with", {}))
    for place in bad.get("without", ()):
        section, _, key = place.partition(".")
        if key:
            del study[section][key]
        else:
            del study[section]
    return tomli_w.dumps(study)


def _merged(old: dict[str, Any], new: dict[str, Any]) -> dict[str, Any]:
    """Merge values into tables; neither argument changes."""
    out = {key: dict(value) if isinstance(value, dict) else value for key, value in old.items()}
    for key, value in new.items():
        both = isinstance(value, dict) and isinstance(out.get(key), dict)
        out[key] = _merged(out[key], value) if both else value
    return out


def errors_of(path: Path) -> list[Place]:
    """Return the places of all errors that ``sinsjax validate`` reports for a study, sorted."""
    errors = io.StringIO()
    argv = mock.patch.object(sys, "argv", ["sinsjax", "validate", str(path)])
    with argv, redirect_stdout(io.StringIO()), redirect_stderr(errors), suppress(SystemExit):
        cli.main()
    return sorted(_place(line) for line in errors.getvalue().splitlines())


def _place(line: str) -> Place:
    file, _, error = line.removeprefix("error: ").partition(".toml: ")
    match = _PLACE.match(error)
    section, key, top = match.groups(default="") if match else ("", "", "")
    return [f"{Path(file).name}.toml", section, key or top]


def all_errors(folder: Path) -> dict[str, list[Place]]:
    """Return the places of all errors of every faulty study, by its name.

    Args:
        folder: where it may write.
    """
    found = {}
    for name, text in bad_studies().items():
        path = folder / f"{name}.toml"
        path.write_text(text, "utf-8")
        found[name] = errors_of(path)
    return found


def as_json(errors: dict[str, list[Place]]) -> str:
    """Return the text of the expected file: sorted, one line per study."""
    lines = [
        f" {json.dumps(name)}: {json.dumps(places)}" for name, places in sorted(errors.items())
    ]
    return "{\n" + ",\n".join(lines) + "\n}\n"
