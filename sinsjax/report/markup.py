"""The package's templates: Markdown is not escaped, HTML is."""

import re
from functools import lru_cache
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined, Template

from sinsjax.report.names import escape_markdown


@lru_cache(maxsize=1)
def template_environment() -> Environment:
    """Return the environment that renders templates.

    An undefined name is an error; templates named ``*.html.j2`` are escaped.
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
    """Render a macro of ``sentences.md.j2`` with values, in one line."""
    macro = getattr(load_template("sentences.md.j2").module, macro_name)
    return " ".join(str(macro(**values)).split())


def _escape_table_cell(text: str) -> str:
    """Text as a cell of a Markdown table."""
    return text.replace("|", "\\|").replace("\n", " ")


def _format_code_span(text: str) -> str:
    """Return text as a Markdown code span, with a fence longer than any backticks within."""
    fence = "`" * (1 + max(map(len, re.findall("`+", text)), default=0))
    blank = " " if text.startswith("`") or text.endswith("`") else ""
    return f"{fence}{blank}{text}{blank}{fence}"
