"""Alignment methods by name: this is where a method is registered. Free of JAX.

Those of other packages register themselves, see `from_outside`.
"""

from collections.abc import Iterable

from sinsjax.alignment.azimuth.description import EKF_AZIMUTH, UNSCENTED
from sinsjax.alignment.compass.description import COMPASS
from sinsjax.alignment.description import Description
from sinsjax.alignment.from_outside import with_those_from_outside
from sinsjax.alignment.inertial_frame.description import (
    INERTIAL,
    OPTIMISATION,
    OPTIMISATION_POSITION,
)
from sinsjax.alignment.invariant.description import INVARIANT
from sinsjax.alignment.sincos.description import SINCOS, SURGE
from sinsjax.alignment.zero_velocity.description import KALMAN5, KALMAN10
from sinsjax.value_types import Section

METHODS: dict[str, Description] = with_those_from_outside(
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
"""Every method; a study names one, the engine drives it through `base.Method`."""

SECTIONS_OF_METHODS: dict[str, type[Section]] = {
    name: section for method in METHODS.values() for name, section in method.sections.items()
}
"""The sections of a study that methods bring with them, by name."""


def keys_unread(names: Iterable[str]) -> set[str]:
    """The keys that other methods read, and none of some."""
    read = {key for name in names for key in METHODS[name].keys}
    return {key for method in METHODS.values() for key in method.keys} - read
