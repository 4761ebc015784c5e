"""Alignment methods of other installed packages, found by their entry points. Free of JAX.

A package names its `Description` in its ``pyproject.toml``:

    [project.entry-points."sinsjax.methods"]
    my_method = "my_package.config:MY_METHOD"

A plug-in that cannot be loaded affects only the studies that use it. An error of its code is
reported in one line with the place in that code, see `describe_plugin_error`.
"""

import inspect
import traceback
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import partial
from importlib.metadata import EntryPoint
from importlib.util import find_spec
from typing import Any, NamedTuple

from sinsjax.errors import InputError
from sinsjax.messages import first_error_line, shorten
from sinsjax.methods.description import Description
from sinsjax.platform import runtime
from sinsjax.value_types import Section


class PluginRegistry(NamedTuple):
    """All methods, and the state of the plug-ins.

    Attributes:
        methods: usable methods by name, the built-in ones first.
        sections: their sections of a study file, by name.
        packages: package and version of each method of a plug-in, by name.
        broken: reason in one line why a plug-in cannot be used, by the name of its entry point.
    """

    methods: dict[str, Description]
    sections: dict[str, type[Section]]
    packages: dict[str, tuple[str, str]]
    broken: dict[str, str]

    def label(self, name: str) -> str:
        """Return the name of a plug-in's method with its package, for messages."""
        return f"method {name!r} of {' '.join(self.packages[name])}"


def load_plugins(built_in: Iterable[Description]) -> PluginRegistry:
    """Return the built-in methods and those of plug-ins; none replaces another."""
    registry = PluginRegistry({}, {}, {}, {})
    for method in built_in:
        registry.methods[method.name] = method
        registry.sections.update(method.sections)
    for point in runtime.method_entry_points():
        try:
            method = _load_plugin(point, registry)
        except (Exception, SystemExit) as error:  # anything that the code of others raises
            reason = str(error)
            if not isinstance(error, InputError):
                reason = f"cannot be loaded ({_describe_error(error, point)})"
            source = f"entry point {point.name!r} in {point.group}{_package_label(point)}"
            registry.broken[point.name] = f"{source}: {reason}"
            continue
        registry.methods[method.name] = method
        registry.sections.update(method.sections)
        if point.dist is not None:
            registry.packages[method.name] = point.dist.name, point.dist.version
    return registry


def _load_plugin(point: EntryPoint, registry: PluginRegistry) -> Description:
    """Return the method of an entry point, whose name, sections and keys must be new."""
    if point.name in registry.methods:
        raise InputError(f"there is already a method {point.name!r}")
    method = point.load()
    if not isinstance(method, Description):
        kind, expected = type(method).__name__, f"{Description.__module__}.Description"
        raise InputError(f"{point.value} is of type {kind}, expected {expected}")
    if method.name != point.name:
        raise InputError(f"its method is called {method.name!r} (give both one name)")
    if not all(issubclass(section, Section) for section in method.sections.values()):
        raise InputError(f"its sections must be subclasses of {Section.__module__}.Section")
    if clash := _find_clash(method, registry.sections):
        raise InputError(clash)
    return method


def exclude_clashing(registry: PluginRegistry, common: Mapping[str, type[Section]]) -> None:
    """Make plug-ins unusable that have a section or key of every study.

    Args:
        registry: all methods; changed in place.
        common: sections of every study, by name.
    """
    for name in list(registry.packages):
        if clash := _find_clash(registry.methods[name], common):
            registry.broken[name] = f"{registry.label(name)}: {clash}"
            del registry.methods[name], registry.packages[name]
    used = {name for method in registry.methods.values() for name in method.sections}
    for name in registry.sections.keys() - used:
        del registry.sections[name]


def _find_clash(method: Description, taken: Mapping[str, type[Section]]) -> str | None:
    """Return the first section or key of a method that others have, in words."""
    for name, section in method.sections.items():
        for other, existing in taken.items():
            if existing is section:  # methods may share a section as a whole
                continue
            if name == other:
                return f"there is already a section [{name}]"
            if keys := sorted(section.model_fields.keys() & existing.model_fields.keys()):
                return f"[{name}] {keys[0]} is a key of [{other}]"
    return None


