"""The package's templates: Markdown as it stands, HTML with everything escaped."""

import re
from functools import lru_cache
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined, Template

from sinsjax.report.names import escape_markdown


@lru_cache(maxsize=1)
def template_environment() -> Environment:
    """How templates are filled in.

    A name that is not there is an error; what ends in ``.html.j2`` is escaped.
    """
    environment = Environment(
        loader=PackageLoader("sinsjax.report"),
        undefined=StrictUndefined,
        autoescape=lambda name: name is not None and name.endswith(".html.j2"),
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.filters |= {
        "cell": _escape_table_cell,
        "code": _format_code_span,
        "literal": escape_markdown,
    }
    return environment


@lru_cache
def load_template(name: str) -> Template:
    """A template of the package by the name of its file."""
    return template_environment().get_template(name)


def render_sentence(macro_name: str, **values: Any) -> str:
    """A macro of ``sentences.md.j2`` with what it tells, in one line."""
    macro = getattr(load_template("sentences.md.j2").module, macro_name)
    return " ".join(str(macro(**values)).split())


def _escape_table_cell(text: str) -> str:
    """Text as a cell of a Markdown table."""
    return text.replace("|", "\\|").replace("\n", " ")


def _format_code_span(text: str) -> str:
    """Text as a Markdown code span, whose fence is longer than any backticks within."""
    fence = "`" * (1 + max(map(len, re.findall("`+", text)), default=0))
    blank = " " if text.startswith("`") or text.endswith("`") else ""
    return f"{fence}{blank}{text}{blank}{fence}"
