"""The package's templates: Markdown as it stands, HTML with everything escaped."""

import re
from functools import lru_cache
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined, Template

from sinsjax.report.names import escaped


@lru_cache(maxsize=1)
def environment() -> Environment:
    """How templates are filled in.

    A name that is not there is an error; what ends in ``.html.j2`` is escaped.
    """
    made = Environment(
        loader=PackageLoader("sinsjax.report"),
        undefined=StrictUndefined,
        autoescape=lambda name: name is not None and name.endswith(".html.j2"),
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    made.filters |= {"cell": _cell, "code": _code, "literal": escaped}
    return made


@lru_cache
def template(name: str) -> Template:
    """A template of the package by the name of its file."""
    return environment().get_template(name)


def said(name: str, **told: Any) -> str:
    """A macro of ``sentences.md.j2`` with what it tells, in one line."""
    macro = getattr(template("sentences.md.j2").module, name)
    return " ".join(str(macro(**told)).split())


def _cell(text: str) -> str:
    """Text as a cell of a Markdown table."""
    return text.replace("|", "\\|").replace("\n", " ")


def _code(text: str) -> str:
    """Text as a Markdown code span, whose fence is longer than any backticks within."""
    fence = "`" * (1 + max(map(len, re.findall("`+", text)), default=0))
    blank = " " if text.startswith("`") or text.endswith("`") else ""
    return f"{fence}{blank}{text}{blank}{fence}"
