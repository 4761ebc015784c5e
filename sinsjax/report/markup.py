"""The package's templates: Markdown is not escaped, HTML is."""

from functools import lru_cache
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined, Template


@lru_cache(maxsize=1)
def template_environment() -> Environment:
    """Return the environment that renders templates.

    An undefined name is an error; templates named ``*.html.j2`` are escaped.
    """
    return Environment(
        loader=PackageLoader("sinsjax.report"),
        undefined=StrictUndefined,
        autoescape=lambda name: name is not None and name.endswith(".html.j2"),
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )


@lru_cache
def load_template(name: str) -> Template:
    """A template of the package by the name of its file."""
    return template_environment().get_template(name)


def render_sentence(macro_name: str, **values: Any) -> str:
    """Render a macro of ``sentences.md.j2`` with values, in one line."""
    macro = getattr(load_template("sentences.md.j2").module, macro_name)
    return " ".join(str(macro(**values)).split())
