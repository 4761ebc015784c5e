"""Plug-in methods: what loads; `acceptance` installs a package with one and breaks its promises."""

from importlib.metadata import EntryPoint
from types import SimpleNamespace
from typing import Any

import pytest

from sinsjax.methods import registry
from sinsjax.methods.method import Method
from sinsjax.platform import runtime
from sinsjax.value_types import Section


class Point(EntryPoint):
    """An entry point that calls a function in place of importing a module."""

    def load(self) -> Any:
        return vars(self)["function"]()


def point(function: Any, name: str = "made") -> Point:
    made = Point(name, f"{__name__}:MADE", "sinsjax.methods")
    vars(made).update(function=function, dist=SimpleNamespace(name="maker", version="1.0"))
    return made


class Lagged(Section):
    lag_s: float = 1.0


class Delayed(Section):
    lag_s: float = 2.0


def described(name: str = "made", **sections: Any) -> Method:
    return Method(name, summary="", source="", build=fails, sections=sections)


def fails(*given: Any) -> Any:
    raise KeyError("nothing")


BUILT_IN = described("own", lagged=Lagged)


@pytest.mark.parametrize(
    ("function", "reason"),
    [
        (fails, "KeyError: 'nothing'"),
        (lambda: described("own"), "there is already a method 'own'"),
        (lambda: described(made=Delayed), "[made] lag_s is a key of [lagged]"),
    ],
)
def test_broken_plugin_has_one_line_reason_and_others_load(
    monkeypatch: pytest.MonkeyPatch, function: Any, reason: str
) -> None:
    points = point(function), point(lambda: described("other"), "other")
    monkeypatch.setattr(runtime, "method_entry_points", lambda: points)
    for name in ("METHODS", "SECTIONS_OF_METHODS", "PACKAGES", "BROKEN"):
        monkeypatch.setattr(registry, name, {})
    registry.add_method(BUILT_IN)
    registry.add_plugins()
    assert registry.METHODS["own"] is BUILT_IN and list(registry.METHODS) == ["own", "other"]
    assert list(registry.SECTIONS_OF_METHODS) == ["lagged"]
    assert registry.PACKAGES == {"other": ("maker", "1.0")}
    (line,) = registry.BROKEN["made"].splitlines()
    assert line.startswith("entry point 'made' in sinsjax.methods of maker 1.0: ")
    assert reason in line and list(registry.BROKEN) == ["made"]
