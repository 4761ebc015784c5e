"""All alignment methods by name; a new one is registered here.

Plug-in methods of other packages are found by their entry points, see `plugins`.
"""

from collections.abc import Callable, Iterable
from typing import Any, NoReturn

from sinsjax.errors import InputError
from sinsjax.methods.azimuth import EKF_AZIMUTH, UNSCENTED
from sinsjax.methods.compass import COMPASS
from sinsjax.methods.gravity_fit.method import GRAVITY_FIT
from sinsjax.methods.inertial_frame import INERTIAL, OPTIMISATION, OPTIMISATION_POSITION
from sinsjax.methods.invariant import INVARIANT
from sinsjax.methods.level import LEVEL
from sinsjax.methods.method import Method, Options, Program
from sinsjax.methods.plugins import load_plugins
from sinsjax.methods.sincos import SINCOS
from sinsjax.methods.surge import SURGE
from sinsjax.methods.zero_velocity import KALMAN5, KALMAN10
from sinsjax.value_types import Section

REGISTRY = load_plugins(
    (
        KALMAN5,
        KALMAN10,
        SINCOS,
        SURGE,
        EKF_AZIMUTH,
        INVARIANT,
        UNSCENTED,
        OPTIMISATION,
        OPTIMISATION_POSITION,
        INERTIAL,
        GRAVITY_FIT,
        COMPASS,
        LEVEL,
    )
)
"""All methods with their sections, and the state of the plug-ins."""

METHODS: dict[str, Method] = REGISTRY.methods
"""Every method; a study names one, and the engine runs its program."""

SECTIONS_OF_METHODS: dict[str, type[Section]] = REGISTRY.sections
"""The sections of a study that belong to methods, by name."""

PACKAGES: dict[str, tuple[str, str]] = REGISTRY.packages
"""Package and version of each method of a plug-in."""

BROKEN: dict[str, str] = REGISTRY.broken
"""Reason why a plug-in cannot be used, in one line, by the name of its entry point.

`METHODS` may have a usable method of the same name.
"""


def _refuse_run(*arguments: Any) -> NoReturn:
    raise InputError("a program outside sinsjax cannot be run here (`sinsjax score` compares it)")


def _made_elsewhere(options: Options) -> Program:
    return Program(_refuse_run, _refuse_run, _refuse_run, covariance=_refuse_run)


def register_external(
    names: Iterable[str], build: Callable[[Options], Program] = _made_elsewhere
) -> None:
    """Make programs outside sinsjax known as methods, as a study with their results needs.

    Args:
        names: of the programs.
        build: builds the `Program` in whose place their attitudes are judged.

    Raises:
        InputError: a name is that of a method of sinsjax.
    """
    for name in names:
        if name in METHODS and not METHODS[name].is_external:
            raise InputError(f"{name!r} is a method of sinsjax (give the program another name)")
        if name in METHODS and build is _made_elsewhere:
            continue  # a study with its results is loaded again
        METHODS[name] = Method(
            name,
            "a program outside sinsjax, whose results were scored",
            "`sinsjax score`",
            build,
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
