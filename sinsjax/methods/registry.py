"""All alignment methods by name; a new one is registered here.

Plug-in methods of other packages are found by their entry points:

    [project.entry-points."sinsjax.methods"]
    my_method = "my_package:MY_METHOD"

A plug-in that cannot be used affects only the studies that name it.
"""

from collections.abc import Callable, Iterable, Mapping
from typing import Any, NoReturn

import jax
import numpy as np

from sinsjax.errors import InputError
from sinsjax.messages import first_error_line, shorten
from sinsjax.methods.azimuth import EKF_AZIMUTH, UNSCENTED
from sinsjax.methods.compass import COMPASS
from sinsjax.methods.gravity_fit.method import GRAVITY_FIT
from sinsjax.methods.inertial_frame import INERTIAL, OPTIMISATION, OPTIMISATION_POSITION
from sinsjax.methods.invariant import INVARIANT
from sinsjax.methods.level import LEVEL
from sinsjax.methods.method import AttitudeCovariance, Method, Options, Program
from sinsjax.methods.sincos import SINCOS, SURGE
from sinsjax.methods.zero_velocity import KALMAN5, KALMAN10
from sinsjax.platform import runtime
from sinsjax.types import Navigation, Quat, Sample, Vec3
from sinsjax.value_types import Section

METHODS: dict[str, Method] = {}
"""Every method; a study names one, and the engine runs its program."""

SECTIONS_OF_METHODS: dict[str, type[Section]] = {}
"""The sections of a study that belong to methods, by name."""

PACKAGES: dict[str, tuple[str, str]] = {}
"""Package and version of each method of a plug-in."""

BROKEN: dict[str, str] = {}
"""Reason why a plug-in cannot be used, in one line, by the name of its entry point.

`METHODS` may have a usable method of the same name.
"""


def add_method(method: Method) -> None:
    """Add a method; an `InputError` says which name, section or key of it is not new."""
    if method.name in METHODS:
        raise InputError(f"there is already a method {method.name!r}")
    _refuse_clashing_sections_and_keys(method, SECTIONS_OF_METHODS)
    METHODS[method.name] = method
    SECTIONS_OF_METHODS.update(method.sections)


def _refuse_clashing_sections_and_keys(method: Method, taken: Mapping[str, type[Section]]) -> None:
    """Refuse a method with a section or key that others have; methods may share a section."""
    for name, section in method.sections.items():
        for other, existing in taken.items():
            if existing is section:
                continue
            if name == other:
                raise InputError(f"there is already a section [{name}]")
            if keys := sorted(section.model_fields.keys() & existing.model_fields.keys()):
                raise InputError(f"[{name}] {keys[0]} is a key of [{other}]")


def add_plugins_or_mark_broken() -> None:
    """Add the methods of plug-ins; none replaces another."""
    for point in runtime.method_entry_points():
        package = (point.dist.name, point.dist.version) if point.dist else ("?", "?")
        try:
            method = point.load()
            add_method(method)
        except (Exception, SystemExit) as error:  # anything that the code of others raises
            source = f"entry point {point.name!r} in {point.group} of {' '.join(package)}"
            BROKEN[point.name] = f"{source}: {type(error).__name__}: {first_error_line(error)}"
        else:
            PACKAGES[method.name] = package


