"""Reports in every medium: names are literal, the HTML page is whole, and no name breaks it."""

import base64
import io
import re
import sys
import unicodedata
from html import escape, unescape

import pytest
from matplotlib.figure import Figure
from rich.console import Console
from support.stored_results import report_text, store_results
from support.studies import small_study
from support.sweep_directories import rewrite_manifest
from support.synthetic_tables import synthetic_summary

from sinsjax import messages as screen
from sinsjax import report
from sinsjax.errors import InputError
from sinsjax.messages import CONTROL
from sinsjax.report.document import Fact, Picture, Report, Table, print_report, to_html

pytestmark = [pytest.mark.optimised(False), pytest.mark.usefixtures("drawn_on_request")]

NASTY = (
    *("[/b]", "reset [fast]", "$x^$", "<script>alert(1)</script>", "a|b", "`tick", "# heading"),
    *("*star* _under_ a_b", "[link](http://x) ![image](y) <http://z>", "- item", "1. number"),
    *(":smile: &amp; ~~gone~~", "\\back\\"),
)
ODD = "\x1b[2J\u202e"
"""Text that a file may contain, which terminal and pages must show harmlessly."""
PNG = b"\x89PNG\r\n\x1a\n-the picture"


@pytest.fixture
def results(tmp_path):
    """Results of a study whose names are nasty."""
    cases = [{"case": label, "phi_u0_deg": float(i)} for i, label in enumerate(NASTY)]
    study = small_study(study={"name": "[/b] <script>x</script> ../../a", "draws": 2}, cases=cases)
    return store_results(tmp_path / "results", study, synthetic_summary(study))


def whole_report(text):
    """A report that has a text in all of its parts."""
    picture = Picture("fig", text, Figure())
    picture.figure.suptitle(text)
    table = Table(text, [text], [[text]], text)
    return Report(text, [Fact(text, text)], None, [table], [picture], [text] * 3)


def test_names_of_a_study_and_its_manifest_are_literal_in_every_medium(results):
    doctored = f"a{ODD}<script>x</script>\nWarning: c"
    changed = {"config": doctored, "warnings": [doctored], "versions": {"sinsjax": doctored}}
    rewrite_manifest(results, **changed)
    page = results.parent / "page\x1b\u202e.html"
    printed = report_text(results, html=page)
    written = page.read_text()
    for text in (printed, written):
        assert not CONTROL.search(text.replace("\n", "")) and "\nWarning: c" not in text
    assert "<script" not in written and r"Warning   a\x1b[2J\u202e<script>" in printed
    for name in NASTY:
        assert f"<td>{escape(name, quote=False)}</td>" in written and name in printed


def test_control_characters_in_any_part_of_report_are_escaped(monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")
    printed, whole = Console(file=io.StringIO()), whole_report(f"part{ODD}")
    print_report(whole, printed, full=True)
    for text in (printed.file.getvalue(), to_html(f"part{ODD}", [(whole, {"fig": PNG})])):
        assert not CONTROL.search(text.replace("\n", ""))
        assert text.count(r"part\x1b") >= 9


def test_html_page_contains_whole_report_literally_and_nothing_else():
    nasty = " ".join(NASTY)
    text = to_html("<i>& so", [(whole_report(nasty), {"fig": PNG})])
    assert not re.search(r"url\(|@import", text)
    seen = re.findall(r"<(\w+)", text)
    assert {seen.count(tag) for tag in ("table", "td", "th", "h1", "h3", "img")} == {1}
    assert not {"b", "a", "i", "script", "link"} & {*seen}
    assert unescape(text).count(nasty) == 12 and "<i>& so" in unescape(text)
    (source,) = re.findall(r"(?:src|href)=\"data:image/png;base64,([^\"]*)\"", text)
    assert base64.b64decode(source) == PNG
    assert f'alt="{escape(nasty)}"' in text


def test_html_page_of_results_has_all_tables_and_figures_without_full(results):
    page = results.parent / "page.html"
    printed = report_text(results, html=page, full=False)
    for title in ("Heading error from true north", "Every variant", "Against "):
        assert title in page.read_text() and title not in printed
    figures = len(list((results / "figures").glob("*.png")))
    assert page.read_text().count("data:image/png;base64,") == figures > 0


def test_failed_report_is_one_line_and_keeps_the_results(results, monkeypatch):
    def broken(*_, **__):
        raise ValueError("\nx^\n  ^\nParseSyntaxException")

    before = {path: path.read_bytes() for path in results.rglob("*.*")}
    monkeypatch.setattr(report.monte_carlo, "build_report", broken)
    with pytest.raises(InputError, match="the report failed, the results are unchanged") as error:
        report_text(results)
    assert "\n" not in str(error.value)
    assert {path: path.read_bytes() for path in before} == before


def test_errors_and_warnings_are_one_visible_line(capsys):
    assert str(InputError("a\nb\x1b[2J\u202e")) == r"a b\x1b[2J\u202e"
    screen.print_warning("a\nb\x1b[2J\u202e")
    assert capsys.readouterr().err == "Warning: a\\nb\\x1b[2J\\u202e\n"


def test_control_characters_are_codes_breaks_direction_marks_and_half_surrogates():
    """Compared with the Unicode database."""
    explicit = {"LRE", "RLE", "LRO", "RLO", "PDF", "LRI", "RLI", "FSI", "PDI"}
    for letter in map(chr, range(sys.maxunicode + 1)):
        expected = (
            unicodedata.category(letter) in ("Cc", "Cs", "Zl", "Zp")
            or unicodedata.bidirectional(letter) in explicit
            or letter in "\u061c\u200e\u200f"
        )
        assert bool(CONTROL.search(letter)) == expected, hex(ord(letter))


@pytest.mark.parametrize("letter", ["\x1b", "\n", "\u202e"])
def test_control_characters_in_names_are_refused(letter):
    cases = [{"case": "a"}, {"case": f"b{letter}"}]
    with pytest.raises(InputError) as error:
        small_study(study={"name": f"a{letter}b"}, cases=cases)
    for line, place in zip(error.value.lines, ("[cases] case[1]", "[study] name"), strict=True):
        assert line.startswith(f"study: {place}: must not contain control characters")
        assert line.isprintable()
