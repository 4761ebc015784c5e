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

_STYLE = """
:root { color-scheme: light dark; --line: #8888; }
body { font: 16px/1.5 system-ui, sans-serif; max-width: 70rem; margin: 2rem auto; padding: 0 1rem; }
h1, h2, h3 { line-height: 1.2; }
h2 { margin-top: 2.5rem; border-bottom: 1px solid var(--line); padding-bottom: .3rem; }
img { max-width: 100%; height: auto; background: #fff; border-radius: 4px; display: block; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; font-size: .9rem; }
th, td { text-align: left; padding: .25rem .8rem .25rem 0; border-bottom: 1px solid var(--line); }
th { vertical-align: bottom; }
"""
_TERMS = {
    "draw": "one realisation of the sensor noise. Variant: one point of a study's axes. Run: one"
    " draw of one variant; all variants of a draw share its noise",
    "bias floor": "the heading error caused by a run's own constant sensor biases after its filter"
    " has converged, about -eps_E / (Omega cos L) + (nabla_E / g) tan L; a parked vehicle cannot"
    " distinguish it from a heading error",
    "truth": "true north, or the reference of a record. A run that has not converged can pass"
    " through it on the way to its bias floor",
    "settled": "the heading error stays within a band, about the bias floor (settle_X_s) or about"
    " the truth (settle_X_truth_s), up to the end of the run. Never: it does not settle",
    "ok": "the heading ends within the success band, about the truth or the bias floor according to"
    " judged_from, has been there for dwell_s, and the level ends within its own band",
    "failed": "the run diverged, or its last attitude is not finite",
    "best": "the option with the fewest runs that never settle and, of equals, the shortest average"
    " settling time over all conditions; its numbers are those of its own runs",
    "[a, b]": "95 % interval over the draws. All variants of a draw count as one",
    "NEES": "phi' P^-1 phi at the end, phi from the truth; 3 on average if the filter's covariance"
    " is right, larger if it is overconfident or a bias outside its states is at work",
}


def to_html(title: str, reports: Sequence[tuple[Report, Mapping[str, bytes]]]) -> str:
    """Return a self-contained HTML page of some reports, with their PNG files by name."""
    parser = MarkdownIt("commonmark", {"html": False, "xhtmlOut": False}).enable("table")
    body = parser.render("\n\n".join(_page_lines(title, reports)) + "\n")
    name = escape(escape_controls(title))
    return (
        f'<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n<title>{name}</title>'
        '\n<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"\n<style>{_STYLE}</style>\n</head>\n<body>\n{body}</body>\n</html>\n"
    )


def _page_lines(title: str, reports: Sequence[tuple[Report, Mapping[str, bytes]]]) -> Iterator[str]:
    """The paragraphs of a page in Markdown, with figures as data addresses."""
    mark = escape_markdown
    yield f"# {mark(title)}"
    yield from dict.fromkeys(mark(report.definition) for report, _ in reports)
    for report, images in reports:
        yield f"## {mark(report.title)}"
        facts = [f"- **{mark(label)}:** {mark(text)}." for label, text, _ in report.facts]
        yield "\n".join(facts)
        for block in (*([report.table] if report.table else ()), *report.blocks):
            yield from _block_lines(block, images)
    yield "## Terms"
    yield "\n".join(f"- *{mark(term)}*: {mark(text)}." for term, text in _TERMS.items())
    yield "; ".join(dict.fromkeys(mark(report.origin) for report, _ in reports))


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