def check_plugin(name: str, program: Program, params: Any, variants: int, site: Any) -> None:
    """Check what a plug-in's functions return, without running them (`jax.eval_shape`).

    Its params, leaves (variants, ...), need one value per variant; the state after a sample must be
    like that of ``init``, attitude and covariance like those of one run at a `Site`.

    Raises:
        InputError: the first of these that fails; begins with the name, that of the method.
    """
    if any(np.shape(leaf)[:1] != (variants,) for leaf in jax.tree.leaves(params)):
        raise InputError(f"{name}: params must return one value per variant")

    def returned_and_wanted_outputs(params: Any, nav: Navigation, sample: Sample) -> dict[str, Any]:
        state = program.init(params, nav)
        after = program.normalise(program.step(params, site, state, sample, nav.ve))
        if program.feedback is not None:
            after = program.feedback.close(params, after, nav.ve)
        covariance = unknown if program.covariance is None else program.covariance(state)
        return {
            "step, normalise or close": (after, state),
            "attitude": (program.attitude(state), nav.q),
            "covariance": (covariance, unknown),
        }

    zero = np.float64(0.0)
    q, unknown = Quat(*(zero,) * 4), AttitudeCovariance(*(zero,) * 6)
    nav, sample = Navigation(q, *(zero,) * 4), Sample(q, Vec3(*(zero,) * 3))
    of_run = jax.tree.map(lambda leaf: np.asarray(leaf)[0], params)
    shapes = jax.eval_shape(returned_and_wanted_outputs, of_run, nav, sample)
    for what, (returned, wanted) in shapes.items():
        if returned != wanted:
            texts = f"{shorten(str(returned), 300)}, expected {shorten(str(wanted), 300)}"
            raise InputError(f"{name}: {what} returns {texts}")


def move_clashing_plugins_to_broken(reserved: Mapping[str, type[Section]]) -> None:
    """Make plug-ins unusable that have a section or key of the given ones, of every study."""
    for name in list(PACKAGES):
        try:
            _refuse_clashing_sections_and_keys(METHODS[name], reserved)
        except InputError as error:
            BROKEN[name] = f"method {name!r} of {' '.join(PACKAGES.pop(name))}: {error}"
            del METHODS[name]
    used = {name for method in METHODS.values() for name in method.sections}
    for name in SECTIONS_OF_METHODS.keys() - used:
        del SECTIONS_OF_METHODS[name]


for _built_in in (
    *(KALMAN5, KALMAN10, SINCOS, SURGE, EKF_AZIMUTH, INVARIANT, UNSCENTED),
    *(OPTIMISATION, OPTIMISATION_POSITION, INERTIAL, GRAVITY_FIT, COMPASS, LEVEL),
):
    add_method(_built_in)
add_plugins_or_mark_broken()


def _refuse_run(*arguments: Any) -> NoReturn:
    raise InputError("a program outside sinsjax cannot be run here (`sinsjax score` compares it)")


_REFUSED = Program(_refuse_run, _refuse_run, _refuse_run, covariance=_refuse_run)


def register_external(
    names: Iterable[str], build: Callable[[Options], Program] | None = None
) -> None:
    """Make programs outside sinsjax known as methods, as a study with their results needs.

    Args:
        names: of the programs.
        build: builds the `Program` in whose place their attitudes are judged; None for one that
            cannot be run.

    Raises:
        InputError: a name is that of a method of sinsjax.
    """
    for name in names:
        if name in METHODS and not METHODS[name].is_external:
            raise InputError(f"{name!r} is a method of sinsjax (give the program another name)")
        if build is None and name in METHODS:
            continue  # a study with its results is loaded again
        METHODS[name] = Method(
            name,
            "a program outside sinsjax, whose results were scored",
            "`sinsjax score`",
            build or (lambda options: _REFUSED),
            without_effect=("position",),
            is_external=True,
        )


def external_names(names: Iterable[str]) -> list[str]:
    """Return the names that are those of programs outside sinsjax."""
    return [name for name in names if name in METHODS and METHODS[name].is_external]


def packages_of(names: Iterable[str]) -> dict[str, str]:
    """Return the packages of those methods that are of plug-ins, and their versions."""
    return dict(PACKAGES[name] for name in names if name in PACKAGES)


def unread_keys(names: Iterable[str]) -> set[str]:
    """Return the keys that only methods other than these read."""
    read = {key for name in names for key in METHODS[name].keys}
    return {key for method in METHODS.values() for key in method.keys} - read
