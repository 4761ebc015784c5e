"""What another package's code raises or gives is told in one line, with its place."""

import re
from functools import partial
from importlib.metadata import EntryPoint
from types import SimpleNamespace
from typing import Annotated, Any, ClassVar, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from pydantic import AfterValidator, BaseModel, Field, create_model
from support.studies import small_study

from sinsjax.errors import InputError
from sinsjax.methods import plugins as from_outside
from sinsjax.methods.base import Method, Relaxed
from sinsjax.methods.description import Description, Implementation
from sinsjax.platform import runtime
from sinsjax.study import load as loading
from sinsjax.study.variants import Variants
from sinsjax.types import Quat
from sinsjax.value_types import KeyInfo, Seconds, Section

pytestmark = pytest.mark.slow

METHOD = Method(*[lambda *given: None] * 7)


class Point(EntryPoint):
    """That of a method which is made up."""

    def load(self) -> Any:
        return vars(self)["made"]()


def point(made: Any, name: str = "made", package: str | None = None) -> Point:
    """Names what a function gives."""
    one = Point(name, "made.description:MADE", "sinsjax.methods")
    dist = None if package is None else SimpleNamespace(name=package, version="1.0")
    vars(one).update(made=made, dist=dist)
    return one


def described(**changes: Any) -> Description:
    given = {"name": "made", "summary": "", "source": "", "sections": {}, "reads": ()}
    return Description(**given | {"load": lambda: implementation()} | changes)


def brought(monkeypatch: pytest.MonkeyPatch, *points: Point, built_in: Any = ()) -> Any:
    monkeypatch.setattr(runtime, "method_entry_points", lambda: points)
    return from_outside.with_those_from_outside(built_in)


def of_package(monkeypatch: pytest.MonkeyPatch, name: str = "made", **changes: Any) -> Any:
    """What comes of a package with one method."""
    return brought(monkeypatch, point(lambda: described(**changes), name))


def implementation(**changes: Any) -> Implementation:
    given = {"build": lambda options: METHOD, "parameters": lambda *columns: ()}
    return Implementation(**given | changes)


def relaxing(relaxed: Any) -> Implementation:
    return implementation(relaxed=relaxed)


def fails(*given: Any) -> Any:
    raise KeyError("nothing")


def refuses(*given: Any) -> Any:
    raise InputError("[made] key: is too large")


def test_valid_plugin_method_is_registered_and_built(monkeypatch: pytest.MonkeyPatch) -> None:
    found = of_package(monkeypatch)
    assert found.broken == {} and list(found.methods) == ["made"]
    built = found.methods["made"](None)
    assert built.init(None, None) is None and built.close is None


HERE = f"in {__file__}:{fails.__code__.co_firstlineno + 1}"


