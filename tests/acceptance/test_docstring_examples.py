"""Examples in public docstrings: each public name has one, and it runs."""

import doctest
import inspect
from pathlib import Path
from typing import Any

import pytest

import sinsjax

pytestmark = pytest.mark.optimised(False)

FLAGS = doctest.NORMALIZE_WHITESPACE | doctest.ELLIPSIS
WITH_METHODS = ("Results", "Study")


def public_names() -> dict[str, Any]:
    """Return all public objects by name, with the methods of `WITH_METHODS`."""
    found = {name: getattr(sinsjax, name) for name in sinsjax.__all__}
    study = sinsjax.load_study("reset_sweep")
    shown = {"read", *dir(study)}
    for name in WITH_METHODS:
        methods = {key for key, _ in inspect.getmembers(found[name], callable)}
        own = {key for key in methods & {*vars(found[name])} if not key.startswith("_")}
        found |= {f"{name}.{key}": getattr(found[name], key) for key in sorted(own & shown)}
    return found


EXAMPLES = public_names()
SLOW = {
    *("Results", "Results.read", "TuningResults", "align"),
    *("one_run", "read_history", "score_results", "tune"),
    *("export_study", "information_bound", "Advice"),
    *("load_increments", "read_curves", "read_manifest", "read_record", "read_summary"),
    *("run", "run_into", "StudyWarning"),
}
"""Examples that take seconds for what tests of the same functions do too."""


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=pytest.mark.nightly) if name in SLOW else name
        for name in sorted(EXAMPLES)
    ],
)
def test_docstring_example_runs(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    text = inspect.getdoc(EXAMPLES[name]) or ""
    test = doctest.DocTestParser().get_doctest(text, {"sinsjax": sinsjax}, name, None, None)
    assert test.examples, f"{name}: its docstring has no example"
    told: list[str] = []
    doctest.DocTestRunner(optionflags=FLAGS).run(test, out=told.append)
    assert not told, "".join(told)
