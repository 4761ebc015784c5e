"""Conversion factors between the units of studies and results and the SI units used inside.

Multiply by a factor to convert to SI, divide to convert from it: ``0.1 * DEG_PER_H`` is in rad/s.
"""

import math

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

SUFFIXES = {
    "arcmin": "arcmin",
    "arcsec": "arcsec",
    "deg": "deg",
    "deg_per_h": "deg/h",
    "deg_per_h_per_sqrt_h": "deg/h/sqrt(h)",
    "deg_per_h_rms": "deg/h rms",
    "deg_per_s": "deg/s",
    "deg_per_h_per_sqrt_hz": "deg/h/sqrt(Hz)",
    "deg_per_sqrt_h": "deg/sqrt(h)",
    "hz": "Hz",
    "m": "m",
    "m_per_s": "m/s",
    "m_per_s2": "m/s^2",
    "per_s": "1/s",
    "ppm": "ppm",
    "s": "s",
    "ug": "ug",
    "ug_per_sqrt_h": "ug/sqrt(h)",
    "ug_rms": "ug rms",
    "um_per_s": "um/s",
    "ug_per_sqrt_hz": "ug/sqrt(Hz)",
}
"""Unit suffixes of keys and columns, and their units."""


def split_unit(name: str) -> tuple[str, str]:
    """Split the name of a key or column into its stem and its unit.

    ``gyro_bias_deg_per_h`` gives ``gyro_bias`` and ``deg/h``; a name without a unit gives itself
    and an empty string.
    """
    suffix = max((s for s in SUFFIXES if name.endswith(f"_{s}")), key=len, default="")
    return (name.removesuffix(f"_{suffix}"), SUFFIXES[suffix]) if suffix else (name, "")


def micro_g(gravity: float = STANDARD_GRAVITY) -> float:
    """One ug in m/s^2, for a given g (m/s^2): the papers use g = 9.8."""
    return MICRO * gravity
