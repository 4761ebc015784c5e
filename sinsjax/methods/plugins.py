"""Methods that other installed packages bring, by entry points. Free of JAX.

A package says in its ``pyproject.toml`` where its `Description` stands:

    [project.entry-points."sinsjax.methods"]
    my_method = "my_package.description:MY_METHOD"

What is wrong with one concerns the studies that use it, and no others.
"""

import math
from collections import defaultdict
from collections.abc import Iterable, Mapping
from importlib.metadata import EntryPoint
from typing import Annotated, Any, NamedTuple, get_type_hints

from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined

from sinsjax.errors import InputError
from sinsjax.messages import suggest_closest
from sinsjax.methods.description import COMMON_KEYS, Description
from sinsjax.methods.guarding import guarded, mistyped, of_package, what
from sinsjax.platform import runtime
from sinsjax.value_types import KeyCondition, key_info


class Brought(NamedTuple):
    """Every method, and what came of entry points.

    Attributes:
        methods: by name, those of this package and those of others after them.
        packages: of a method from outside, its package and that one's version, by name.
        broken: why a method cannot be used, in a line, by name or, where it has none, by that of
            its entry point. Under the name of a method of this package, which is used all the same,
            why that of another is not.
    """

    methods: dict[str, Description]
    packages: dict[str, tuple[str, str]]
    broken: dict[str, str]


def with_those_from_outside(built_in: Iterable[Description]) -> Brought:
    """Every method that can be used, and what is wrong with others."""
    methods = {method.name: method for method in built_in}
    brought, named = Brought(methods, {}, {}), defaultdict(list)
    for point in runtime.method_entry_points():
        named[point.name].append(point)
    for name, points in named.items():
        try:
            method = _the_only(points, methods)
        except InputError as error:
            brought.broken[name] = str(error)
            continue
        methods[name] = guarded(method, points[0])
        if (package := points[0].dist) is not None:
            brought.packages[name] = package.name, package.version
    return brought


def _the_only(points: list[EntryPoint], methods: Mapping[str, Description]) -> Description:
    """The method of entry points of one name, of which there may be one."""
    point, *others = points
    if point.name in methods:
        clashes = (f"{_named(one)}: there is already a method {one.name!r}" for one in points)
        raise InputError("; ".join(clashes))
    if others:
        packages = " and".join(map(of_package, points))
        raise InputError(
            f"entry point {point.name!r} in {point.group}{packages}: each brings a method of this"
            " name (uninstall all but one)"
        )
    method = _loaded(point)
    if method.name in methods:
        raise InputError(f"{_named(point)}: there is already a method {method.name!r}")
    if method.name != point.name:
        raise InputError(
            f"{_named(point)}: its method is called {method.name!r} (give both one name)"
        )
    for name, section in method.sections.items():
        _check_section(point, name, section.model_fields, methods)
    return method


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
    if EntryPoint.pattern.match(point.value) is None:
        form = "no package.module:NAME, of letters, digits and _"
        raise InputError(f"{_named(point)}: cannot be loaded ({point.value!r} is {form})")
    try:
        method = point.load()
    except (Exception, SystemExit) as error:  # whatever another's module raises
        raise InputError(f"{_named(point)}: cannot be loaded ({what(error, point)})") from error
    if not isinstance(method, Description):
        found = f"{point.value} is a {type(method).__name__}"
        raise InputError(f"{_named(point)}: {found}, no sinsjax.methods.description.Description")
    for field, kind in get_type_hints(Description).items():
        _check_type(point, field, getattr(method, field), kind)
    for name, section in method.sections.items():
        _check_type(point, f"[{name}] exclusive", section.exclusive, tuple[tuple[str, str], ...])
        _check_type(point, f"[{name}] conditions", section.conditions, tuple[KeyCondition, ...])
        for key, of_key in section.model_fields.items():
            _check_defaults(point, f"[{name}] default of {key}", of_key)
    named = {"silent": method.silent, "gyro_bias_keys": sum(method.gyro_bias_keys, ())}
    for field, keys in named.items():
        if unknown := sorted({*keys} - method.keys - {*COMMON_KEYS}):
            hint = suggest_closest(unknown[0], sorted(method.keys))
            text = f"{unknown[0]!r} is in none of its sections, nor in reads{hint}"
            raise InputError(f"{_named(point)}: {field}: {text}")
    if not 0 < method.step_s < 1:
        raise InputError(f"{_named(point)}: step_s: must be above 0 and below 1 s")
    return method


def _check_type(point: EntryPoint, field: str, value: object, kind: Any) -> None:
    """Refuse what a description should not say: every study is read by it."""
    try:
        wrong = mistyped(field, value, kind)
    except Exception as error:  # what a validator of another's raises
        wrong = f"{field}: {what(error, point)}"
    if wrong:
        raise InputError(f"{_named(point)}: {wrong}")


def _check_defaults(point: EntryPoint, where: str, field: FieldInfo) -> None:
    """Refuse a default that no study could give: pydantic takes it as it stands."""
    info, kind = key_info(field), Annotated[field.annotation, field]
    for value in (field.get_default(), PydanticUndefined if info.default is None else info.default):
        if value is PydanticUndefined:
            continue
        _check_type(point, where, value, kind)
        low, high = info.usual or (-math.inf, math.inf)
        if isinstance(value, int | float) and not low <= value <= high:
            text = f"must be within the usual {low:g} to {high:g}, not {value!r}"
            raise InputError(f"{_named(point)}: {where}: {text}")


def _named(point: EntryPoint) -> str:
    return f"entry point {point.name!r} in {point.group}{of_package(point)}"
