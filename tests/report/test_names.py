"""Names from a study are printed literally in every medium, and no name breaks a report."""

import io
import sys
import unicodedata
from html import escape
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from markdown_it import MarkdownIt
from rich.console import Console
from support.stored_results import report_text, store_results, write_part
from support.studies import small_study
from support.sweep_directories import rewrite_manifest
from support.synthetic_tables import synthetic_summary

from sinsjax import console as screen
from sinsjax import report
from sinsjax.errors import InputError
from sinsjax.execution.directory import read_manifest
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
NAME = "[/b] <script>x</script> $x^$ ../../a"


def store_nasty_results(directory: Path) -> Path:
    """Results of a study with the worst possible names."""
    cases = [{"case": label, "phi_u0_deg": float(i)} for i, label in enumerate(NASTY)]
    unbiased = {"accel_bias_ug": 0.0, "gyro_bias_deg_per_h": 0.0}
    study = small_study(study={"name": NAME, "draws": 2}, cases=cases, sensors=unbiased)
    return store_results(directory, study, synthetic_summary(study))


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return store_nasty_results(tmp_path_factory.mktemp("names") / "results")


@pytest.mark.parametrize("name", NASTY)
def test_escaped_name_renders_unchanged_in_markdown(name: str) -> None:
    read = MarkdownIt("commonmark").enable(["table", "strikethrough"])
    shown = escape(name, quote=False)
    assert read.renderInline(escape_markdown(name)) == shown
    assert f"<td>{shown}</td>" in read.render(f"| a |\n| --- |\n| {escape_markdown(name)} |\n")


DOCTORED = "a\x1b]0;x\x07\x7f\u202e\u2028\u061c\udcff|`<script>x</script> --> b\nWarning: c"
"""Text that a file may contain, which terminal and pages must show harmlessly."""


@pytest.mark.usefixtures("drawn_on_request")
def test_control_characters_from_results_are_escaped_in_every_medium(tmp_path: Path) -> None:
    directory = store_nasty_results(tmp_path / "results")
    part = directory / "summary" / "part-0000-000000.parquet"
    table = pq.read_table(part)
    cases = [f"{case}\x1b[2J\u202e\n" for case in table["case"].to_pylist()]
    table = table.set_column(table.column_names.index("case"), "case", pa.array(cases))
    write_part(part, table, read_manifest(directory)["identity"])
    doctored = {"config": DOCTORED, "warnings": [DOCTORED], "versions": {"sinsjax": DOCTORED}}
    rewrite_manifest(directory, **doctored)
    page = tmp_path / "page\x1b\u202e.html"
    said = report_text(directory, html=page)
    written = page.read_text()
    for text in (said, written):
        assert not CONTROL.search(text.replace("\n", "")) and "\nWarning: c" not in text
    assert "<script" not in written
    assert r"Warning   a\x1b]0;x\x07\x7f\u202e \u061c\udcff|`<script>" in said
    for name in NASTY:
        cell = "<td>" + escape(name, quote=False) + r"\x1b[2J\u202e\n</td>"
        assert cell in written, name


def test_control_characters_in_any_part_of_report_are_escaped(
    results: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Control characters are escaped wherever they come from."""
    monkeypatch.setenv("COLUMNS", "200")
    said, odd = Console(file=io.StringIO()), "\x1b[2J\u202e"
    table = Table(f"title{odd}", [f"header{odd}"], [[f"cell{odd}"]], f"note{odd}")
    row = Table(f"verdict{odd}", [f"head{odd}"], [[f"row{odd}"]])
    facts = [Fact(f"label{odd}", f"fact{odd}")]
    whole = Report(f"study{odd}", facts, row, [f"text{odd}", table])
    report.print_report(whole, said, results)
    report.print_report(whole, said, results, full=True)
    page = to_html(f"name{odd}", [(whole, {})])
    for text in (said.file.getvalue(), page):
        assert not CONTROL.search(text.replace("\n", ""))
        for part in ("study", "label", "fact", "text", "title", "header", "cell", "note"):
            assert rf"{part}\x1b" in text, part
    assert r"name\x1b" in page


def test_errors_and_warnings_are_one_visible_line(capsys: pytest.CaptureFixture[str]) -> None:
    assert str(InputError("a\nb\x1b[2J\u202e")) == r"a b\x1b[2J\u202e"
    screen.print_warning("a\nb\x1b[2J\u202e")
    assert capsys.readouterr().err == "Warning: a\\nb\\x1b[2J\\u202e\n"


def test_control_characters_are_codes_breaks_direction_marks_and_half_surrogates() -> None:
    """Return the control characters of the Unicode database."""
    explicit = {"LRE", "RLE", "LRO", "RLO", "PDF", "LRI", "RLI", "FSI", "PDI"}
    for letter in map(chr, range(sys.maxunicode + 1)):
        expected = (
            unicodedata.category(letter) in ("Cc", "Cs", "Zl", "Zp")
            or unicodedata.bidirectional(letter) in explicit
            or letter in "\u061c\u200e\u200f"
        )
        assert bool(CONTROL.search(letter)) == expected, hex(ord(letter))


@pytest.mark.parametrize("letter", ["\x1b", "\n", "\x00", "\x85", "\u2028", "\u202e"])
def test_control_characters_in_names_are_refused(letter: str) -> None:
    for place, changes in {
        "[study] name": {"study": {"name": f"a{letter}b"}},
        "[cases] case[1]": {"cases": [{"case": "a"}, {"case": f"b{letter}"}]},
    }.items():
        with pytest.raises(InputError) as error:
            small_study(**changes)
        line = str(error.value)
        assert line.startswith(f"study: {place}: must not contain control characters")
        assert letter not in line and line.isprintable()


def test_failed_report_is_one_line_and_keeps_the_results(
    results: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*_: Any, **__: Any) -> None:
        raise ValueError("\nx^\n  ^\nParseSyntaxException")

    before = {path: path.read_bytes() for path in results.rglob("*.*")}
    monkeypatch.setattr(report.monte_carlo, "build_report", broken)
    with pytest.raises(InputError, match="the report failed, the results are unchanged") as error:
        report_text(results)
    assert "\n" not in str(error.value)
    assert {path: path.read_bytes() for path in before} == before
