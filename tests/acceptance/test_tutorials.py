"""The commands of the tutorials run in order in an empty folder."""

import re
import shlex
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from support.commands import Command

from sinsjax import advise, read_summary

pytestmark = [
    pytest.mark.nightly,
    pytest.mark.optimised(False),
    pytest.mark.usefixtures("drawn_on_request"),
]

ROOT = Path(__file__).parents[2]
Typed = Callable[..., list[str]]


def blocks(page: str) -> list[tuple[str, str]]:
    """Return language and text of the fenced blocks of a page; commands have no language."""
    text = (ROOT / "docs" / page).read_text(encoding="utf-8")
    return re.findall(r"^```(\w*)\n(.*?)^```$", text, re.DOTALL | re.MULTILINE)


@pytest.fixture
def typed(sinsjax: Command, capsys: pytest.CaptureFixture[str]) -> Typed:
    """Types the blocks of a page; a function that returns their output.

    The lines that contain a key of ``shorter`` get its words, to save time; ``saved`` is the file
    of the page's study.
    """

    def run_page(page: str, shorter: dict[str, str] | None = None, saved: str = "") -> list[str]:
        told: list[str] = []
        names: dict[str, object] = {}
        for language, text in blocks(page):
            if language == "toml" and saved:
                Path(saved).write_text(text, encoding="utf-8")
            if language == "python":
                exec(compile(text, page, "exec"), names)
                told.append(capsys.readouterr().out)
            for line in text.splitlines() if not language else ():
                more = [words for part, words in (shorter or {}).items() if part in line]
                code, out, error = sinsjax(*shlex.split(" ".join([line, *more]))[1:])
                assert code == 0 and "error" not in error, line
                told.append(out)
        return told

    return run_page


def test_start_tutorial_commands_run_with_expected_output(typed: Typed) -> None:
    """The first study with a few of its points; the other is as it comes."""
    few = "--draws 2 --set axes.reset_cycle_s=[10,50] --set axes.phi_u0_deg=[0,90]"
    few += " --set study.duration_s=450 --set study.window_s=[300,450]"
    told = typed("start.md", shorter={"sweep reset_sweep": few})
    first, full = told[0], told[2]
    assert "reset_sweep: 56 runs in " in first and "by reset_count" not in first
    assert "by reset_count" in full
    assert read_summary(Path("gravity"))["ok_floor"].to_pylist() == [True] * 56
    shares = [re.findall(r"Success +(\d+) \[.* floor, (\d+) \[", text) for text in told[7:9]]
    assert shares == [[("94", "88")], [("94", "6")]]  # from the bias floor, and from north
    assert "identical" in told[9]
    assert Path("first/figures/settling_time.png").exists()


def test_advice_page_prints_documented_numbers(typed: Typed) -> None:
    told = typed("advise.md", saved="imu.toml")
    (shown,) = (text for language, text in blocks("advise.md") if language == "text")
    assert told[0].split() == shown.split()  # the page has other line breaks
    assert "confirm.toml written" in told[1]
    page = (ROOT / "docs" / "advise.md").read_text(encoding="utf-8")
    number = r"([\d.]+) \[([\d.]+), ([\d.]+)\]"
    rows = re.findall(rf"^\| \d+ s \| ([\d.]+) \| {number} \|$", page, re.MULTILINE)
    found = [list(map(float, line.split())) for line in told[3].splitlines()]
    table = np.array(rows, float)
    assert table.shape == (3, 4) and np.abs(table[:, 1:] - found).max() < 0.15
    advised = {one.time_s: one.rms_arcmin for one in advise("imu.toml").headings}
    np.testing.assert_allclose(table[:, 0], [advised[t] for t in (60, 120, 300)], atol=0.06)
    assert told[4].split()[::2] == ["10.3", "8.4", "7.9"]
    assert "bring 7.9 arcmin instead of 10.3" in page


def test_own_record_tutorial_finds_expected_heading(typed: Typed) -> None:
    told = typed("own_record.md")
    assert "drive.toml written" in told[1] and "drive.toml: valid" in told[2]
    (row,) = read_summary("drive").to_pylist()
    assert abs(row["yaw_deg"] + 35) < 0.2 and abs(row["phi_u_arcmin"]) < 12
    text = Path("drive.toml").read_text()
    (shown,) = (text for language, text in blocks("own_record.md") if language == "toml")
    for line in shown.splitlines():
        assert line in text.splitlines(), line


def test_two_position_tutorial_finds_documented_heading(typed: Typed) -> None:
    told = typed("turning.md")
    assert "two_positions.toml written" in told[1] and "two_positions.toml: valid" in told[2]
    assert told[-1].splitlines() == ["214.9 26 1.0", "[1.0, 1.0]"]
    page = (ROOT / "docs" / "turning.md").read_text(encoding="utf-8")
    assert "214.9 deg with a 1 sigma of 26 arcmin" in page


def test_one_run_tutorial_prints_shown_output(typed: Typed) -> None:
    """Each block prints what the page shows below it."""
    shown = [text for language, text in blocks("one_run.md") if language == "text"]
    assert typed("one_run.md") == shown and len(shown) == 4


def test_own_method_page_shows_example_package_files() -> None:
    """Other tests install and run them, and run the study at the page's end."""
    folder = ROOT / "tests" / "example_method"
    files = ("pyproject.toml", "averaged_alignment/method.py")
    shown = [text for language, text in blocks("own_method.md") if language in ("toml", "python")]
    assert shown[:-1] == [(folder / name).read_text("utf-8") for name in files]
    assert {path.name for path in folder.rglob("*.*")} == {Path(name).name for name in files} | {
        "__init__.py"
    }
