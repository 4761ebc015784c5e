"""A report as one HTML page that needs nothing else: no network, no file beside it, no script."""

import base64
from collections.abc import Iterator, Sequence
from functools import lru_cache
from html import escape
from pathlib import Path
from typing import Any

from sinsjax.platform.files import replacing
from sinsjax.report.base import Block, Picture, Table, Text
from sinsjax.report.names import NO_NAMES, Names
from sinsjax.report.output import Made, meanings, names_of, origin

_STYLE = """
:root { color-scheme: light dark; --line: #8888; --soft: #8881; }
body { font: 16px/1.5 system-ui, sans-serif; max-width: 70rem; margin: 2rem auto; padding: 0 1rem; }
h1, h2, h3 { line-height: 1.2; }
h2 { margin-top: 2.5rem; border-bottom: 1px solid var(--line); padding-bottom: .3rem; }
figure { margin: 1.5rem 0; }
img { max-width: 100%; height: auto; background: #fff; border-radius: 4px; }
figcaption, .note { font-size: .9rem; opacity: .85; }
.table { overflow-x: auto; margin: 1.5rem 0 .5rem; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; font-size: .9rem; }
caption { text-align: left; font-weight: 600; padding-bottom: .4rem; }
th, td { text-align: left; padding: .25rem .8rem .25rem 0; border-bottom: 1px solid var(--line); }
th { vertical-align: bottom; }
tbody tr:hover { background: var(--soft); }
details { margin: 1rem 0; }
summary { cursor: pointer; font-weight: 600; }
footer { margin-top: 3rem; font-size: .85rem; opacity: .75; }
@media print { body { max-width: none; } }
""".strip()


def write_html(path: Path, title: str, made: Sequence[Made], notes: Sequence[str] = ()) -> None:
    """Writes a page with all that is said, every table and every figure.

    Args:
        path: HTML file.
        title: of the page.
        made: what stands on it, in this order.
        notes: said below the headline.

    Raises:
        InputError: the page cannot be written.
    """
    with replacing(path) as file:
        file.write("\n".join(_page(title, made, notes)).encode())


def _page(title: str, made: Sequence[Made], notes: Sequence[str]) -> Iterator[str]:
    yield "<!DOCTYPE html>"
    yield '<html lang="en">'
    yield f'<head>\n<meta charset="utf-8">\n<title>{escape(title)}</title>'
    yield '<meta name="viewport" content="width=device-width, initial-scale=1">'
    yield f"<style>\n{_STYLE}\n</style>\n</head>\n<body>\n<main>"
    yield f"<h1>{_inline(title, names_of(made))}</h1>"
    yield from (f"<p>{_inline(line)}</p>" for line in meanings(made))
    if lines := [_inline(line, one.names) for one in made for line in one.report.headline]:
        items = "\n".join(f"<li>{line}</li>" for line in lines)
        yield f"<ul>\n{items}\n</ul>"
    yield from (f"<p>{_inline(note)}</p>" for note in notes)
    for one in made:
        for section in one.report.sections:
            yield f"<section>\n<h2>{_inline(section.heading, one.names)}</h2>"
            yield from (_block(block, one) for block in section.blocks)
            yield "</section>"
    yield f"</main>\n<footer>{escape(origin(made))}</footer>"
    yield "</body>\n</html>\n"


def _block(block: Block, made: Made) -> str:
    if isinstance(block, Text):
        return str(_markdown().render(made.names.markdown(block.text))).rstrip()
    if isinstance(block, Table):
        return _table(block, made.names)
    return _figure(block, made)


def _figure(picture: Picture, made: Made) -> str:
    data = base64.b64encode(made.images[picture.name]).decode()
    image = f'<img src="data:image/png;base64,{data}" alt="{escape(picture.caption)}">'
    caption = _inline(picture.caption, made.names)
    return f"<figure>\n{image}\n<figcaption>{caption}</figcaption>\n</figure>"


def _table(table: Table, names: Names) -> str:
    head = "".join(f'<th scope="col">{_inline(name, names)}</th>' for name in table.header)
    cells_of = [[f"<td>{_inline(cell, names)}</td>" for cell in row] for row in table.rows]
    rows = "\n".join(f"<tr>{''.join(cells)}</tr>" for cells in cells_of)
    title = _inline(table.title, names)
    caption = "" if table.folded else f"\n<caption>{title}</caption>"
    body = f"<thead>\n<tr>{head}</tr>\n</thead>\n<tbody>\n{rows}\n</tbody>"
    lines = f'<div class="table">\n<table>{caption}\n{body}\n</table>\n</div>'
    if table.note:
        lines += f'\n<p class="note">{_inline(table.note, names)}</p>'
    return f"<details>\n<summary>{title}</summary>\n{lines}\n</details>" if table.folded else lines


def _inline(text: str, names: Names = NO_NAMES) -> str:
    return str(_markdown().renderInline(names.markdown(text)))


@lru_cache(maxsize=1)
def _markdown() -> Any:
    """What a report says is Markdown without links or images; anything else in it is text."""
    from markdown_it import MarkdownIt  # late, for reports without such a page

    return MarkdownIt("commonmark", {"html": False}).disable(["link", "image", "autolink"])
