"""Alignment methods of other installed packages, found by their entry points.

A package names its `Method` in its ``pyproject.toml``:

    [project.entry-points."sinsjax.methods"]
    my_method = "my_package:MY_METHOD"

A plug-in that cannot be loaded affects only the studies that use it. An error of its code is
reported in one line with the place in that code, see `describe_plugin_error`.
"""

from collections.abc import Iterable, Mapping
from importlib.metadata import EntryPoint
from traceback import walk_tb
from typing import Any, NamedTuple

import jax
import numpy as np

from sinsjax.errors import InputError
from sinsjax.messages import first_error_line, shorten
from sinsjax.methods.method import AttitudeCovariance, Method, Program
from sinsjax.platform import runtime
from sinsjax.types import Navigation, Quat, Sample, Vec3
from sinsjax.value_types import Section


class PluginRegistry(NamedTuple):
    """All methods, and the state of the plug-ins; all by name."""

    methods: dict[str, Method]  # usable ones, the built-in ones first
    sections: dict[str, type[Section]]  # their sections of a study file
    packages: dict[str, tuple[str, str]]  # package and version of each method of a plug-in
    broken: dict[str, str]  # in one line, why the plug-in of an entry point cannot be used

    def label(self, name: str) -> str:
        """Return the name of a plug-in's method with its package, for messages."""
        return f"method {name!r} of {' '.join(self.packages[name])}"

    def add(self, method: Method) -> None:
        """Add a method; an `InputError` says which name, section or key of it is not new."""
        if method.name in self.methods:
            raise InputError(f"there is already a method {method.name!r}")
        if clash := _find_clash(method, self.sections):
            raise InputError(clash)
        self.methods[method.name] = method
        self.sections.update(method.sections)


def load_plugins(built_in: Iterable[Method]) -> PluginRegistry:
    """Return the built-in methods and those of plug-ins; none replaces another."""
    registry = PluginRegistry({}, {}, {}, {})
    for method in built_in:
        registry.add(method)
    for point in runtime.method_entry_points():
        try:
            method = point.load()
            registry.add(method)
        except (Exception, SystemExit) as error:  # anything that the code of others raises
            reason = str(error)
            if not isinstance(error, InputError):
                reason = f"cannot be loaded ({_describe_error(error, point)})"
            source = f"entry point {point.name!r} in {point.group}{_package_label(point)}"
            registry.broken[point.name] = f"{source}: {reason}"
            continue
        if point.dist is not None:
            registry.packages[method.name] = point.dist.name, point.dist.version
    return registry


def exclude_clashing(registry: PluginRegistry, common: Mapping[str, type[Section]]) -> None:
    """Make plug-ins of a registry unusable that have a section or key of every study."""
    for name in list(registry.packages):
        if clash := _find_clash(registry.methods[name], common):
            registry.broken[name] = f"{registry.label(name)}: {clash}"
            del registry.methods[name], registry.packages[name]
    used = {name for method in registry.methods.values() for name in method.sections}
    for name in registry.sections.keys() - used:
        del registry.sections[name]


def _find_clash(method: Method, taken: Mapping[str, type[Section]]) -> str | None:
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
    name: str, program: Program, params: Any, variants: int, site: Any, *, passes: str = "once"
) -> None:
    """Check what a plug-in's functions return, without running them (`jax.eval_shape`).

    Its params, leaves (variants, ...), need one value per variant; the state after a sample must be
    like that of ``init``, attitude and covariance like those of one run at a `Site`; and a record
    can be read repeatedly ("alternate" or "rewind") only with ``passes``.

    Raises:
        InputError: the first of these that fails; begins with the name, that of the method.
    """
    if any(np.shape(leaf)[:1] != (variants,) for leaf in jax.tree.leaves(params)):
        raise InputError(f"{name}: params must return one value per variant")
    if passes != "once" and program.passes is None:
        raise InputError(f"{name}: reads a stored record once (drop [passes])")
    if passes == "rewind" and program.passes and program.passes.rewind is None:
        raise InputError(f"{name}: cannot rewind a record (use direction = 'alternate')")

    def first_sample(params: Any, nav: Navigation, sample: Sample) -> Any:
        state = program.init(params, nav)
        after = program.normalise(program.step(params, site, state, sample, nav.ve))
        if program.feedback is not None:
            after = program.feedback.close(params, after, nav.ve)
        covariance = unknown if program.covariance is None else program.covariance(state)
        return (after, state), (program.attitude(state), nav.q), (covariance, unknown)

    def describe(tree: Any) -> str:
        leaves = jax.tree.map(lambda leaf: f"{leaf.dtype}{[*leaf.shape]}", tree)
        return str(leaves).replace("'", "")

    zero = np.float64(0.0)
    q, unknown = Quat(*(zero,) * 4), AttitudeCovariance(*(zero,) * 6)
    nav, sample = Navigation(q, *(zero,) * 4), Sample(q, Vec3(*(zero,) * 3))
    of_run = jax.tree.map(lambda leaf: np.asarray(leaf)[0], params)
    pairs = jax.eval_shape(first_sample, of_run, nav, sample)
    names = "step, normalise or close", "attitude", "covariance"
    for what, pair in zip(names, pairs, strict=True):
        returned, wanted = map(describe, pair)
        if returned != wanted:
            texts = f"{shorten(returned, 300)}, expected {shorten(wanted, 300)}"
            raise InputError(f"{name}: {what} returns {texts}")


def describe_plugin_error(error: BaseException) -> str | None:
    """Return method, package, kind, file and line of an error of a plug-in's code; else None."""
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
    package = point.module.partition(".")[0]
    inside = [
        f", in {frame.f_code.co_filename}:{line}"
        for frame, line in walk_tb(error.__traceback__)
        if frame.f_globals.get("__name__", "").partition(".")[0] == package
    ]
    return inside[-1] if inside else ""
