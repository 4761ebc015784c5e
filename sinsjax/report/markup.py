"""The package's templates: Markdown as it stands, HTML with everything escaped."""

from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import Any

from jinja2 import (
    ChoiceLoader,
    Environment,
    FileSystemLoader,
    PackageLoader,
    StrictUndefined,
    Template,
)


def environment(
    folder: Path | None = None, finalize: Callable[[Any], Any] | None = None
) -> Environment:
    """Where templates are found and how they are filled in.

    A name that is not there is an error; what ends in ``.html.j2`` is escaped.

    Args:
        folder: of templates besides those of the package.
        finalize: called with each value before it is printed.
    """
    folders = [FileSystemLoader(folder)] if folder else []
    made = Environment(
        loader=ChoiceLoader([*folders, PackageLoader("sinsjax.report")]),
        undefined=StrictUndefined,
        autoescape=lambda name: name is not None and name.endswith(".html.j2"),
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
        finalize=finalize,
    )
    made.filters["cell"] = _cell
    return made


@lru_cache
def template(name: str) -> Template:
    """A template of the package by the name of its file."""
    return environment().get_template(name)


def _cell(text: str) -> str:
    """Text as a cell of a Markdown table."""
    return text.replace("|", "\\|").replace("\n", " ")
