"""Methods that other installed packages bring, by entry points. Free of JAX.

A package says in its ``pyproject.toml`` where its `Description` stands:

    [project.entry-points."sinsjax.methods"]
    my_method = "my_package.description:MY_METHOD"
"""

from collections.abc import Iterable, Mapping
from importlib.metadata import EntryPoint

from sinsjax.alignment.description import Description
from sinsjax.errors import InputError
from sinsjax.platform import runtime


def with_those_from_outside(built_in: Iterable[Description]) -> dict[str, Description]:
    """Every method by name: those of this package, and those of others after them.

    Raises:
        InputError: an entry point cannot be loaded, is no `Description`, or takes a name, a section
            or a key that is taken.
    """
    methods = {method.name: method for method in built_in}
    for point in runtime.method_entry_points():
        method = _loaded(point)
        if method.name in methods:
            raise InputError(f"{_named(point)}: there is already a method {method.name!r}")
        for name, section in method.sections.items():
            _check_section(point, name, section.model_fields, methods)
        methods[method.name] = method
    return methods


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
        what = f"{type(error).__name__}: {error}"
        raise InputError(f"{_named(point)}: cannot be loaded ({what})") from error
    if not isinstance(method, Description):
        what = f"{point.value} is a {type(method).__name__}"
        raise InputError(f"{_named(point)}: {what}, no sinsjax.alignment.description.Description")
    return method


def _named(point: EntryPoint) -> str:
    of = f" of {point.dist.name} {point.dist.version}" if point.dist else ""
    return f"entry point {point.name!r} in {point.group}{of}"