def check_plugin(
    name: str,
    description: Description,
    method: Any,
    params: Any,
    site: Any,
    *,
    repeats: bool = False,
    rewinds: bool = False,
) -> None:
    """Check the shapes of a plug-in's functions without running them (`jax.eval_shape`).

    Args:
        name: of the plug-in's method, with its package, for the message.
        description: of the method.
        method: the `base.Method` that it builds.
        params: of one run, leaves (...).
        site: `base.Site` of one run.
        repeats: whether a stored record is read repeatedly.
        rewinds: whether it is read forward every time.

    Raises:
        InputError: ``step``, ``normalise`` or ``close`` returns another state than ``init``;
            ``attitude`` or ``covariance`` is of another kind; or the method has no ``passes`` for a
            record that is read repeatedly.
    """
    import jax
    import numpy as np

    from sinsjax.methods.base import AttitudeCovariance
    from sinsjax.types import Navigation, Quat, Sample, Vec3

    number = np.float64(0.0)
    q = Quat(*(number,) * 4)
    nav, sample = Navigation(q, *(number,) * 4), Sample(q, Vec3(*(number,) * 3))
    state = jax.eval_shape(method.init, params, nav)
    changes: list[tuple[str, Callable[..., Any], tuple[Any, ...]]] = [
        ("step", method.step, (params, site, state, sample, number)),
        ("normalise", method.normalise, (state,)),
    ]
    if method.feedback is not None:
        changes.append(("close", method.feedback.close, (params, state, number)))
    for what, function, given in changes:
        if wrong := [*_differences(jax.eval_shape(function, *given), state)]:
            text = f"{what} returns the state {'; '.join(wrong[:2])}"
            more = f"; and {len(wrong) - 2} more" if len(wrong) > 2 else ""
            raise InputError(f"{name}: {text}{more}{_place_of(function)}")
    for what, kind in (("attitude", Quat), ("covariance", AttitudeCovariance)):
        function = getattr(method, what)
        found = jax.eval_shape(function, state)
        if not isinstance(found, kind) or any(np.shape(leaf) for leaf in found):
            text = f"{what} returns {_format_shapes(found)}, expected {kind.__name__} of numbers"
            raise InputError(f"{name}: {text}{_place_of(function)}")
    if repeats and method.passes is None:
        raise InputError(f"{name}: reads a stored record once (drop [passes])")
    if rewinds and method.passes.rewind is None:
        raise InputError(f"{name}: cannot rewind a record (use direction = 'alternate')")


def check_parameters(name: str, function: Any, params: Any, variants: int) -> None:
    """Check that each of a plug-in's params has one value per variant.

    Args:
        name: of the plug-in's method, with its package, for the message.
        function: its ``parameters``.
        params: what it returns for some variants.
        variants: their number.

    Raises:
        InputError: an array is of another length, or not of numbers.
    """
    import jax
    import numpy as np

    for path, array in jax.tree.leaves_with_path(jax.tree.map(np.asarray, params)):
        if array.shape[:1] != (variants,) or array.dtype.kind not in "biuf":
            at = f" at {jax.tree_util.keystr(path)}" if path else ""
            text = f"parameters returns {_format_shapes(array)}{at}, expected [{variants}, ...]"
            raise InputError(f"{name}: {text}: one value per variant{_place_of(function)}")


def describe_plugin_error(error: BaseException) -> str | None:
    """Return one line on an error of a plug-in's code, None if the error is not of such code.

    The line names method, package, kind of error, file and line.
    """
    for point in runtime.method_entry_points():
        if _last_place(error, point):
            return f"method {point.name!r}{_package_label(point)}: {_describe_error(error, point)}"
    return None


def _package_label(point: EntryPoint) -> str:
    return f" of {point.dist.name} {point.dist.version}" if point.dist else ""


def _describe_error(error: BaseException, point: EntryPoint) -> str:
    return f"{type(error).__name__}: {first_error_line(error)}{_last_place(error, point)}"


def _last_place(error: BaseException, point: EntryPoint) -> str:
    """Return the last place of a traceback in a plug-in's code, as ``, in file:line``."""
    folders = _package_folders(point)
    frames = traceback.extract_tb(error.__traceback__)
    inside = [frame for frame in frames if frame.filename.startswith(folders)]
    return f", in {inside[-1].filename}:{inside[-1].lineno}" if inside else ""


def _package_folders(point: EntryPoint) -> tuple[str, ...]:
    """Return the folders of a package's code, without importing it."""
    try:
        spec = find_spec(point.module.partition(".")[0])
    except (AttributeError, ImportError, ValueError):
        return ()
    if spec is None:
        return ()
    folders = spec.submodule_search_locations
    return tuple(f"{folder}/" for folder in folders) if folders else (str(spec.origin),)


def _place_of(function: Any) -> str:
    """Return the place of a function's definition, as ``, in file:line``."""
    while isinstance(function, partial):
        function = function.func
    code = getattr(inspect.unwrap(function), "__code__", None)
    return f", in {code.co_filename}:{code.co_firstlineno}" if code else ""


def _differences(found: Any, expected: Any, path: str = "") -> Iterator[str]:
    """Yield the innermost parts of a tree of shapes that differ from those expected, in words."""
    texts = _format_shapes(found), _format_shapes(expected)
    if texts[0] == texts[1]:
        return
    parts, others = _parts(found), _parts(expected)
    if type(found) is type(expected) and parts.keys() == others.keys() and parts:
        for name, part in parts.items():
            yield from _differences(part, others[name], f"{path}.{name}" if path else name)
    else:
        prefix = f"with {path} = " if path else ""
        yield f"{prefix}{shorten(texts[0], 60)}, expected {shorten(texts[1], 60)}"


def _parts(tree: Any) -> dict[str, Any]:
    """Return the parts of a tuple, list or dictionary by name or number."""
    if isinstance(tree, dict):
        return {str(key): part for key, part in tree.items()}
    if isinstance(tree, list | tuple):
        names = getattr(tree, "_fields", range(len(tree)))
        return {str(name): part for name, part in zip(names, tree, strict=True)}
    return {}


def _format_shapes(tree: Any) -> str:
    """Return a tree of shapes on one line."""
    import jax

    return str(jax.tree.map(lambda leaf: f"{leaf.dtype}{list(leaf.shape)}", tree)).replace("'", "")
