"""The README's words are facts: its example runs, its commands, links and configs exist."""

import re
from pathlib import Path

import pytest
from support.commands import command_line
from typer.main import get_command

from sinsjax import cli

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text(encoding="utf-8")
CONTRIBUTING = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
PAGES = (ROOT / "docs" / "pages.md").read_text(encoding="utf-8")
CHEAT_SHEET = (ROOT / "docs" / "cheat_sheet.md").read_text(encoding="utf-8")


def test_readme_links_and_configs_exist() -> None:
    targets = re.findall(r"\]\(([^)#]+)\)", README) + re.findall(r"configs/\w+\.toml", README)
    assert len(targets) > 8
    missing = [name for name in targets if not (ROOT / name).exists()]
    assert not missing


def test_readme_is_read_in_a_minute() -> None:
    assert len(README.splitlines()) <= 110 and len(README.split()) < 900


def test_cheat_sheet_names_every_command() -> None:
    told = set(re.findall(r"sinsjax (\w+)", CHEAT_SHEET))
    known = set(get_command(cli.app).commands)  # type: ignore[attr-defined]
    assert told <= known and known - told == {"bench", "info"}


def test_every_page_answers_a_question() -> None:
    topics = (ROOT / "docs" / "python.md").read_text(encoding="utf-8")  # a page of links too
    linked = {"index.md", "pages.md", *re.findall(r"\]\(([\w/]+\.md)", PAGES + topics)}
    pages = {path.relative_to(ROOT / "docs").as_posix() for path in (ROOT / "docs").rglob("*.md")}
    assert pages - linked == set()


def test_map_names_every_module() -> None:
    told = set(re.findall(r"`(\w+)/?`", CONTRIBUTING.split("## Map")[1].split("## Goals")[0]))
    paths = [path for path in (ROOT / "sinsjax").iterdir() if path.suffix != ".typed"]
    modules = {path.stem for path in paths if not path.stem.startswith("_")}
    assert modules - told == set()


def assert_same_but_for_last_digits(here: str, there: str) -> None:
    """Two texts with the same words and, on another machine, nearly the same numbers."""
    number = r"\d+(?:\.\d+)?"
    assert re.sub(number, "#", here).split() == re.sub(number, "#", there).split()
    numbers = [[float(x) for x in re.findall(number, text)] for text in (here, there)]
    assert numbers[0] == pytest.approx(numbers[1], rel=0.05, abs=5)


@pytest.mark.slow
def test_readme_python_example_prints_what_is_shown(capsys: pytest.CaptureFixture[str]) -> None:
    (example,) = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
    shown = re.findall(r"```text\n(.*?)```", README, re.DOTALL)[1].splitlines()
    exec(compile(example, "README.md", "exec"), {})
    printed = capsys.readouterr().out.splitlines()
    for here, there in zip(printed, shown, strict=True):
        assert_same_but_for_last_digits(here, there)


@pytest.mark.slow
def test_first_command_prints_what_is_shown(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    command = command_line(monkeypatch, capsys)
    code, told, _ = command("sweep", "reset_sweep", "-o", tmp_path / "out")
    shown = re.findall(r"```text\n(.*?)```", README, re.DOTALL)[0]
    assert code == 0
    for label in ("Best", "Others", "Accuracy", "Caution"):
        pattern = rf"^  {label} (.*?)(?=^  \w|^\s*$|^\w|\Z)"
        here, there = (re.findall(pattern, t, re.M | re.S)[0] for t in (told, shown))
        assert_same_but_for_last_digits(here, there)
