"""The HTML page: whole, self-contained, and harmless whatever the text."""

import base64
import re
from html.parser import HTMLParser

import pytest
from matplotlib.figure import Figure
from support.stored_results import report_text, store_results
from support.studies import small_study
from support.synthetic_tables import synthetic_summary

from sinsjax import report
from sinsjax.errors import InputError
from sinsjax.execution.results import Results
from sinsjax.report import base, monte_carlo
from sinsjax.report.markdown import to_html

pytestmark = pytest.mark.usefixtures("drawn_on_request")

PNG = b"\x89PNG\r\n\x1a\n-the picture"
NASTY = "<b>&amp;</b> 1 < 2 [a](http://x) ![b](http://y) <http://z> phi_u0_deg a_b_c 1. *w* `2`"


class Reader(HTMLParser):
    """The elements of a page, their attributes and its text."""

    def __init__(self, text):
        super().__init__(convert_charrefs=True)
        self.seen, self.attributes, self.text = [], [], ""
        self.feed(text)
        self.close()

    def handle_starttag(self, tag, attrs):
        self.seen.append(tag)
        self.attributes += [(tag, name, value) for name, value in attrs]

    def handle_data(self, data):
        self.text += data


def test_html_page_contains_whole_report_literally_and_nothing_else():
    picture = base.Picture("fig", NASTY, Figure())
    picture.figure.suptitle(NASTY)
    blocks = [NASTY, base.Table(NASTY, [NASTY], [[NASTY]], NASTY), picture]
    facts = [base.Fact("Best", NASTY)]
    made = base.Report("title", facts, None, blocks, definition="ok", origin="study.toml of a<b")
    text = to_html("<i>& so", [(made, {"fig": PNG})])
    assert "<script" not in text and "<link" not in text and not re.search(r"url\(|@import", text)
    read = Reader(text)
    counts = {tag: read.seen.count(tag) for tag in ("table", "td", "th", "h1", "h3", "img")}
    assert {*counts.values()} == {1} and not {"b", "a", "i"} & {*read.seen}
    assert read.text.count(NASTY) == 7 and "<i>& so" in read.text
    assert "study.toml of a<b" in read.text and "<li><strong>Best:</strong>" in text
    (source,) = (value for _, name, value in read.attributes if name in ("src", "href"))
    assert base64.b64decode(source.removeprefix("data:image/png;base64,")) == PNG
    assert ("img", "alt", NASTY) in read.attributes


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("file/one", "--html .*one: cannot be written: .*file is not a writable folder$"),
        ("results", "--html .*results: is a folder, give the name of a file$"),
    ],
)
def test_unwritable_page_is_refused_before_report_is_made(tmp_path, monkeypatch, name, message):
    study = small_study()
    directory = store_results(tmp_path / "results", study, synthetic_summary(study))
    (tmp_path / "file").write_text("")
    monkeypatch.setattr(report.monte_carlo, "build_report", lambda source: pytest.fail("was made"))
    with pytest.raises(InputError, match=message):
        report_text(directory, html=tmp_path / name)


def test_failed_report_is_one_line_and_keeps_the_results(tmp_path, monkeypatch):
    def broken(*_, **__):
        raise ValueError("\nx^\n  ^\nParseSyntaxException")

    study = small_study()
    directory = store_results(tmp_path, study, synthetic_summary(study))
    before = {path: path.read_bytes() for path in directory.rglob("*.*")}
    monkeypatch.setattr(report.monte_carlo, "build_report", broken)
    with pytest.raises(InputError, match="the report failed, the results are unchanged") as error:
        report_text(directory)
    assert "\n" not in str(error.value)
    assert {path: path.read_bytes() for path in before} == before


def test_html_page_of_results_has_all_tables_and_figures_without_full(tmp_path):
    study = small_study(study={"name": "swing"}, axes={"phi_u0_deg": [0.0, 30.0]})
    directory = store_results(tmp_path / "results", study, synthetic_summary(study))
    page = tmp_path / "page.html"
    printed = report_text(directory, html=page, full=False)
    blocks = monte_carlo.build_report(Results.read(directory)).blocks
    titles = [block.title for block in blocks if isinstance(block, base.Table)]
    text = Reader(page.read_text()).text
    assert titles and all(title in text and title not in printed for title in titles)
    figures = len(list((directory / "figures").glob("*.png")))
    assert page.read_text().count("data:image/png;base64,") == figures > 0
