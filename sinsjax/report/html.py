"""A report as one HTML page that needs nothing else: no network, no file beside it, no script."""

from base64 import b64encode
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

from markupsafe import Markup

from sinsjax.platform.files import replacing
from sinsjax.report.markup import template
from sinsjax.report.names import NO_NAMES, Names
from sinsjax.report.output import Made, meanings, names_of, origin


def write_html(path: Path, title: str, made: Sequence[Made]) -> None:
    """Writes a page with all that is said, every table and every figure.

    Raises:
        InputError: the page cannot be written.
    """
    page = template("report.html.j2").render(
        title=title,
        all_names=names_of(made),
        meanings=meanings(made),
        made=made,
        origin=origin(made),
        inline=_inline,
        paragraphs=_paragraphs,
        base64=lambda content: b64encode(content).decode(),
    )
    with replacing(path) as file:
        file.write(page.encode())


def _inline(text: str, names: Names = NO_NAMES) -> Markup:
    return Markup(_markdown().renderInline(names.markdown(text)))


def _paragraphs(text: str, names: Names = NO_NAMES) -> Markup:
    return Markup(_markdown().render(names.markdown(text)).rstrip())


@lru_cache(maxsize=1)
def _markdown() -> Any:
    """What a report says is Markdown without links or images; anything else in it is text."""
    from markdown_it import MarkdownIt  # late, for reports without such a page

    return MarkdownIt("commonmark", {"html": False}).disable(["link", "image", "autolink"])
