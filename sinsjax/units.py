"""Conversion factors between the units of studies and results and the SI units used inside.

Multiply by a factor to convert to SI, divide to convert from it: ``0.1 * DEG_PER_H`` is in rad/s.
"""

import math
from functools import cache
from typing import NamedTuple

STANDARD_GRAVITY = 9.80665
"""m/s^2; the g of a datasheet's ug, and of records that do not state their own."""

DEG = math.pi / 180
ARCMIN = DEG / 60
ARCSEC = DEG / 3600
HOUR = 3600.0
DEG_PER_H = DEG / HOUR
DEG_PER_SQRT_H = DEG / math.sqrt(HOUR)
PPM = 1e-6
MICRO = 1e-6


class Unit(NamedTuple):
    """A unit by the suffix of keys and columns."""

    text: str  # as it is printed
    si: float = 1.0  # its size in SI units; with ug, its size in m/s^2 for a ug of 1 m/s^2


SUFFIXES = {
    "arcmin": Unit("arcmin", ARCMIN),
    "arcsec": Unit("arcsec", ARCSEC),
    "deg": Unit("deg", DEG),
    "deg_per_h": Unit("deg/h", DEG_PER_H),
    "deg_per_h_per_sqrt_h": Unit("deg/h/sqrt(h)", DEG_PER_H / math.sqrt(HOUR)),
    "deg_per_h_per_sqrt_hz": Unit("deg/h/sqrt(Hz)", DEG_PER_H),
    "deg_per_h_rms": Unit("deg/h rms", DEG_PER_H),
    "deg_per_s": Unit("deg/s", DEG),
    "deg_per_sqrt_h": Unit("deg/sqrt(h)", DEG_PER_SQRT_H),
    "hz": Unit("Hz"),
    "m": Unit("m"),
    "m_per_s": Unit("m/s"),
    "m_per_s2": Unit("m/s^2"),
    "per_s": Unit("1/s"),
    "ppm": Unit("ppm", PPM),
    "s": Unit("s"),
    "ug": Unit("ug"),
    "ug_per_sqrt_h": Unit("ug/sqrt(h)", 1 / math.sqrt(HOUR)),
    "ug_per_sqrt_hz": Unit("ug/sqrt(Hz)"),
    "ug_rms": Unit("ug rms"),
    "um_per_s": Unit("um/s", MICRO),
}
"""Units of keys and columns by the suffix of their names."""


@cache
def _find_suffix(name: str) -> str:
    return max((s for s in SUFFIXES if name.endswith(f"_{s}")), key=len, default="")


def split_unit(name: str) -> tuple[str, str]:
    """Split the name of a key or column into its stem and its unit.

    ``gyro_bias_deg_per_h`` gives ``gyro_bias`` and ``deg/h``; a name without a unit gives itself
    and an empty string.
    """
    suffix = _find_suffix(name)
    return (name.removesuffix(f"_{suffix}"), SUFFIXES[suffix].text) if suffix else (name, "")


def si_factor(name: str, ug: float | None = None) -> float:
    """Return the factor from the unit of a key or column to SI units; 1 for a name without a unit.

    The micro-g is that of the study, m/s^2, or of standard gravity.
    """
    suffix = _find_suffix(name)
    factor = SUFFIXES[suffix].si if suffix else 1.0
    return factor * (ug or micro_g()) if suffix.startswith("ug") else factor


def micro_g(gravity: float = STANDARD_GRAVITY) -> float:
    """One ug in m/s^2, for a given g (m/s^2): the papers use g = 9.8."""
    return MICRO * gravity
