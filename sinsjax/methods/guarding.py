"""A method of another package, guarded: what its code raises, or gives amiss, is one line.

Free of JAX until the method is loaded.
"""

import functools
import inspect
import re
import sysconfig
import traceback
from collections.abc import Callable
from dataclasses import replace
from importlib.metadata import EntryPoint
from importlib.util import find_spec
from pathlib import Path
from typing import Any, get_type_hints

from pydantic import ConfigDict, TypeAdapter, ValidationError

from sinsjax.errors import InputError
from sinsjax.messages import explain_error, first_error_line, to_one_line
from sinsjax.methods.description import Description, Implementation

_CONFIG = ConfigDict(strict=True, arbitrary_types_allowed=True, allow_inf_nan=False)

_NOT_THEIRS = (
    *(f"{folder}/" for folder in (Path(__file__).parents[1], sysconfig.get_path("stdlib"))),
    *("/site-packages/", "/dist-packages/", "/jax/", "/pydantic/", "<"),
)
"""In the paths of code that calls a package's own, or is called by it."""

_STUDIES = f"{Path(__file__).parents[1] / 'study'}/"
"""Where a key is looked up that a method asks for."""

_TRACER = re.compile(r"\b\w+Tracer\b")
"""What JAX calls the numbers that it traces."""

_STATES = {"step": 2, "turn": 2, "normalise": 0, "close": 1, "begin_after": 0, "rewind": 2}
"""Functions of a `Method` that give the state which they are given, and its place among these."""


def guarded(method: Description, point: EntryPoint) -> Description:
    """A method whose failures are told in one line, which names the package and the place."""
    guard = functools.partial(_guard, f"method {method.name!r}{of_package(point)}", point)

    def load() -> Implementation:
        from sinsjax.methods.base import AttitudeCovariance
        from sinsjax.methods.limits import Limit
        from sinsjax.types import Quat, Vec3

        made = guard("load", method.load, _loadable(method.keys))()
        build = guard("build", made.build, _buildable(method.has_error_step))
        given = {
            "attitude": _as("attitude", Quat(*(0.0,) * 4)),
            "covariance": _as("covariance", AttitudeCovariance(*(0.0,) * 6)),
            "limit": _as("limit", Limit(Vec3(*(0.0,) * 3), 0.0, 0.0)),
        }
        given |= {name: _as_given(place) for name, place in _STATES.items()}

        def built(options: Any) -> Any:
            found = build(options)
            return found._replace(
                **{
                    field: guard(field, value, given.get(field))
                    for field, value in found._asdict().items()
                    if callable(value)
                }
            )

        return made._replace(
            build=built,
            parameters=guard("parameters", made.parameters, _one_each),
            check=guard("check", made.check),
            relaxed=made.relaxed and _relaxed(guard, made.relaxed),
        )

    columns = (
        own._replace(value=guard("columns", own.value), where=guard("columns", own.where))
        for own in method.columns
    )
    return replace(
        method,
        load=load,
        rules=tuple(guard("rules", rule) for rule in method.rules),
        columns=tuple(columns),
        last_called=guard("last_called", method.last_called),
    )


def _relaxed(guard: Callable[..., Any], relaxed: Any) -> Any:
    """How numbers follow keys, each function guarded."""
    changes = {
        key: guard(f"relaxed.changes[{key!r}]", change, _like_numbers)
        for key, change in relaxed.changes.items()
    }
    return relaxed._replace(
        changes=changes,
        soften=relaxed.soften and guard("relaxed.soften", relaxed.soften),
        refused=guard("relaxed.refused", relaxed.refused),
    )


def of_package(point: EntryPoint) -> str:
    """The package of an entry point and its version, after a word; empty where it has none."""
    return f" of {point.dist.name} {point.dist.version}" if point.dist else ""


