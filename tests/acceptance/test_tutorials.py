"""What the tutorials tell to type runs, one after another, in an empty folder."""

import ast
import re
import shlex
from pathlib import Path

import numpy as np
import pytest
from support.commands import Command, command_line

import sinsjax
from sinsjax.records.layout import to_body

pytestmark = pytest.mark.optimised(False)

ROOT = Path(__file__).parents[2]


@pytest.fixture
def command(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> Command:
    monkeypatch.chdir(tmp_path)
    return command_line(monkeypatch, capsys)


def blocks(page: str) -> list[tuple[str, str]]:
    """Language and text of the fenced blocks of a page; commands have no language."""
    text = (ROOT / "docs" / page).read_text(encoding="utf-8")
    return re.findall(r"^```(\w*)\n(.*?)^```$", text, re.DOTALL | re.MULTILINE)


def typed(page: str, command: Command, capsys: pytest.CaptureFixture[str]) -> list[str]:
    """What the blocks of a page print, as a reader would type them."""
    told: list[str] = []
    names: dict[str, object] = {}
    for language, text in blocks(page):
        if language == "python":
            exec(compile(text, page, "exec"), names)
            told.append(capsys.readouterr().out)
        for line in text.splitlines() if not language else ():
            code, out, error = command(*shlex.split(line)[1:])
            assert (code, error) == (0, ""), line
            told.append(out)
    return told


def test_own_record(command: Command, capsys: pytest.CaptureFixture[str]) -> None:
    told = typed("own_record.md", command, capsys)
    assert "drive.toml written" in told[1] and "drive.toml: valid" in told[2]
    (row,) = sinsjax.read_summary("out").to_pylist()
    assert abs(row["yaw_deg"] + 35) < 0.2 and abs(row["phi_u_arcmin"]) < 12
    text = Path("drive.toml").read_text()
    (shown,) = (text for language, text in blocks("own_record.md") if language == "toml")
    for line in shown.splitlines():
        assert line in text.splitlines(), line
    starts = ast.literal_eval(told[-1])
    assert [one["start_s"] for one in starts] == [0.0, 30.0]
    assert all(abs(one["yaw_deg"] + 35) < 0.5 for one in starts)


def test_one_run(command: Command, capsys: pytest.CaptureFixture[str]) -> None:
    told = typed("one_run.md", command, capsys)
    assert len(told) == 4 and all(told)
    assert 0 < float(told[1]) < 0.5
    assert float(told[2]) != 0 and "0." not in re.findall(r"[\d.e+-]+", told[3])


def test_the_figure_of_the_axes_shows_what_is_read() -> None:
    """The numbers behind it: each name turns its own axes to right, front and up."""
    names: dict[str, object] = {"__name__": "body_axes"}
    exec((ROOT / "docs" / "figures" / "body_axes.py").read_text(encoding="utf-8"), names)
    ways = names["_WAYS"]
    assert isinstance(ways, dict)
    body = {"right": (1, 0, 0), "front": (0, 1, 0), "up": (0, 0, 1)}
    body |= {"left": (-1, 0, 0), "down": (0, 0, -1)}
    for name, own in ways.items():
        for axis, way in enumerate(own):
            sensed = np.eye(3)[axis]
            assert to_body(sensed[None], name)[0].tolist() == list(body[way])
