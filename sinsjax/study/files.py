"""Study files: the shipped ones by name, templates to begin a study from, and reading them."""

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
"""Begins a line about what could not be known where a study was written for a record."""

_STUDY, _PAGE = re.compile(r"\bconfigs/(\w+)\.toml"), re.compile(r"\bdocs/(\w+)\.md")

TOO_DEEP = "is nested too deeply"
_MOST_NESTED = 50
"""Tables and lists within one another; a study has at most five."""

TEMPLATES = ("sweep", "record", "tune", "compare")
"""Kinds of study that have a template."""


def studies() -> dict[str, Path]:
    """The files of the shipped studies by name, in alphabetical order."""
    return {path.stem: path for path in sorted(asset(_FOLDER).glob("*.toml"))}


def templates() -> dict[str, Path]:
    """The files of the templates by name."""
    return {name: asset(f"{_FOLDER}/templates/{name}.toml") for name in TEMPLATES}


def found(given: str | Path) -> Path:
    """The file that a study's name stands for; what stands for none is returned as given.

    Args:
        given: a file, which comes first, with or without ``.toml``; or a shipped study, as
            ``reset_sweep``, ``reset_sweep.toml`` or ``configs/reset_sweep.toml``.
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
    """What a study is for: the first sentence of the comment that it begins with.

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
    """The text of a template or shipped study, comments included, with the way to the schema.

    Raises:
        InputError: there is none of that name.
    """
    known = studies() | templates()
    stem = Path(name).stem
    if stem not in known:
        raise InputError(
            f"{name}: no study of this name (`init --list` shows them){near(stem, known)}"
        )
    return f"{schema_line()}\n{_body(known[stem])}"


def schema_line() -> str:
    """The first line of a study, which tells editors the way to the schema of its keys."""
    return f"{_SCHEMA} {asset(f'{_FOLDER}/schema.json').as_uri()}"


def _body(path: Path) -> str:
    """A shipped file without its first line, which tells editors the way to its schema."""
    first, _, rest = path.read_text("utf-8").partition("\n")
    return rest if first.startswith(_SCHEMA) else f"{first}\n{rest}"


def read_tables(path: str | Path) -> dict[str, Any]:
    """The tables of a study file, unchecked.

    Args:
        path: the file, or the name of a shipped study.

    Raises:
        InputError: the file cannot be read or is no TOML; one line says why.
    """
    try:
        tables = tomllib.loads(found(path).read_text("utf-8-sig"))
    except FileNotFoundError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}{_hint(path)}") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from None
    except UnicodeDecodeError:
        raise InputError(f"{path}: is no UTF-8 text") from None
    except ValueError as error:
        raise InputError(f"{path}: is no TOML: {error}") from None
    except RecursionError:
        raise InputError(f"{path}: {TOO_DEEP}") from None
    require_shallow(tables, path)
    return tables


def require_shallow(content: Any, source: str | Path) -> None:
    """Refuse tables and lists that are nested too deeply for functions that call themselves.

    A parser may accept them: TOML's does, of ``[a.a.a.a]``.

    Args:
        content: of a file.
        source: the name that the message gives it.

    Raises:
        InputError: they are.
    """
    level = [content]
    for _ in range(_MOST_NESTED):
        tables = [one.values() for one in level if isinstance(one, dict)]
        lists = [one for one in level if isinstance(one, list | tuple)]
        level = [*chain.from_iterable(tables), *chain.from_iterable(lists)]
    if level:
        raise InputError(f"{source}: {TOO_DEEP}")


def _hint(given: str | Path) -> str:
    """The nearest shipped study to a name that stands for no file, if any."""
    return near(Path(given).stem, studies())
