"""Reports as Markdown, and as one HTML file made from it: no network, no script, no other files."""

import re
from base64 import b64encode
from collections.abc import Iterator, Mapping, Sequence
from html import escape

from markdown_it import MarkdownIt

from sinsjax.messages import escape_controls
from sinsjax.report.base import Block, Report, Table

_MARKUP = re.compile(r"[\\`*_\[\]<>#|~$&!]|^[-+=]|(?<=\d)[.)](?= )")
"""What Markdown may interpret: marks anywhere, bullets, and the stop of a numbered item."""

_PAGE = """<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<title>{title}</title>
<meta name="viewport" content="width=device-width, initial-scale=1">
<style>
:root {{ color-scheme: light dark; }}
body {{ font: 16px/1.5 system-ui, sans-serif; max-width: 70rem; margin: 2rem auto; padding: 1rem; }}
img {{ max-width: 100%; background: #fff; display: block; }}
table {{ border-collapse: collapse; font-variant-numeric: tabular-nums; font-size: .9rem; }}
th, td {{ text-align: left; padding: .25rem .8rem .25rem 0; border-bottom: 1px solid #8888; }}
</style>
</head>
<body>
{body}</body>
</html>
"""


def to_html(title: str, reports: Sequence[tuple[Report, Mapping[str, bytes]]]) -> str:
    """Return a self-contained HTML page of some reports, with their PNG files by name."""
    parser = MarkdownIt("commonmark", {"html": False, "xhtmlOut": False}).enable("table")
    body = parser.render("\n\n".join(_page_lines(title, reports)) + "\n")
    return _PAGE.format(title=escape(escape_controls(title)), body=body)


def _page_lines(title: str, reports: Sequence[tuple[Report, Mapping[str, bytes]]]) -> Iterator[str]:
    """The paragraphs of a page in Markdown, with figures as data addresses."""
    mark = escape_markdown
    yield f"# {mark(title)}"
    for report, images in reports:
        yield f"## {mark(report.title)}"
        yield "\n".join(f"- **{mark(label)}:** {mark(text)}." for label, text, _ in report.facts)
        for block in (*([report.table] if report.table else ()), *report.blocks):
            yield from _block_lines(block, images)
        yield mark(report.definition)
        yield mark(report.origin)


def _block_lines(block: Block, images: Mapping[str, bytes]) -> Iterator[str]:
    if isinstance(block, str):
        yield escape_markdown(block)
    elif isinstance(block, Table):
        yield f"### {escape_markdown(block.title)}"
        header, *rows = (
            f"| {' | '.join(map(escape_markdown, row))} |" for row in (block.header, *block.rows)
        )
        yield "\n".join([header, "| --- " * len(block.header) + "|", *rows])
        if block.note:
            yield escape_markdown(block.note)
    else:
        text = escape_markdown(block.figure.get_suptitle().replace("\n", " "))
        yield f"![{text}](data:image/png;base64,{b64encode(images[block.name]).decode()})"
        yield escape_markdown(block.caption)


def escape_markdown(text: str) -> str:
    """Return plain text as Markdown that shows it literally, in one line."""
    return _MARKUP.sub(r"\\\g<0>", escape_controls(text))
