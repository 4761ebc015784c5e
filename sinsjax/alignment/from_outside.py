"""Methods that other installed packages bring, by entry points. Free of JAX.

A package says in its ``pyproject.toml`` where its `Description` stands:

    [project.entry-points."sinsjax.methods"]
    my_method = "my_package.description:MY_METHOD"

What is wrong with one concerns the studies that use it, and no others.
"""

import functools
import traceback
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any, NamedTuple

from sinsjax.alignment.description import Description, Implementation
from sinsjax.errors import InputError
from sinsjax.messages import first_line
from sinsjax.platform import runtime

_NOT_THEIRS = (str(Path(__file__).parents[1]), "/jax/", "/pydantic/", "/importlib/", "<")
"""In the paths of code that calls a package's own, or is called by it."""


class Brought(NamedTuple):
    """Every method, and what came of entry points.

    Attributes:
        methods: by name, those of this package and those of others after them.
        packages: of a method from outside, its package and that one's version, by name.
        broken: why a method cannot be used, in a line, by name or, where it has none, by that of
            its entry point.
    """

    methods: dict[str, Description]
    packages: dict[str, tuple[str, str]]
    broken: dict[str, str]


def with_those_from_outside(built_in: Iterable[Description]) -> Brought:
    """Every method that can be used, and what is wrong with others."""
    methods = {method.name: method for method in built_in}
    brought = Brought(methods, {}, {})
    for point in runtime.method_entry_points():
        try:
            method = _loaded(point)
            if method.name in methods:
                raise InputError(f"{_named(point)}: there is already a method {method.name!r}")
            if method.name != point.name:
                raise InputError(
                    f"{_named(point)}: its method is called {method.name!r} (give both one name)"
                )
            for name, section in method.sections.items():
                _check_section(point, name, section.model_fields, methods)
        except InputError as error:
            brought.broken[point.name] = str(error)
            continue
        methods[method.name] = _guarded(method, point)
        if point.dist is not None:
            brought.packages[method.name] = point.dist.name, point.dist.version
    return brought


def _check_section(
    point: EntryPoint, name: str, keys: Mapping[str, object], methods: Mapping[str, Description]
) -> None:
    """Refuse keys of another section; methods may share a section as a whole."""
    others = {
        other: section
        for method in methods.values()
        for other, section in method.sections.items()
        if section.model_fields is not keys
    }
    if name in others:
        raise InputError(f"{_named(point)}: section [{name}] is that of another method")
    for other, section in others.items():
        if taken := sorted(keys & section.model_fields.keys()):
            raise InputError(f"{_named(point)}: key {taken[0]} is one of section [{other}]")


def _loaded(point: EntryPoint) -> Description:
    try:
        method = point.load()
    except Exception as error:  # whatever another's module raises
        raise InputError(f"{_named(point)}: cannot be loaded ({_what(error)})") from error
    if not isinstance(method, Description):
        what = f"{point.value} is a {type(method).__name__}"
        raise InputError(f"{_named(point)}: {what}, no sinsjax.alignment.description.Description")
    return method


def _named(point: EntryPoint) -> str:
    of = f" of {point.dist.name} {point.dist.version}" if point.dist else ""
    return f"entry point {point.name!r} in {point.group}{of}"


# What a package's own code raises or gives


def _guarded(method: Description, point: EntryPoint) -> Description:
    """A method whose failures are told in one line, which names the package and the place."""
    of = f" of {point.dist.name} {point.dist.version}" if point.dist else ""

    def guard(name: str, function: Callable[..., Any], kind: type | None = None) -> Any:
        @functools.wraps(function)
        def call(*given: Any, **named: Any) -> Any:
            try:
                found = function(*given, **named)
            except InputError:
                raise
            except Exception as error:  # whatever another's module raises
                what = f"method {method.name!r}{of}: {name}: {_what(error)}"
                raise InputError(what) from error
            if kind is not None and not isinstance(found, kind):
                got = f"gave a {type(found).__name__}, not a {kind.__module__}.{kind.__name__}"
                raise InputError(f"method {method.name!r}{of}: {name}: {got}")
            return found

        return call

    def load() -> Implementation:
        from sinsjax.alignment.base import Method
        from sinsjax.alignment.limits import Limit

        made = guard("load", method.load, Implementation)()
        build = guard("build", made.build, Method)

        def built(options: Any) -> Any:
            found = build(options)
            kinds = {"limit": Limit}
            return found._replace(
                **{
                    field: guard(field, value, kinds.get(field))
                    for field, value in found._asdict().items()
                    if callable(value)
                }
            )

        parameters = guard("parameters", made.parameters)
        return made._replace(build=built, parameters=parameters, check=guard("check", made.check))

    return replace(
        method,
        load=load,
        rules=tuple(guard("rules", rule) for rule in method.rules),
        last_called=guard("last_called", method.last_called),
    )


def _what(error: Exception) -> str:
    """An error in one line, with the last place in the package's own code."""
    what = f"{type(error).__name__}: {first_line(error)}"
    frames = traceback.extract_tb(error.__traceback__)
    own = [f for f in frames if not any(one in f.filename for one in _NOT_THEIRS)]
    return f"{what}, in {own[-1].filename}:{own[-1].lineno}" if own else what
