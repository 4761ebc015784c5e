"""Alignment methods of other installed packages, found by their entry points.

A package names its `Method` in its ``pyproject.toml``:

    [project.entry-points."sinsjax.methods"]
    my_method = "my_package:MY_METHOD"

A plug-in that cannot be loaded affects only the studies that use it. An error of its code is
reported in one line with the place in that code, see `describe_plugin_error`.
"""

import traceback
from collections.abc import Iterable, Mapping
from importlib.metadata import EntryPoint
from importlib.util import find_spec
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
    """All methods, and the state of the plug-ins.

    Attributes:
        methods: usable methods by name, the built-in ones first.
        sections: their sections of a study file, by name.
        packages: package and version of each method of a plug-in, by name.
        broken: reason in one line why a plug-in cannot be used, by the name of its entry point.
    """

    methods: dict[str, Method]
    sections: dict[str, type[Section]]
    packages: dict[str, tuple[str, str]]
    broken: dict[str, str]

    def label(self, name: str) -> str:
        """Return the name of a plug-in's method with its package, for messages."""
        return f"method {name!r} of {' '.join(self.packages[name])}"

    def add(self, method: Method) -> None:
        """Add a method whose name, sections and keys are new.

        Raises:
            InputError: they are not.
        """
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

    Args:
        name: of the plug-in's method, with its package, for the message.
        program: the program that it builds.
        params: its params, leaves (variants, ...).
        variants: number of variants.
        site: `Site` of one run.
        passes: "once", or how a stored record is read repeatedly.

    Raises:
        InputError: a param has not one value per variant; the state after a sample is another than
            that of ``init``; ``attitude`` or ``covariance`` is not that of one run; or a record is
            read in a way that the method has no ``passes`` for.
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
        return (after, program.attitude(state), covariance), (state, nav.q, unknown)

    zero = np.float64(0.0)
    q, unknown = Quat(*(zero,) * 4), AttitudeCovariance(*(zero,) * 6)
    nav, sample = Navigation(q, *(zero,) * 4), Sample(q, Vec3(*(zero,) * 3))
    of_run = jax.tree.map(lambda leaf: np.asarray(leaf)[0], params)
    found, expected = jax.eval_shape(first_sample, of_run, nav, sample)
    for what, one, other in zip(
        ("step, normalise or close", "attitude", "covariance"), found, expected, strict=True
    ):
        texts = [
            str(jax.tree.map(lambda leaf: f"{leaf.dtype}{[*leaf.shape]}", tree)).replace("'", "")
            for tree in (one, other)
        ]
        if texts[0] != texts[1]:
            returned, wanted = (shorten(text, 300) for text in texts)
            raise InputError(f"{name}: {what} returns {returned}, expected {wanted}")


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
    try:  # the folders of the package, without importing it
        spec = find_spec(point.module.partition(".")[0])
    except (AttributeError, ImportError, ValueError):
        spec = None
    if spec is None:
        return ""
    folders = tuple(f"{folder}/" for folder in spec.submodule_search_locations or ())
    frames = traceback.extract_tb(error.__traceback__)
    inside = [f for f in frames if f.filename.startswith(folders or (str(spec.origin),))]
    return f", in {inside[-1].filename}:{inside[-1].lineno}" if inside else ""
