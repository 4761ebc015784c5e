"""Plug-in methods: what is loaded, what is refused, and how an error of their code is reported."""

from importlib.metadata import EntryPoint
from types import SimpleNamespace
from typing import Any

import jax
import numpy as np
import pytest

from sinsjax.errors import InputError
from sinsjax.methods.method import AttitudeCovariance, Description, Feedback, Implementation, Method
from sinsjax.methods.plugins import (
    PluginRegistry,
    check_plugin,
    describe_plugin_error,
    exclude_clashing,
    load_plugins,
)
from sinsjax.platform import runtime
from sinsjax.types import Quat
from sinsjax.value_types import Section


class Point(EntryPoint):
    """An entry point that calls a function in place of importing a module."""

    def load(self) -> Any:
        return vars(self)["function"]()


def point(function: Any, name: str = "made", value: str = f"{__name__}:MADE") -> Point:
    made = Point(name, value, "sinsjax.methods")
    vars(made).update(function=function, dist=SimpleNamespace(name="maker", version="1.0"))
    return made


class Lagged(Section):
    lag_s: float = 1.0


class Delayed(Section):
    lag_s: float = 2.0


def described(name: str = "made", **changes: Any) -> Description:
    given: dict[str, Any] = {"summary": "", "source": "", "sections": {}, "reads": ()}
    given["load"] = lambda: Implementation(lambda options: METHOD, lambda *columns: ())
    return Description(name, **given | changes)


def load(monkeypatch: pytest.MonkeyPatch, *points: Point, built_in: Any = ()) -> PluginRegistry:
    monkeypatch.setattr(runtime, "method_entry_points", lambda: points)
    return load_plugins(built_in)


def fails(*given: Any) -> Any:
    raise KeyError("nothing")


def exits() -> Any:
    raise SystemExit(3)


def line_of(function: Any, after: int = 1) -> str:
    return f"in {__file__}:{function.__code__.co_firstlineno + after}"


BUILT_IN = described("own", sections={"lagged": Lagged})
SOURCE = "entry point 'made' in sinsjax.methods of maker 1.0: "


@pytest.mark.parametrize(
    ("function", "reason"),
    [
        (fails, "KeyError: 'nothing'"),
        (exits, "SystemExit: 3"),
        (lambda: 1, "AttributeError"),
        (lambda: described(sections={"lagged": Delayed}), "[lagged]"),
        (lambda: described(sections={"made": Delayed}), "[made] lag_s is a key of [lagged]"),
    ],
)
def test_broken_plugin_has_one_line_reason_and_others_load(
    monkeypatch: pytest.MonkeyPatch, function: Any, reason: str
) -> None:
    points = point(function), point(lambda: described("other"), "other")
    found = load(monkeypatch, *points, built_in=[BUILT_IN])
    assert list(found.methods) == ["own", "other"] and list(found.sections) == ["lagged"]
    assert found.packages == {"other": ("maker", "1.0")}
    (line,) = found.broken["made"].splitlines()
    assert line.startswith(SOURCE) and reason in line and list(found.broken) == ["made"]
    if function in (fails, exits):
        assert line.endswith(f", {line_of(function)})")


def test_plugin_replaces_no_other_method(monkeypatch: pytest.MonkeyPatch) -> None:
    points = point(described), point(described)
    found = load(monkeypatch, *points, built_in=[BUILT_IN])
    assert found.methods["own"] is BUILT_IN and list(found.packages) == ["made"]
    assert found.broken["made"] == f"{SOURCE}there is already a method 'made'"
    points = (point(lambda: described("own")),)
    found = load(monkeypatch, *points, built_in=[BUILT_IN])
    assert found.methods == {"own": BUILT_IN}
    assert found.broken == {"made": f"{SOURCE}there is already a method 'own'"}


@pytest.mark.parametrize("common", [{"made": Section}, {"study": Delayed}])
def test_plugin_with_section_or_key_of_every_study_is_excluded(
    monkeypatch: pytest.MonkeyPatch, common: Any
) -> None:
    made = described(sections={"made": Lagged, "shared": Section})
    other = described("other", sections={"shared": Section})
    found = load(monkeypatch, point(lambda: made), built_in=[other])
    exclude_clashing(found, {})
    assert list(found.methods) == ["other", "made"] and found.broken == {}
    exclude_clashing(found, common)
    assert list(found.methods) == ["other"] and list(found.sections) == ["shared"]
    assert found.packages == {}
    assert "'made' of maker 1.0: " in found.broken["made"] and "[made]" in found.broken["made"]


def init(params: Any, nav: Any) -> Any:
    return nav.q


METHOD = Method(
    init=init,
    step=lambda params, site, state, sample, n: state,
    attitude=lambda state: state,
    covariance=lambda state: AttitudeCovariance(*[state.w] * 6),
    normalise=lambda state: state,
    floor=fails,
)


def check(params: Any = None, **changes: Any) -> None:
    check_plugin("it", METHOD._replace(**changes), params, 2, None)


def wrong(*given: Any) -> Any:
    return ()


def test_plugin_that_keeps_its_promises_passes_check() -> None:
    check(feedback=Feedback(lambda params, state, n: state, fails))
    check(step=lambda params, site, state, sample, n: Quat(*[1.0 * n] * 4))


@pytest.mark.parametrize(
    ("changes", "what"),
    [
        ({"step": wrong}, "step, normalise or close"),
        ({"normalise": wrong}, "step, normalise or close"),
        ({"feedback": Feedback(wrong, fails)}, "step, normalise or close"),
        ({"attitude": wrong}, "attitude"),
        ({"covariance": wrong}, "covariance"),
    ],
)
def test_function_that_returns_other_structure_is_named(changes: dict[str, Any], what: str) -> None:
    with pytest.raises(InputError) as caught:
        check(**changes)
    assert str(caught.value).startswith(f"it: {what} returns (), expected ")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "params",
    [0.5, [np.ones(2), 0.5], {"kept": np.ones(1)}, "ab"],
    ids=["number", "list", "one", "text"],
)
def test_parameters_without_a_value_per_variant_are_refused(params: Any) -> None:
    check((np.ones(2), {"list": np.ones((2, 3))}, None))
    with pytest.raises(InputError, match="^it: parameters must return one value per variant$"):
        check(params)


def test_error_of_plugin_code_is_described_with_its_last_place(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    load(monkeypatch, point(described))
    with pytest.raises(KeyError) as caught:
        jax.eval_shape(fails, 1.0)
    line = f"method 'made' of maker 1.0: KeyError: 'nothing', {line_of(fails)}"
    assert describe_plugin_error(caught.value) == line
    assert describe_plugin_error(KeyError("of no code")) is None
