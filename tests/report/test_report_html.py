import base64
import re
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from matplotlib.figure import Figure
from support.stored_results import report_text, store_results
from support.studies import small_study

from sinsjax import columns
from sinsjax.errors import InputError
from sinsjax.execution.source import Source
from sinsjax.report import base
from sinsjax.report.output import DrawnReport, write_html_page

pytestmark = pytest.mark.usefixtures("drawn_on_request")

VOID = {"meta", "img", "br", "hr", "link", "input"}
PNG = b"\x89PNG\r\n\x1a\n-the picture"


class Reader(HTMLParser):
    """The elements of a page, each closed where it should be."""

    def __init__(self, text):
        super().__init__(convert_charrefs=True)
        self.open, self.seen, self.attributes, self.text = [], [], [], []
        self.feed(text)
        self.close()
        assert not self.open, f"left open: {self.open}"

    def handle_starttag(self, tag, attrs):
        self.seen.append((*self.open, tag))
        self.attributes += [(tag, name, value) for name, value in attrs]
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open and self.open[-1] == tag, f"</{tag}> closes {self.open}"
        self.open.pop()

    def handle_data(self, data):
        self.text.append(data)


def drawn_report(*blocks, headline=("Found: *much*",), name="swing"):
    study = small_study(study={"name": name})
    table = pa.table({"run_id": np.arange(3)})
    facts = [base.Fact("Best", text) for text in headline]
    report = base.Report(base.Verdict("title", facts), [base.Chapter("A `part`", blocks)])
    images = {block.name: PNG for block in blocks if isinstance(block, base.Picture)}
    return DrawnReport(Source(Path("results"), study, f"{name}.toml", table), report, images)


def html_page(tmp_path, *parts, title="Title"):
    path = tmp_path / "page.html"
    write_html_page(path, title, parts)
    return path.read_text(encoding="utf-8")


def test_html_page_contains_whole_report(tmp_path):
    table = base.Table("A *table*", ["a", "b"], [["1", "`2`"], ["3", "4"]], "a note")
    picture = base.Picture("fig", 'what is "seen"', Figure())
    picture.figure.suptitle('what is "drawn"')
    text = html_page(tmp_path, drawn_report(base.Text("Some *words*.\n\nMore."), table, picture))
    assert text.startswith('<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">')
    read = Reader(text)
    seen = [path[-1] for path in read.seen]
    assert seen.count("table") == 1 and seen.count("td") == 4 and seen.count("th") == 2
    assert seen.count("h1") == 1 and "<h2>A <code>part</code></h2>" in text
    assert "<li><strong>Best:</strong> Found: <em>much</em>.</li>" in text
    assert "<p>Some <em>words</em>.</p>\n<p>More.</p>" in text
    assert "<caption>A <em>table</em></caption>" in text and "<td><code>2</code></td>" in text
    assert '<p class="note">a note</p>' in text
    source = next(value for tag, name, value in read.attributes if (tag, name) == ("img", "src"))
    assert base64.b64decode(source.removeprefix("data:image/png;base64,")) == PNG
    assert ("img", "alt", 'what is "drawn"') in read.attributes


def test_html_page_is_self_contained(tmp_path):
    text = html_page(
        tmp_path, drawn_report(base.Picture("fig", "c", Figure()), base.Text("http://a.b/c"))
    )
    places = [value for _, name, value in Reader(text).attributes if name in ("src", "href")]
    assert len(places) == 1 and places[0].startswith("data:")
    assert "<script" not in text and "<link" not in text
    assert not re.search(r"url\(|@import", text)


def test_html_page_escapes_markup_in_text(tmp_path):
    nasty = "<b>&amp;</b> 1 < 2 [a](http://x) ![b](http://y) <http://z> phi_u0_deg a_b_c"
    table = base.Table(nasty, [nasty], [[nasty]], nasty)
    picture = base.Picture("fig", nasty, Figure())
    picture.figure.suptitle(nasty)
    made_of = drawn_report(base.Text(nasty), table, picture, headline=[nasty], name="a<b")
    text = html_page(tmp_path, made_of, title="<i>& so")
    read = Reader(text)
    assert not {"b", "a", "i"} & {path[-1] for path in read.seen}
    assert sum(path[-1] == "img" for path in read.seen) == 1
    said = "".join(read.text)
    # Markdown reads an entity as what it stands for, on the Markdown page too.
    assert said.count(nasty.replace("&amp;", "&")) == 7 and "<i>& so" in said
    assert "a<b.toml; computed by sinsjax " in said and "configs/" not in said


def test_unwritable_html_page_raises_input_error(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="cannot be written"):
        write_html_page(tmp_path / "file" / "page.html", "T", [drawn_report()])


def test_html_and_markdown_pages_have_same_content(tmp_path):
    study = small_study(study={"name": "swing"}, axes={"phi_u0_deg": [0.0, 30.0]})
    names = [c.name for c in (*columns.IDENTITY, *columns.OBSERVED, *columns.JUDGED)]
    names += ["settle_10_s", "settle_10_truth_s"]
    rows = {name: np.linspace(1.0, 2.0, 6) for name in names}
    rows |= dict.fromkeys(
        ("has_floor", "ok_floor", "ok_truth"), [True, True, True, False] + [True] * 2
    )
    rows |= {"run_id": np.arange(6), "draw_id": np.repeat(np.arange(3), 2)}
    rows |= {"status": ["ok"] * 6, "phi_u0_deg": [0.0, 30.0] * 3, "reset_times_s": [[]] * 6}
    directory = store_results(tmp_path / "results", study, pa.table(rows))
    markdown, one = tmp_path / "page.md", tmp_path / "page.html"
    report_text(directory, page=markdown, html=one)
    text = Reader(one.read_text()).text
    for line in markdown.read_text().splitlines():
        if line.startswith("| ") and "---" not in line:
            cells = [cell.strip().replace("*", "") for cell in line.strip("|").split(" | ")]
            assert all(cell.strip() in text for cell in cells), line
    assert one.read_text().count("data:image/png;base64,") == markdown.read_text().count("![")
    first = one.read_bytes()
    report_text(directory, html=one)
    assert one.read_bytes() == first
