"""What another package's code raises or gives is told in one line, with its place."""

from importlib.metadata import EntryPoint
from typing import Any

import pytest

from sinsjax.alignment import from_outside
from sinsjax.alignment.base import Method
from sinsjax.alignment.description import Description, Implementation
from sinsjax.errors import InputError
from sinsjax.platform import runtime

METHOD = Method(*[lambda *given: None] * 7)


def of_package(monkeypatch: pytest.MonkeyPatch, name: str = "made", **changes: Any) -> Any:
    """What comes of a package with one method."""
    given = {"name": "made", "summary": "", "source": "", "sections": {}, "reads": ()}
    made = Description(**given | {"load": lambda: implementation()} | changes)

    class Point(EntryPoint):
        def load(self) -> Any:
            return made

    point = Point(name, "made.description:MADE", "sinsjax.methods")
    monkeypatch.setattr(runtime, "method_entry_points", lambda: (point,))
    return from_outside.with_those_from_outside([])


def implementation(**changes: Any) -> Implementation:
    given = {"build": lambda options: METHOD, "parameters": lambda *columns: ()}
    return Implementation(**given | changes)


def fails(*given: Any) -> Any:
    raise KeyError("nothing")


def refuses(*given: Any) -> Any:
    raise InputError("[made] key: is too large")


def test_what_works_is_as_it_was(monkeypatch: pytest.MonkeyPatch) -> None:
    brought = of_package(monkeypatch)
    assert brought.broken == {} and list(brought.methods) == ["made"]
    built = brought.methods["made"](None)
    assert built.init(None, None) is None and built.close is None


HERE = f"in {__file__}:{fails.__code__.co_firstlineno + 1}"


@pytest.mark.parametrize(
    ("call", "changes", "what"),
    [
        ("load", {"load": fails}, f"load: KeyError: 'nothing', {HERE}"),
        ("load", {"load": lambda: None}, "load: gave a NoneType, not a sinsjax.alignment."),
        ("build", {"load": lambda: implementation(build=fails)}, "build: KeyError"),
        ("build", {"load": lambda: implementation(build=lambda o: 1)}, "build: gave a int, not"),
        ("parameters", {"load": lambda: implementation(parameters=fails)}, "parameters: KeyError"),
        ("check", {"load": lambda: implementation(check=fails)}, "check: KeyError"),
        ("rule", {"rules": (fails,)}, "rules: KeyError"),
        ("limit", {}, "limit: gave a NoneType, not a sinsjax.alignment.limits.Limit"),
    ],
)
def test_what_fails_is_told(
    monkeypatch: pytest.MonkeyPatch, call: str, changes: dict[str, Any], what: str
) -> None:
    method = of_package(monkeypatch, **changes).methods["made"]
    calls = {
        "load": lambda: method.implementation,
        "build": lambda: method(None),
        "parameters": lambda: method.implementation.parameters(None, None, 1.0),
        "check": lambda: method.implementation.check(None, None),
        "rule": lambda: method.rules[0](None),
        "limit": lambda: method(None).limit(None, None, None, None),
    }
    with pytest.raises(InputError) as caught:
        calls[call]()
    assert str(caught.value).startswith(f"method 'made': {what}")
    raised = what.partition(": ")[2].startswith("KeyError")
    assert isinstance(caught.value.__cause__, KeyError) == raised


def test_what_it_refuses_itself_is_its_own_line(monkeypatch: pytest.MonkeyPatch) -> None:
    method = of_package(monkeypatch, rules=(refuses,)).methods["made"]
    with pytest.raises(InputError, match=r"^\[made\] key: is too large$"):
        method.rules[0](None)


def test_an_entry_point_has_the_name_of_its_method(monkeypatch: pytest.MonkeyPatch) -> None:
    brought = of_package(monkeypatch, name="other")
    assert brought.methods == {}
    assert brought.broken["other"].endswith("its method is called 'made' (give both one name)")
