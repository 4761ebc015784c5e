"""What the README, the tutorials and public docstrings show: it runs, and prints what is shown."""

import doctest
import inspect
import re
import shlex
import tomllib
from pathlib import Path

import pytest

import sinsjax as package

pytestmark = [pytest.mark.optimised(False), pytest.mark.usefixtures("drawn_on_request")]

ROOT = Path(__file__).parents[2]
FEW = "--draws 2 --set axes.reset_cycle_s=[10,50] --set axes.phi_u0_deg=[0,90]"
FEW += " --set study.duration_s=450 --set study.window_s=[300,450]"
"""Of `reset_sweep`, to save time."""

PRINTED = {
    "start": r"floor, 88 \[",
    "advise": r"10\.3 \S+\n8\.4 \S+\n7\.9 ",
    "own_record": r"'yaw_deg': -3[45]\.",
    "turning": r"214\.9 26 1\.0",
    "one_run": "",
}
"""Tutorials, and what a command or block of code prints besides what the page shows below it."""


def blocks(page):
    """Return language and text of the fenced blocks of a page; commands have no language."""
    text = (ROOT / page).read_text(encoding="utf-8")
    return re.findall(r"^```(\w*)\n(.*?)^```$", text, re.DOTALL | re.MULTILINE)


@pytest.mark.nightly
@pytest.mark.parametrize("page", PRINTED)
def test_tutorial_runs_and_prints_what_it_shows(page, sinsjax, capsys):
    told, names = [""], dict[str, object]()
    for language, text in blocks(f"docs/{page}.md"):
        if language == "toml":
            Path("imu.toml").write_text(text, encoding="utf-8")  # the only one that is read
        elif language == "text":
            assert text.split() == told[-1].split()
        elif language == "python":
            exec(compile(text, page, "exec"), names)
            told.append(capsys.readouterr().out)
        for line in text.splitlines() if not language else ():
            words = f"{line} {FEW}" if "sweep reset_sweep" in line else line
            code, out, error = sinsjax(*shlex.split(words)[1:])
            assert code == 0 and "error" not in error, line
            told.append(out)
    assert any(re.search(PRINTED[page], out) for out in told), told


def assert_same_but_for_last_digits(here, there):
    """Two texts with the same words and, on another machine, nearly the same numbers."""
    number = r"\d+(?:\.\d+)?"
    assert re.sub(number, "#", here).split() == re.sub(number, "#", there).split()
    numbers = [[float(x) for x in re.findall(number, text)] for text in (here, there)]
    assert numbers[0] == pytest.approx(numbers[1], rel=0.05, abs=5)


@pytest.mark.nightly
def test_readme_example_and_first_command_print_what_is_shown(sinsjax, capsys):
    (example,) = (text for language, text in blocks("README.md") if language == "python")
    _, sweep, rows = (text for language, text in blocks("README.md") if language == "text")
    exec(compile(example, "README.md", "exec"), {})
    assert_same_but_for_last_digits(capsys.readouterr().out, rows)
    code, told, _ = sinsjax("sweep", "reset_sweep", "-o", "out")
    assert code == 0
    for label in ("Best", "Others", "Accuracy"):
        pattern = rf"^  {label} (.*?)(?=^  \w|^\s*$|^\w|\Z)"
        here, there = (re.findall(pattern, text, re.M | re.S)[0] for text in (told, sweep))
        assert_same_but_for_last_digits(here, there)


def test_release_has_one_version_and_date_everywhere():
    """Also that of the package as installed."""
    files = ("pyproject.toml", "CITATION.cff", "CHANGELOG.md", "docs/start.md")
    project, citation, changes, start = ((ROOT / name).read_text("utf-8") for name in files)
    version, date = re.findall(r"^(?:version|date-released): (.+)$", citation, re.M)
    assert version == tomllib.loads(project)["project"]["version"] == package.__version__
    assert re.findall(r"^## (\[\d.+)$", changes, re.M)[0] == f"[{version}] - {date}"
    assert f"sinsjax-{version}-py3" in start


EXAMPLES = {name: getattr(package, name) for name in package.__all__}
"""All public objects by name, with the methods of studies and results."""
for cls in (package.Results, package.Study):
    shown = {"read", *dir(package.load_study("reset_sweep"))}
    for name, function in inspect.getmembers(cls, callable):
        if name in shown & {*vars(cls)} and not name.startswith("_"):
            EXAMPLES[f"{cls.__name__}.{name}"] = function

SLOW = {
    *("Results", "Results.read", "TuningResults", "align"),
    *("one_run", "read_history", "score_results", "tune"),
    *("export_study", "information_bound", "Advice"),
    *("load_increments", "read_curves", "read_manifest", "read_record", "read_summary"),
    *("run", "run_into", "StudyWarning"),
}
"""Examples that take seconds for what tests of the same functions do too."""


@pytest.mark.nightly(fast=sorted(EXAMPLES.keys() - SLOW))
@pytest.mark.parametrize("name", sorted(EXAMPLES))
def test_docstring_example_runs(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    text = inspect.getdoc(EXAMPLES[name]) or ""
    test = doctest.DocTestParser().get_doctest(text, {"sinsjax": package}, name, None, None)
    assert test.examples, f"{name}: its docstring has no example"
    flags, told = doctest.NORMALIZE_WHITESPACE | doctest.ELLIPSIS, list[str]()
    doctest.DocTestRunner(optionflags=flags).run(test, out=told.append)
    assert not told, "".join(told)
