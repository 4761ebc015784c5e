"""Study files: shipped studies by name, templates for a new study, and reading of a file."""

import os
import re
import tomllib
from contextlib import suppress
from pathlib import Path
from typing import Any

from sinsjax.errors import InputError
from sinsjax.messages import suggest_closest
from sinsjax.platform.assets import asset_path

_FOLDER = "configs"
_SCHEMA, _GROUP = "#:schema", "#:group "
DOUBT, QUESTION = "# DOUBT: ", "# QUESTION: "
"""Start of a comment about an uncertain or an open value in a study that is written for a record.
"""

OPEN = "?"
"""Value of an open key, which the study must answer."""

_STUDY, _PAGE = re.compile(r"\bconfigs/(\w+)\.toml"), re.compile(r"\bdocs/(\w+)\.md")

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
    is_shipped = path.parent.as_posix() in (".", _FOLDER)
    return shipped_studies().get(with_suffix.stem, path) if is_shipped else path


def describe_shadowed_study(name_or_path: str | Path) -> list[str]:
    """Return a line if a name means an edited local file instead of the shipped study.

    Args:
        name_or_path: name or file of a study; reading a file that is no text fails later.
    """
    shipped = shipped_studies().get(Path(name_or_path).name)
    path = find_study_file(name_or_path)
    if shipped is None or path.parent != Path():
        return []
    with suppress(OSError, UnicodeDecodeError):
        if _name_pages(_read_body(path)) == _name_pages(_read_body(shipped)):
            return []
    return [f"{name_or_path}: the local file {path}, not the shipped study."]


def source_name(name_or_path: str | Path) -> str:
    """Return the name of a study in messages: a shipped study's own, otherwise its path as given.

    Args:
        name_or_path: file, or name of a shipped study, see `find_study_file`.
    """
    path = find_study_file(name_or_path)
    return path.stem if path.parent == asset_path(_FOLDER) else str(path)


def read_purpose(path: Path) -> str:
    """Return the purpose of a study: the first sentence of the comment at its start."""
    lines = []
    for line in _read_body(path).splitlines():
        if not line.startswith("# "):
            break
        lines.append(line[2:].strip())
    text = " ".join(lines)
    ends = [at + 1 for mark in (". ", "? ") if (at := text.find(mark)) > 0]
    sentence = text[: min(ends, default=len(text))] or path.stem
    return _name_pages(_STUDY.sub(r"\1", sentence))


def shipped_text(name: str, copy: Path) -> str:
    """Return the text of a template or shipped study, with its comments and a path to the schema.

    Its comments name the copy, and other studies without their folder, which a wheel does not have.

    Raises:
        InputError: the name is unknown.
    """
    known, stem = shipped_studies() | template_files(), Path(name).stem
    if stem not in known:
        hint = suggest_closest(stem, known)
        raise InputError(f"{name}: no study of this name (`init --list` shows them){hint}")
    text = _read_body(known[stem]).replace(f"{_FOLDER}/{stem}.toml", str(copy))
    text = _STUDY.sub(r"\1", text)
    return f"{schema_line()}\n{_name_pages(text)}"


def _name_pages(text: str) -> str:
    """Return a text that names pages without their folder, which a wheel does not have."""
    return _PAGE.sub(r"the page \1", text)


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
    name = source_name(path)
    try:
        return tomllib.loads(find_study_file(path).read_text("utf-8-sig"))
    except OSError as error:
        missing = isinstance(error, FileNotFoundError)
        hint = suggest_closest(Path(path).stem, shipped_studies()) if missing else ""
        raise InputError(f"{name}: cannot be read: {error.strerror}{hint}") from None
    except UnicodeDecodeError:
        raise InputError(f"{name}: is not UTF-8 text (save it as UTF-8)") from None
    except ValueError as error:
        raise InputError(f"{name}: is not TOML: {error}") from None
    except RecursionError:
        raise InputError(f"{name}: {TOO_DEEP}") from None