def what(
    error: BaseException, point: EntryPoint, function: Callable[..., Any] | None = None
) -> str:
    """An error in one line, with the last place in the package's own code.

    Args:
        error: that was raised.
        point: entry point of the package.
        function: that was called; its beginning is told where no place is, as of wrong arguments.
    """
    frames = traceback.extract_tb(error.__traceback__)
    own = [f for f in frames if f.filename.startswith(_folders(point))]
    own = own or [f for f in frames if not any(one in f.filename for one in _NOT_THEIRS)]
    place = f", in {own[-1].filename}:{own[-1].lineno}" if own else defined(function)
    if isinstance(error, KeyError) and frames and frames[-1].filename.startswith(_STUDIES):
        return f"no section of the method, or of the study, has a key {error}{place}"
    said = _TRACER.sub("array or number", first_error_line(error))
    return f"{type(error).__name__}: {said}{place}"


def _folders(point: EntryPoint) -> tuple[str, ...]:
    """Where the code of a package lies; nothing is imported to find out."""
    try:
        found = find_spec(point.module.partition(".")[0])
    except (ImportError, ValueError):
        found = None
    if found is None:
        return ()
    folders = found.submodule_search_locations
    return tuple(f"{folder}/" for folder in folders) if folders else (str(found.origin),)


Check = Callable[[Any, tuple[Any, ...]], str | None]
"""(what a function gave, its arguments) -> what is wrong with it, in words; None if nothing is."""


def _guard(
    whose: str,
    point: EntryPoint,
    name: str,
    function: Callable[..., Any],
    check: Check | None = None,
) -> Any:
    """A function that raises `InputError` where it fails, or where what it gives is wrong."""

    @functools.wraps(function)
    def call(*given: Any, **named: Any) -> Any:
        try:
            found = function(*given, **named)
            wrong = check and check(found, given)
        except InputError:
            raise
        except (Exception, SystemExit) as error:  # whatever another's module raises
            raise InputError(f"{whose}: {name}: {what(error, point, function)}") from error
        if wrong:
            raise InputError(f"{whose}: {name}: {wrong}{defined(function)}")
        return found

    return call


def mistyped(field: str, value: object, kind: Any) -> str | None:
    """What is wrong with the value of a field, in words; None if it is of the type wanted."""
    try:
        TypeAdapter(kind, config=_CONFIG).validate_python(value)
    except ValidationError as error:
        first = error.errors()[0]
        where = field + "".join(f"[{part!r}]" for part in first["loc"])
        text = explain_error(first).replace(
            "must be a list", "must be a tuple"
        )  # that of a study file
        return to_one_line(f"{where}: {text}")
    return None


def defined(function: Callable[..., Any] | None) -> str:
    """Where a function begins; empty of one that is not written in Python."""
    if function is None:
        return ""
    function = inspect.unwrap(function)
    while isinstance(function, functools.partial):
        function = inspect.unwrap(function.func)
    written = function if hasattr(function, "__code__") else type(function).__call__
    code = getattr(written, "__code__", None)
    return f", in {code.co_filename}:{code.co_firstlineno}" if code else ""


# What functions should give


def _loadable(keys: frozenset[str]) -> Check:
    """An `Implementation`, and what it says of gradients: of keys that the method reads."""

    def check(found: Any, given: tuple[Any, ...]) -> str | None:
        from sinsjax.methods.base import Relaxed

        wrong = _of_type(Implementation)(found, given)
        if wrong or found.relaxed is None:
            return wrong
        relaxed = found.relaxed
        if wrong := _of_type(Relaxed)(relaxed, given):
            return f"relaxed: {wrong}"
        for field, kind in get_type_hints(Relaxed).items():
            if wrong := mistyped(f"relaxed.{field}", getattr(relaxed, field), kind):
                return wrong
        follows = (*relaxed.follows, *relaxed.follows.values())
        named = (*relaxed.changes, *follows, *relaxed.moves, *filter(None, [relaxed.times]))
        unread = next((key for key in named if key not in keys), None)
        return unread and f"relaxed: the method reads no key {unread!r}"

    return check


