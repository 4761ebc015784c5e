"""Study files: shipped studies by name, templates for a new study, and reading of a file."""

import os
import tomllib
from itertools import takewhile
from pathlib import Path
from typing import Any

from sinsjax.errors import InputError
from sinsjax.messages import suggest_closest
from sinsjax.platform.assets import asset_path

_FOLDER = "configs"
_SCHEMA, _GROUP = "#:schema", "#:group "
DOUBT, QUESTION = "# DOUBT: ", "# QUESTION: "
"""Start of a comment about an uncertain or an open value, in a study written for a record."""

OPEN = "?"
"""Value of an open key, which the study must answer."""

TOO_DEEP = "is nested too deeply"

GROUPS = {
    "first": "studies to begin with",
    "papers": "what the two papers print, and what they leave open",
    "resets": "covariance resets: how many, when, and set by triggers",
    "comparison": "which method to use, and why",
    "stored": "repeated passes over a stored record",
    "records": "recorded data of a car",
    "tuning": "settings and schedules found by a search",
    "theory": "whether a filter is consistent",
}
"""Groups of shipped studies. The second line of a study, ``#:group NAME``, names its group."""

TEMPLATES = ("sweep", "record", "tune", "compare")
"""Kinds of study with a template."""


def shipped_studies() -> dict[str, Path]:
    """Return the files of the shipped studies by name, in alphabetical order."""
    return {path.stem: path for path in sorted(asset_path(_FOLDER).glob("*.toml"))}


def studies_by_group() -> dict[str, dict[str, Path]]:
    """Return the shipped studies by group, in the order of their numbers and names."""
    placed = sorted(((_read_group(path), name), path) for name, path in shipped_studies().items())
    return {
        group: {name: path for (place, name), path in placed if place.split()[:1] == [group]}
        for group in GROUPS
    }


def template_files() -> dict[str, Path]:
    """Return the files of the templates by name."""
    return {name: asset_path(f"{_FOLDER}/templates/{name}.toml") for name in TEMPLATES}


def find_study_file(name_or_path: str | Path) -> Path:
    """Return the file of a study; an unknown name is returned unchanged.

    Args:
        name_or_path: a file, with or without ``.toml``, or else a shipped study, such as
            ``reset_sweep``, ``reset_sweep.toml`` or ``configs/reset_sweep.toml``.
    """
    path = Path(name_or_path)
    if not path.name or os.path.isfile(path):
        return path
    with_suffix = path if path.suffix == ".toml" else path.with_name(f"{path.name}.toml")
    if os.path.isfile(with_suffix):
        return with_suffix
    shipped = asset_path(_FOLDER) / with_suffix.name
    return shipped if path.parent in (Path(), Path(_FOLDER)) and os.path.isfile(shipped) else path


def source_name(name_or_path: str | Path) -> str:
    """Return the name of a study in messages: a shipped study's own, otherwise its path as given.

    Args:
        name_or_path: file, or name of a shipped study, see `find_study_file`.
    """
    path = find_study_file(name_or_path)
    return path.stem if path.parent == asset_path(_FOLDER) else str(path)


def read_purpose(path: Path) -> str:
    """Return the purpose of a study: the first sentence of the comment at its start."""
    comment = takewhile(lambda line: line.startswith("# "), _read_body(path).splitlines())
    text = " ".join(line[2:].strip() for line in comment)
    ends = [at + 1 for mark in (". ", "? ") if (at := text.find(mark)) > 0]
    return text[: min(ends, default=len(text))] or path.stem


def shipped_text(name: str, copy: Path) -> str:
    """Return the text of a template or shipped study, whose comments name its copy.

    Raises:
        InputError: the name is unknown.
    """
    known, stem = shipped_studies() | template_files(), Path(name).stem
    if stem not in known:
        hint = suggest_closest(stem, known)
        raise InputError(f"{name}: no study of this name (`init --list` shows them){hint}")
    text = _read_body(known[stem]).replace(f"{_FOLDER}/{stem}.toml", str(copy))
    return f"{schema_line()}\n{text}"


def schema_line() -> str:
    """Return the first line of a study, with the path of the schema of its keys for editors."""
    return f"{_SCHEMA} {asset_path(f'{_FOLDER}/schema.json').as_uri()}"


def _read_group(path: Path) -> str:
    """Return the group of a shipped study, and its number there if it has one; empty if none."""
    lines = path.read_text("utf-8").splitlines()[:2]
    return next((line.removeprefix(_GROUP) for line in lines if line.startswith(_GROUP)), "")


def _read_body(path: Path) -> str:
    """Return a shipped file without its first lines, the path of the schema and the group."""
    lines = path.read_text("utf-8").splitlines(keepends=True)
    return "".join(line for line in lines if not line.startswith((_SCHEMA, _GROUP)))


def read_tables(path: str | Path) -> dict[str, Any]:
    """Return the tables of a study, of a file or a shipped one, unchecked.

    Raises:
        InputError: the file cannot be read or is not TOML.
    """
    try:
        return tomllib.loads(find_study_file(path).read_text("utf-8-sig"))
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
