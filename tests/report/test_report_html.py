import base64
import re
from html.parser import HTMLParser

import pytest
from matplotlib.figure import Figure
from support.stored_results import report_text, store_results
from support.studies import small_study
from support.synthetic_tables import synthetic_summary

from sinsjax.errors import InputError
from sinsjax.execution.results import Results
from sinsjax.report import base, monte_carlo, write_html_page

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
    facts = [base.Fact("Best", text) for text in headline]
    origin = f"study.toml of {name}; computed by sinsjax 1"
    report = base.Report("title", facts, None, blocks, origin=origin)
    images = {block.name: PNG for block in blocks if isinstance(block, base.Picture)}
    return report, images


def html_page(tmp_path, *parts, title="Title"):
    path = tmp_path / "page.html"
    write_html_page(path, title, parts)
    return path.read_text(encoding="utf-8")


def test_html_page_contains_whole_report(tmp_path):
    table = base.Table("A *table*", ["a", "b"], [["1", "`2`"], ["3", "4"]], "a note")
    picture = base.Picture("fig", 'what is "seen"', Figure())
    picture.figure.suptitle('what is "drawn"')
    text = html_page(tmp_path, drawn_report("Some *words*, 1. item", table, picture))
    assert text.startswith('<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">')
    read = Reader(text)
    seen = [path[-1] for path in read.seen]
    assert seen.count("table") == 1 and seen.count("td") == 4 and seen.count("th") == 2
    assert seen.count("h1") == 1 and "<h2>title</h2>" in text
    assert "<li><strong>Best:</strong> Found: *much*.</li>" in text
    assert "<p>Some *words*, 1. item</p>" in text
    assert "<h3>A *table*</h3>" in text and "<td>`2`</td>" in text and "<p>a note</p>" in text
    source = next(value for tag, name, value in read.attributes if (tag, name) == ("img", "src"))
    assert base64.b64decode(source.removeprefix("data:image/png;base64,")) == PNG
    assert ("img", "alt", 'what is "drawn"') in read.attributes


def test_html_page_is_self_contained(tmp_path):
    text = html_page(tmp_path, drawn_report(base.Picture("fig", "c", Figure()), "http://a.b/c"))
    places = [value for _, name, value in Reader(text).attributes if name in ("src", "href")]
    assert len(places) == 1 and places[0].startswith("data:")
    assert "<script" not in text and "<link" not in text
    assert not re.search(r"url\(|@import", text)


def test_html_page_escapes_markup_in_text(tmp_path):
    nasty = "<b>&amp;</b> 1 < 2 [a](http://x) ![b](http://y) <http://z> phi_u0_deg a_b_c"
    table = base.Table(nasty, [nasty], [[nasty]], nasty)
    picture = base.Picture("fig", nasty, Figure())
    picture.figure.suptitle(nasty)
    made_of = drawn_report(nasty, table, picture, headline=[nasty], name="a<b")
    text = html_page(tmp_path, made_of, title="<i>& so")
    read = Reader(text)
    assert not {"b", "a", "i"} & {path[-1] for path in read.seen}
    assert sum(path[-1] == "img" for path in read.seen) == 1
    said = "".join(read.text)
    assert said.count(nasty) == 7 and "<i>& so" in said
    assert "study.toml of a<b; computed by sinsjax " in said and "configs/" not in said


def test_unwritable_html_page_raises_input_error(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="cannot be written"):
        write_html_page(tmp_path / "file" / "page.html", "T", [drawn_report()])


def test_html_page_of_results_has_all_tables_and_figures_without_full(tmp_path):
    study = small_study(study={"name": "swing"}, axes={"phi_u0_deg": [0.0, 30.0]})
    directory = store_results(tmp_path / "results", study, synthetic_summary(study))
    page = tmp_path / "page.html"
    printed = report_text(directory, html=page, full=False)
    text = Reader(page.read_text()).text
    blocks = monte_carlo.build_report(Results.read(directory)).blocks
    titles = [block.title for block in blocks if isinstance(block, base.Table)]
    assert titles and all(title in "".join(text) for title in titles)
    assert not any(title in printed for title in titles)
    figures = len(list((directory / "figures").glob("*.png")))
    assert page.read_text().count("data:image/png;base64,") == figures > 0
    first = page.read_bytes()
    report_text(directory, html=page)
    assert page.read_bytes() == first
