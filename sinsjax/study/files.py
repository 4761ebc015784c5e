"""Study files: shipped studies by name, templates for a new study, and reading of a file."""

import os
import tomllib
from itertools import takewhile
from pathlib import Path
from typing import Any

from sinsjax.errors import InputError
from sinsjax.messages import suggest_closest
from sinsjax.platform.files import asset_path

_FOLDER = "configs"
_SCHEMA = "#:schema"
DOUBT, QUESTION = "# DOUBT: ", "# QUESTION: "
"""Start of a comment about an uncertain or an open value, in a study written for a record."""

OPEN = "?"
"""Value of an open key, which the study must answer."""

TOO_DEEP = "is nested too deeply"

TEMPLATES = ("sweep", "record", "tune", "compare")
"""Kinds of study with a template."""


def shipped_studies() -> dict[str, Path]:
    """Return the files of the shipped studies by name, in alphabetical order."""
    return {path.stem: path for path in sorted(asset_path(_FOLDER).glob("*.toml"))}


def template_files() -> dict[str, Path]:
    """Return the files of the templates by name."""
    return {name: asset_path(f"{_FOLDER}/templates/{name}.toml") for name in TEMPLATES}


def study_file_or_given_path(name_or_path: str | Path) -> Path:
    """Return the file of a study; an unknown name is returned unchanged.

    It is a file, with or without ``.toml``, or else a shipped study, such as ``reset_sweep``,
    ``reset_sweep.toml`` or ``configs/reset_sweep.toml``.
    """
    path = Path(name_or_path)
    name = f"{path.name.removesuffix('.toml')}.toml"
    places = [path, path.parent / name]
    if path.parent in (Path(), Path(_FOLDER)):
        places.append(asset_path(_FOLDER) / name)
    return next((place for place in places if os.path.isfile(place)), path)


def source_name(name_or_path: str | Path) -> str:
    """Return the name of a study in messages: of a shipped study its own, else its path."""
    path = study_file_or_given_path(name_or_path)
    return path.stem if path.parent == asset_path(_FOLDER) else str(path)


def read_purpose(path: Path) -> str:
    """Return the purpose of a study: the first sentence of the comment at its start."""
    comment = takewhile(lambda line: line.startswith("# "), _read_body(path).splitlines())
    text = " ".join(line[2:].strip() for line in comment)
    ends = [at + 1 for mark in (". ", "? ") if (at := text.find(mark)) > 0]
    return text[: min(ends, default=len(text))] or path.stem


def shipped_text(name: str, copy: Path) -> str:
    """Return the text of a template or shipped study, whose comments name its copy."""
    known, stem = shipped_studies() | template_files(), Path(name).stem
    if stem not in known:
        hint = suggest_closest(stem, known)
        raise InputError(f"{name}: no study of this name (`init --list` shows them){hint}")
    text = _read_body(known[stem]).replace(f"{_FOLDER}/{stem}.toml", str(copy))
    return f"{schema_line()}\n{text}"


def schema_line() -> str:
    """Return the first line of a study, with the path of the schema of its keys for editors."""
    return f"{_SCHEMA} {asset_path(f'{_FOLDER}/schema.json').as_uri()}"


def _read_body(path: Path) -> str:
    """Return a shipped file without its first line, the path of the schema."""
    text = path.read_text("utf-8")
    return text.partition("\n")[2] if text.startswith(_SCHEMA) else text


def read_tables(path: str | Path) -> dict[str, Any]:
    """Return the tables of a study, of a file or a shipped one, unchecked."""
    try:
        return tomllib.loads(study_file_or_given_path(path).read_text("utf-8-sig"))
    except OSError as error:
        missing = isinstance(error, FileNotFoundError)
        hint = suggest_closest(Path(path).stem, shipped_studies()) if missing else ""
        text = f"cannot be read: {error.strerror}{hint}"
    except UnicodeDecodeError:
        text = "is not UTF-8 text (save it as UTF-8)"
    except ValueError as error:
        text = f"is not TOML: {error}"
    except RecursionError:
        text = TOO_DEEP
    raise InputError(f"{source_name(path)}: {text}")
