"""Alignment methods of other installed packages, found by their entry points. Free of JAX.

A package names its `Description` in its ``pyproject.toml``:

    [project.entry-points."sinsjax.methods"]
    my_method = "my_package.config:MY_METHOD"

A plug-in that cannot be loaded affects only the studies that use it. An error of its code is
reported in one line with the place in that code, see `describe_plugin_error`.
"""

import traceback
from collections.abc import Iterable, Mapping
from importlib.metadata import EntryPoint
from importlib.util import find_spec
from typing import Any, NamedTuple

from sinsjax.errors import InputError
from sinsjax.messages import first_line
from sinsjax.methods.description import Description
from sinsjax.platform import runtime


class PluginRegistry(NamedTuple):
    """All methods, and the state of the plug-ins.

    Attributes:
        methods: usable methods by name, the built-in ones first.
        packages: package and version of each method of a plug-in, by name.
        broken: reason in one line why a plug-in cannot be used, by the name of its entry point.
    """

    methods: dict[str, Description]
    packages: dict[str, tuple[str, str]]
    broken: dict[str, str]


def load_plugins(built_in: Iterable[Description]) -> PluginRegistry:
    """Return the built-in methods and those of plug-ins; none replaces another."""
    registry = PluginRegistry({method.name: method for method in built_in}, {}, {})
    for point in runtime.method_entry_points():
        try:
            method = _load_plugin(point, registry.methods)
        except InputError as error:
            registry.broken[point.name] = str(error)
            continue
        registry.methods[method.name] = method
        if point.dist is not None:
            registry.packages[method.name] = point.dist.name, point.dist.version
    return registry


def _load_plugin(point: EntryPoint, methods: Mapping[str, Description]) -> Description:
    """Return the method of an entry point, whose name, sections and keys must be new."""
    source = f"entry point {point.name!r} in {point.group}{_package_label(point)}"
    if point.name in methods:
        raise InputError(f"{source}: there is already a method {point.name!r}")
    try:
        method = point.load()
    except (Exception, SystemExit) as error:  # anything that the code of others raises
        where = _last_place(error, _package_folders(point)) or ""
        raise InputError(
            f"{source}: cannot be loaded ({type(error).__name__}: {first_line(error)}{where})"
        ) from error
    if not isinstance(method, Description):
        kind = type(method).__name__
        raise InputError(f"{source}: {point.value} is a {kind}, not a {Description.__module__}")
    if method.name != point.name:
        raise InputError(f"{source}: its method is called {method.name!r} (give both one name)")
    for name, section in method.sections.items():
        for other in methods.values():
            for taken, existing in other.sections.items():
                if existing is section:  # methods may share a section as a whole
                    continue
                if name == taken:
                    raise InputError(f"{source}: section [{name}] is that of another method")
                if keys := sorted(section.model_fields.keys() & existing.model_fields.keys()):
                    raise InputError(f"{source}: key {keys[0]} is one of section [{taken}]")
    return method


def check_plugin(name: str, description: Description, method: Any, params: Any, site: Any) -> None:
    """Check the shapes of a plug-in's functions without running them (`jax.eval_shape`).

    Args:
        name: of the plug-in's method, with its package, for the message.
        description: of the method.
        method: the `base.Method` that it builds.
        params: of one run, leaves (...).
        site: `base.Site` of one run.

    Raises:
        InputError: ``step`` returns another state than ``init``, or ``attitude``, ``covariance``
            or ``error_model`` is not what the description promises.
    """
    import jax
    import numpy as np

    from sinsjax.methods.base import AttitudeCovariance
    from sinsjax.types import Navigation, Quat, Sample, Vec3

    def structure(tree: Any) -> Any:
        return jax.tree.map(lambda leaf: (leaf.shape, leaf.dtype), tree)

    number = np.float64(0.0)
    q = Quat(*(number,) * 4)
    nav, sample = Navigation(q, *(number,) * 4), Sample(q, Vec3(*(number,) * 3))
    state = jax.eval_shape(method.init, params, nav)
    later = jax.eval_shape(method.step, params, site, state, sample, number)
    if structure(later) != structure(state):
        raise InputError(
            f"{name}: step returns the state {_format_shapes(later)}, init {_format_shapes(state)}"
        )
    for field, kind in (("attitude", Quat), ("covariance", AttitudeCovariance)):
        returned = jax.eval_shape(getattr(method, field), state)
        if not isinstance(returned, kind) or any(np.shape(leaf) for leaf in returned):
            text = f"{field} returns {_format_shapes(returned)}, not a {kind.__name__} of numbers"
            raise InputError(f"{name}: {text}")
    if description.has_error_model and method.error_model is None:
        raise InputError(f"{name}: has_error_model is True, but its Method has no error_model")


def describe_plugin_error(error: BaseException) -> str | None:
    """Return one line with the place in a plug-in's code that an error is from, None if from none.

    The line names the package, the kind of error, file and line.
    """
    for point in runtime.method_entry_points():
        if where := _last_place(error, _package_folders(point)):
            text = f"{type(error).__name__}: {first_line(error)}{where}"
            return f"method {point.name!r}{_package_label(point)}: {text}"
    return None


def _package_label(point: EntryPoint) -> str:
    return f" of {point.dist.name} {point.dist.version}" if point.dist else ""


def _last_place(error: BaseException, folders: tuple[str, ...]) -> str | None:
    """Return the last place of a traceback in some folders, as ``, in file:line``."""
    frames = traceback.extract_tb(error.__traceback__)
    inside = [frame for frame in frames if frame.filename.startswith(folders)] if folders else []
    return f", in {inside[-1].filename}:{inside[-1].lineno}" if inside else None


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


def _format_shapes(tree: Any) -> str:
    """Return a tree of shapes on one line."""
    import jax

    return str(jax.tree.map(lambda leaf: f"{leaf.dtype}{list(leaf.shape)}", tree)).replace("'", "")