def _buildable(has_error_step: bool) -> Check:
    """A `Method`, with all that covariance analysis asks for where the description says so."""

    def check(found: Any, given: tuple[Any, ...]) -> str | None:
        from sinsjax.methods.base import Method

        if wrong := _of_type(Method)(found, given):
            return wrong
        for name, value in found._asdict().items():
            left_out = value is None and name in Method._field_defaults
            if not (callable(value) or left_out or name == "common_covariance"):
                return f"gave a Method whose {name} is {_called(value)}, not a function"
        if not has_error_step:
            return None
        asked = ("error_step", "error_angles", "start_error")
        lacks = next((name for name in asked if getattr(found, name) is None), None)
        return lacks and f"gave a Method without {lacks}, but has_error_step is True"

    return check


def _of_type(kind: type) -> Check:
    def check(found: Any, given: tuple[Any, ...]) -> str | None:
        if isinstance(found, kind):
            return None
        return f"gave {_called(found)}, not a {kind.__module__}.{kind.__name__}"

    return check


def _called(found: Any) -> str:
    """What something is, in words; JAX has many names for its arrays."""
    if found is None:
        return "nothing"
    if isinstance(found, int | float):
        return "a number"
    shape = getattr(found, "shape", None)
    if shape is None:
        return f"a {type(found).__name__}"
    return f"an array of shape {tuple(shape)}" if shape else "a number"


def _as(name: str, like: Any) -> Check:
    """Of the type of another value, with numbers in the same places."""
    of_type = _of_type(type(like))
    return lambda found, given: of_type(found, given) or _unlike(name, found, like)


def _as_given(place: int) -> Check:
    """The state that it was given: a loop over samples takes no other."""

    def check(found: Any, given: tuple[Any, ...]) -> str | None:
        wrong = _unlike("state", found, given[place])
        return wrong and f"{wrong}, unlike the state that it was given"

    return check


def _like_numbers(found: Any, given: tuple[Any, ...]) -> str | None:
    """The numbers that it was given, changed: whole ones may have become real ones."""
    wrong = _unlike("numbers", found, given[0], types=False)
    return wrong and f"{wrong}, unlike the numbers that it was given"


def _one_each(found: Any, given: tuple[Any, ...]) -> str | None:
    """A number, or an array, a variant in each leaf."""
    import jax
    import numpy as np

    count = given[0].count
    for path, leaf in jax.tree_util.tree_leaves_with_path(found):
        if np.shape(leaf)[:1] != (count,):
            return (
                f"gave {place('numbers', path)} of shape {np.shape(leaf)}, not ({count}, ...): one"
                " a variant"
            )
    return None


def _unlike(name: str, found: Any, like: Any, *, types: bool = True) -> str | None:
    """How numbers differ in place, shape or type from those that they should be like."""
    import jax

    have, want = (jax.tree_util.tree_leaves_with_path(tree) for tree in (found, like))
    for (path, leaf), (wanted, model) in zip(have, want, strict=False):
        if path != wanted and not path:
            return f"gave one number or array, without {place(name, wanted)}"
        if path != wanted:
            return f"gave {place(name, path)}, not {place(name, wanted)}"
        one, other = jax.typeof(leaf), jax.typeof(model)
        if one.shape != other.shape:
            return f"gave {place(name, path)} of shape {one.shape}, not {other.shape}"
        if types and one.dtype != other.dtype and not other.weak_type:
            return f"gave {place(name, path)} of type {one.dtype}, not {other.dtype}"
    if len(have) > len(want):
        return f"gave {place(name, have[len(want)][0])} too"
    if len(have) < len(want):
        return f"gave no {place(name, want[len(have)][0])}"
    if jax.tree.structure(found) != jax.tree.structure(like):
        return f"gave {name} in other containers (a list for a tuple, say)"
    return None


def place(name: str, path: Any) -> str:
    """A leaf of a tree by the way to it, as ``numbers.kept``."""
    import jax

    return name + jax.tree_util.keystr(path)
