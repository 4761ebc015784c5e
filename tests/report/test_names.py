"""Names from a study are printed literally in every medium, and no name breaks a report."""

import io
import sys
import unicodedata
from html import escape
from pathlib import Path

import pytest
from markdown_it import MarkdownIt
from rich.console import Console
from support.stored_results import report_text, store_results
from support.studies import small_study
from support.sweep_directories import rewrite_manifest
from support.synthetic_tables import synthetic_summary

from sinsjax import console as screen
from sinsjax import report
from sinsjax.errors import InputError
from sinsjax.messages import CONTROL
from sinsjax.report.base import Fact, Report, Table
from sinsjax.report.markdown import escape_markdown, to_html

pytestmark = pytest.mark.optimised(False)

NASTY = (
    "[/b]",
    "reset [fast]",
    "$x^$",
    "<script>alert(1)</script>",
    "a|b",
    "`tick",
    "*star* _under_ a_b",
    "[link](http://x) ![image](y)",
    ":smile: &amp; ~~gone~~",
    "\\back\\",
    "# heading",
    "- item",
)
ODD = "\x1b[2J\u202e"
"""Text that a file may contain, which terminal and pages must show harmlessly."""


@pytest.mark.parametrize("name", NASTY)
def test_escaped_name_renders_unchanged_in_markdown(name: str) -> None:
    read = MarkdownIt("commonmark").enable(["table", "strikethrough"])
    shown = escape(name, quote=False)
    assert read.renderInline(escape_markdown(name)) == shown
    assert f"<td>{shown}</td>" in read.render(f"| a |\n| --- |\n| {escape_markdown(name)} |\n")


@pytest.mark.usefixtures("drawn_on_request")
def test_names_of_a_study_and_its_manifest_are_literal_in_every_medium(tmp_path: Path) -> None:
    cases = [{"case": label, "phi_u0_deg": float(i)} for i, label in enumerate(NASTY)]
    study = small_study(study={"name": "[/b] <script>x</script> ../../a", "draws": 2}, cases=cases)
    directory = store_results(tmp_path / "results", study, synthetic_summary(study))
    doctored = f"a{ODD}<script>x</script>\nWarning: c"
    changed = {"config": doctored, "warnings": [doctored], "versions": {"sinsjax": doctored}}
    rewrite_manifest(directory, **changed)
    page = tmp_path / "page\x1b\u202e.html"
    printed = report_text(directory, html=page)
    written = page.read_text()
    for text in (printed, written):
        assert not CONTROL.search(text.replace("\n", "")) and "\nWarning: c" not in text
    assert "<script" not in written and r"Warning   a\x1b[2J\u202e<script>" in printed
    for name in NASTY:
        assert f"<td>{escape(name, quote=False)}</td>" in written and name in printed


def test_control_characters_in_any_part_of_report_are_escaped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    printed = Console(file=io.StringIO())
    table = Table(f"title{ODD}", [f"header{ODD}"], [[f"cell{ODD}"]], f"note{ODD}")
    row = Table(f"verdict{ODD}", [f"head{ODD}"], [[f"row{ODD}"]])
    whole = Report(f"study{ODD}", [Fact(f"label{ODD}", f"fact{ODD}")], row, [f"text{ODD}", table])
    report.print_report(whole, printed, tmp_path, full=True)
    for text in (printed.file.getvalue(), to_html(f"study{ODD}", [(whole, {})])):
        assert not CONTROL.search(text.replace("\n", ""))
        for part in ("study", "label", "fact", "text", "title", "header", "cell", "note", "row"):
            assert rf"{part}\x1b" in text, part


def test_errors_and_warnings_are_one_visible_line(capsys: pytest.CaptureFixture[str]) -> None:
    assert str(InputError("a\nb\x1b[2J\u202e")) == r"a b\x1b[2J\u202e"
    screen.print_warning("a\nb\x1b[2J\u202e")
    assert capsys.readouterr().err == "Warning: a\\nb\\x1b[2J\\u202e\n"


def test_control_characters_are_codes_breaks_direction_marks_and_half_surrogates() -> None:
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
@pytest.mark.parametrize("place", ["[study] name", "[cases] case[1]"])
def test_control_characters_in_names_are_refused(letter: str, place: str) -> None:
    changes = {"[study] name": {"study": {"name": f"a{letter}b"}}}
    changes["[cases] case[1]"] = {"cases": [{"case": "a"}, {"case": f"b{letter}"}]}
    with pytest.raises(InputError) as error:
        small_study(**changes[place])
    line = str(error.value)
    assert line.startswith(f"study: {place}: must not contain control characters")
    assert letter not in line and line.isprintable()
