"""Notebooks use public names only and store tidy outputs; CI notices outputs that differ."""

import ast
import importlib.util
import json
import re
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

import sinsjax

ROOT = Path(__file__).parents[2]
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))


@pytest.fixture(scope="module")
def checker() -> ModuleType:
    """The script that CI runs on notebooks."""
    for library in ("nbclient", "nbformat"):
        pytest.importorskip(library)
    spec = importlib.util.spec_from_file_location("ci_notebooks", ROOT / ".ci" / "notebooks.py")
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    sys.modules["ci_notebooks"] = module
    spec.loader.exec_module(module)
    return module


def printing(text: str, name: str = "stdout") -> Any:
    """A notebook of one cell that has printed a text."""
    from nbformat.v4 import new_code_cell, new_notebook, new_output

    output = new_output("stream", name=name, text=text)
    return new_notebook(cells=[new_code_cell("", execution_count=1, outputs=[output])])


def test_there_are_notebooks() -> None:
    assert len(NOTEBOOKS) > 5


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebook_has_short_setup_and_uses_public_names(path: Path) -> None:
    """Set-up has three lines; no cell needs a checkout, runs a program or asserts."""
    text = path.read_text(encoding="utf-8")
    assert "../configs" not in text
    cells = [cell for cell in json.loads(text)["cells"] if cell["cell_type"] == "code"]
    sources = ["".join(cell["source"]) for cell in cells]
    assert sum(bool(line.strip()) for line in sources[0].splitlines()) <= 3
    code = "\n".join(re.sub(r"^%.*", "", source) for source in sources)
    for node in ast.walk(ast.parse(code)):
        assert not isinstance(node, ast.Assert)
        if isinstance(node, ast.Import):
            assert not [a.name for a in node.names if re.match(r"sinsjax\.|subprocess", a.name)]
        elif isinstance(node, ast.ImportFrom):
            assert not re.match("sinsjax|subprocess", str(node.module))
        elif isinstance(node, ast.Attribute) and ast.unparse(node.value) == "sinsjax":
            assert node.attr in sinsjax.__all__


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebook_stores_tidy_outputs(path: Path, checker: ModuleType) -> None:
    import nbformat

    assert path.stat().st_size < 200_000
    notebook = nbformat.read(path, as_version=4)
    assert list(checker.stored_faults(notebook)) == []
    checker.tidy(notebook)
    assert nbformat.writes(notebook) + "\n" == path.read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("stored in /tmp/tmpx1/out", "/tmp/"),
        ("~/data/log.csv", "~/data/"),
        ("2026-01-31 is the date", "2026-01-31"),
        ("<object at 0x7f00c0ffee>", "0x7f00c0"),
        ("x" * 200_000, "200 kB"),
    ],
)
def test_stored_faults_finds_paths_dates_and_size(
    text: str, fault: str, checker: ModuleType
) -> None:
    (found,) = checker.stored_faults(printing(text))
    assert fault in found


def test_stored_faults_accepts_units_and_ratios(checker: ModuleType) -> None:
    assert list(checker.stored_faults(printing("3 deg/h, 0.1 m/s/s, 1/2, a/b ratio"))) == []


def test_stored_faults_finds_missing_outputs_stderr_and_order(checker: ModuleType) -> None:
    bare = printing("")
    bare.cells[0].outputs = []
    assert "no outputs" in next(checker.stored_faults(bare))
    assert "stderr" in next(checker.stored_faults(printing("careful", "stderr")))
    late = printing("1")
    late.cells[0].execution_count = 7
    assert "execution count 7" in next(checker.stored_faults(late))


@pytest.mark.parametrize(
    ("was", "now", "agree"),
    [
        ("rms 101.02 arcmin", "rms  101.04 arcmin", True),
        ("rms 101.02 arcmin", "rms 107.00 arcmin", False),
        ("tilt -0.01", "tilt 0.01", True),
        ("settles after 12 s", "settles after 12 deg", False),
        ("+----+\n| 10 |\n+----+", "+---+\n| 10|\n+---+", True),
        ("never", "300", False),
        ("computed in 25.4 s", "computed in 31.0 s", False),
    ],
)
def test_differences_ignores_rounding_and_layout_only(
    was: str, now: str, agree: bool, checker: ModuleType
) -> None:
    assert (not list(checker.differences(printing(was), printing(now)))) == agree


def test_differences_finds_other_kinds_of_outputs(checker: ModuleType) -> None:
    blank = printing("")
    blank.cells[0].outputs = []
    assert list(checker.differences(printing("1"), blank))
