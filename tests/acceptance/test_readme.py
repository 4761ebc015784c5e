"""The README's example and first command, and one version everywhere."""

import re
import tomllib
from pathlib import Path

import pytest
from support.commands import Command

from sinsjax import __version__

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text(encoding="utf-8")


def assert_same_but_for_last_digits(here: str, there: str) -> None:
    """Two texts with the same words and, on another machine, nearly the same numbers."""
    number = r"\d+(?:\.\d+)?"
    assert re.sub(number, "#", here).split() == re.sub(number, "#", there).split()
    numbers = [[float(x) for x in re.findall(number, text)] for text in (here, there)]
    assert numbers[0] == pytest.approx(numbers[1], rel=0.05, abs=5)


@pytest.mark.nightly
def test_readme_python_example_prints_what_is_shown(capsys: pytest.CaptureFixture[str]) -> None:
    (example,) = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
    shown = re.findall(r"```text\n(.*?)```", README, re.DOTALL)[2].splitlines()
    exec(compile(example, "README.md", "exec"), {})
    printed = capsys.readouterr().out.splitlines()
    for here, there in zip(printed, shown, strict=True):
        assert_same_but_for_last_digits(here, there)


@pytest.mark.nightly
def test_first_command_prints_what_is_shown(sinsjax: Command) -> None:
    code, told, _ = sinsjax("sweep", "reset_sweep", "-o", "out")
    shown = re.findall(r"```text\n(.*?)```", README, re.DOTALL)[1]
    assert code == 0
    for label in ("Best", "Others", "Accuracy"):
        pattern = rf"^  {label} (.*?)(?=^  \w|^\s*$|^\w|\Z)"
        here, there = (re.findall(pattern, t, re.M | re.S)[0] for t in (told, shown))
        assert_same_but_for_last_digits(here, there)


def test_release_has_one_version_and_date_everywhere() -> None:
    """Also that of the package as installed."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    citation = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    changes = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    version, date = re.findall(r"^(?:version|date-released): (.+)$", citation, re.M)
    assert version == project["version"] == __version__
    released = [
        title for title in re.findall("^## (.+)$", changes, re.M) if title != "[Unreleased]"
    ]
    assert released[0] == f"[{version}] - {date}"
    (wheel,) = re.findall(r"sinsjax-(\S+)-py3", (ROOT / "docs/start.md").read_text("utf-8"))
    assert wheel == version
