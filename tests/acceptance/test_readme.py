"""The README's words are facts: its example runs, its commands, links and configs exist."""

import re
from pathlib import Path

import pytest
from typer.main import get_command

from sinsjax import cli

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text(encoding="utf-8")


def test_readme_links_and_configs_exist() -> None:
    targets = re.findall(r"\]\(([^)#]+)\)", README) + re.findall(r"configs/\w+\.toml", README)
    assert len(targets) > 8
    missing = [name for name in targets if not (ROOT / name).exists()]
    assert not missing


def test_readme_command_table_matches_cli() -> None:
    told = set(re.findall(r"^\| `sinsjax (\w+)", README, re.MULTILINE))
    assert told == set(get_command(cli.app).commands)  # type: ignore[attr-defined]


def test_readme_map_names_every_module() -> None:
    told = set(re.findall(r"`(\w+)/?`", README.split("## Map")[1].split("## Goals")[0]))
    paths = [path for path in (ROOT / "sinsjax").iterdir() if path.suffix != ".typed"]
    modules = {path.stem for path in paths if not path.stem.startswith("_")}
    assert modules - told == set()


@pytest.mark.slow
def test_readme_python_example_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (example,) = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
    (tmp_path / "configs").symlink_to(ROOT / "configs")
    monkeypatch.chdir(tmp_path)
    exec(compile(example, "README.md", "exec"), {})
    told = capsys.readouterr().out.splitlines()
    assert "condition 5 with resets" in told[0]
    assert told[1] == "192"