@pytest.mark.parametrize(
    ("call", "changes", "what"),
    [
        ("load", {"load": fails}, f"load: KeyError: 'nothing', {HERE}"),
        ("load", {"load": lambda: None}, "load: gave nothing, not a sinsjax.methods."),
        ("build", {"load": lambda: implementation(build=fails)}, "build: KeyError"),
        ("build", {"load": lambda: implementation(build=lambda o: 1)}, "build: gave a number, not"),
        (
            "build",
            {"load": lambda: implementation(build=lambda o: METHOD._replace(limit=3))},
            "build: gave a Method whose limit is a number, not a function, in ",
        ),
        (
            "build",
            {"load": lambda: implementation(build=lambda o: METHOD._replace(init=None))},
            "build: gave a Method whose init is nothing, not a function, in ",
        ),
        (
            "build",
            {"has_error_step": True},
            "build: gave a Method without error_step, but has_error_step is True, in ",
        ),
        ("parameters", {"load": lambda: implementation(parameters=fails)}, "parameters: KeyError"),
        ("check", {"load": lambda: implementation(check=fails)}, "check: KeyError"),
        ("rule", {"rules": (fails,)}, "rules: KeyError"),
        ("load", {"load": lambda: relaxing({})}, "load: relaxed: gave a dict, not a sinsjax."),
        (
            "load",
            {"load": lambda: relaxing(Relaxed({"lag_s": None}))},
            "load: relaxed.changes['lag_s']: must be callable, not None",
        ),
        (
            "load",
            {"load": lambda: relaxing(Relaxed({"phi_u0_deg": fails}))},
            "load: relaxed: the method reads no key 'phi_u0_deg'",
        ),
        ("limit", {}, "limit: gave nothing, not a sinsjax.methods.limits.Limit, in "),
    ],
)
def test_failing_plugin_function_is_named_in_error(
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


def one_too_few(state: Any) -> Any:
    return state


def two(state: Any, n: Any) -> Any:
    return state


class Called:
    def __call__(self, state: Any) -> Any:
        return state


TOO_FEW, TOO_MANY = (f"TypeError: {f.__name__}() " for f in (one_too_few, two))


@pytest.mark.parametrize(
    ("function", "written", "what"),
    [
        (partial(one_too_few, 1), one_too_few, TOO_FEW),
        (partial(partial(two)), two, TOO_MANY),
        (two, two, TOO_MANY),
        (jax.jit(lambda state: state), None, "gave a number, not a sinsjax.types.Quat"),
        (Called(), Called.__call__, "gave a number, not a sinsjax.types.Quat"),
        (partial(lambda n, state: jnp.ones(4), 1), None, "gave an array of shape (4,), not a sin"),
        (lambda state: state.q, None, "AttributeError: array or number has no attribute q"),
        (lambda state: [*state], None, "TypeError: iteration over a 0-d array"),
    ],
)
def test_plugin_error_points_to_line_of_wrapped_function(
    monkeypatch: pytest.MonkeyPatch, function: Any, written: Any, what: str
) -> None:
    """Bound to numbers, called with others than it takes, or traced."""
    made = METHOD._replace(attitude=function)
    load = implementation(build=lambda options: made)
    attitude = of_package(monkeypatch, load=lambda: load).methods["made"](None).attitude
    with pytest.raises(InputError) as caught:
        jax.vmap(attitude)(np.ones(3))
    assert str(caught.value).startswith(f"method 'made': attitude: {what}")
    line = r"\d+" if written is None else written.__code__.co_firstlineno
    assert re.search(rf", in {__file__}:{line}$", str(caught.value))


def test_unknown_key_in_plugin_parameters_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    columns = Variants(small_study(), np.zeros(1, int))
    for key in ("gain", "compass_time_s"):

        def parameters(columns: Any, site: Any, ug: float, key: str = key) -> Any:
            return columns.column(key)

        load = implementation(parameters=parameters)
        method = of_package(monkeypatch, load=lambda load=load: load).methods["made"]
        with pytest.raises(InputError) as caught:
            method.implementation.parameters(columns, None, 1.0)
        why = f"no section of the method, or of the study, has a key '{key}'"
        line = parameters.__code__.co_firstlineno + 1
        assert str(caught.value) == f"method 'made': parameters: {why}, in {__file__}:{line}"


def test_input_error_of_plugin_passes_unchanged(monkeypatch: pytest.MonkeyPatch) -> None:
    method = of_package(monkeypatch, rules=(refuses,)).methods["made"]
    with pytest.raises(InputError, match=r"^\[made\] key: is too large$"):
        method.rules[0](None)


def test_entry_point_named_unlike_its_method_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    found = of_package(monkeypatch, name="other")
    assert found.methods == {}
    assert found.broken["other"].endswith("its method is called 'made' (give both one name)")


class Plain(BaseModel):
    lag_s: float = 1.0


class Unpaired(Section):
    exclusive: ClassVar[Any] = ("lag_s", "delay_s")


class Unconditional(Section):
    conditions: ClassVar[Any] = (("lag_s",),)


class Right(Section):
    lag_s: Seconds = 1.0
    delay_s: Annotated[Seconds | None, KeyInfo(default=2.0)] = None
    limit_s: Seconds
    kind: Literal["one", "two"] = "one"
    times_s: tuple[Seconds, ...] = (1.0, 2.0)


def with_default(kind: Any, value: Any) -> dict[str, Any]:
    made = create_model("Made", __base__=Section, lag_s=(kind, value))
    return {"sections": {"lagged": made}}


def test_valid_section_defaults_are_accepted(monkeypatch: pytest.MonkeyPatch) -> None:
    assert of_package(monkeypatch, sections={"lagged": Right}).broken == {}


@pytest.mark.parametrize(
    ("kind", "value", "what"),
    [
        (Annotated[str, Field(description="its name")], 10.0, "must be text, not 10.0"),
        (Seconds, "ten", "must be a number, not 'ten'"),
        (Seconds, -10.0, "must be greater than 0, not -10.0"),
        (Seconds, 1e10, "must be within the usual 1e-09 to 1e+08, not 10000000000.0"),
        (Seconds, None, "must be a number, not None"),
        (Annotated[Seconds, Field(description="lag, s")], True, "must be a number, not True"),
        (Annotated[Seconds | None, KeyInfo(default="ten")], None, "must be a number, not 'ten'"),
        (float, np.inf, "must be finite, not inf"),
        (
            Annotated[float, AfterValidator(lambda value: fails())],
            1.0,
            f"KeyError: 'nothing', {HERE}",
        ),
    ],
)
def test_invalid_section_default_is_refused(
    monkeypatch: pytest.MonkeyPatch, kind: Any, value: Any, what: str
) -> None:
    found = of_package(monkeypatch, **with_default(kind, value))
    where = "entry point 'made' in sinsjax.methods: [lagged] default of lag_s"
    assert found.methods == {} and found.broken == {"made": f"{where}: {what}"}


@pytest.mark.parametrize(
    ("changes", "what"),
    [
        ({"sections": {"lagged": dict}}, "sections['lagged']: must be a subclass of Section, not"),
        ({"sections": {"lagged": Plain}}, "sections['lagged']: must be a subclass of Section, not"),
        ({"sections": ("lagged",)}, "sections: must be a valid dictionary, not ['lagged']"),
        ({"sections": {"lagged": Unpaired}}, "[lagged] exclusive[0]: must be a tuple, not 'lag_s'"),
        ({"sections": {"lagged": Unconditional}}, "[lagged] conditions[0]"),
        ({"reads": "phi_u0_deg"}, "reads: must be a tuple, not 'phi_u0_deg'"),
        ({"silent": (1,)}, "silent[0]: must be text, not 1"),
        (
            {"reads": ("phi_u0_deg",), "silent": ("phi_u_deg",)},
            "silent: 'phi_u_deg' is in none of its sections, nor in reads (did you mean phi_u0_deg",
        ),
        ({"gyro_bias_keys": (("a_deg", "b_deg"),)}, "gyro_bias_keys: 'a_deg' is in none of its s"),
        ({"step_s": "fast"}, "step_s: must be a number, not 'fast'"),
        ({"step_s": 0.0}, "step_s: must be above 0"),
        ({"load": None}, "load: must be callable, not None"),
        ({"rules": (None,)}, "rules[0]: must be callable, not None"),
    ],
)
def test_description_with_invalid_fields_is_refused(
    monkeypatch: pytest.MonkeyPatch, changes: dict[str, Any], what: str
) -> None:
    made = described()
    for field, value in changes.items():  # which the types of this test run do not let be given
        object.__setattr__(made, field, value)
    found = brought(monkeypatch, point(lambda: made))
    assert found.methods == {} and "\n" not in found.broken["made"]
    assert found.broken["made"].startswith(f"entry point 'made' in sinsjax.methods: {what}")


def test_plugin_module_that_exits_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    found = brought(monkeypatch, point(exits))
    where = f"in {__file__}:{exits.__code__.co_firstlineno + 1}"
    assert found.broken["made"].endswith(f"cannot be loaded (SystemExit: 3, {where})")


@pytest.mark.parametrize("value", ["made-of.description:MADE", "made.description:MADE:x y", ""])
def test_malformed_entry_point_is_reported_and_others_load(
    monkeypatch: pytest.MonkeyPatch, value: str
) -> None:
    """What its module is cannot be asked, and other methods stay."""
    others = EntryPoint("bad", value, "sinsjax.methods"), point(described)
    found = brought(monkeypatch, *others)
    assert [*found.methods] == ["made"]
    form = "no package.module:NAME, of letters, digits and _"
    why = f"cannot be loaded ({value!r} is {form})"
    assert found.broken == {"bad": f"entry point 'bad' in sinsjax.methods: {why}"}


def exits() -> Any:
    raise SystemExit(3)


def test_built_in_method_is_kept_over_plugin_of_same_name(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever others bring under its name, even if that cannot be loaded."""
    own = described()
    others = point(described, package="one"), point(exits, package="other")
    found = brought(monkeypatch, *others, built_in=[own])
    assert found.methods == {"made": own} and found.packages == {}
    told = (
        f"entry point 'made' in sinsjax.methods of {name} 1.0: there is already a method 'made'"
        for name in ("one", "other")
    )
    assert found.broken == {"made": "; ".join(told)}
    monkeypatch.setattr(loading, "BROKEN", found.broken)
    monkeypatch.setattr(loading, "METHODS", found.methods)
    loading._check_methods_usable({"alignment": {"method": "made"}})


def test_two_plugins_with_same_method_name_are_both_reported(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    others = point(described, package="one"), point(described, package="other")
    found = brought(monkeypatch, *others, built_in=[described(name="own")])
    assert list(found.methods) == ["own"]
    told = "of one 1.0 and of other 1.0: each brings a method of this name (uninstall all but one)"
    assert found.broken == {"made": f"entry point 'made' in sinsjax.methods {told}"}


class Two(NamedTuple):
    x: Any
    y: Any


ONE = np.float64(1)


def no_field(state: Any) -> Any:
    return state._replace(nav=1)


@pytest.mark.parametrize(
    ("name", "function", "given", "what"),
    [
        ("attitude", lambda s: (1.0,) * 4, (1,), "gave a tuple, not a sinsjax.types.Quat"),
        (
            "attitude",
            lambda s: Quat((1.0, 2.0), 0.0, 0.0, 0.0),
            (1,),
            "gave attitude.w[0], not attitude.w",
        ),
        (
            "attitude",
            lambda s: Quat(np.ones(3), 0.0, 0.0, 0.0),
            (1,),
            "gave attitude.w of shape (3,), not ()",
        ),
        (
            "covariance",
            lambda s: (0.0,) * 6,
            (1,),
            "gave a tuple, not a sinsjax.methods.base.AttitudeCovariance",
        ),
        (
            "normalise",
            lambda s: (s.x, s.y),
            (Two(ONE, ONE),),
            "gave state[0], not state.x, unlike the state that it was given",
        ),
        (
            "step",
            lambda p, site, s, sample, n: Two(s.x, np.int32(1)),
            (1, 1, Two(ONE, ONE), 1, 1),
            "gave state.y of type int32, not float64, unlike the state that it was given",
        ),
        (
            "turn",
            lambda p, site, s: Two(s.x, (s.y, s.y)),
            (1, 1, Two(ONE, ONE)),
            "gave state.y[0], not state.y, unlike the state that it was given",
        ),
        (
            "close",
            lambda p, s, n: [s[0]],
            (1, [ONE, ONE], 1),
            "gave no state[1], unlike the state that it was given",
        ),
        (
            "close",
            lambda p, s, n: [s[0], s[1], n],
            (1, (ONE, ONE), 1),
            "gave state[2] too, unlike the state that it was given",
        ),
        (
            "begin_after",
            lambda s, n: [*s],
            ((ONE, ONE), 1),
            "gave state in other containers (a list for a tuple, say), unlike the state that it was"
            " given",
        ),
        ("normalise", no_field, (Two(1, 1),), "ValueError: Got unexpected field names: ['nav']"),
    ],
)
def test_wrong_plugin_return_value_is_reported_with_place(
    monkeypatch: pytest.MonkeyPatch, name: str, function: Any, given: Any, what: str
) -> None:
    made = METHOD._replace(**{name: function})
    load = implementation(build=lambda options: made)
    method = of_package(monkeypatch, load=lambda: load).methods["made"]
    with pytest.raises(InputError) as caught:
        getattr(method(None), name)(*given)
    line = function.__code__.co_firstlineno + (function is no_field)
    assert str(caught.value) == f"method 'made': {name}: {what}, in {__file__}:{line}"


@pytest.mark.parametrize(
    ("change", "what"),
    [
        (lambda params, *given: params.x, "gave one number or array, without numbers.x, unlike"),
        (lambda params, *given: params._replace(x=None), "gave numbers.y, not numbers.x, unlike"),
        (lambda params, *given: Two(ONE, np.ones(2)), "gave numbers.y of shape (2,), not (), unl"),
        (lambda params, value: params, "TypeError: "),
    ],
)
def test_relaxed_change_returning_other_structure_is_reported(
    monkeypatch: pytest.MonkeyPatch, change: Any, what: str
) -> None:
    made = relaxing(Relaxed({"lag_s": change}))
    method = of_package(monkeypatch, reads=("lag_s",), load=lambda: made).methods["made"]
    with pytest.raises(InputError) as caught:
        method.implementation.relaxed.changes["lag_s"](Two(ONE, ONE), None, 2.0, 1.0)
    assert str(caught.value).startswith(f"method 'made': relaxed.changes['lag_s']: {what}")


def test_relaxed_change_may_turn_integer_into_float(monkeypatch: pytest.MonkeyPatch) -> None:
    made = relaxing(Relaxed({"lag_s": lambda params, entry, value, base: params * value / base}))
    method = of_package(monkeypatch, reads=("lag_s",), load=lambda: made).methods["made"]
    assert method.implementation.relaxed.changes["lag_s"](np.int64(3), None, 1.0, 2.0) == 1.5


def test_plain_number_in_state_may_become_float(monkeypatch: pytest.MonkeyPatch) -> None:
    """A plain number of a state becomes what the first step makes of it."""
    made = METHOD._replace(normalise=lambda state: Two(ONE, state.y))
    load = implementation(build=lambda options: made)
    method = of_package(monkeypatch, load=lambda: load).methods["made"]
    assert method(None).normalise(Two(0, ONE)) == Two(ONE, ONE)


@pytest.mark.parametrize("leaf", [np.ones(7), np.ones(1), 1.0, np.ones((3, 2))])
def test_plugin_parameters_need_one_value_per_variant(
    monkeypatch: pytest.MonkeyPatch, leaf: Any
) -> None:
    columns = SimpleNamespace(count=2)

    def parameters(leaf: Any) -> Any:
        load = implementation(parameters=lambda *given: Two(np.ones((2, 3)), leaf))
        method = of_package(monkeypatch, load=lambda: load).methods["made"]
        return method.implementation.parameters(columns, None, 1.0)

    assert parameters(np.ones(2)).y.shape == (2,) and parameters(None).y is None
    with pytest.raises(InputError) as caught:
        parameters(leaf)
    text = f"gave numbers.y of shape {np.shape(leaf)}, not (2, ...): one a variant, in {__file__}:"
    assert str(caught.value).startswith(f"method 'made': parameters: {text}")
