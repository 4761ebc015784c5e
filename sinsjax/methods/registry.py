"""Alignment methods by name: this is where a method is registered. Free of JAX.

Those of other packages register themselves, see `from_outside`.
"""

from collections.abc import Iterable

from sinsjax.methods.azimuth.description import EKF_AZIMUTH, UNSCENTED
from sinsjax.methods.compass.description import COMPASS
from sinsjax.methods.description import Description
from sinsjax.methods.inertial_frame.description import (
    INERTIAL,
    OPTIMISATION,
    OPTIMISATION_POSITION,
)
from sinsjax.methods.invariant.description import INVARIANT
from sinsjax.methods.plugins import with_those_from_outside
from sinsjax.methods.sincos.description import SINCOS, SURGE
from sinsjax.methods.zero_velocity.description import KALMAN5, KALMAN10
from sinsjax.value_types import Section

_BROUGHT = with_those_from_outside(
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
        COMPASS,
    )
)

METHODS: dict[str, Description] = _BROUGHT.methods
"""Every method; a study names one, the engine drives it through `base.Method`."""

PACKAGES: dict[str, tuple[str, str]] = _BROUGHT.packages
"""Package and version of each method that another package brings."""

BROKEN: dict[str, str] = _BROUGHT.broken
"""Why a method that another package brings cannot be used, in a line, by its name.

Where `METHODS` has one of that name, it is another one, which can.
"""

SECTIONS_OF_METHODS: dict[str, type[Section]] = {
    name: section for method in METHODS.values() for name, section in method.sections.items()
}
"""The sections of a study that methods bring with them, by name."""


def packages_of(names: Iterable[str]) -> dict[str, str]:
    """The packages that bring some methods, and their versions."""
    return dict(PACKAGES[name] for name in names if name in PACKAGES)


def from_package(name: str) -> str:
    """A method that another package brings, as messages name it."""
    return f"method {name!r} of {' '.join(PACKAGES.get(name, ('another package',)))}"


def unusable() -> str:
    """Where to look for what is unknown, as a method may be there that cannot be used; else empty.

    An entry point may be one of another name than its method's, which is not known then.
    """
    text = "an installed package brings a method that cannot be used, `sinsjax info` shows why"
    return f" ({text})" if BROKEN else ""


def keys_unread(names: Iterable[str]) -> set[str]:
    """The keys that other methods read, and none of some."""
    read = {key for name in names for key in METHODS[name].keys}
    return {key for method in METHODS.values() for key in method.keys} - read
