"""Study files: shipped studies by name, templates for a new study, and reading of a file."""

import os
import re
import tomllib
from itertools import chain
from pathlib import Path
from typing import Any

from sinsjax.errors import InputError
from sinsjax.messages import near
from sinsjax.platform.assets import asset

_FOLDER = "configs"
_SCHEMA = "#:schema"
DOUBT = "# DOUBT: "
"""Start of a comment about an uncertain value in a study that is written for a record."""

_STUDY, _PAGE = re.compile(r"\bconfigs/(\w+)\.toml"), re.compile(r"\bdocs/(\w+)\.md")

TOO_DEEP = "is nested too deeply"
_MOST_NESTED = 50
"""Largest depth of nested tables and lists; a study has at most five."""

TEMPLATES = ("sweep", "record", "tune", "compare")
"""Kinds of study with a template."""


def studies() -> dict[str, Path]:
    """Return the files of the shipped studies by name, in alphabetical order."""
    return {path.stem: path for path in sorted(asset(_FOLDER).glob("*.toml"))}


def templates() -> dict[str, Path]:
    """Return the files of the templates by name."""
    return {name: asset(f"{_FOLDER}/templates/{name}.toml") for name in TEMPLATES}


def find_study(given: str | Path) -> Path:
    """Return the file of a study; an unknown name is returned unchanged.

    Args:
        given: a file, with or without ``.toml``, or else a shipped study, such as ``reset_sweep``,
            ``reset_sweep.toml`` or ``configs/reset_sweep.toml``.
    """
    path = Path(given)
    if not path.name or os.path.isfile(path):
        return path
    with_suffix = path if path.suffix == ".toml" else path.with_name(f"{path.name}.toml")
    if os.path.isfile(with_suffix):
        return with_suffix
    if path.parent.as_posix() in (".", _FOLDER):
        return studies().get(with_suffix.stem, path)
    return path


def purpose(path: Path) -> str:
    """Return the purpose of a study: the first sentence of the comment at its start.

    Studies and pages are named without their folders, which a wheel does not have.
    """
    lines = []
    for line in _body(path).splitlines():
        if not line.startswith("# "):
            break
        lines.append(line[2:].strip())
    text = " ".join(lines)
    ends = [at + 1 for mark in (". ", "? ") if (at := text.find(mark)) > 0]
    sentence = text[: min(ends, default=len(text))] or path.stem
    return _PAGE.sub(r"the page \1", _STUDY.sub(r"\1", sentence))


def text_of(name: str) -> str:
    """Return the text of a template or shipped study, with its comments and a path to the schema.

    Raises:
        InputError: the name is unknown.
    """
    known = studies() | templates()
    stem = Path(name).stem
    if stem not in known:
        raise InputError(
            f"{name}: no study of this name (`init --list` shows them){near(stem, known)}"
        )
    return f"{schema_line()}\n{_body(known[stem])}"


def schema_line() -> str:
    """Return the first line of a study, with the path of the schema of its keys for editors."""
    return f"{_SCHEMA} {asset(f'{_FOLDER}/schema.json').as_uri()}"


def _body(path: Path) -> str:
    """Return a shipped file without its first line, the path of the schema."""
    first, _, rest = path.read_text("utf-8").partition("\n")
    return rest if first.startswith(_SCHEMA) else f"{first}\n{rest}"


def read_tables(path: str | Path) -> dict[str, Any]:
    """Return the tables of a study file, unchecked.

    Args:
        path: file, or name of a shipped study.

    Raises:
        InputError: the file cannot be read or is not TOML.
    """
    try:
        tables = tomllib.loads(find_study(path).read_text("utf-8-sig"))
    except FileNotFoundError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}{_hint(path)}") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from None
    except UnicodeDecodeError:
        raise InputError(f"{path}: is not UTF-8 text (save it as UTF-8)") from None
    except ValueError as error:
        raise InputError(f"{path}: is not TOML: {error}") from None
    except RecursionError:
        raise InputError(f"{path}: {TOO_DEEP}") from None
    require_shallow(tables, path)
    return tables


def require_shallow(content: Any, source: str | Path) -> None:
    """Refuse tables and lists that are nested too deeply for recursive functions.

    The TOML parser accepts them, for example ``[a.a.a.a]``.

    Args:
        content: content of a file.
        source: name of the file in the message.

    Raises:
        InputError: the content is nested too deeply.
    """
    level = [content]
    for _ in range(_MOST_NESTED):
        tables = [one.values() for one in level if isinstance(one, dict)]
        lists = [one for one in level if isinstance(one, list | tuple)]
        level = [*chain.from_iterable(tables), *chain.from_iterable(lists)]
    if level:
        raise InputError(f"{source}: {TOO_DEEP}")


def _hint(given: str | Path) -> str:
    """Return a hint at the shipped study with the most similar name; empty without one."""
    return near(Path(given).stem, studies())
